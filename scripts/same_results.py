"""Say whether a change of the library, such as a refactoring, changed any result: rollouts, tables, training, exports.

    python scripts/same_results.py --write before.json      # on the old commit
    python scripts/same_results.py --against before.json    # on the new one; exit status 1 where something is unlike

Results are digests of bytes, figures and short texts, each with a name. Digests are equal or not; of figures that are
unlike it says how far they are apart. Both runs need the same machine and the same packages: the file has them, and
another one is told. Nothing is downloaded, and no data set is read. Three to four minutes on two cores.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import math
import os
import platform
import sys
import tempfile
import time
from dataclasses import replace
from functools import cache, partial
from importlib.metadata import version
from pathlib import Path

os.environ["JAX_PLATFORMS"] = "cpu"
# Most of the time would go into compiling; and what is fused less, rounds alike after a move of code.
os.environ["JAX_DISABLE_MOST_OPTIMIZATIONS"] = "1"
if version("jaxlib") == "0.10.2":  # half of that time; XLA ends a process that names a flag it does not know
    os.environ["XLA_FLAGS"] = "--xla_cpu_use_fusion_emitters=false --xla_cpu_parallel_codegen_split_count=1"

import jax
import numpy as np
import pandas as pd
from claims_page import ledger_markdown
from model_cards import card_of, measured_table
from safetensors.numpy import load_file

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))  # this tree's library, whatever is installed
sys.path.insert(1, str(Path(__file__).resolve().parents[1] / "notebooks"))

from f3amd_notebooks.beside_printed import beside_printed, speedups_by_turns, times_beside_paper, training_beside_paper
from f3amd_notebooks.equation_map import equation_map
from f3amd_notebooks.quality_tables import QUALITY_TABLES, committed_quality, of_queue, quality_markdown
from f3amd_notebooks.readings import readings_table
from f3amd_notebooks.speed_bars import speed_bars

from f3amd_companion.ledger.claims import judge_claims, ledger
from f3amd_companion.measuring.consistency_task import distil
from f3amd_companion.measuring.times import fastest_implementations
from f3amd_companion.serving.artefact import JAX_EXPORT, MANIFEST, STABLEHLO, load_artefact
from f3amd_companion.serving.crowd import generate_crowd
from f3amd_companion.serving.export import export_model
from f3amd_companion.serving.foot_locking import lock_rollout
from f3amd_companion.serving.motion_files import write_glb, write_motion_csv
from f3amd_companion.serving.onnx_export import export_onnx, load_text_or_latent, model_card
from f3amd_companion.serving.player import player_page, rollout_scene
from f3amd_companion.speed.machine import describe_machine
from f3amd_lib.data.packed import CACHE_DIR_VARIABLE, pack
from f3amd_lib.data.sources import open_dataset
from f3amd_lib.diffusion.schedules import straight, variance_preserving_betas
from f3amd_lib.ground.papers import load_paper_file, paper_folders
from f3amd_lib.ground.profiles import load_profile, repository_root
from f3amd_lib.ground.records import committed_table, read_table
from f3amd_lib.measures.classifier import train_classifier
from f3amd_lib.measures.metrics import camdm_metrics, first_metrics
from f3amd_lib.measures.walking import walking_figures, walking_measures
from f3amd_lib.motion.bvh import format_bvh
from f3amd_lib.motion.inverse_kinematics import fitted
from f3amd_lib.motion.root_paths import named_path
from f3amd_lib.motion.skeleton import Motion, resample
from f3amd_lib.motion.synthetic import STYLES, synthesize
from f3amd_lib.networks.presets import PRESETS, Preset, build_config, find_family, find_preset, of_paper, table
from f3amd_lib.rollout.rollout import MotionGenerator
from f3amd_lib.text.data.text_encoders import embed_captions, load_text_encoder
from f3amd_lib.text.data.text_motions import text_motions
from f3amd_lib.text.judge.text_judge import EvaluatorTraining, load_judge, train_judge
from f3amd_lib.text.judge.text_metrics import clip_score, foot_skating_ratio, matching_distance, raised_hands
from f3amd_lib.text.sampling.captioned_motion import draw_motions, stream_motions, told_captions
from f3amd_lib.text.stages.train_stage import train_stage
from f3amd_lib.training.checkpoints import load_model
from f3amd_lib.training.pipeline import PRETRAINED_DIR, ModelFiles, PreparedData, train
from f3amd_lib.training.recipe import short_recipe

RECORDS = repository_root() / "paper_figures"
WALKERS = sorted(PRETRAINED_DIR.glob("*/*.safetensors"))
TOLD = [PRETRAINED_DIR / f"bandai/text/{name}.safetensors" for name in ("ACMDM-S-PS22-raw-n3", "MotionPCM-M1-small")]
JUDGE = PRETRAINED_DIR / "bandai/text/judge.safetensors"
CAPTION = "a person raises the left hand"
TRAINED = ("F3AMD-FNO-32", "F3AMD-Transformer-32", "CAMDM", "F3AMD-FNO-64-steady")
STEPS = 20
_ACMDM = {"latent_width": 16, "depth": 1, "num_heads": 2, "channels": 3, "window": 40}
_LATENT = {"window": 2, "channels": 3, "latent_width": 16, "depth": 3, "num_heads": 2, "hidden_width": 16}
_VP = variance_preserving_betas()
_MESH = {
    "coarse_levels": (40, 12), "channels": (4, 6), "latent_channels": 5, "num_bases": 2, "around": (5, 4),
    "down": (40, 8), "up": (3, 2),
}  # fmt: skip
TINY = {
    "tiny": ("acmdm", "ACMDM", straight(), _ACMDM, {}, ""),
    "tiny-AE": ("acmdm", "motion autoencoder", straight(), {"width": 8, "dilations": (1,)}, {}, ""),
    "tiny-prefix": ("acmdm", "ACMDM", straight(), _ACMDM | {"channels": 4, "window": 8}, {"prefix_frames": 3}, "-AE"),
    "tiny-mesh-AE": ("acmdm", "mesh autoencoder", straight(), _MESH, {}, ""),
    "tiny-mesh": ("acmdm", "ACMDM", straight(), _ACMDM | {"num_joints": 12, "channels": 5}, {}, "-mesh-AE"),
    "tiny-VAE": ("motionpcm", "latent autoencoder", _VP, _LATENT, {}, ""),
    "tiny-teacher": ("motionpcm", "latent denoiser", _VP, _LATENT | {"time_features": 8}, {}, "-VAE"),
    "tiny-M2": (
        "motionpcm", "latent denoiser", _VP, _LATENT | {"time_features": 8, "guidance_features": 256},
        {"num_phases": 2, "num_frames": 40}, "-VAE",
    ),
}  # fmt: skip
"""Paper, family, noise, network and training of smallest models of text to motion, and whose latent they make."""


def digest(*parts) -> str:
    """Return the first digits of the SHA-256 of texts, bytes and arrays."""
    made = hashlib.sha256()
    for part in parts:
        if not isinstance(part, (str, bytes)):
            part = np.ascontiguousarray(part)
            made.update(f"{part.dtype}{part.shape}".encode())
        made.update(part.encode() if isinstance(part, str) else part)
    return made.hexdigest()[:16]


def weights(tree) -> str:
    """Return a digest of a tree's leaves in the order of their paths; names themselves do not count."""
    leaves = {jax.tree_util.keystr(path): leaf for path, leaf in jax.tree_util.tree_leaves_with_path(tree)}
    return digest(*(leaves[name] for name in sorted(leaves)))


