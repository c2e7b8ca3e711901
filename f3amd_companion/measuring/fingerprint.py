"""What one trained network does in 8, 4, 2 and 1 steps, under both grids and both updates of Appendix F.

Table 5 prints two plateaus, {8, 4} and {2, 1} steps. Whether ours has any may hang on where the steps lie and on
which state the network is shown; both cost no training, so that every reading of the paper is measured under all four.
Appendix F prints a DDIM step that takes a variance-exploding state and returns a preserving one. To rescale it before
the next step gives plain DDIM ("rescaled"); to leave it as it is gives another walk ("literal").
Walks amplify a millimetre to a per cent: single windows are compared in centimetres beside them.

How like the paper's FNO-96 is a network? `likeness` has a distance for each line of `papers/f3amd/fingerprint.toml`.
The lines are what survives a change of data: ratios to real motion, changes between numbers of steps, and one figure of
CAMDM's code. Likeness is no quality: the paper's network may have faults of its own.
"""

from collections.abc import Sequence
from itertools import product

import jax
import numpy as np
import pandas as pd

from f3amd_lib.data.features import frame_positions
from f3amd_lib.data.packed import PackedMotion
from f3amd_lib.data.windows import WindowSet, spread_windows
from f3amd_lib.diffusion.samplers import walk
from f3amd_lib.ground.names import check_known
from f3amd_lib.ground.papers import load_paper_file, load_paper_table
from f3amd_lib.measures import real_clips
from f3amd_lib.measures.classifier import StyleClassifier
from f3amd_lib.measures.denoising import CM
from f3amd_lib.measures.distributions import diversity
from f3amd_lib.measures.metrics import foot_sliding, joint_acceleration
from f3amd_lib.measures.protocol import classify_windows, distribution_figures, evaluation_paths, real_features
from f3amd_lib.measures.real_clips import motion_figures
from f3amd_lib.measures.registry import BY_KEY, METRICS
from f3amd_lib.motion.root_paths import RootPath
from f3amd_lib.motion.skeleton import Motion
from f3amd_lib.networks.conditioning import Condition
from f3amd_lib.rollout.rollout import MotionGenerator, Rollout
from f3amd_lib.training.checkpoints import TrainedModel
from f3amd_lib.training.denoising_task import network_inputs

UPDATES = {"rescaled": "ddim", "literal": "ddim_literal"}
"""Reading of Appendix F -> name of its sampler in `samplers.SAMPLERS`."""

GRIDS = ("endpoints", "uniform")
"""Where the steps lie: t = linspace(0, 1, N), and t = i / N."""

STEPS = (8, 4, 2, 1)
NUM_FRAMES = 640
FURTHEST = 5.0
"""Metres between a root and its target, or 1 m of height from where it began, that no walk comes back from."""

WINDOWS_PER_STYLE = 10
"""Windows of 60 frames that 640 frames hold, of each style on either side of FID."""


def _figures(motion: Motion, path: RootPath, window: int, floor: float) -> dict[str, float]:
    """Measure one walk; the names are those of records."""
    figures = motion_figures(motion, path, window, floor)
    figures["foot_all_frames"] = foot_sliding(motion.positions, motion.skeleton, contact_height=np.inf)[0]
    return {BY_KEY[key].name: float(value) for key, value in figures.items()}


def diverged(rollout: Rollout) -> np.ndarray:
    """Tell which characters of a rollout have left their path for good, or the ground, [B] booleans."""
    wanted = np.stack([path.position for path in rollout.paths])
    away = np.linalg.norm(rollout.frames[..., [0, 2]] - wanted, axis=-1).max(axis=-1)
    height = np.abs(rollout.frames[..., 1] - rollout.history[:, -1:, 1]).max(axis=-1)
    # A number that is none is in no range.
    return ~((away <= FURTHEST) & (height <= 1.0) & np.isfinite(rollout.frames).all(axis=(-2, -1)))


def _table(figures: pd.DataFrame, **columns) -> pd.DataFrame:
    """Return mean and median over walks of each figure."""
    rows = [
        {"metric": name, "unit": METRICS[name].unit, "value": values.mean(), "median": values.median()}
        for name, values in figures.items()
    ]
    return pd.DataFrame(rows).assign(**columns)


