"""What the judge of text to motion sees, and which hand a model raises: `f3amd measure text_judge` and `hands`.

Both are asked about real motion first, and about motion that is wrong on purpose: a judge that takes that for right,
or a count of hands that does, would be worth nothing. `text_one_caption` keeps what a model that does not ship makes
of one caption.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd

from f3amd_companion.measuring.runner import Records
from f3amd_companion.measuring.text_tables import TABLES, bench_of, measure_text_table
from f3amd_lib.ground.profiles import Profile, results_dir
from f3amd_lib.ground.records import run_record, write_table
from f3amd_lib.ground.trees import weights_digest
from f3amd_lib.motion.skeleton import Motion, Skeleton, mirror
from f3amd_lib.text.data.captions import caption_wordings
from f3amd_lib.text.data.text_encoders import TextEncoder, embed_captions
from f3amd_lib.text.data.text_motions import TextMotions
from f3amd_lib.text.judge.text_metrics import RAISED, raised_hands
from f3amd_lib.text.sampling.captioned_motion import draw_motions
from f3amd_lib.text.sampling.motionpcm_sampling import latent_walk, steps_of
from f3amd_lib.text.stages.text_models import LatentModel, find_text_model, load_text_model
from f3amd_lib.training.checkpoints import network_with

TREMBLE = 0.02
"""Deviation of the noise on every coordinate of every joint of trembling motion, metres."""

SEEDS = {"smoke": 2}
"""Motions of each caption in `measure_hands`, by profile; 50 in all others."""

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

    def drawn(repeat: int) -> np.random.Generator:
        return np.random.default_rng([seed, repeat, 3])

    def told(repeat: int) -> list[str]:
        generator = drawn(repeat)
        return [said[generator.integers(len(said))] for said in real.captions]

    def others_shown(repeat: int):
        generator = drawn(repeat)
        chosen = [generator.choice(of_pair[pair]) for pair in real.pairs]
        said = [others.captions[number] for number in chosen]
        return [others.clip(number) for number in chosen], [s[generator.integers(len(s))] for s in said]

    def trembling(repeat: int):
        generator = drawn(repeat)
        return [clip + TREMBLE * generator.normal(size=clip.shape) for clip in clips], told(repeat)

    return {
        "other real clips": others_shown,
        "captions of other clips": lambda repeat: (clips, list(drawn(repeat).permutation(told(repeat)))),
        "left and right exchanged": lambda repeat: (
            [mirrored_positions(real.skeleton, clip) for clip in clips], told(repeat),
        ),
        "backwards in time": lambda repeat: ([clip[::-1] for clip in clips], told(repeat)),
        "trembling": trembling,
        "frozen": lambda repeat: ([np.repeat(clip[:1], len(clip), 0) for clip in clips], told(repeat)),
    }  # fmt: skip


def measure_judge(data: TextMotions, encoder: TextEncoder, profile: Profile, *, models=None, **leg) -> Path | None:
    """Ask the judge about real motion and about motion that is wrong on purpose; it is trained if it is not.

    Returns:
      The table, `records/text_judge.csv`: system, metric, value, low, high; None where `stop_at` came first.
    """
    if models:
        raise ValueError("text_judge judges real motion alone: leave --model out")
    bench = bench_of(data, encoder, profile, **leg)
    if bench is None:
        return None
    others = data.cut(bench.settings["most_frames"])
    others = others.select(others.members("train"))
    table = bench.judged(probes_of(bench.real, others, bench.seed), bench.settings["repeats"])
    record = bench.record(profile, data, "text_judge", tremble=TREMBLE)
    return write_table(results_dir(profile.dataset, profile.name) / "records" / "text_judge.csv", table, record)


def counted_hands(skeleton: Skeleton, motions, side: str) -> dict[str, int]:
    """Count motions by the hands that go up.

    Args:
      skeleton: of all of them.
      motions: positions [L, J, 3] of each.
      side: "left" or "right", which was asked for.

    Returns:
      motions, and of them `asked_hand` (it alone), `other_hand` (it alone), `both_hands`, `no_hand`.
    """
    up = np.array([raised_hands(skeleton, motion) for motion in motions])
    asked, other = (up if side == "left" else up[:, ::-1]).T
    kinds = {"asked_hand": asked & ~other, "other_hand": other & ~asked, "both_hands": asked & other}
    counts = {name: int(those.sum()) for name, those in kinds.items()}
    return {"motions": len(up), **counts, "no_hand": len(up) - sum(counts.values())}


def _clip_rows(data: TextMotions, mirrored: bool) -> pd.DataFrame:
    """Count the hands of held-out clips; of their mirror images, by what the clips themselves show, if asked."""
    rows = []
    for content, side in HAND_CONTENTS:
        of_content = [k for k in data.members("test") if data.pairs[k].partition(",")[0] == content]
        clips = [data.clip(k)[:HAND_FRAMES] for k in of_content]
        if mirrored:
            clips = [mirrored_positions(data.skeleton, clip) for clip in clips]
        told = {"content": content, "side": side, "wording": "", "caption": ""}
        rows.append(told | counted_hands(data.skeleton, clips, side))
    return pd.DataFrame(rows)


def _told_rows(trained, encoder: TextEncoder, profile: Profile) -> pd.DataFrame:
    """Count the hands of motions that a model makes of captions with training's wordings and with others."""
    rows, count = [], SEEDS.get(profile.name, 50)
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
    record = run_record(profile=profile, dataset=data, seed=profile.seed, measurement="hands",
                        text_encoder=encoder.identity, frames=HAND_FRAMES, raised_from=RAISED)  # fmt: skip
    records = Records(results_dir(profile.dataset, profile.name) / "records", record, {"hands": ["model"]}, again=asked)
    rows = {"real clips": lambda: _clip_rows(data, False), "mirrored clips": lambda: _clip_rows(data, True)}
    todo = [{"model": name, "weights": ""} for name in rows]
    for name in asked or [None]:
        trained = load_text_model(find_text_model(profile.dataset, name))
        rows[trained.name] = lambda trained=trained: _told_rows(trained, encoder, profile)
        todo.append({"model": trained.name, "weights": weights_digest(trained.params)})
    return records.measure(todo, lambda row: {"hands": rows[row["model"]]()})