def text_of(frame: pd.DataFrame) -> str:
    return frame.to_csv(index=False)


# ------------------------------------------------------------------------------------------------------ motion, metrics


def walks(path: Path, folder: Path) -> dict:
    """Let a shipped model walk three rounds in two styles; measure it."""
    trained, made = load_model(path), {}
    window, styles = trained.config.window, [trained.styles[0], trained.styles[-1]]
    line = named_path("figure-eight", 3 * window, seed=0)
    for steps in (8, 1):
        rollout = MotionGenerator(trained, steps).rollout([line], styles, seed=0)
        for number, style in enumerate(styles):
            motion = rollout.motion(number)
            positions, skeleton, name = motion.positions, motion.skeleton, f"{steps} steps, {style}"
            made[name] = digest(positions)
            figures = first_metrics(positions, line, window, skeleton) | camdm_metrics(positions, line, skeleton)
            figures |= walking_measures(positions, skeleton) | walking_figures(motion, window)
            made |= {f"{name}, {key}": float(value) for key, value in figures.items()}
    return made


def finished(folder: Path) -> dict:
    """Blend seams and hold feet of the synthetic model's walk, write it in each format; and a crowd."""
    generator = MotionGenerator(load_model(WALKERS[-1]), 2)
    line = named_path("spiral", 96, seed=1)
    rollout = lock_rollout(generator.rollout(line, generator.trained.styles[0], seed=1, blend_frames=4))
    motion, page = rollout.motion(), player_page(rollout_scene(rollout, "walk"), title="walk", credit="nobody")
    crowd = generate_crowd(generator, 3, 40, folder / "crowd", min_distance=0.8, seed=0, chunk=2)
    glb, table = write_glb(folder / "walk.glb", motion, credit="nobody"), write_motion_csv(folder / "walk.csv", motion)
    return {
        "positions": digest(motion.positions),
        "bvh": digest(format_bvh(motion)),
        "glb": digest(glb.read_bytes()),
        "csv": digest(table.read_bytes()),
        "player page": digest(page),
        "player data": digest(page.partition('id="player-data">')[2].partition("</script>")[0]),
        "crowd": digest(*(crowd.motion(number).positions for number in range(3))),
    }


