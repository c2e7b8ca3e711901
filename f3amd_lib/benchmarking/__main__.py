"""Time rounds and training steps: what `python -m f3amd_lib bench` runs in a process of its own.

XLA reads its flags when JAX starts, so that they are in the environment before this runs.
"""

from __future__ import annotations

import argparse
import logging
import sys

from f3amd_lib.benchmarking.measurements import measure_round_parts, measure_synthesis_time, measure_training_time
from f3amd_lib.benchmarking.speed_tables import speed_bars
from f3amd_lib.benchmarking.synthesis import SUITES
from f3amd_lib.ground.profiles import load_profile
from f3amd_lib.ground.records import read_table
from f3amd_lib.ground.tables import markdown_table
from f3amd_lib.training.pipeline import prepare

log = logging.getLogger("f3amd")


def main(arguments: list[str] | None = None) -> int:
    """Run the command line of `f3amd bench`; 2 for what the user has to mend."""
    parser = argparse.ArgumentParser(prog="f3amd bench")
    add_arguments(parser)
    options = parser.parse_args(arguments)
    logging.basicConfig(level=logging.INFO, format="%(message)s", stream=sys.stdout)
    logging.getLogger("jax").setLevel(logging.WARNING)
    try:
        profile = load_profile(options.profile, options.data)
        prepared = prepare(profile, path=options.source)
        if options.suite or not (options.training or options.parts):
            path = measure_synthesis_time(
                prepared, profile, options.suite, characters=options.characters, again=options.again
            )
            ways = path.with_name("synthesis_ways.csv")
            suite = "bars" if options.suite == ["bars"] else "main"
            log.info("\n%s\n", markdown_table(speed_bars(read_table(ways)[0], suite=suite), digits=3))
            log.info("every way    %s\nfastest      %s", ways, path)
        if options.parts:
            log.info("parts        %s", measure_round_parts(prepared, profile))
        if options.training:
            log.info("training     %s", measure_training_time(prepared, profile))
    except (ValueError, OSError) as error:
        print(f"f3amd bench: {error}", file=sys.stderr)
        return 2
    return 0


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of `f3amd bench` to a parser."""
    from f3amd_lib.ground.profiles import DATASETS, PROFILES

    parser.add_argument("--data", default="synthetic", choices=DATASETS, help="its sizes are taken")
    parser.add_argument("--profile", default="laptop", choices=PROFILES)
    parser.add_argument("--source", help="folder or archive, for data sets that need one")
    parser.add_argument("--suite", action="append", help=f"{', '.join(SUITES)}; repeatable")
    parser.add_argument("--characters", type=int, action="append", help="these numbers only")
    parser.add_argument("--again", action="store_true", help="time anew what is in the table")
    parser.add_argument("--training", action="store_true", help="time training steps (Table 2)")
    parser.add_argument("--parts", action="store_true", help="time a round without each part")


if __name__ == "__main__":
    sys.exit(main())
