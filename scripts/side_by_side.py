"""Draw the README's moving picture: a real clip and three generated walks on its path, abreast on one floor.

The second is written as BVH, too, for the site's first page (`docs/players.py`), which puts the real clip beside it
where the data are.

    python scripts/side_by_side.py      (needs the data set bandai: downloaded, or in F3AMD_DATA_DIR)

Everybody starts from the same frames of a clip that no model has seen. What is generated is shown as the network made
it: nothing is blended, no foot is held.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import to_hex, to_rgb
from matplotlib.figure import Figure
from PIL import Image

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))  # this tree's library, whatever is installed
sys.path.insert(1, str(Path(__file__).resolve().parents[1] / "notebooks"))

from f3amd_notebooks.shown import follow_clip

from f3amd_lib.drawing.pictures import draw_crowd
from f3amd_lib.drawing.stick_figures import TARGET_COLOR, Camera
from f3amd_lib.drawing.style import model_style, plot_style
from f3amd_lib.ground.files import whole_file
from f3amd_lib.ground.profiles import load_profile, repository_root
from f3amd_lib.ground.records import run_record
from f3amd_lib.ground.trees import weights_digest
from f3amd_lib.motion.bvh import write_bvh
from f3amd_lib.motion.skeleton import resample
from f3amd_lib.rollout.rollout import MotionGenerator
from f3amd_lib.training.checkpoints import load_model
from f3amd_lib.training.pipeline import PRETRAINED_DIR, prepare

CLIP, STYLE, SEED = "dataset-2_walk-turn-left_normal_007", "2-normal", 0
SYSTEMS = (("F3AMD-FNO-96-steady", 8), ("F3AMD-FNO-96-steady", 1), ("CAMDM", 8))
FPS = 25
WIDTH = 960  # pixels
LANE = 1.8  # metres between neighbours


def followed(packed, config) -> tuple:
    """Return what `follow_clip` does of the clip, for a network with these windows."""
    clip = [packed.motion(k).name for k in range(len(packed.clip_style))].index(CLIP)
    num_frames = (packed.motion(clip).num_frames - config.num_history) // config.window * config.window
    return follow_clip(packed, clip, num_history=config.num_history, num_frames=num_frames)


def walks(packed, models) -> tuple[dict, np.ndarray]:
    """Return motions by label, at `FPS`, and the line on the ground that all of them follow, [T, 2]."""
    history, path, real = followed(packed, models[SYSTEMS[0][0]].config)
    made = {"real clip": real}
    for name, steps in SYSTEMS:
        rollout = MotionGenerator(models[name], steps).rollout([path], [STYLE], seed=SEED, history=history)
        made[f"{name}\n{steps} step{'s' * (steps > 1)} a window"] = rollout.motion(0)
    return {label: resample(motion, FPS) for label, motion in made.items()}, path.position


@plot_style()
def draw(walkers: dict, line, credit: str) -> list[Image.Image]:
    """Draw everybody abreast, a picture a frame. The floor stays where it is: on it one sees whether feet do."""
    yaw = np.deg2rad(135.0)  # the line turns from +X to -Z: both ends of it come towards the camera
    across = np.array([np.cos(yaw), 0.0, -np.sin(yaw)])
    middle = 0.5 * (line.min(axis=0) + line.max(axis=0))
    camera = Camera(yaw, np.deg2rad(24.0), (middle[0], 0.75, middle[1]), 16.0)
    places = LANE * (np.arange(len(walkers)) - 0.5 * (len(walkers) - 1))
    moved = [
        motion.replace(root_position=motion.root_position + place * across)
        for motion, place in zip(walkers.values(), places, strict=True)
    ]
    ours = np.array(to_rgb(model_style(SYSTEMS[0][0]).color))
    colors = ["#555555", to_hex(ours), to_hex(0.6 * ours), model_style("CAMDM").color]
    # Room around everybody at all times, from the credit below the feet to the label above the head.
    roots = np.concatenate([motion.root_position for motion in moved]) * [1.0, 0.0, 1.0]
    around = np.array([0.75, 0.0, 0.0]) * across[0] + np.array([0.0, 0.0, 0.75]) * across[2]
    corners = [roots + sign * around + [0.0, height, 0.0] for sign in (-1, 1) for height in (-0.15, 2.55)]
    seen = camera.project(np.concatenate(corners))[:, :2]
    (left, low), (right, high) = seen.min(axis=0), seen.max(axis=0)
    metre = WIDTH / (right - left)  # pixels, at the middle of the floor
    figure = Figure(figsize=(WIDTH / 100, metre * (high - low) / 100), dpi=100, layout="none")
    canvas, axis = FigureCanvasAgg(figure), figure.add_axes((0, 0, 1, 1))
    pictures = []
    for frame in range(min(motion.num_frames for motion in moved)):
        axis.clear()
        axis.axis("off")
        axis.set(xlim=(left, right), ylim=(low, high))
        draw_crowd(axis, moved, colors, frame, camera, 0.72 * metre)
        for label, motion, place, color in zip(walkers, moved, places, colors, strict=True):
            ground = np.stack([line[:, 0], np.zeros(len(line)), line[:, 1]], axis=-1) + place * across
            axis.plot(*camera.project(ground)[:, :2].T, color=TARGET_COLOR, linewidth=0.8, alpha=0.5, zorder=1.5)
            x, y = camera.project(motion.root_position[frame] * [1.0, 0.0, 1.0] + [0.0, 1.8, 0.0])[:2]
            name = label.replace("-steady", "\n-steady")  # neighbours are as far apart as this is wide
            axis.text(x, y, name, color=color, fontsize=8.5, fontweight="bold", ha="center", va="bottom", zorder=20)
        axis.text(0.5, 0.012, credit, transform=axis.transAxes, fontsize=7, color="#555555", ha="center", va="bottom")
        canvas.draw()
        pictures.append(Image.fromarray(np.asarray(canvas.buffer_rgba())).convert("RGB"))
    return pictures


def main() -> None:
    settings = load_profile("laptop", "bandai", seed=SEED)
    packed = prepare(settings).packed
    models = {name: load_model(PRETRAINED_DIR / "bandai" / f"{name}.safetensors") for name, _ in SYSTEMS}
    walkers, line = walks(packed, models)
    source = packed.credit.partition(";")[0]
    pictures = draw(walkers, line, f"{source}; non-commercial use. Generated motion as the networks made it.")
    record = run_record(
        profile=settings, dataset=packed, seed=SEED, clip=CLIP, style=STYLE, fps=FPS,
        shown=[label.replace("\n", ", ") for label in walkers], blend_frames=0, feet_locked=False,
        weights_digests={name: weights_digest(model.params) for name, model in models.items()},
    )  # fmt: skip
    path = repository_root() / "paper_figures/bandai/laptop/media/side_by_side.webp"
    write_bvh(path.with_name("side_by_side_steady.bvh"), list(walkers.values())[1], overwrite=True)
    durations = [1000 // FPS] * (len(pictures) - 1) + [1000]  # a pause before it starts again
    with whole_file(path, overwrite=True) as temporary:
        pictures[0].save(
            temporary, "webp", save_all=True, append_images=pictures[1:], duration=durations, loop=0,
            quality=45, method=4,
        )  # fmt: skip
    path.with_suffix(".json").write_text(json.dumps(record, indent=1) + "\n", encoding="utf-8")
    print(f"{path.relative_to(repository_root())}: {len(pictures)} frames, {path.stat().st_size / 1e6:.2f} MB")


if __name__ == "__main__":
    main()
