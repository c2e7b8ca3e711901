"""Write the pages of the site that move: the walk of its first page, walkers and crowds.

    python docs/players.py docs/_build/html

Walks are read from the results (`media/*.bvh`); a crowd is made anew, in about a minute on two cores.
Pages that the site links to are those of `pages.PLAYERS`.
"""

from __future__ import annotations

import os
import shutil
import sys
import tempfile
from pathlib import Path

DOCS = Path(__file__).resolve().parent
sys.path[:0] = [str(DOCS / "_ext"), str(DOCS.parent), str(DOCS.parent / "scripts")]

import pages  # noqa: E402 (the line above is what finds it)
import side_by_side  # noqa: E402

from f3amd_companion.__main__ import main as command  # noqa: E402
from f3amd_companion.serving.player import Scene, write_player  # noqa: E402
from f3amd_lib.data.sources import DATA_DIR_VARIABLE  # noqa: E402
from f3amd_lib.ground.profiles import load_profile  # noqa: E402
from f3amd_lib.motion.bvh import read_bvh  # noqa: E402
from f3amd_lib.motion.skeleton import resample  # noqa: E402
from f3amd_lib.training.checkpoints import load_model  # noqa: E402
from f3amd_lib.training.pipeline import PRETRAINED_DIR, prepare  # noqa: E402

CROWD = ("--characters", "64", "--seconds", "8", "--plan", "--pictures")


def write_first(site: Path) -> None:
    """Write the walk of the first page: what our recipe makes of a real clip's first frames and path.

    The clip itself is no part of the repository: it walks beside it where F3AMD_DATA_DIR says where the data are.
    """
    folder, model = pages.ROOT / "paper_figures" / "bandai" / "laptop", side_by_side.SYSTEMS[0][0]
    walks = [Scene(read_bvh(folder / "media/side_by_side_steady.bvh"), title=f"{model}, ours: 8 steps a window")]
    if os.environ.get(DATA_DIR_VARIABLE):
        packed = prepare(load_profile("laptop", "bandai")).packed
        config = load_model(PRETRAINED_DIR / f"bandai/{model}.safetensors").config
        real = side_by_side.followed(packed, config)[-1]
        walks.insert(0, Scene(resample(real, side_by_side.FPS), title="A real clip"))
    write_player(site / "players" / "first.html", walks, strip=False, credit=pages.credit_line(folder))


def write_walker(folder: Path, page: Path) -> None:
    """Write the page of the walker that a run of notebook 14 left among its results."""
    walker = read_bvh(folder / "media" / "14_walker.bvh").replace(name=f"One of the crowd, data {folder.parent.name}")
    write_player(page, walker, strip=False, credit=pages.credit_line(folder))


def write_crowd(folder: Path, page: Path) -> None:
    """Write the page of a crowd that the shipped weights of the data set make."""
    with tempfile.TemporaryDirectory() as made:
        status = command(["crowd", "--data", folder.parent.name, *CROWD, "--out", f"{made}/crowd"])
        if status:
            raise SystemExit(f"{page.name}: no crowd could be made (status {status})")
        page.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(f"{made}/crowd.html", page)


WRITERS = {"14_crowd": write_crowd, "14_walker": write_walker}


def main(site: Path) -> None:
    for folder, name in pages.players():
        WRITERS[name](folder, site / pages.player_address(folder, name))


if __name__ == "__main__":
    site = Path(sys.argv[1])
    write_first(site)
    main(site)
