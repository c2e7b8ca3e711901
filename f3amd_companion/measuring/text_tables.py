"""Measurements of text to motion: `f3amd measure text_table1` and its like, `text_judge`, `hands`.

Rows of tables stand in `papers/PAPER/experiments.toml`. Each row's model is trained first, if it is not, by
`text.stages.train_stage`; then it makes a motion for each held-out clip's caption, and the judge looks. A row is kept
as soon as it is measured; a leg that is out of time goes on there.

What the judge itself sees, and which hand a model raises, is asked about real motion first, and about motion that is
wrong on purpose: a judge that takes that for right, or a count of hands that does, would be worth nothing.
"""

from __future__ import annotations

import dataclasses
import itertools
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pandas as pd

from f3amd_companion.measuring.runner import Records, record_of, records_folder
from f3amd_companion.speed.timing import take_turns
from f3amd_lib.ground.arrays import in_batches
from f3amd_lib.ground.names import check_known
from f3amd_lib.ground.papers import load_paper_file
from f3amd_lib.ground.profiles import Profile, runs_dir
from f3amd_lib.ground.records import read_table, write_table
from f3amd_lib.ground.trees import weights_digest
from f3amd_lib.measures.distributions import intervals_over_repeats
from f3amd_lib.measures.metrics import joint_acceleration
from f3amd_lib.motion.skeleton import Motion, Skeleton, mirror
from f3amd_lib.networks import presets
from f3amd_lib.text.data.text_encoders import TextEncoder, embed_captions
from f3amd_lib.text.data.text_motions import TextMotions, caption_wordings, frame_mask, pad_motions
from f3amd_lib.text.judge import text_metrics
from f3amd_lib.text.judge.text_judge import EvaluatorTraining, TextJudge, judge_motions, judged_clips, train_judge
from f3amd_lib.text.networks.acmdm import Control, TextCondition
from f3amd_lib.text.sampling import motionpcm_sampling, text_to_motion
from f3amd_lib.text.sampling.captioned_motion import draw_motions, motion_drawer
from f3amd_lib.text.stages import text_models
from f3amd_lib.text.stages.text_models import CONTROL, PELVIS, LatentModel, TextModel
from f3amd_lib.text.stages.train_stage import STAGES, stage_of, stage_recipe, stands_on, train_stage

EXPERIMENTS = load_paper_file("experiments", "acmdm") | load_paper_file("experiments", "motionpcm")
"""Table -> its rows and what is trained for them; and the settings of each profile and plan."""

TABLES = tuple(name for name in EXPERIMENTS if name != "settings")
"""Those that `measure_text_table` knows."""

HELD = ("pelvis", "left_foot", "right_foot")
"""Joints that stay where they are in upper-body editing (ACMDM section 4.4)."""

BRANCHES = {"trained on pelvis": PELVIS, "trained on all joints": CONTROL, "upper-body edit": CONTROL}
"""The branch that a section of Table 3 asks; noise is optimised without one."""

UNCONTROLLED = "without control"
"""A section of ours: how far the network without a branch is from places that it was not told."""


