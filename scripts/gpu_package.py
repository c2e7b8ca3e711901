"""Lay out what a GPU elsewhere needs for a package of gpu_plan.toml: the library, the plan, the packed clips of Bandai.

    python scripts/gpu_package.py FOLDER --package A --minutes 9 [--packed FILE]

There, with JAX for its GPU and the library's other packages installed: `cd FOLDER && bash run.sh`. It goes on where it
was stopped, and leaves weights under FOLDER/states, which `f3amd campaign --package A --measure --out states` measures
on any machine. Bandai's clips keep their terms (CC BY-NC 4.0): do not hand the folder on without them.
"""

from __future__ import annotations

import argparse
import shutil
import sys
import tomllib
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))  # this tree's library, whatever is installed

from f3amd_lib.data.packed import cache_folder
from f3amd_lib.ground.names import check_known

ROOT = Path(__file__).resolve().parents[1]
MOST_BYTES = 55_000_000
PLAN = ROOT / "f3amd_lib" / "papers" / "f3amd" / "gpu_plan.toml"
PACKAGES = ("f3amd_lib", "f3amd_companion")
LEFT_OUT = shutil.ignore_patterns("pretrained", "__pycache__", "*.pyc", ".ipynb_checkpoints")
BESIDE = ("pyproject.toml", "README.md", "LICENSE", "NOTICE")
RUN = """\
#!/usr/bin/env bash
# Train package {package} of gpu_plan.toml for {minutes:g} minutes; the next call goes on.
set -euo pipefail
cd "$(dirname "${{BASH_SOURCE[0]}}")"
# XLA would try out fusions for longer than a short training takes. Products it may try out: on an H200 a step of 512
# windows takes 5.7 ms then, and 20 ms with --xla_gpu_autotune_level=0.
export XLA_FLAGS="--xla_gpu_enable_triton_gemm=false --xla_gpu_experimental_enable_fusion_autotuner=false"
export JAX_COMPILATION_CACHE_DIR="$PWD/jax-cache" XLA_PYTHON_CLIENT_PREALLOCATE=false
python3 -m f3amd_companion campaign --data bandai --profile laptop --packed {packed} \\
  --package {package} --minutes {minutes:g} --out states
"""


def packed_bandai() -> Path:
    """Return the packed clips of Bandai in the user's cache, the newest file of them.

    Raises:
      ValueError: if there is none.
    """
    found = sorted(cache_folder().glob("bandai-*.safetensors"), key=lambda path: path.stat().st_mtime)
    if not found:
        raise ValueError(f"{cache_folder()}: no packed clips of Bandai there; `f3amd data --data bandai` packs them")
    return found[-1]


def lay_out(folder: Path, package: str, minutes: float, packed: Path) -> int:
    """Lay out a package in a folder that is not there yet, and return how many bytes it takes.

    Args:
      folder: to make.
      package: a name of gpu_plan.toml.
      minutes: of the training, for `run.sh`.
      packed: the data set's packed file.

    Raises:
      ValueError: if the folder is there, the package unknown, the packed file missing, or all of it larger than 55 MB:
        then the largest files are named, and the folder is removed.
    """
    check_known(package, tomllib.loads(PLAN.read_text(encoding="utf-8")), "package")
    if folder.exists():
        raise ValueError(f"{folder} is there already; name another, or remove it")
    if not packed.is_file():
        raise ValueError(f"{packed}: no such file")
    folder.mkdir(parents=True)
    for name in PACKAGES:
        shutil.copytree(ROOT / name, folder / name, ignore=LEFT_OUT)
    for path in (*(ROOT / name for name in BESIDE), packed):
        shutil.copy(path, folder / path.name)
    run = RUN.format(package=package, minutes=minutes, packed=packed.name)
    (folder / "run.sh").write_text(run, encoding="utf-8")
    sizes = {path.relative_to(folder): path.stat().st_size for path in folder.rglob("*") if path.is_file()}
    total = sum(sizes.values())
    if total > MOST_BYTES:
        shutil.rmtree(folder)
        largest = sorted(sizes, key=sizes.get, reverse=True)[:5]
        named = ", ".join(f"{path} {sizes[path] / 1e6:.1f} MB" for path in largest)
        raise ValueError(f"{total / 1e6:.1f} MB, more than {MOST_BYTES / 1e6:.0f}; the largest: {named}")
    return total


def main(words: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description="Lay out a package of gpu_plan.toml for a GPU elsewhere.")
    parser.add_argument("folder", type=Path, help="to make")
    parser.add_argument("--package", required=True, help="a name of gpu_plan.toml")
    parser.add_argument("--minutes", type=float, required=True, help="of the training")
    parser.add_argument("--packed", type=Path, help="the packed clips of Bandai, by default those of the cache")
    asked = parser.parse_args(words)
    try:
        size = lay_out(asked.folder, asked.package, asked.minutes, asked.packed or packed_bandai())
    except ValueError as error:
        print(f"gpu_package: {error}", file=sys.stderr)
        return 2
    print(f"{asked.folder}: {size / 1e6:.1f} MB; there: bash run.sh")
    return 0


if __name__ == "__main__":
    sys.exit(main())