def captioned(path: Path, folder: Path) -> dict:
    """Draw a motion of one caption with a shipped model, and let the shipped judge look."""
    trained, encoder, judge = load_text_or_latent(path), load_text_encoder(), load_judge(JUDGE)
    steps = 1 if "PCM" in trained.name else 8
    pooled = told_captions(trained, encoder, [CAPTION])
    positions = draw_motions(trained, pooled, 48, jax.random.key(0), num_steps=steps)[0]
    seen, told = judge.embed_motions([positions]), judge.embed_texts(embed_captions([CAPTION], encoder))
    motion, residual = fitted(Motion.from_positions(trained.skeleton, positions, trained.fps, CAPTION))
    return {
        "caption": digest(pooled),
        "positions": digest(positions),
        "judge's vectors": digest(seen, told),
        "matching distance": matching_distance(told, seen),
        "CLIP score": clip_score(told, seen),
        "foot skating": foot_skating_ratio(trained.skeleton, positions),
        "raised hands": digest(raised_hands(trained.skeleton, positions)),
        "residual of the skeleton": float(residual.mean()),
        "bvh": digest(format_bvh(motion)),
        "glb": digest(write_glb(folder / "told.glb", motion).read_bytes()),
    }


# --------------------------------------------------------------------------------------------------------------- tables


def claims(paper: str, folder: Path) -> dict:
    """Judge a paper's claims from the committed records."""
    judged = judge_claims(paper=paper)
    rows = ledger(judged).to_dict("records")
    made = {row["id"]: f"{row['verdict']} / {row['paper_verdict']} {digest(json.dumps(row))}" for row in rows}
    return made | {"page": digest(ledger_markdown(judged))}


def papers(folder: Path) -> dict:
    """Lay out what is known of each paper: models, readings, equations without the places of code; F3AMD's sizes."""
    sizes = {"channels": 141, "num_styles": 100, "num_joints": 22, "text_width": 256, "num_vertices": 480}
    made = {"sizes": digest(text_of(table("f3amd", channels=141, num_styles=100)))}
    for paper in paper_folders():
        for name, preset in of_paper(paper).items():
            if not name.startswith("tiny") and not name.endswith("-shallow"):  # those are of the trainings below
                wanted = set(find_family(preset.family)[0].from_data) - set(preset.network)
                config = build_config(name, **{key: value for key, value in sizes.items() if key in wanted})
                made[name] = digest(json.dumps([config.to_dict(), preset.diffusion.to_dict(), dict(preset.training)]))
        equations = equation_map(paper=paper, course=True)
        made[f"equations of {paper}"] = digest(text_of(equations.drop(columns=["functions", "tests"])))
        for label, text in zip(equations["equation"], equations["functions"], strict=True):
            made[f"{paper}, {label}"] = ", ".join(sorted(one.split(": ")[-1] for one in text.split(", ")))
        made[f"readings of {paper}"] = digest(text_of(readings_table(paper=paper)))
    return made