ONE_CAPTION = "a person walks forward"
"""The caption of `measure_one_caption`, and of notebook 21's strip."""


def measure_one_caption(
    data: TextMotions, encoder: TextEncoder, profile: Profile, *, models: Iterable[str] | None = None, folder=None,
    **leg,
) -> Path:  # fmt: skip
    """Keep the latent that a model makes of one caption in its own steps, from the noise of the profile's seed.

    The autoencoder that ships decodes it, so that a picture needs no weights of the student.

    Args:
      data, encoder, profile: captioned motion, what embeds the caption, where results lie.
      models: presets with weights; by default MotionLCM's, one step.
      folder: where weights lie, instead of the user's own and the shipped ones.

    Returns:
      The table, `records/text_one_caption.csv`: a row a token of the latent, its numbers in columns; `weights` are the
      model's, `autoencoder` those that decode.
    """
    record = run_record(profile=profile, dataset=data, seed=profile.seed, measurement="text_one_caption",
                        text_encoder=encoder.identity, caption=ONE_CAPTION)  # fmt: skip
    text, rows = jnp.asarray(embed_captions([ONE_CAPTION], encoder).pooled), []
    for name in models or ["MotionLCM-V2-small"]:
        path = find_text_model(profile.dataset, name) if folder is None else Path(folder) / f"{name}.safetensors"
        trained = load_text_model(path, LatentModel)
        network, key = network_with(trained.config, trained.params), jax.random.key(profile.seed)
        noise = jax.random.normal(key, trained.config.state_shape(1))
        latent = latent_walk(trained)(network, text, noise, key)
        table = pd.DataFrame(np.asarray(latent[0]), columns=[f"channel_{n}" for n in range(latent.shape[-1])])
        digests = {"weights": weights_digest(trained.params), "autoencoder": weights_digest(trained.autoencoder_params)}
        rows.append(table.assign(model=trained.name, steps=steps_of(trained), token=range(len(table)), **digests))
    path = results_dir(profile.dataset, profile.name) / "records" / "text_one_caption.csv"
    return write_table(path, pd.concat(rows), record)


TEXT_MEASUREMENTS = {name: partial(measure_text_table, name) for name in TABLES} | {
    "text_judge": measure_judge,
    "hands": measure_hands,
    "text_one_caption": measure_one_caption,
}
"""What `f3amd measure` knows of text to motion, by name: functions of captioned motion, encoder and profile."""