def walk_rows(trained: TrainedModel, packed: PackedMotion, classifier: StyleClassifier, seed: int = 0) -> pd.DataFrame:
    """Walk every style `NUM_FRAMES` long under both grids and updates in each number of steps.

    Args:
      trained: the model; one that was not trained with F3AMD's noise keeps its own sampler.
      packed: the data set.
      classifier: for FID and coverage of the styles that it knows.
      seed: of paths, noise and starting poses.

    Returns:
      Columns grid, update, steps, walks, diverged, metric, unit, value, median: means and medians over the walks that
      did not diverge. One step is the same under all four, and listed once.
    """
    styles = list(packed.styles)
    paths = evaluation_paths(packed, styles, NUM_FRAMES, seed=seed)
    floors = [real_clips.style_floor(packed, style) for style in styles]
    known = [style for style in styles if style in classifier.styles]
    real = real_features(packed, classifier, known, trained.config.window)
    told = getattr(trained.config, "noise_levels", ())
    own = trained.diffusion.sampler
    updates = {own: own} if told or own != UPDATES["rescaled"] else UPDATES
    tables = []
    for steps, grid, (update, sampler) in product(STEPS, GRIDS, updates.items()):
        if steps == 1 and (grid, update) != (GRIDS[0], next(iter(updates))):
            continue
        rollout = MotionGenerator(trained, steps, spacing=grid, sampler=sampler).rollout(paths, styles, seed=seed)
        gone = diverged(rollout)
        motions = {place: rollout.motion(place) for place in np.flatnonzero(~gone)}
        columns = {"grid": grid, "update": update, "steps": steps, "walks": len(gone), "diverged": int(gone.sum())}
        figures = [_figures(motion, paths[k], rollout.window, floors[k]) for k, motion in motions.items()]
        tables.append(_table(pd.DataFrame(figures, columns=None if figures else ["IRD"]), **columns))
        if all(k in motions for k, style in enumerate(styles) if style in known):
            seen = classify_windows(classifier, [motions[styles.index(style)] for style in known], known)
            count = min(WINDOWS_PER_STYLE, NUM_FRAMES // classifier.config.window, *(len(one) for one in real.values()))
            scores = distribution_figures(seen, real, count, np.random.default_rng([seed, 0]))
            tables.append(_table(pd.DataFrame([scores]), **columns))
    return pd.concat(tables, ignore_index=True)


Walks = dict[tuple[str, int], np.ndarray]
"""(update, steps) -> joints that one network made, [S, B, T, J, 3], metres; seed s has one noise in all of them."""


def walk_updates(
    trained: TrainedModel, condition: Condition, *, spacing: str = GRIDS[0], num_seeds: int = 8, seed: int = 0
) -> Walks:
    """Sample windows under given conditions, B rows in network units, with both updates and each number of `STEPS`."""
    # One compiled evaluation serves every update and number of steps.
    denoise = trained.denoiser(condition)
    shape, made = (len(condition.style), trained.config.window, trained.config.channels), {}
    for key in jax.random.split(jax.random.key(seed), num_seeds):
        noise = jax.random.normal(key, shape)
        for steps, (update, sampler) in product(STEPS, UPDATES.items()):
            grid = trained.diffusion.grid(steps, spacing).astype(np.float32)
            *_, end = walk(sampler, denoise, grid[0] * noise, grid)
            made.setdefault((update, steps), []).append(trained.joint_positions(end.x_noisy))
    return {way: np.stack(draws) for way, draws in made.items()}


def window_figures(made: Walks, real: np.ndarray | None = None) -> pd.DataFrame:
    """Measure what walks from the same noise made, beside what was captured ([B, T, J, 3], metres) if anything was.

    Returns:
      Columns update, steps, metric, unit, value, means over windows and seeds. joint_error, from_rescaled and
      from_half_the_steps are mean distances of joints from what was captured, from the rescaled walk of as many steps,
      and from the same update with half the steps; joint_acceleration is that of `metrics`; seed_spread is
      `diversity` over the seeds of one condition.
    """
    distance = lambda one, other: float(CM * np.mean(np.linalg.norm(one - other, axis=-1)))
    rows = []
    for (update, steps), joints in made.items():
        figures = {} if real is None else {"joint_error": distance(joints, real)}
        figures["joint_acceleration"] = float(np.mean(joint_acceleration(joints)))
        figures["seed_spread"] = diversity(np.swapaxes(joints, 0, 1))
        figures["from_rescaled"] = distance(joints, made["rescaled", steps])
        if (half := (update, steps / 2)) in made:
            figures["from_half_the_steps"] = distance(joints, made[half])
        rows += [(update, steps, name, value) for name, value in figures.items()]
    table = pd.DataFrame(rows, columns=["update", "steps", "metric", "value"])
    table.insert(3, "unit", np.where(table["metric"] == "joint_acceleration", "cm/frame^2", "cm"))
    return table


def window_rows(trained: TrainedModel, held_out: WindowSet, *, num_windows: int = 64, seed: int = 0) -> pd.DataFrame:
    """Compare single windows from one noise between N and N / 2 steps; columns as of `walk_rows`, walks and diverged 0.

    Args:
      trained: the model, trained with F3AMD's noise.
      held_out: windows.
      num_windows: conditions.
      seed: of the noise.
    """
    batch = spread_windows(held_out, num_windows)
    _, condition = network_inputs(batch, trained.normaliser)
    real, how = frame_positions(trained.skeleton, np.asarray(batch.future)), {"num_seeds": 4, "seed": seed}
    made = {grid: walk_updates(trained, condition, spacing=grid, **how) for grid in GRIDS}
    tables = [window_figures(walks, real).assign(grid=grid) for grid, walks in made.items()]
    table = pd.concat(tables, ignore_index=True)
    return table.assign(metric="window_" + table["metric"], median=np.nan, walks=0, diverged=0)


def real_rows(packed: PackedMotion, clips: Sequence[int], *, window: int = 32) -> pd.DataFrame:
    """Measure real clips by the same figures, each against its own smoothed path; grid and update are "real"."""
    figures = []
    for motion, floor in zip(map(packed.motion, clips), real_clips.clip_floors(packed, clips), strict=True):
        figures.append(_figures(motion, real_clips.own_path(motion), window, floor))
    return _table(pd.DataFrame(figures), grid="real", update="real", steps=0, walks=len(figures), diverged=0)


# ------------------------------------------------------------------------------------ likeness to the paper's network

LINES: dict[str, dict] = load_paper_file("fingerprint")["line"]
REFUSED: dict[str, str] = load_paper_file("fingerprint")["refused"]
"""Metric that is not compared -> why."""


def _figure(line: dict, by_steps: pd.DataFrame, real: pd.Series, steps: int) -> float:
    """Return what a line compares; metrics are columns of `by_steps`, numbers of steps its index."""
    if "change" in line:
        before, after = by_steps.loc[line["between"], line["change"]].to_numpy(float)
        return float(np.max(np.abs(after / before - 1.0)))
    return float(by_steps.loc[steps, line["metric"]] / (real[line["metric"]] if line.get("of_real") else 1.0))


def paper_figures() -> pd.DataFrame:
    """Return what Table 5 prints of FNO-96, metric -> column by our names, a row for each number of steps."""
    table = load_paper_table(5).query("model == 'F3AMD-FNO-96'")
    ours = {line["paper"]: line["metric"] for line in LINES.values() if "paper" in line}
    return table.replace({"metric": ours}).pivot(index="steps", columns="metric", values="value")


def likeness(by_steps: pd.DataFrame, real: pd.Series, lines: Sequence[str] = tuple(LINES), *, steps=8) -> pd.DataFrame:
    """Compare a network with the paper's, line by line.

    Args:
      by_steps: figures of the network, metrics as columns, an index of 8, 4, 2 and 1 steps.
      real: the same metrics of real motion, measured by the same protocol.
      lines: names of `LINES`.
      steps: of the lines that look at one number of steps.

    Returns:
      A row a line: paper (its figure, held against the same real motion), ours, low, high, distance: 0 within the
      bounds, else the logarithm of the factor that is missing; infinite where ours is not known.

    Raises:
      ValueError: for an unknown line, or a metric that cannot be compared, with the reason.
    """
    rows, paper = [], paper_figures()
    for name in lines:
        if name in REFUSED:
            raise ValueError(f"{name} cannot be compared with the paper's: {REFUSED[name]}")
        check_known(name, LINES, "line of the fingerprint")
        line = LINES[name]
        low, high = line.get("low", 0.0), line.get("high", np.inf)
        theirs, ours = (_figure(line, table, real, steps) for table in (paper, by_steps))
        with np.errstate(divide="ignore"):
            missing = [np.log(low / np.float64(ours)) if low else 0.0, np.log(ours / np.float64(high)) if ours else 0.0]
        distance = max(0.0, *missing) if ours == ours else np.inf
        rows.append({"line": name, "paper": theirs, "ours": ours, "low": low, "high": high, "distance": distance})
    return pd.DataFrame(rows)


def likeness_of_readings(readings: pd.DataFrame, lines: Sequence[str] = tuple(LINES)) -> pd.DataFrame:
    """Compare every network of `records/readings.csv` under each grid and update, by means over walks.

    Returns:
      The columns of `likeness`, and run, windows, grid, update, diverged (walks in 8 steps).
    """
    real = readings[readings["run"] == "real"].set_index("metric")["value"]
    walked = readings[readings["walks"].gt(0) & (readings["run"] != "real")]
    tables = []
    for (run, windows), rows in walked.groupby(["run", "windows"], sort=False):
        one = rows[rows["steps"] == 1]  # the same under every grid and update
        for (grid, update), several in rows[rows["steps"] > 1].groupby(["grid", "update"], sort=False):
            by_steps = pd.concat([several, one]).pivot_table(index="steps", columns="metric", values="value")
            by_steps = by_steps.reindex(index=[8, 4, 2, 1], columns=real.index)
            gone = int(several.loc[several["steps"] == 8, "diverged"].max())
            named = {"run": run, "windows": windows, "grid": grid, "update": update, "diverged": gone}
            tables.append(likeness(by_steps, real, lines).assign(**named))
    return pd.concat(tables, ignore_index=True)
