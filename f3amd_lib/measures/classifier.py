"""The style classifier: the eyes through which FID, EMD and style coverage look at motion.

The network of CAMDM's evaluation code, trained by this project on the data at hand. It sees two
seconds of one body at a time, turned so that every frame faces the same way and standing on the
spot: posture and gait, but no path. What it makes of them just before the answer, 512 numbers, are
the features whose distributions FID and EMD compare; its answer is what style coverage counts.

A distance between features says something about style only if the features do. Every classifier
therefore carries its accuracy on clips that it was not trained on, and `require_telling_styles`
refuses one that guesses. What it goes by may still be something else than style: in the Bandai
Namco data style and recording session go together. And posture alone gives most styles away, so
that coverage says little about how somebody moves.

Source: CAMDM's released evaluation code (its paper and F3AMD's section 4.4 and Appendix C name the
metrics and leave the network out).
"""

from __future__ import annotations

import dataclasses
import functools
import itertools
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from flax import nnx

from f3amd_lib.data.packed import PackedMotion
from f3amd_lib.data.sources import SPLITS
from f3amd_lib.ground.arrays import in_batches
from f3amd_lib.ground.files import read_toml
from f3amd_lib.ground.names import check_known
from f3amd_lib.ground.profiles import Profile, runs_dir
from f3amd_lib.ground.records import record_hash, run_record
from f3amd_lib.ground.trees import check_kind, errors_name, load_tree, save_tree
from f3amd_lib.measures.metrics import checked_positions
from f3amd_lib.motion.anatomy import twin_name
from f3amd_lib.motion.rotations import matrix_from_yaw
from f3amd_lib.motion.skeleton import Skeleton, check_joints, describe_skeleton, described_skeleton, facing_yaw
from f3amd_lib.networks.attention import dropout
from f3amd_lib.networks.config import CheckedConfig, LayerKeys
from f3amd_lib.networks.spectral import TemporalConvolution
from f3amd_lib.training.optimise import Task, TrainingState, frozen_tree, optimise

ACCURACY_BAR = 0.8
"""Least held-out accuracy of a classifier whose features may be used for FID, EMD and coverage."""

_SPLITS = {"train": ("train",), "held_out": ("validation", "test")}
"""Splits whose clips are trained on, and whose clips say how well."""

_BATCH = 256
"""Windows that are evaluated at once; fixed, so that a window's features depend on it alone."""


# ------------------------------------------------------------------------------- what it sees of motion

_LIMBS = ("collar", "shoulder", "elbow", "hip", "knee", "ankle")
CLASSIFIER_JOINTS = ("hips", "neck", "head", *(f"{side}_{part}" for side in ("left", "right") for part in _LIMBS))
"""Roles of the 15 joints that the classifier sees; wrists and toes, the noisiest, are left out."""

NUM_CHANNELS = 3 * len(CLASSIFIER_JOINTS)
"""Numbers a frame: x, y, z of each of `CLASSIFIER_JOINTS`."""


def classifier_frames(positions, skeleton: Skeleton) -> np.ndarray:
    """Reduce joint positions to what the classifier sees: posture, without place and direction.

    Each frame is moved so that its hips are the origin and turned about the vertical so that its
    own facing, shoulders among it (`facing_yaw`), is +Z. (CAMDM's code turns to +X, which is the
    same up to the order and sign of channels.)

    Args:
      positions: global joint positions, [..., T, J, 3], metres.
      skeleton: J joints.

    Returns:
      [..., T, 45], metres, float64: x, y, z of each of `CLASSIFIER_JOINTS`.

    Raises:
      ValueError: for a wrong shape, numbers that are not finite, or a skeleton without one of the
        joints.

    Source: CAMDM's evaluation code (its feature extraction).
    """
    positions = checked_positions(positions)
    check_joints(skeleton, positions)
    seen = [skeleton.role(role) for role in CLASSIFIER_JOINTS]
    body = positions - positions[..., seen[:1], :]
    turned = body[..., seen, :] @ np.swapaxes(matrix_from_yaw(-facing_yaw(skeleton, body, shoulders=True)), -1, -2)
    return turned.reshape(*turned.shape[:-2], NUM_CHANNELS)


def side_by_side(frames: np.ndarray, window: int) -> np.ndarray:
    """Cut frames [..., T, 45] into windows side by side, [..., T // window, window, 45], float32; the rest is left."""
    count = frames.shape[-2] // window
    whole = frames[..., : count * window, :].astype(np.float32)
    return whole.reshape(*whole.shape[:-2], count, window, NUM_CHANNELS)