def tables(folder: Path) -> dict:
    """Lay committed records beside the papers' tables."""
    quality, campaign = (committed_table("bandai", name)[0] for name in ("quality", "campaign"))
    made = {f"Table {number}": digest(quality_markdown(number, quality, "ours")) for number in QUALITY_TABLES}
    windows = int(campaign.loc[campaign["recipe"] == "paper", "windows"].max())
    made["Table 3 of the queue"] = digest(quality_markdown(3, of_queue(campaign, windows), "ours"))
    made["measured"] = digest(measured_table(committed_quality("bandai")))
    for paper in ("acmdm", "motionpcm"):
        names = load_paper_file("experiments", paper).keys() - {"settings"}
        for name in sorted(set(names) - {"text_guidance"}):  # which no paper prints
            metrics = list(committed_table("bandai", name)[0]["metric"].unique())
            rows, sentence = beside_printed(paper, name, metrics)
            made[name] = digest(text_of(rows), sentence)
    for place, device in (("synthetic/laptop", "CPU"), ("bandai/gpu", "GPU")):
        ways, times, training = (
            read_table(RECORDS / place / f"records/{name}.csv")[0]
            for name in ("synthesis_ways", "synthesis_time", "training_time")
        )
        shown = [speed_bars(ways), fastest_implementations(ways), speedups_by_turns(ways)]
        shown += [times_beside_paper(times, number, device) for number in (1, 4, 7)] + [training_beside_paper(training)]
        made[f"times, {device}"] = digest(*map(text_of, shown))
    return made


def cards(folder: Path) -> dict:
    """Write the cards of all shipped weights."""
    return {path.stem: digest(card_of(path)) for path in sorted(PRETRAINED_DIR.rglob("*.safetensors"))}


# ------------------------------------------------------------------------------------------------------------- training


@cache
def motions() -> PreparedData:
    """Return two styles of the synthetic walker."""
    return PreparedData(pack(open_dataset("synthetic", seconds_per_style=40.0, num_styles=2), progress=False))


@cache
def captions():
    """Return walks of it with captions."""
    clips = []
    for style in STYLES[:2]:
        for seed, split in enumerate(("test", "validation", "train", "train", "train")):
            motion = resample(synthesize(style, seconds=3.2, seed=seed), 20.0).slice(0, 64)
            clips.append((f"{style}_{seed}", motion, (f"a person walks {style}",), split, style))
    return text_motions(clips, skeleton=motion.skeleton, name="walker", fps=20.0)


def left(folder: Path) -> dict:
    """Return what trainings left in a folder: weights of their last states, and the losses on the way."""
    made = {}
    for path in sorted(folder.glob("*.state.safetensors")):
        state = load_file(path)
        for part in ("params", "ema"):
            made[f"{path.stem}, {part}"] = weights({k: v for k, v in state.items() if k.strip(".[]'").startswith(part)})
    for path in sorted(folder.glob("*.history.csv")):
        for row in pd.read_csv(path).to_dict("records"):
            step = row.pop("step")
            made |= {f"{path.stem}, {name} at {step}": float(value) for name, value in row.items()}
    return made


def shallow(preset: str) -> str:
    """Name a preset's network of two blocks, which is compiled sooner."""
    known, name = find_preset(preset), f"{preset}-shallow"
    PRESETS[name] = replace(known, name=name, network={**known.network, "depth": 2}, paper_names=())
    return name


def trains(preset: str, folder: Path) -> dict:
    """Train a network of locomotion for some steps."""
    how, profile = {"folder": folder, "progress": False}, load_profile("smoke", "synthetic")
    train(motions(), profile, preset=shallow(preset), config=short_recipe(shallow(preset), STEPS, batch_size=4), **how)
    return left(folder)


