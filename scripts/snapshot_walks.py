"""Let snapshots of the long queue follow one held-out clip, for the film strips of notebook 23.

    python scripts/snapshot_walks.py runs/bandai/laptop/campaign/F3AMD-FNO-96-seed0/*.safetensors

Each weights file gives one motion, `paper_figures/bandai/laptop/media/RUN_WINDOWS.bvh`: eight steps, from the start,
on the path and in the style of the clip that notebook 15.5 follows. `snapshot_walks.json` beside them names their
weights.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

import tyro

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))  # this tree's library, whatever is installed
sys.path.insert(1, str(Path(__file__).resolve().parents[1] / "notebooks"))

from f3amd_notebooks.shown import follow_longest

from f3amd_lib.ground.files import write_whole
from f3amd_lib.ground.profiles import load_profile, repository_root
from f3amd_lib.ground.records import run_record
from f3amd_lib.ground.trees import weights_digest
from f3amd_lib.motion.bvh import write_bvh
from f3amd_lib.rollout.rollout import MotionGenerator
from f3amd_lib.training.checkpoints import load_model
from f3amd_lib.training.pipeline import prepare


def snapshot_walks(weights: tyro.conf.Positional[list[Path]]) -> None:
    """Write the motion of each weights file."""
    media = repository_root() / "paper_figures" / "bandai" / "laptop" / "media"
    packed = prepare(profile := load_profile("laptop", "bandai")).packed
    about = media / "snapshot_walks.json"
    known = json.loads(about.read_text(encoding="utf-8"))["weights_digests"] if about.exists() else {}
    for path in weights:
        trained = load_model(path)
        style = next(style for style in trained.styles if style.endswith("normal"))
        history, line, _ = follow_longest(packed, style, num_history=10, num_frames=3 * 32)
        motion = MotionGenerator(trained, 8).rollout([line], [style], seed=0, history=history).motion(0)
        name = f"{path.parent.name}_{path.stem}"
        write_bvh(media / f"{name}.bvh", motion, overwrite=True)
        known[name] = weights_digest(trained.params)
    record = run_record(profile=profile, dataset=packed, seed=0, weights_digests=dict(sorted(known.items())))
    write_whole(about, json.dumps(record, indent=2, ensure_ascii=False) + "\n")


if __name__ == "__main__":
    tyro.cli(snapshot_walks)
