"""Draw twelve captions, a real clip beside both networks that ship, and measure what a viewer sees of them.

    python scripts/caption_strip.py      (needs the data set bandai: downloaded, or in F3AMD_DATA_DIR)

It leaves the picture `captions.png` and the table `captions.csv`, which notebooks 19 and 21 show. Motion is drawn with
the skeleton fitted to it and standing people kept in place, as `f3amd text` shows it; no foot is held.
"""

from __future__ import annotations

import sys
from pathlib import Path

import jax
import numpy as np
import pandas as pd

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))  # this tree's library, whatever is installed

from f3amd_companion.serving.foot_locking import lock_feet
from f3amd_lib.drawing.pictures import draw_poses
from f3amd_lib.drawing.style import new_figure, plot_style, show_figure
from f3amd_lib.ground.files import write_whole
from f3amd_lib.ground.profiles import load_profile, repository_root
from f3amd_lib.ground.records import run_record, write_table
from f3amd_lib.ground.trees import weights_digest
from f3amd_lib.measures.metrics import joint_acceleration
from f3amd_lib.measures.walking import slide_speed
from f3amd_lib.motion.inverse_kinematics import fitted
from f3amd_lib.motion.skeleton import Motion
from f3amd_lib.text.data.text_encoders import load_text_encoder
from f3amd_lib.text.sampling.captioned_motion import as_shown, draw_motions, told_captions
from f3amd_lib.text.stages.text_models import load_text_model, open_text_motions
from f3amd_lib.training.pipeline import PRETRAINED_DIR

CAPTIONS = (
    "a person walks forward", "an old person walks backwards", "a person walks and turns left",
    "an elderly person walks forward", "an exhausted person walks forward", "an elderly person runs forward",
    "an elderly person raises the left hand", "an old person raises the right hand",
    "an elderly person raises both hands", "a person waves the right hand", "a person bows", "a person punches",
)  # fmt: skip
MODELS = ("ACMDM-S-PS22-raw-n3", "MotionPCM-M1-small")
FRAMES, SEED, POSES = 80, 1, 6


def real_clips(data) -> np.ndarray:
    """Return the first frames of a clip of each caption, [captions, FRAMES, J, 3]; held out where there is one."""
    order = np.argsort([split == "train" for split in data.splits], kind="stable")
    long = [k for k in order if data.lengths[k] >= FRAMES]
    return np.stack([data.clip(next(k for k in long if said in data.captions[k]))[:FRAMES] for said in CAPTIONS])


def seen(skeleton, fps: float, positions: np.ndarray) -> tuple[Motion, dict]:
    """Return the motion that is shown of positions [T, J, 3], and what a viewer sees of it."""
    motion, moved = fitted(Motion.from_positions(skeleton, positions, fps))
    bones = np.linalg.norm(positions[:, 1:] - positions[:, list(skeleton.parents)[1:]], axis=-1)
    true = np.linalg.norm(skeleton.offsets[1:], axis=-1)
    slide = lambda shown: float(slide_speed(np.asarray(shown.positions), skeleton, fps))
    return motion, {
        "joint_acceleration": float(joint_acceleration(motion.positions, fps)),
        "first_frame": 100 * float(np.linalg.norm(positions[0, 0, ::2])),
        "bones_off": 100 * float((np.abs(bones - true) / true).mean()),
        "moved": 100 * float(moved.mean()),
        "moved_most": 100 * float(moved.max()),
        "drift": 100 * float(np.linalg.norm(positions[-1, 0, ::2] - positions[0, 0, ::2])),
        "slide": slide(motion),
        "slide_held": slide(lock_feet(motion)),
    }


@plot_style()
def draw(columns: dict[str, list[Motion]], credit: str):
    """Draw a row of poses for each caption and column."""
    figure, axes = new_figure(10.5, 1.25 * len(CAPTIONS), len(CAPTIONS), len(columns))
    for (title, motions), panels in zip(columns.items(), axes.T, strict=True):
        panels[0].set_title(title, fontsize=11, pad=18)
        for motion, panel in zip(motions, panels, strict=True):
            draw_poses(panel, motion, np.linspace(0, FRAMES - 1, POSES).astype(int), scale=34.0, numbered=False)
    for caption, panel in zip(CAPTIONS, axes[:, 0], strict=True):
        panel.text(0.0, 1.0, caption, transform=panel.transAxes, fontsize=9, fontweight="bold")
    figure.supxlabel(f"Orange: left; blue: right. {credit}", fontsize=8)
    return figure


def main() -> None:
    data, encoder = open_text_motions("bandai"), load_text_encoder()
    models = [load_text_model(PRETRAINED_DIR / "bandai" / "text" / f"{name}.safetensors") for name in MODELS]
    made = {"real clip": real_clips(data)}
    for trained in models:
        pooled = told_captions(trained, encoder, CAPTIONS)
        made[trained.name] = np.asarray(draw_motions(trained, pooled, FRAMES, jax.random.key(SEED)))
    columns, rows = {}, []
    for system, all_positions in made.items():
        if system != "real clip":
            all_positions = [as_shown(data.skeleton, positions, data.fps) for positions in all_positions]
        shown = [seen(data.skeleton, data.fps, positions) for positions in all_positions]
        columns[system] = [motion for motion, _ in shown]
        rows += [{"system": system, "caption": said, **row} for said, (_, row) in zip(CAPTIONS, shown, strict=True)]
    record = run_record(
        profile=load_profile("laptop", "bandai", seed=SEED), dataset=data, seed=SEED, frames=FRAMES,
        weights_digests={trained.name: [weights_digest(trained.params)] for trained in models},
    )  # fmt: skip
    folder = repository_root() / "paper_figures/bandai/laptop"
    write_table(folder / "records/captions.csv", pd.DataFrame(rows), record)
    source = data.credit.partition(";")[0]
    light = show_figure(draw(columns, f"{source}; non-commercial use."), dpi=80, colors=8)  # a notebook holds it
    write_whole(folder / "media/captions.png", light.data)


if __name__ == "__main__":
    main()