def mirror_channels() -> tuple[np.ndarray, np.ndarray]:
    """Return (which channel to take, its sign), each [45], that show a frame in the mirror."""
    twins = [CLASSIFIER_JOINTS.index(twin_name(role)) for role in CLASSIFIER_JOINTS]
    order = 3 * np.repeat(twins, 3) + np.tile(np.arange(3), len(twins))
    return order, np.tile(np.array([-1.0, 1.0, 1.0], np.float32), len(twins))


# ------------------------------------------------------------------------------------ the network


@dataclass(frozen=True)
class ClassifierConfig(CheckedConfig):
    """Sizes of the network; the defaults are CAMDM's.

    Attributes:
      num_styles: classes, S.
      window: frames it sees, at 30 fps.
      widths: channels of the two convolution blocks.
      hidden_width: of the first layer after them.
      feature_width: of the second, whose output is the feature.
      dropout: share of block outputs that is blanked in training.
    """

    may_be_zero: ClassVar[tuple[str, ...]] = ("dropout",)

    num_styles: int
    window: int = 60
    widths: tuple[int, ...] = (64, 128)
    hidden_width: int = 1024
    feature_width: int = 512
    dropout: float = 0.5


# Short trainings need statistics that follow; 0.9 is PyTorch's default, thus CAMDM's.
_batch_norm = functools.partial(nnx.BatchNorm, momentum=0.9, epsilon=1e-5)


class _ConvolutionBlock(nnx.Module):
    """Convolution over three frames, batch norm and leaky ReLU; plus a shortcut frame by frame."""

    def __init__(self, width_in: int, width_out: int, *, rngs: nnx.Rngs):
        self.convolution = TemporalConvolution(width_in, width_out, 3, rngs=rngs)
        self.norm = _batch_norm(width_out, rngs=rngs)
        self.shortcut = nnx.Linear(width_in, width_out, rngs=rngs)

    def __call__(self, z, training: bool):
        """Map [B, T, D0] to [B, T, D1]."""
        main = self.norm(self.convolution(z), use_running_average=not training)
        return nnx.leaky_relu(main) + self.shortcut(z)


class StyleNetwork(nnx.Module):
    """Two convolution blocks, two wide layers and a class layer; 8,489,572 weights at 100 styles.

    Source: CAMDM's evaluation code (its classifier).
    """

    def __init__(self, config: ClassifierConfig, *, rngs: nnx.Rngs):
        self.dropout = config.dropout
        widths = (NUM_CHANNELS, *config.widths)
        self.blocks = nnx.List(_ConvolutionBlock(*pair, rngs=rngs) for pair in itertools.pairwise(widths))
        self.hidden = nnx.Linear(config.window * widths[-1], config.hidden_width, rngs=rngs)
        self.hidden_norm = _batch_norm(config.hidden_width, rngs=rngs)
        self.feature = nnx.Linear(config.hidden_width, config.feature_width, rngs=rngs)
        self.feature_norm = _batch_norm(config.feature_width, rngs=rngs)
        self.classes = nnx.Linear(config.feature_width, config.num_styles, rngs=rngs)

    def __call__(self, windows, key=None):
        """Return features and class scores.

        Args:
          windows: [B, window, 45], metres.
          key: JAX random key of the dropout. With it the network trains: batch norm goes by this
            batch and updates its running statistics. Without it, it goes by those.

        Returns:
          (features [B, feature_width], scores [B, S]).
        """
        training = key is not None
        z = windows
        for block in self.blocks:
            z = block(z, training)
        z = dropout(z, self.dropout, key) if training else z
        z = self.hidden(z.reshape(z.shape[0], -1))
        z = nnx.leaky_relu(self.hidden_norm(z, use_running_average=not training))
        z = self.feature_norm(self.feature(z), use_running_average=not training)
        features = nnx.leaky_relu(z)
        return features, self.classes(features)


@functools.lru_cache(maxsize=8)
def _blank(config: ClassifierConfig):
    """Return a network's structure and the shapes of its weights and batch statistics."""
    network = nnx.eval_shape(lambda: StyleNetwork(config, rngs=LayerKeys(jax.random.key(0))))
    return nnx.split(network, nnx.Param, nnx.BatchStat)