def distils(folder: Path) -> dict:
    """Distil a network of locomotion that was trained for a few steps."""
    how, profile, preset = {"progress": False}, load_profile("smoke", "synthetic"), shallow(TRAINED[0])
    config = short_recipe(preset, 2, batch_size=4)
    teacher, _ = train(motions(), profile, preset=preset, config=config, folder=folder / "teacher", **how)
    distil(motions(), profile, teacher, folder, num_steps=STEPS, batch_size=4, **how)
    return left(folder)


def trains_text(name: str, folder: Path) -> dict:
    """Train a tiny model of text to motion with what it stands on; a stream of what is of the prefix form."""
    for known, (paper, family, noise, network, training, latent) in TINY.items():
        latent = latent and f"tiny{latent}"
        PRESETS[known] = Preset(known, paper, family, noise, network, training, "ours", latent=latent)
    latent = TINY[name.partition("+")[0]][0] == "motionpcm"
    # A student has 0.15 of the steps, its autoencoder a quarter.
    profile = load_profile("smoke", "bandai", train_steps=100 if latent else STEPS)
    how, encoder = {"folder": folder, "batch_size": 2, "progress": False}, load_text_encoder()
    trained = train_stage(captions(), encoder, profile, name, **how)
    made = left(folder)
    if getattr(trained, "starts", None):
        pooled = embed_captions(list(trained.starts), encoder).pooled
        made["stream"] = digest(stream_motions(trained, pooled, [1, 1], jax.random.key(0), starts=pooled, num_steps=4))
    else:
        pooled = embed_captions(list(trained.words[:2]), encoder).pooled
        made["drawn"] = digest(draw_motions(trained, pooled, 40, jax.random.key(0), num_steps=2))
    return made


def trains_judges(folder: Path) -> dict:
    """Train a judge of text to motion and a classifier of styles."""
    sizes = {"movement_width": 16, "motion_hidden": 16, "text_hidden": 16, "embedding_width": 8}
    training = EvaluatorTraining(num_steps=STEPS, batch_size=8, num_frames=40)
    files = ModelFiles.of(folder, "judge")
    judge = train_judge(captions(), load_text_encoder(), training, files=files, progress=False, **sizes)
    losses = {f"judge, {name}": value for row in judge.record["history"] for name, value in row.items()}
    small = {"widths": (8, 8), "hidden_width": 16, "feature_width": 8}
    classifier = train_classifier(motions().packed, num_steps=STEPS, batch_size=8, progress=False, **small)
    answers = {f"accuracy, {style}": share for style, share in classifier.held_out_accuracy.items()}
    references = {split: digest(*part) for split, part in classifier.references.items()}
    return left(folder) | losses | answers | references | {"classifier": weights(classifier.params)}


# -------------------------------------------------------------------------------------------------------------- exports


def exports(path: Path, folder: Path) -> dict:
    """Export a round, without the record in its manifest; run it."""
    trained = load_model(path)
    written = export_model(trained, folder / "round", num_steps=2, targets=())
    manifest = json.loads((written / MANIFEST).read_text(encoding="utf-8"))
    made = {name: digest((written / name).read_bytes()) for name in (STABLEHLO, JAX_EXPORT)}
    made["manifest"] = digest(json.dumps({k: v for k, v in manifest.items() if k not in ("record", "sha256", "files")}))
    program, random = load_artefact(written, runtime="jax"), np.random.default_rng(0)
    given = [random.standard_normal(shape, dtype=np.float32) for shape in program.input_shapes.values()]
    return made | {"answer": digest(program(*given)), "card for ONNX": digest(json.dumps(model_card(trained, 2)))}


def onnx_cards(folder: Path) -> dict:
    """Describe models of text to motion as their ONNX cards do."""
    return {path.stem: digest(json.dumps(model_card(load_text_or_latent(path), 1))) for path in TOLD}


def onnx_programs(folder: Path) -> dict:
    """Export to ONNX, where jax2onnx is installed."""
    places = [export_onnx(load_model(WALKERS[-1]), folder / "walk", num_steps=2)]
    places += [export_onnx(load_text_or_latent(TOLD[1]), folder / "told", num_steps=1)]
    return {f"{place.name}, {file.name}": digest(file.read_bytes()) for place in places for file in place.iterdir()}