@dataclass(frozen=True)
class Bench:
    """What all rows of a table share.

    Attributes:
      judge, encoder: what looks, and what embeds captions.
      real: the clips whose captions are told, and with which motions are compared.
      settings: of the profile, from the paper's file.
      seed: of captions and noise.
    """

    judge: TextJudge
    encoder: TextEncoder
    real: TextMotions
    settings: Mapping
    seed: int
    vectors: ClassVar[bool] = False
    """Whether the judge sees the redundant vectors that a network makes, not positions."""

    def repeated(self) -> list[Bench]:
        """Return the benches that a row is measured on; each repeats what it can by itself."""
        return [self]

    def embed(self, motions) -> np.ndarray:
        """Return motions as the judge's vectors, [N, D]."""
        return self.judge.embed_motions(motions)

    def captions(self, repeat: int) -> tuple[list[str], np.ndarray]:
        """Return a caption of each clip and their embeddings [N, W], drawn anew in each repeat."""
        generator = np.random.default_rng([self.seed, repeat, 2])
        told = [said[generator.integers(len(said))] for said in self.real.captions]
        return told, self.pool(told)

    def pool(self, told: list[str]) -> np.ndarray:
        """Return the embeddings of captions, [N, W]."""
        return embed_captions(told, self.encoder).pooled

    def quality(self, make: Callable) -> pd.DataFrame:
        """Return metric, value, low and high of what `make(pooled [N, W], lengths [N], key)` makes, [N, L, J, 3]."""
        lengths = self.real.lengths

        def system(repeat: int):
            told, pooled = self.captions(repeat)
            made = make(pooled, lengths, jax.random.fold_in(jax.random.key(self.seed), repeat))
            return [motion[:length] for motion, length in zip(made, lengths, strict=True)], told

        return self._seen(system, self.settings["repeats"])

    def _seen(self, system: Callable, repeats: int) -> pd.DataFrame:
        """Return metric, value, low and high of a system as `judge_motions` knows it, foot skating among them."""
        seen, shaking = [], lambda clips: np.mean([joint_acceleration(clip, self.real.fps) for clip in clips])
        real = shaking(map(self.real.clip, range(self.real.num_clips)))

        def watched(repeat: int):
            motions, told = system(repeat)
            shares = [text_metrics.foot_skating_ratio(self.real.skeleton, each, self.real.fps) for each in motions]
            seen.append({"metric": "foot_skating", "value": np.mean(shares)})
            seen.append({"metric": "acceleration_ratio", "value": shaking(motions) / real})
            return motions, told

        table = self.judged({"made": watched}, repeats)
        table = pd.concat([table[table["system"] == "made"], intervals_over_repeats(pd.DataFrame(seen), ["metric"])])
        return table[["metric", "value", "low", "high"]]

    def judged(self, systems: dict, repeats: int) -> pd.DataFrame:
        """Return what `judge_motions` says of systems beside real motion."""
        return judge_motions(
            self.judge, self.encoder, self.real, systems, repeats=repeats, seed=self.seed,
            group=self.settings["group"], bar=self.settings["sight"],
        )  # fmt: skip

    def variety(self, make: Callable) -> pd.DataFrame:
        """Return how far motions of one caption lie from each other before the judge, over one group of captions.

        As many motions are made at once as in `quality`, so that nothing is compiled again. Settings may say how many
        captions (`varied`), and how many motions of each (`samples`).
        """
        count = min(self.settings.get("varied", self.settings["group"]), self.real.num_clips // 2)
        clips, made, at_once = np.arange(self.real.num_clips) % count, [], self.real.num_clips // count
        samples = self.settings.get("samples", 2 * at_once)
        pooled, lengths = self.captions(0)[1][clips], self.real.lengths[clips]
        for number in range(-(-samples // at_once)):
            key = jax.random.fold_in(jax.random.key(self.seed), self.settings["repeats"] + number)
            motions = [one[:length] for one, length in zip(make(pooled, lengths, key), lengths, strict=True)]
            embedded = self.embed(motions)
            made.append(embedded[: at_once * count].reshape(at_once, count, embedded.shape[-1]))
        made = np.swapaxes(np.concatenate(made)[:samples], 0, 1)
        far = text_metrics.multimodality(made, np.random.default_rng([self.seed, 4]))
        return pd.DataFrame([{"metric": "multimodality", "value": far}])

    def look(self, motions, told) -> dict[str, float]:
        """Return the figures of one motion [L, J, 3] for each clip, made of the captions `told`."""
        return dict(self._seen(lambda repeat: (motions, told), 1).set_index("metric")["value"])

    def record(self, profile: Profile, data: TextMotions, measurement: str, **extra) -> dict:
        """Return the record of a measurement with this judge."""
        seen = {"judge_weights": weights_digest(self.judge.params), "text_encoder": self.encoder.identity}
        return record_of(profile, data, measurement, settings=dict(self.settings), **seen, **extra)

    def num_steps(self, trained: TextModel) -> int | None:
        """Return Euler's steps of a flow; other schedules walk the levels that they have."""
        return self.settings["num_steps"] if trained.schedule.kind == "straight" else None


# --------------------------------------------------------------------------------------------------------- whole motion

_AT_ONCE = 256
"""Motions that are drawn together: a test split of thousands would not fit into memory."""


def in_parts(draw: Callable) -> Callable:
    """Return `draw(pooled, mask, key)`, asked for parts of one shape where there are more than `_AT_ONCE` motions."""

    return lambda pooled, mask, key, control=None: _drawn_in_parts(draw, key, pooled, mask)


def _drawn_in_parts(draw: Callable, key, *arrays):
    """Return what `draw(*arrays, key)` makes, asked for at most `_AT_ONCE` rows of the arrays at a time."""
    part = lambda rows: draw(*(one[rows] for one in arrays), jax.random.fold_in(key, rows[0]) if rows[0] else key)
    return in_batches(part, len(arrays[0]), min(_AT_ONCE, len(arrays[0])))


def whole_rows(bench: Bench, trained: TextModel, row: Mapping, about: Mapping, first: TextModel | None) -> pd.DataFrame:
    """Return the figures of a model that makes whole motions; with cfg "no" without guidance."""
    how = {"num_steps": bench.num_steps(trained), "guidance": 1.0 if row.get("cfg") == "no" else None}
    draw = in_parts(motion_drawer(trained, **how))
    make = lambda *asked: draw_motions(trained, *asked, draw=draw)
    return pd.concat([bench.quality(make), bench.variety(make)])


def prefix_drawer(trained: TextModel, most_frames: int, num_steps: int | None) -> Callable:
    """Return what goes on from first frames in the clips' own places, window after window (prefix form).

    Args:
      trained: a model of the prefix form.
      most_frames: of motion that is wanted.
      num_steps: of Euler's method.

    Returns:
      `draw(starts, pooled, key)`, compiled once for a shape: of first frames [N, F, J, 3], metres, at least as many as
      its prefix has, and captions [N, W] it makes [N, L, J, 3], metres, L `most_frames` or more.
    """
    codec, config = trained.codec, trained.config
    given = next(iter(trained.starts.values())).shape[0]
    frames = given * codec.frames_per_state
    windows = -(-(most_frames // codec.frames_per_state - given) // (config.window - given))
    how = {} if num_steps is None else {"sampler": trained.schedule.sampler, "num_steps": num_steps}

    @jax.jit
    def draw(starts, pooled, key):
        prefix = codec.encode(codec.axes.normalise(starts[:, :frames]), jnp.ones((len(starts), frames), bool))
        captions = [pooled] * max(1, windows)
        parts = text_to_motion.continue_prefix(trained.network(), trained.schedule, prefix, captions, key, **how)
        state = jnp.concatenate([prefix, *parts], axis=1)
        return codec.decode(state, jnp.ones((len(state), state.shape[1] * codec.frames_per_state), bool))

    return lambda *given: codec.axes.restore(_drawn_in_parts(draw, given[-1], *map(jnp.asarray, given[:-1])))


def autoregressive_rows(bench: Bench, trained: TextModel, row: Mapping, about: Mapping, first) -> pd.DataFrame:
    """Return the figures of an autoregressive form; the prefix form goes on from true or from generated frames."""
    if not trained.starts:
        return whole_rows(bench, trained, row, about, first)
    count = next(iter(trained.starts.values())).shape[0] * trained.codec.frames_per_state
    true = np.asarray(pad_motions([bench.real.clip(k)[:count] for k in range(bench.real.num_clips)], count).motion)
    draw = prefix_drawer(trained, int(bench.real.lengths.max()), bench.num_steps(trained))
    begin = None if first is None else in_parts(motion_drawer(first, num_steps=bench.num_steps(first)))

    def make(pooled, lengths, key):
        if begin is None:
            return draw(true, pooled, key)
        return draw(draw_motions(first, pooled, count, jax.random.fold_in(key, 2**31 - 1), draw=begin), pooled, key)

    return bench.quality(make)


def mesh_rows(bench: Bench, trained: TextModel, row: Mapping, about: Mapping, first) -> pd.DataFrame:
    """Return the figures of a model that makes vertices: its joints before the judge, and LSD of its meshes."""
    mesh, apart = trained.codec.mesh, []
    draw = motion_drawer(trained, num_steps=bench.num_steps(trained), mesh=True)

    def make(pooled, lengths, key):
        made = draw_motions(trained, pooled, lengths, key, draw=draw, mesh=True)
        each = (text_metrics.laplacian_surface_distance(one[:length], mesh.body.vertices, mesh.body.faces).mean()
                for one, length in zip(made, lengths, strict=True))  # fmt: skip
        apart.append({"metric": "LSD", "value": float(np.mean(list(each)))})
        return mesh.joints(made)

    table = bench.quality(make)
    return pd.concat([table, intervals_over_repeats(pd.DataFrame(apart), ["metric"])[table.columns]])


# -------------------------------------------------------------------------------------------------------------- control


def asked_frames(generator: np.random.Generator, lengths, how_many) -> np.ndarray:
    """Return which frames of each motion are controlled, [N, L]: a number of frames, or a share of them (a float)."""
    asked = np.zeros((len(lengths), max(lengths)), bool)
    for row, length in zip(asked, lengths, strict=True):
        count = round(how_many * length) if isinstance(how_many, float) else min(how_many, length)
        row[generator.choice(length, max(1, count), replace=False)] = True
    return asked


def _controlled_states(bench: Bench, trained: TextModel, section: str, condition, mask) -> Callable:
    """Return `states(noise, control)` of a section of Table 3: by the branch, by optimised noise, or by neither."""
    schedule, network = trained.schedule, trained.network()
    how = {"sampler": schedule.sampler, "num_steps": bench.settings["num_steps"]}
    if section == UNCONTROLLED:
        return lambda noise, control: text_to_motion.sample_text(network, schedule, condition, noise, **how)
    if section != "noise optimisation":
        given = network, trained.control_branch(), schedule, condition
        return lambda noise, control: text_to_motion.sample_control(*given, control, noise, **how)

    def optimised(noise, control):
        few = how | {"num_steps": 10}  # of Euler's method (ACMDM Appendix F)
        sample = lambda noise: text_to_motion.sample_text(network, schedule, condition, noise, **few)
        distance = text_to_motion.control_distance(trained.codec, mask, control)
        return text_to_motion.optimise_noise(sample, distance, noise, num_steps=bench.settings["optimise_steps"]).state

    return optimised


def control_drawer(bench: Bench, trained: TextModel, section: str, clips, pooled) -> tuple[Callable, np.ndarray]:
    """Return what draws motions of some clips' captions under a control, and the true motions, [N, L, J, 3].

    Args:
      bench, trained, section: as in `control_rows`.
      clips, pooled: numbers [N] of the clips, captions [N, W].

    Returns:
      (`draw(asked [N, L, J], key)` -> positions in metres, compiled once; true motions, zero in padding).
    """
    codec, config = trained.codec, trained.config
    batch = pad_motions([bench.real.clip(clip) for clip in clips], int(bench.real.lengths[clips].max()))
    given = jnp.asarray(pooled), batch.mask, jnp.asarray(codec.axes.normalise(batch.motion))

    @jax.jit
    def draw(pooled, mask, wanted, asked, key):
        condition = TextCondition(pooled, codec.state_mask(mask))
        noise = jax.random.normal(key, (*condition.mask.shape, config.num_joints, config.channels))
        states = _controlled_states(bench, trained, section, condition, mask)
        return codec.decode(states(noise, Control.of(wanted, asked)), mask)

    parts = lambda asked, key: codec.axes.restore(_drawn_in_parts(draw, key, *given, jnp.asarray(asked)))
    return parts, np.asarray(batch.motion)


def control_rows(bench: Bench, trained: TextModel, row: Mapping, about: Mapping, first) -> dict[str, pd.DataFrame]:
    """Return figures by joint and number of frames that are asked for, and their means over numbers of frames.

    The judge looks, too, where all clips are controlled. The mean over joints has the seconds of one sentence. With
    "upper-body edit" pelvis and feet are held in all frames of all clips.

    Returns:
      {"text_table3": means over the five numbers of frames, "text_control": each of them}.
    """
    real, section = bench.real, row["section"]
    joints = text_models.controlled_joints(real.skeleton) if trained.branch is None else trained.controlled
    num_joints, key = real.skeleton.num_joints, jax.random.key(bench.seed)
    asked_of = lambda joints, frames: frames[..., None] & np.isin(np.arange(num_joints), joints)
    if section == "upper-body edit":
        held = asked_of([joints[name] for name in HELD], np.arange(max(real.lengths)) < real.lengths[:, None])

        every = np.arange(real.num_clips)
        make = lambda pooled, _, key: control_drawer(bench, trained, section, every, pooled)[0](held, key)
        return {"text_table3": bench.quality(make).assign(joint="pelvis and feet")}
    few = bench.settings["optimised_clips" if section == "noise optimisation" else "control_clips"]
    clips = np.arange(min(few, real.num_clips))
    told, pooled = bench.captions(0)
    pooled, lengths, rows = pooled[clips], real.lengths[clips], []
    draw, wanted = control_drawer(bench, trained, section, clips, pooled)
    for number, how_many in enumerate((*about["frames"], *about["shares"])):
        frames = f"{how_many:.0%}" if isinstance(how_many, float) else str(how_many)
        for name, joint in joints.items():
            generator = np.random.default_rng([bench.seed, number, joint])
            asked = asked_of([joint], asked_frames(generator, lengths, how_many))
            made = draw(asked, jax.random.fold_in(key, number))
            figures = text_metrics.control_errors(made, wanted, asked)
            if len(clips) == real.num_clips:
                figures |= bench.look([one[:length] for one, length in zip(made, lengths, strict=True)], told)
            named = {"joint": name.replace("_", " "), "frames": frames}
            rows += [named | {"metric": metric, "value": value} for metric, value in figures.items()]
    table = pd.DataFrame(rows)
    if len(joints) > 1:
        table = pd.concat([table, table.assign(joint="average")])
    each = table.groupby(["joint", "frames", "metric"], sort=False)["value"].mean().reset_index()
    draw, _ = control_drawer(bench, trained, section, clips[:1], pooled[:1])
    asked = asked_of([0], np.ones((1, lengths[0]), bool))
    seconds = median_seconds(lambda number: draw(asked, jax.random.fold_in(key, number)), 5)
    taken = {"joint": each["joint"].iloc[-1], "metric": "sampling_seconds", "value": seconds}
    means = each.groupby(["joint", "metric"], sort=False)["value"].mean().reset_index()
    return {"text_table3": pd.concat([means, pd.DataFrame([taken])]), "text_control": each}


def median_seconds(ask: Callable, count: int) -> float:
    """Return the median seconds of so many calls `ask(number)`, after one that compiles."""
    numbers = itertools.count()
    call = lambda: jax.block_until_ready(ask(next(numbers)))
    return take_turns({"": call}, min_rounds=count, min_seconds=np.inf, warmup=1)[""].median


# ------------------------------------------------------------------------------------------------------------ MotionPCM


def sentence_seconds(bench: Bench, trained: LatentModel, draw: Callable) -> float:
    """Return the seconds of one sentence by itself, from caption to vectors of a frame; joints are not counted.

    The median of 30, after one that compiles; all are as long as the model's longest clip.
    """
    told, mask = bench.captions(0)[0], frame_mask([trained.most_frames], trained.most_frames)
    embed = lambda number: bench.encoder([told[number % len(told)]]).pooled
    return median_seconds(lambda number: draw(embed(number), mask, jax.random.key(number)), 30)


def latent_rows(bench: Bench, trained: LatentModel | None, row: Mapping, about: Mapping, first) -> pd.DataFrame:
    """Return the figures of a teacher or a student of MotionPCM in so many steps; without a model, of real motion."""
    if trained is None:
        return bench.quality(lambda *asked: map(bench.real.clip, range(bench.real.num_clips)))
    draw = in_parts(motionpcm_sampling.latent_sampler(trained, row.get("steps"), row.get("guidance")))
    make = lambda *asked: motionpcm_sampling.latent_motions(trained, *asked, draw=draw)
    if bench.vectors:
        make = lambda pooled, lengths, key: np.asarray(draw(pooled, frame_mask(lengths, int(lengths.max())), key))
    made = bench.quality(make)
    if "samples" in bench.settings:
        made = pd.concat([made, bench.variety(make)])
    if about.get("shipped"):
        own = reconstructed(bench.real, trained)[2]
        made = pd.concat([made, own[own["metric"] == "kept_movement"]])
    if not about.get("timed"):
        return made
    taken = {"metric": "sampling_seconds", "value": sentence_seconds(bench, trained, draw)}
    return pd.concat([made, pd.DataFrame([taken])])


def reconstruction_rows(bench: Bench, trained: LatentModel, row: Mapping, about: Mapping, first) -> pd.DataFrame:
    """Return how well an autoencoder gives held-out motion back: FID, and what `reconstructed` says."""
    motions, given_back, own = reconstructed(bench.real, trained)
    return pd.concat([bench.quality(lambda *asked: given_back if bench.vectors else motions), own])


def reconstructed(real: TextMotions, trained: LatentModel) -> tuple[list, list, pd.DataFrame]:
    """Return motions as an autoencoder gives them back, positions and vectors, and its errors (MotionPCM Table 3).

    Joints are compared after the roots of each frame were laid on each other. The feature error is the norm of a clip's
    difference in network units, summed over clips, divided by their frames (MotionLCM V2's code). Kept movement (ours)
    is the variance over a clip's frames, over that of the real clip: a pose that only glides along has nearly none.
    """
    most = int(real.lengths.max())
    vectors = real.redundant_vectors(released=trained.autoencoder.released_facing)
    clips = [vectors[first:last] for first, last in zip(real.start[:-1], real.start[1:], strict=True)]
    motions, given_back, apart, moved = [], [], [], []
    spread = lambda vectors: np.sum(np.var(vectors / np.asarray(trained.statistics.deviation), axis=0))
    for begin in range(0, len(clips), 64):
        padded = pad_motions(clips[begin : begin + 64], most)
        made, positions = motionpcm_sampling.reconstruction(trained, padded.motion, padded.mask)
        for number, length in enumerate(np.asarray(padded.length)):
            motions.append(positions[number, :length])
            given_back.append(made[number, :length])
            away = (given_back[-1] - clips[begin + number]) / np.asarray(trained.statistics.deviation)
            apart.append(np.linalg.norm(away))
            moved.append([spread(given_back[-1]), spread(clips[begin + number])])
    local = lambda motion: motion - motion[:, :1]
    pairs = zip(map(local, motions), map(local, map(real.clip, range(real.num_clips))), strict=True)
    errors = [np.linalg.norm(ours - true, axis=-1).mean(axis=-1) for ours, true in pairs]
    own = pd.DataFrame([
        {"metric": "reconstruction_error", "value": 1000.0 * float(np.concatenate(errors).mean())},
        {"metric": "feature_error", "value": float(np.sum(apart) / real.lengths.sum())},
        {"metric": "kept_movement", "value": float(np.divide(*np.sum(moved, axis=0)))},
    ])  # fmt: skip
    return motions, given_back, own


# ----------------------------------------------------------------------------------------------------------- the runner

KINDS = {
    "whole": whole_rows, "mesh": mesh_rows, "autoregressive": autoregressive_rows, "control": control_rows,
    "latent": latent_rows, "reconstruction": reconstruction_rows,
}  # fmt: skip


def obtain_judge(data: TextMotions, encoder: TextEncoder, profile: Profile, *, folder=None, **leg) -> TextJudge | None:
    """Return the judge of a data set: the user's own, else the one that ships, else trained on the training split.

    The one that ships must know these very motions and this encoder. None where `stop_at` comes first.
    """
    files = text_models.text_model_files(profile, text_models.JUDGE, folder=folder)
    if not files.model.exists() and (shipped := text_models.shipped_for(files.model.stem, data, encoder, TextJudge)):
        return shipped
    # A check of the way needs no judge that sees.
    training = EvaluatorTraining(num_steps=profile.train_steps) if profile.name == "smoke" else None
    return train_judge(data, encoder, training, files=files, **leg)


def _over_repeats(tables: list[pd.DataFrame]) -> pd.DataFrame:
    """Return the one table as it is, or the means of several with intervals."""
    if len(tables) == 1:
        return tables[0]
    together = pd.concat(tables)
    return intervals_over_repeats(together, [column for column in ("joint", "frames", "metric") if column in together])


REAL = "Real"
"""The row of real motion, which no model makes."""


def _judged(model: TextModel | LatentModel):
    """Return the weights that a row is about."""
    if isinstance(model, LatentModel):
        return model.autoencoder_params if model.config is None else model.params
    return model.params if model.branch is None else model.branch


def bench_of(
    data: TextMotions, encoder: TextEncoder, profile: Profile, *, folder=None, plan: str = "", **leg
) -> Bench | None:
    """Return what rows are measured with; the judge is trained if it is not, None where `stop_at` comes first.

    Args:
      data, encoder, profile: as of `measure_text_table`; the judge learns from whole clips and is asked about the first
        `most_frames` of so many held-out ones as the profile's settings say.
      folder: where the judge lies instead of `runs/`.
      plan: settings of the file instead of the profile's, such as "queue".
      **leg: stop_at and progress, as for `optimise`.
    """
    judge = obtain_judge(data, encoder, profile, folder=folder, **leg)
    if judge is None:
        return None
    settings = EXPERIMENTS["settings"][plan or profile.name]
    real = judged_clips(data.cut(settings["most_frames"]))
    chosen = np.random.default_rng(profile.seed).permutation(real.num_clips)[: settings["clips"]]
    return Bench(judge, encoder, real.select(np.sort(chosen)), settings, profile.seed)


def measure_text_table(
    name: str, data: TextMotions, encoder: TextEncoder, profile: Profile, *,
    models: Iterable[str] | None = None, folder=None, rows: Iterable[Mapping] | None = None, plan: str = "", **leg,
) -> Path | None:  # fmt: skip
    """Train and measure the rows of a table that it still lacks.

    Args:
      name: of `TABLES`.
      data, encoder: captioned motion, and what embeds captions.
      profile: says how long each row is trained and how often it is measured.
      models: rows of these models alone, which are measured again.
      folder: where judge and weights lie instead of `runs/`.
      rows: instead of the file's.
      plan: settings of the file instead of the profile's: of "queue" each row is trained to several lengths, and
        in its `compared` tables with several seeds.
      **leg: stop_at and progress, as for `optimise`.

    Returns:
      The table, `records/<name>.csv`; None where the time was over first.
    """
    about = EXPERIMENTS[name]
    asked, rows = list(models or ()), [dict(row) for row in (about["rows"] if rows is None else rows)]
    for model in asked:
        check_known(model, [row["model"] for row in rows], f"model of {name}")
    bench = bench_of(data, encoder, profile, folder=folder, plan=plan, **leg)
    if bench is None:
        return None
    settings, record = bench.settings, bench.record(profile, data, name)
    # ACMDM's models of a table are all trained alike, and briefly, apart from those that `f3amd text` is to find.
    apart = folder or runs_dir(profile.dataset, profile.name) / (f"text_{plan}" if plan else "text_tables")
    cut, most_frames = data.cut(settings["most_frames"]), settings["most_frames"]
    keys = [column for column in rows[0] if column not in ("trained", "first")] + ["seed", "length"] * bool(plan)
    tables = dict.fromkeys((name, *about.get("beside", ())), keys)
    records = Records(records_folder(profile), record, tables, again=asked)

    def trained(preset: str, seed: int = profile.seed, length: float = 1.0) -> TextModel | LatentModel | None:
        base = text_models.preset_and_branch(preset)[0]
        form, latent = presets.find_preset(base), text_models.is_latent_preset(base)
        if latent and not plan:  # these see clips of a length of their own
            if about.get("shipped") and (found := text_models.shipped_for(preset, data, encoder, LatentModel)):
                return found
            return train_stage(data, encoder, profile, preset, folder=folder, **leg)
        # Prefixes and blocks have lengths of their own; other windows only say how long the longest clip is.
        own = "prefix_frames" in form.training or "block_frames" in form.network
        where = {"window": None if own or latent else most_frames, "folder": apart, **leg}
        if plan:
            where |= {"folder": apart / f"seed{seed}-{length:g}", **settings["stages"][stage_of(preset)]}
            motions, stage = where.pop("motions") * length, STAGES[stage_of(preset)]
            share = load_paper_file("recipes", stage.settings.paper)[f"short-{stage.recipe}"].get("share", 1.0)
            steps = max(1, round(motions / where["batch_size"] / share))
            brief = dataclasses.replace(profile, train_steps=steps, seed=seed)
            recipe = {setting: where[setting] for setting in ("batch_size", "learning_rate")}
            recipe = dataclasses.asdict(stage_recipe(stage.settings, stage.recipe, brief, base, **recipe))
            ships = lambda name: text_models.shipped_for(name, data, encoder) if latent else None
            if (found := ships(preset)) and found.record["identity"]["training"] == recipe:
                return found
            if below := stands_on(preset):  # a teacher that ships holds its autoencoder
                where["teacher"] = (found if stage_of(preset) == "latent denoiser" else ships(below)) or trained(below)
                if where["teacher"] is None:
                    return None
            return train_stage(data if latent else cut, encoder, brief, preset, **where)
        if form.latent and "autoencoder_steps" in settings:
            steps = dataclasses.replace(profile, train_steps=settings["autoencoder_steps"])
            if train_stage(cut, encoder, steps, form.latent, **where) is None:
                return None
        brief = dataclasses.replace(profile, train_steps=settings.get("train_steps", profile.train_steps))
        return train_stage(cut, encoder, brief, preset, batch_size=settings.get("batch_size"), **where)

    rows = [row for row in rows if not asked or row["model"] in asked]
    if plan:
        rows = planned(rows, profile.seed, settings, name in settings["compared"])
    watched = partial(_watched, profile, apart) if plan else None
    return measure_rows(name, rows, about, records, bench, trained, leg.get("stop_at"), watched)


def _watched(profile: Profile, folder: Path, row: Mapping, model) -> tuple[dict, pd.DataFrame]:
    """Return what a row of the plan says besides, its model's size, and the last held-out loss."""
    if model is None:
        return {"parameters": 0}, pd.DataFrame()
    folder = folder / f"seed{row['seed']}-{row['length']:g}"
    history = text_models.text_model_files(profile, model.name, folder=folder).history
    if not history.exists():
        history = text_models.PRETRAINED_DIR / profile.dataset / "text" / history.name  # that of what ships
    loss = read_table(history)[0]["held_out_loss"].dropna().iloc[-1]
    return {"parameters": optax.tree.size(_judged(model))}, pd.DataFrame([{"metric": "held_out_loss", "value": loss}])


def measure_rows(
    name: str, rows: Iterable[Mapping], about: Mapping, records: Records, bench: Bench, find: Callable,
    stop_at: float | None = None, watched: Callable | None = None,
) -> Path | None:  # fmt: skip
    """Measure the rows of a table that its records lack; return the table, or None where the time was over first.

    Args:
      name, about: of the table; `about` has the key of `KINDS` that measures it.
      rows: each with `trained`, the preset that is measured, and perhaps `first`, `section`, `seed`, `length`.
      records, bench: where rows are kept, and what they are measured with.
      find: preset, perhaps with a branch behind it, seed and length where a row has them -> model; None where there
        was no time for it.
      stop_at: do not begin a row after this time (`time.monotonic`).
      watched: (row, model) -> more columns, and figures of its training.
    """
    for row in rows:
        model = first = None
        if row["trained"] != REAL:
            asked = [row[key] for key in ("seed", "length") if key in row]
            model = find(row["trained"] + BRANCHES.get(row.get("section"), ""), *asked)
            first = find(row["first"]) if model is not None and "first" in row else None
            if model is None or ("first" in row and first is None):
                return None
        if stop_at is not None and time.monotonic() >= stop_at:
            return None
        named = row | {"windows": 0, "weights": weights_digest(bench.judge.params)}
        if model is not None:
            told = model.record["identity"]["training"]
            steps = model.record.get("stopped_at_step", told.get("num_steps", 0))  # nobody knows of released weights
            named |= {"windows": steps * told["batch_size"], "weights": weights_digest(_judged(model))}
        more, figures = ({}, None) if watched is None else watched(row, model)
        named |= more

        def measured(row: Mapping, model=model, first=first, figures=figures) -> dict:
            made = [KINDS[about["kind"]](one, model, row, about, first) for one in bench.repeated()]
            made = [one if isinstance(one, dict) else {name: one} for one in made]
            made = {table: _over_repeats([one[table] for one in made]) for table in made[0]}
            if figures is not None and len(figures):
                what = [column for column in made[name] if column not in ("metric", "value", "low", "high")]
                places = made[name][what].drop_duplicates() if what else pd.DataFrame([{}])
                made[name] = pd.concat([made[name], places.merge(figures, how="cross")])
            return made

        records.measure([named], measured)
    return records.path(name)


def planned(rows: Sequence[Mapping], seed: int, settings: Mapping, compared: bool) -> list[dict]:
    """Return a row with seed and length for each training of a table, in order: first what verdicts on orders ask for.

    Rows that are `compared` have all seeds at half and at full length; other lengths have the first seed. Real motion
    has no length.
    """
    asked, rest = ([one for one in settings["lengths"] if (one in (0.5, 1.0)) is first] for first in (True, False))
    real, made = ([row for row in rows if (row["trained"] == REAL) is first] for first in (True, False))
    seeds = range(seed, seed + (settings["seeds"] if compared else 1))
    every = (([seed], real, [0.0]), (seeds, made, asked), ([seed], made, rest))
    every = itertools.chain.from_iterable(itertools.product(*each) for each in every)
    return [row | {"seed": seed, "length": length} for seed, row, length in every]


# --------------------------------------------------------------------------------------------------------- the probes

TREMBLE = 0.02
"""Deviation of the noise on every coordinate of every joint of trembling motion, metres."""

HAND_FRAMES, EULER_STEPS = 80, 20
"""Length of the motions in `measure_hands`, four seconds, and the steps in which a flow makes them."""

HAND_CONTENTS = [(f"{what}-{side}-hand", side) for what in ("raise-up", "wave") for side in ("left", "right")]
"""What is told of a hand, and of which."""


def mirrored_positions(skeleton: Skeleton, positions) -> np.ndarray:
    """Return positions [L, J, 3] with left and right exchanged."""
    return mirror(Motion.from_positions(skeleton, positions)).positions


def probes_of(real: TextMotions, others: TextMotions, seed: int) -> dict:
    """Return systems for `judge_motions` that are right or wrong on purpose.

    Args:
      real: the clips that are compared with.
      others: clips of other splits, of the same pairs.
      seed: of the noise and of what is drawn.
    """
    clips = [real.clip(number) for number in range(real.num_clips)]
    of_pair = {pair: np.flatnonzero(np.equal(others.pairs, pair)) for pair in set(real.pairs)}
    drawn = lambda repeat: np.random.default_rng([seed, repeat, 3])

    def told(repeat: int, captions=real.captions, generator=None) -> list[str]:
        generator = generator or drawn(repeat)
        return [said[generator.integers(len(said))] for said in captions]

    def others_shown(repeat: int):
        generator = drawn(repeat)
        chosen = [generator.choice(of_pair[pair]) for pair in real.pairs]
        return list(map(others.clip, chosen)), told(repeat, [others.captions[number] for number in chosen], generator)

    def trembling(repeat: int):
        generator = drawn(repeat)
        return [clip + TREMBLE * generator.normal(size=clip.shape) for clip in clips], told(repeat)

    def changed(change: Callable) -> Callable:
        return lambda repeat: (list(map(change, clips)), told(repeat))

    shown = {"other real clips": others_shown} if all(map(len, of_pair.values())) else {}
    return shown | {
        "captions of other clips": lambda repeat: (clips, list(drawn(repeat).permutation(told(repeat)))),
        "left and right exchanged": changed(partial(mirrored_positions, real.skeleton)),
        "backwards in time": changed(lambda clip: clip[::-1]),
        "trembling": trembling,
        "frozen": changed(lambda clip: np.repeat(clip[:1], len(clip), 0)),
    }


def measure_judge(data: TextMotions, encoder: TextEncoder, profile: Profile, *, models=None, **leg) -> Path | None:
    """Test the judge on real motion and on motion that is wrong on purpose; it is trained if it is not.

    Returns:
      The table, `records/text_judge.csv`: system, metric, value, low, high; None where `stop_at` came first.
    """
    if models:
        raise ValueError("text_judge judges real motion alone: leave --model out")
    bench = bench_of(data, encoder, profile, **leg)
    if bench is None:
        return None
    others = data.select(data.members("train")).cut(bench.settings["most_frames"])
    table = bench.judged(probes_of(bench.real, others, bench.seed), bench.settings["repeats"])
    record = bench.record(profile, data, "text_judge", tremble=TREMBLE)
    return write_table(records_folder(profile) / "text_judge.csv", table, record)


def counted_hands(skeleton: Skeleton, motions, side: str) -> dict[str, int]:
    """Count motions by the hands that go up.

    Args:
      skeleton: of all of them.
      motions: positions [L, J, 3] of each.
      side: "left" or "right", which was asked for.

    Returns:
      motions, and of them `asked_hand` (it alone), `other_hand` (it alone), `both_hands`, `no_hand`.
    """
    up = np.array([text_metrics.raised_hands(skeleton, motion) for motion in motions])
    asked, other = (up if side == "left" else up[:, ::-1]).T
    kinds = {"asked_hand": asked & ~other, "other_hand": other & ~asked, "both_hands": asked & other}
    counts = {name: int(those.sum()) for name, those in kinds.items()}
    return {"motions": len(up), **counts, "no_hand": len(up) - sum(counts.values())}


def _clip_rows(data: TextMotions, mirrored: bool) -> pd.DataFrame:
    """Count the hands of held-out clips; of their mirror images, by what the clips themselves show, if asked."""
    rows = []
    shown = partial(mirrored_positions, data.skeleton) if mirrored else np.asarray
    for content, side in HAND_CONTENTS:
        of_content = [k for k in data.members("test") if data.pairs[k].partition(",")[0] == content]
        clips = [shown(data.clip(k)[:HAND_FRAMES]) for k in of_content]
        told = {"content": content, "side": side, "wording": "", "caption": ""}
        rows.append(told | counted_hands(data.skeleton, clips, side))
    return pd.DataFrame(rows)


def _told_rows(trained, encoder: TextEncoder, profile: Profile) -> pd.DataFrame:
    """Count the hands of motions that a model makes of captions with training's wordings and with others."""
    rows, count = [], 2 if profile.name == "smoke" else 50
    steps = EULER_STEPS if trained.schedule.kind == "straight" else None
    for (content, side), wording in itertools.product(HAND_CONTENTS, ("training", "held out")):
        for action in caption_wordings(content, held_out=wording == "held out"):
            told = {"content": content, "side": side, "wording": wording, "caption": f"a person {action}"}
            pooled = np.repeat(embed_captions([told["caption"]], encoder).pooled, count, axis=0)
            made = draw_motions(trained, pooled, HAND_FRAMES, jax.random.key(profile.seed), num_steps=steps)
            rows.append(told | counted_hands(trained.skeleton, made, side))
    return pd.DataFrame(rows)


def measure_hands(
    data: TextMotions, encoder: TextEncoder, profile: Profile, *, models: Iterable[str] | None = None, **leg
) -> Path:
    """Count which hand goes up where a caption says "left" or "right".

    Held-out clips must all be right and their mirror images all wrong. A model makes 50 motions of each caption.

    Args:
      data, encoder, profile: captioned motion, what embeds captions, how much is measured.
      models: presets that have weights; by default the one that `f3amd text` uses.

    Returns:
      The table, `records/hands.csv`: a row per model, content, side and caption.
    """
    asked = list(models or ())
    if not {content for content, _ in HAND_CONTENTS} & {pair.partition(",")[0] for pair in data.pairs}:
        raise ValueError(f"data set {data.name!r} has none of the contents of bandai that name a hand: leave hands out")
    told = {"text_encoder": encoder.identity, "frames": HAND_FRAMES, "raised_from": text_metrics.RAISED}
    record = record_of(profile, data, "hands", **told)
    records = Records(records_folder(profile), record, {"hands": ["model"]}, again=asked)
    rows = {"real clips": lambda: _clip_rows(data, False), "mirrored clips": lambda: _clip_rows(data, True)}
    todo = [{"model": name, "weights": ""} for name in rows]
    for name in asked or [None]:
        trained = text_models.load_text_model(text_models.find_text_model(profile.dataset, name))
        rows[trained.name] = lambda trained=trained: _told_rows(trained, encoder, profile)
        todo.append({"model": trained.name, "weights": weights_digest(trained.params)})
    return records.measure(todo, lambda row: {"hands": rows[row["model"]]()})


TEXT_MEASUREMENTS = {name: partial(measure_text_table, name) for name in TABLES} | {
    "text_judge": measure_judge,
    "hands": measure_hands,
}
"""What `f3amd measure` knows of text to motion, by name: functions of captioned motion, encoder and profile."""