def _network(config: ClassifierConfig, params, statistics) -> StyleNetwork:
    # A fresh tree, so that the network may update its statistics inside a gradient.
    return nnx.merge(_blank(config)[0], params, jax.tree.map(lambda leaf: leaf, statistics))


_evaluate = jax.jit(lambda config, weights, windows: _network(config, *weights)(windows), static_argnums=0)


def _answers(config, params, statistics, windows) -> tuple[np.ndarray, np.ndarray]:
    """Return (features, scores) of windows [N, window, 45], a fixed number at a time."""
    return in_batches(lambda rows: _evaluate(config, (params, statistics), windows[rows]), len(windows), _BATCH)


# ----------------------------------------------------------------------------------- the classifier


class ReferenceFeatures(NamedTuple):
    """Features of real windows, cut side by side from the clips of a split.

    Attributes:
      features: [N, feature_width], float16.
      styles: [N], index of each window's own style.
      clips: [N], number of the clip in the packed data set that it was cut from. Windows of one
        clip are alike: an interval from resampling must draw clips, not windows.
    """

    features: np.ndarray
    styles: np.ndarray
    clips: np.ndarray


@dataclass(frozen=True, eq=False)
class StyleClassifier:
    """A trained style classifier with what it knows of real motion.

    Attributes:
      config: sizes of the network.
      params, statistics: weights and running batch statistics; weights are rounded to bfloat16, so
        that a file holds exactly what was measured.
      skeleton: of the data it was trained on; no other is accepted.
      styles: the classes, in the order of the scores.
      held_out_accuracy: per style, the share of held-out windows that it recognises.
      references: "train" and "held_out" (validation and test clips), the features of real motion.
      record: how it was trained, on what, under what terms.
    """

    config: ClassifierConfig
    params: Any
    statistics: Any
    skeleton: Skeleton
    styles: tuple[str, ...]
    held_out_accuracy: dict[str, float]
    references: dict[str, ReferenceFeatures]
    record: dict

    @property
    def accuracy(self) -> float:
        """Held-out accuracy, each style counting alike; guessing gives 1 / S."""
        return float(np.mean(list(self.held_out_accuracy.values())))

    def style_index(self, style: str) -> int:
        """Return a style's class number; ValueError names the nearest one known."""
        check_known(style, self.styles, "style of the classifier")
        return self.styles.index(style)

    def windows_of(self, positions, skeleton: Skeleton) -> np.ndarray:
        """Cut motion into the windows that the classifier sees (see `classifier_frames`).

        Args:
          positions: global joint positions, [..., T, J, 3], metres, at 30 fps.
          skeleton: of the motion; must be the classifier's own.

        Returns:
          [..., T // window, window, 45], metres.

        Raises:
          ValueError: for another skeleton, motion that is too short, or numbers not finite.
        """
        if skeleton != self.skeleton:
            raise ValueError(
                f"this style classifier was trained on the skeleton of {self.record['dataset']!r}; for another one "
                "(other names, parents or bone lengths) train one on its data"
            )
        windows = side_by_side(classifier_frames(positions, skeleton), self.config.window)
        if windows.size == 0:
            raise ValueError(f"motion {np.shape(positions)} does not fill a window of {self.config.window} frames")
        return windows

    def features_and_classes(self, windows) -> tuple[np.ndarray, np.ndarray]:
        """Return the features of windows, for FID and EMD, and the class that each is taken for, for style coverage.

        Args:
          windows: from `windows_of`, [..., window, 45], metres.

        Returns:
          (features [..., feature_width], without unit; indices into `styles`, [...]).
        """
        windows = np.asarray(windows, np.float32)
        several = windows.shape[:-2]
        flat = windows.reshape(-1, self.config.window, NUM_CHANNELS)
        features, scores = _answers(self.config, self.params, self.statistics, flat)
        return features.reshape(*several, -1), np.argmax(scores, axis=-1).reshape(several)

    def reference(self, split: str, style: str | None = None) -> np.ndarray:
        """Return the features of real windows, [N, feature_width], float16.

        Args:
          split: "train" or "held_out".
          style: one of `styles`; by default all of them pooled.

        Raises:
          ValueError: for an unknown split or style.
        """
        check_known(split, self.references, "reference")
        known = self.references[split]
        return known.features if style is None else known.features[known.styles == self.style_index(style)]