ITEMS = {
    **{f"walks of {path.stem}, {path.parent.name}": partial(walks, path) for path in WALKERS},
    **{f"motion of {path.stem}": partial(captioned, path) for path in TOLD},
    "finished motion, player, crowd": finished,
    **{f"claims of {paper}": partial(claims, paper) for paper in paper_folders()},
    "models, equations, readings": papers,
    "tables": tables,
    "cards": cards,
    **{f"training of {preset}": partial(trains, preset) for preset in TRAINED},
    "training of a student of few steps": distils,
    "training of ACMDM and its branch": partial(trains_text, "tiny+control"),
    "training of ACMDM in a latent": partial(trains_text, "tiny-prefix"),
    "training of ACMDM on meshes": partial(trains_text, "tiny-mesh"),
    "training of MotionPCM": partial(trains_text, "tiny-M2"),
    "training of judge and classifier": trains_judges,
    **{f"export of {path.stem}": partial(exports, path) for path in (WALKERS[0], WALKERS[-1])},
    "ONNX cards": onnx_cards,
    "ONNX programs": onnx_programs,
}
"""What is computed: name -> function of an empty folder, which gives digests, figures and texts by name."""


def computed(only: str) -> dict:
    """Compute the items whose names have `only` in them; one that raises leaves its error and stops no other."""
    about = {name: version(name) for name in ("jax", "jaxlib", "numpy", "scipy", "flax", "optax", "pandas")}
    made = {"about": about | {"Python": platform.python_version(), "CPU": describe_machine()["processor"]}}
    for name, item in ITEMS.items():
        if only not in name:
            continue
        started = time.perf_counter()
        with tempfile.TemporaryDirectory() as folder:
            os.environ[CACHE_DIR_VARIABLE] = f"{folder}/cache"
            (Path(folder) / "out").mkdir()
            try:
                made[name] = item(Path(folder) / "out")
            except Exception as error:
                made[name] = {"error": f"error: {type(error).__name__}: {error}".replace(folder, "")}
        print(f"{time.perf_counter() - started:5.0f} s  {name}  {made[name].get('error', '')}", flush=True)
    return made


def apart(one, other) -> float:
    """Return how far two results are apart: 0 for the same, relative for figures, infinite for all else."""
    if one == other or (one != one and other != other):
        return 0.0
    numbers = all(isinstance(value, (int, float)) and math.isfinite(value) for value in (one, other))
    return abs(one - other) / max(abs(one), abs(other)) if numbers else math.inf


def compared(before: dict, after: dict) -> pd.DataFrame:
    """Return a row an item: how many of its results are equal, how many unlike and how far, and which."""
    rows = []
    for name in before | after:
        old, new = before.get(name, {}), after.get(name, {})
        gaps = {key: apart(old.get(key), new.get(key)) for key in old | new}
        unlike = {key: gap for key, gap in gaps.items() if gap > 0.0}
        figures = [gap for gap in unlike.values() if gap < math.inf]
        row = {"item": name, "equal": len(gaps) - len(unlike), "unlike": len(unlike)}
        row |= {"largest relative difference": f"{max(figures):.1e}" if figures else "", "which": list(unlike)}
        rows.append(row | {"error": new.get("error", "")})
    return pd.DataFrame(rows)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    what = parser.add_mutually_exclusive_group(required=True)
    what.add_argument("--write", type=Path, metavar="FILE.json", help="keep what is computed there")
    what.add_argument("--against", type=Path, metavar="FILE.json", help="compare what is computed with that")
    parser.add_argument("--only", default="", help="part of the names of items")
    given = parser.parse_args()
    before = given.against and json.loads(given.against.read_text(encoding="utf-8"))
    made = json.loads(json.dumps(computed(given.only)))
    if given.write:
        given.write.write_text(json.dumps(made, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")
        return 0
    found = compared({name: of for name, of in before.items() if name == "about" or given.only in name}, made)
    print(found.drop(columns=["which", "error"]).to_string(index=False))
    for row in found.itertuples():
        if row.which:
            print(f"UNLIKE {row.item}: {'; '.join(row.which[:8])}{' ...' * (len(row.which) > 8)}")
        if row.error:
            print(f"NOT COMPUTED {row.item}: {row.error}")
    return int(found["unlike"].any())


if __name__ == "__main__":
    sys.exit(main())