def require_telling_styles(classifier: StyleClassifier) -> None:
    """Refuse a classifier that cannot tell styles apart on clips it was not trained on.

    With as much real motion of each style, coverage is at least the accuracy a, so that up to 1 - a
    of a coverage figure is the classifier's own error; and features that mix styles up let FID and
    EMD take one style for another. The bar of 0.8 keeps that error within a fifth, and lies far
    from guessing (1 / S) and from what a whole training reaches (0.98 and more on our data sets).

    Raises:
      ValueError: naming the accuracy, the bar and the styles that are confused most.
    """
    # Written so that an accuracy which is not a number is refused too.
    if not classifier.accuracy >= ACCURACY_BAR:
        worst = sorted(classifier.held_out_accuracy.items(), key=lambda item: item[1])[:3]
        listed = ", ".join(f"{style} {100 * share:.0f} %" for style, share in worst)
        raise ValueError(
            f"the style classifier recognises {100 * classifier.accuracy:.1f} % of held-out real "
            f"motion, under the bar of {100 * ACCURACY_BAR:.1f} % (worst: {listed}): FID, EMD and coverage "
            "on its features would mean nothing. Train it longer or on more data"
        )


# --------------------------------------------------------------------------------------- training


def _collect(
    packed: PackedMotion, styles: tuple[str, ...], splits: tuple[str, ...], window: int
) -> tuple[list[np.ndarray], np.ndarray, np.ndarray]:
    """Return the clips of styles and splits, sorted by style; one shorter than a window holds none to give.

    Returns:
      (frames of each clip, [T, 45], metres, float32; its style's index; its number in the data set), K of each.
    """
    chosen = []
    for number, style in enumerate(styles):
        usable = np.asarray(packed.clip_style) == packed.styles.index(style)
        usable &= np.isin(packed.clip_split, [SPLITS.index(split) for split in splits])
        usable &= np.diff(packed.clip_start) >= window
        if not usable.any():
            raise ValueError(
                f"data set {packed.name!r}: style {style!r} has no {' or '.join(splits)} clip of at least {window} "
                "frames; add clips, or leave the style out"
            )
        chosen += [(number, clip) for clip in np.flatnonzero(usable)]
    labels, clips = np.array(chosen, np.int32).T
    positions = (packed.motion(int(clip)).positions for clip in clips)
    return [classifier_frames(each, packed.skeleton).astype(np.float32) for each in positions], labels, clips


@dataclass(frozen=True)
class ClassifierTraining:
    """How a classifier is trained; CAMDM's code, but for the schedule (see `train_classifier`).

    Attributes:
      num_steps, batch_size: optimiser steps, and windows in each.
      seed: of weights, batches and dropout.
      learning_rate: of Adam, at first.
      schedule: of the learning rate; there is one.
      stride: frames between the windows trained on.
    """

    ema_decay: ClassVar[None] = None
    """The schedule falls to 0, so that weights and batch statistics settle without an average."""

    num_steps: int
    batch_size: int
    seed: int
    learning_rate: float = 1e-3
    schedule: str = "cosine to 0"
    stride: int = 10

    def optimiser(self) -> optax.GradientTransformation:
        """Return Adam, at a rate that falls to zero."""
        return optax.adam(optax.cosine_decay_schedule(self.learning_rate, self.num_steps))


@frozen_tree("frames", "starts", "first", "count", "mirrored")
class StyleTask(Task):
    """A style classifier to train.

    Attributes:
      network, config: its sizes and its training.
      frames: that windows are cut from, [N, 45], metres.
      starts: first frame of each window, sorted by style, [W].
      first, count: each style's first window and number of windows, [S].
      mirrored: whether a style's windows may be mirrored, [S].
    """

    name = "style classifier"

    network: ClassifierConfig
    config: ClassifierTraining
    frames: jax.Array
    starts: jax.Array
    first: jax.Array
    count: jax.Array
    mirrored: jax.Array

    def init(self, key):
        """Return initial weights and batch statistics."""
        _, params, statistics = nnx.split(StyleNetwork(self.network, rngs=LayerKeys(key)), nnx.Param, nnx.BatchStat)
        return params, statistics

    def draw(self, state: TrainingState | None, key):
        """Draw a batch; return ((windows [B, window, 45], styles [B]), key of the dropout)."""
        size = (self.config.batch_size,)
        key_draw, key_dropout = jax.random.split(key)
        key_style, key_place, key_mirror = jax.random.split(key_draw, 3)
        # The style first, so that each is seen alike however much motion it has.
        style = jax.random.randint(key_style, size, 0, len(self.count))
        place = jax.random.randint(key_place, size, 0, self.count[style])
        start = self.starts[self.first[style] + place]
        windows = self.frames[start[:, None] + jnp.arange(self.network.window)]
        channel, sign = mirror_channels()
        swapped = self.mirrored[style] & jax.random.bernoulli(key_mirror, 0.5, size)
        return (jnp.where(swapped[:, None, None], sign * windows[..., channel], windows), style), key_dropout

    def loss(self, params, statistics, drawn, key):
        """Return (cross entropy, (it by name, batch statistics after the step))."""
        windows, style = drawn
        network = _network(self.network, params, statistics)
        _, scores = network(windows, key)
        loss = optax.softmax_cross_entropy_with_integer_labels(scores, style).mean()
        return loss, ({"loss": loss}, nnx.state(network, nnx.BatchStat))


def _asked_for(
    packed: PackedMotion, *, num_steps: int, batch_size: int, seed: int, **sizes
) -> tuple[ClassifierConfig, ClassifierTraining, dict]:
    """Return the network's sizes, its training, and what the record tells of both: all but the data.

    The classes are the data's primary styles.
    """
    styles = tuple(packed.primary_styles)
    if len(styles) < 2:
        raise ValueError(f"data set {packed.name!r}: a style classifier needs at least two styles, got {len(styles)}")
    config, training = ClassifierConfig(len(styles), **sizes), ClassifierTraining(num_steps, batch_size, seed)
    told = {"classifier": dataclasses.asdict(config), "classifier_training": dataclasses.asdict(training)}
    return config, training, told | {"classifier_styles": styles}


def train_classifier(
    packed: PackedMotion, *, num_steps: int = 600, batch_size: int = 128, seed: int = 0,
    profile: Profile | str = "none", progress: bool = True, **sizes,
) -> StyleClassifier:  # fmt: skip
    """Train a style classifier on a data set's training clips and try it on the held-out ones.

    Cross entropy, Adam from 1e-3, windows every 10 frames and dropout 0.5 are CAMDM's. Ours: the
    learning rate falls to 0 on a cosine (at a constant rate the accuracy of a short training swings
    by several points from seed to seed), each style is drawn alike however much motion it has, half
    the windows of styles that may be mirrored are, as in the training of the generators, and clips
    are held out.

    The classes are the primary styles, so that every answer is a style that is evaluated, and each
    style has held-out clips enough to say how well it is recognised. A clip
    shorter than a window (60 frames) holds none and is left out; Bandai's primary styles have none
    so short, and a window padded by still or repeated frames would be no real motion.

    Args:
      packed: the data.
      num_steps, batch_size: optimiser steps, and windows in each.
      seed: of weights, batches and dropout.
      profile: what the run record names.
      progress: show a progress bar.
      **sizes: fields of `ClassifierConfig` to change.

    Returns:
      The classifier, weights rounded to bfloat16 and then measured.

    Raises:
      ValueError: for fewer than two styles, a style without a training or a held-out clip of 60
        frames, or a skeleton without one of `CLASSIFIER_JOINTS`.
      TrainingDiverged: if the loss stops being a number.

    Source: CAMDM's evaluation code (its classifier).
    """
    config, training, told = _asked_for(packed, num_steps=num_steps, batch_size=batch_size, seed=seed, **sizes)
    styles, window = told["classifier_styles"], config.window
    takes = {split: _collect(packed, styles, members, window) for split, members in _SPLITS.items()}
    frames, labels, _ = takes["train"]
    lengths = [len(part) for part in frames]
    ends = zip(np.cumsum(lengths), lengths, strict=True)
    starts = [np.arange(end - length, end - window + 1, training.stride) for end, length in ends]
    count = np.bincount(np.repeat(labels, [len(each) for each in starts]), minlength=len(styles))
    task = StyleTask(
        config, training, frames=jnp.asarray(np.concatenate(frames)),
        starts=jnp.asarray(np.concatenate(starts), jnp.int32), first=jnp.asarray(np.cumsum(count) - count, jnp.int32),
        count=jnp.asarray(count, jnp.int32), mirrored=jnp.asarray([style in packed.mirror_styles for style in styles]),
    )  # fmt: skip
    state, _ = optimise(task, chunk=max(1, min(20, num_steps // 10)), progress=progress)
    params = jax.tree.map(lambda leaf: leaf.astype(jnp.bfloat16).astype(leaf.dtype), state.params)
    references = {}
    for split, (frames, *of_clips) in takes.items():
        windows = [side_by_side(part, window) for part in frames]
        labels, clips = (np.repeat(each, [len(cut) for cut in windows]) for each in of_clips)
        features, scores = _answers(config, params, state.statistics, np.concatenate(windows))
        references[split] = ReferenceFeatures(features.astype(np.float16), labels, clips)
    right = np.argmax(scores, axis=-1) == labels  # of the last split, held out
    accuracy = {style: float(right[labels == number].mean()) for number, style in enumerate(styles)}
    record = run_record(
        profile=profile, dataset=packed, seed=seed, num_train_windows=len(task.starts),
        num_held_out_windows=len(labels), **told,
    )  # fmt: skip
    return StyleClassifier(config, params, state.statistics, packed.skeleton, styles, accuracy, references, record)


_PROFILE_TRAINING = read_toml(Path(__file__).with_name("classifier.toml"))


def obtain_classifier(
    packed: PackedMotion, profile: Profile, *, progress: bool = True, **changes
) -> tuple[StyleClassifier, str]:
    """Return the style classifier of a data set: of an earlier run, or trained now and kept.

    It is not shipped: its 8.5 million weights would take as much room as all models together, and a
    laptop trains it in under a minute. The seed is always the same, since features of two trainings
    do not compare. Two machines, or two numbers of cores, add in another order and end at other weights,
    so that records name them; on Bandai FIDs through two such classifiers were within 4 %
    (`records/classifiers.csv`). It is kept in `runs/<data set>/<profile>/classifier/` under a name that depends
    on data, styles and recipe.

    Args:
      packed: the data.
      profile: says how long, and where the file goes.
      progress: show a progress bar if training is needed.
      **changes: settings of `train_classifier` to change.

    Returns:
      (classifier, origin), origin being "earlier run" or "trained now".

    Raises:
      ValueError: as `train_classifier`, or naming a file that is broken.
    """
    settings = {"seed": 0} | _PROFILE_TRAINING[profile.name] | changes
    identity = {"dataset_fingerprint": packed.fingerprint, **_asked_for(packed, **settings)[2]}
    folder = runs_dir(profile.dataset, profile.name) / "classifier"
    path = folder / f"style-classifier-{record_hash(identity)[:12]}.safetensors"
    if path.exists():
        return load_classifier(path), "earlier run"
    classifier = train_classifier(packed, profile=profile, progress=progress, **settings)
    save_classifier(path, classifier)
    return classifier, "trained now"


# ------------------------------------------------------------------------------------------- files


def save_classifier(path: Path, classifier: StyleClassifier) -> None:
    """Write a classifier; `load_classifier` gives back exactly the same."""
    skeleton = classifier.skeleton
    tree = {
        "params": jax.tree.map(lambda leaf: leaf.astype(jnp.bfloat16), classifier.params),
        "statistics": classifier.statistics,
        "references": {split: reference._asdict() for split, reference in classifier.references.items()},
        "offsets": jnp.asarray(skeleton.offsets, jnp.float32),
    }
    metadata = {
        "kind": "style classifier", "classifier": dataclasses.asdict(classifier.config),
        "styles": list(classifier.styles), **describe_skeleton(skeleton),
        "held_out_accuracy": classifier.held_out_accuracy, "record": classifier.record,
    }  # fmt: skip
    save_tree(path, tree, metadata)


def load_classifier(path: Path) -> StyleClassifier:
    """Read a classifier written by `save_classifier`.

    Raises:
      ValueError: naming the file, if it is missing, truncated, damaged or of another kind.
    """

    def weights(metadata: dict) -> dict:
        check_kind(metadata, "style classifier")
        _, params, statistics = _blank(ClassifierConfig.from_dict(metadata["classifier"]))
        return {"params": params, "statistics": statistics}

    with errors_name(path):
        tree, metadata = load_tree(path, weights, rest=True)
        references = jax.tree.map(np.asarray, tree["references"])
        references = {split: ReferenceFeatures(**part) for split, part in references.items()}
        return StyleClassifier(
            params=tree["params"], statistics=tree["statistics"], styles=tuple(metadata["styles"]),
            config=ClassifierConfig.from_dict(metadata["classifier"]), references=references,
            skeleton=described_skeleton(metadata, tree["offsets"]),
            held_out_accuracy=metadata["held_out_accuracy"], record=metadata["record"],
        )  # fmt: skip
