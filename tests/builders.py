"""Small skeletons, motions, data sets and networks that several test files share."""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from compiled import Compiled
from flax import nnx
from PIL import Image
from scipy.spatial.transform import Rotation

from f3amd_lib.data.features import num_channels
from f3amd_lib.data.packed import PackedMotion
from f3amd_lib.data.windows import build_windows, fit_normaliser, starting_poses
from f3amd_lib.diffusion.schedules import variance_exploding, variance_preserving_cosine
from f3amd_lib.motion import synthetic
from f3amd_lib.motion.root_paths import RootPath
from f3amd_lib.motion.rotations import matrix_from_yaw, rotation_6d_from_matrix
from f3amd_lib.motion.skeleton import Motion, Skeleton, resample
from f3amd_lib.networks.camdm import CAMDMConfig
from f3amd_lib.networks.conditioning import Condition
from f3amd_lib.networks.config import NetworkConfig
from f3amd_lib.networks.f3amd import F3AMDConfig
from f3amd_lib.networks.presets import build_from_config, config_from_dict
from f3amd_lib.text.data.text_motions import TextMotions, text_motions
from f3amd_lib.training.checkpoints import TrainedModel
from f3amd_lib.training.denoising_task import DenoisingTask, denoising_task
from f3amd_lib.training.recipe import TrainingConfig

WINDOW = 8
HISTORY = 4

SKELETON = Skeleton(
    names=("Hips", "Spine", "LeftUpLeg", "LeftToeBase", "RightUpLeg", "RightToeBase"),
    parents=(-1, 0, 0, 2, 0, 4),
    offsets=np.array(
        [[0.0, 0.0, 0.0], [0.0, 0.5, 0.0], [0.1, -0.05, 0.0], [0.0, -0.8, 0.1], [-0.1, -0.05, 0.0], [0.0, -0.8, 0.1]]
    ),
    end_sites=((1, (0.0, 0.2, 0.0)),),
)
CHANNELS = num_channels(SKELETON)


def wandering_motion(num_frames: int = 40, seed: int = 0, speed: float = 0.04) -> Motion:
    """A walk of sorts that turns, sways and swings every joint; no two seeds alike."""
    rng = np.random.default_rng(seed)
    frame = np.arange(num_frames)
    yaw = rng.uniform(-3, 3) + rng.uniform(-0.05, 0.05) * frame
    heading = np.stack([np.sin(yaw), np.cos(yaw)], axis=-1)
    plane = rng.uniform(-2, 2, 2) + np.cumsum(speed * heading, axis=0)
    height = 0.9 + 0.02 * np.sin(0.5 * frame + rng.uniform(0, 6))
    root = np.stack([plane[:, 0], height, plane[:, 1]], axis=-1)
    phase = rng.uniform(0, 6, (SKELETON.num_joints, 3))
    angles = 0.4 * np.sin(0.4 * frame[:, None, None] + phase)
    rotations = Rotation.from_rotvec(angles.reshape(-1, 3)).as_matrix()
    rotations = rotations.reshape(num_frames, SKELETON.num_joints, 3, 3)
    rotations[:, 0] = matrix_from_yaw(yaw) @ rotations[:, 0]
    return Motion(SKELETON, root, rotations, name=f"wandering {seed}")


def straight_motion(num_frames: int = 120, step=(0.03, 0.0, 0.04)) -> Motion:
    """A stiff figure that slides along a line, facing +Z."""
    root = np.array([0.3, 0.9, -0.2]) + np.arange(num_frames)[:, None] * np.array(step)
    rotations = np.broadcast_to(np.eye(3), (num_frames, SKELETON.num_joints, 3, 3))
    return Motion(SKELETON, root, rotations, name="straight")


def stiff_walk(step: float, num_frames: int = 60) -> Motion:
    """A stiff figure at `step` metres a frame along +Z."""
    return straight_motion(num_frames, (0.0, 0.0, step))


def walks_and_runs() -> PackedMotion:
    """Calm walks 1.2 m/s and has a run in the test split; of proud only fast test clips exist."""
    train, validation, test = 0, 1, 2
    clips = [(stiff_walk(step), style, train) for step, style in ((0.04, 0), (0.04, 0), (0.12, 0), (0.03, 1))]
    clips += [(stiff_walk(step), style, test) for step, style in ((0.042, 0), (0.12, 0), (0.09, 1), (0.15, 1))]
    made = packed_from([*clips, (stiff_walk(0.04, 9), 0, test), (stiff_walk(0.045), 0, validation)])
    made.floor_shift[:] = np.linspace(0.01, 0.10, 10)
    return made


def packed_from(clips, *, styles=("calm", "proud"), mirror_styles=()) -> PackedMotion:
    """Pack (motion, style index, split number) triples."""
    motions = [motion for motion, _, _ in clips]
    lengths = [motion.num_frames for motion in motions]
    names = tuple(f"clip {k}" for k in range(len(clips)))
    return PackedMotion(
        skeleton=motions[0].skeleton,
        styles=tuple(styles),
        root_position=np.concatenate([m.root_position for m in motions]).astype(np.float32),
        rotation_6d=np.concatenate([rotation_6d_from_matrix(m.rotations) for m in motions]).astype(np.float16),
        clip_start=np.concatenate([[0], np.cumsum(lengths)]).astype(np.int32),
        clip_names=names,
        clip_contents=("walk",) * len(clips),
        clip_style=np.array([style for _, style, _ in clips], np.int32),
        clip_split=np.array([split for _, _, split in clips], np.uint8),
        floor_shift=np.zeros(len(clips), np.float32),
        primary_styles=tuple(styles),
        mirror_styles=frozenset(mirror_styles),
        name="tiny",
        licence="none",
        credit="nobody",
        fingerprint="0" * 64,
    )


def walk_with_contacts(style, seconds, seed=0, fps=30.0):
    """A walk of the synthetic walker, and the contacts that it planned, [T, 2]."""
    return synthetic._walk(style, seed, fps, round(seconds * fps))


def walks_of(styles, splits=(0, 0, 1, 2, 2), seconds: float = 4.0) -> PackedMotion:
    """Packed walks of these styles of the synthetic walker, one of each for each split number."""
    made = [
        (synthetic.synthesize(style, seconds, seed), number, split)
        for number, style in enumerate(styles)
        for seed, split in enumerate(splits)
    ]
    return packed_from(made, styles=styles)


def tiny_packed(mirror_styles=("calm",)) -> PackedMotion:
    """Five clips of two styles: three for training, one each to validate and to test."""
    frames_styles_splits = enumerate(((30, 0, 0), (21, 1, 0), (26, 0, 1), (17, 1, 0), (24, 1, 2)))
    clips = [(wandering_motion(frames, seed), style, split) for seed, (frames, style, split) in frames_styles_splits]
    return packed_from(clips, mirror_styles=mirror_styles)


_TINY = {"channels": CHANNELS, "num_styles": 2, "window": WINDOW, "num_history": HISTORY, "latent_width": 8, "depth": 1}


def tiny_config(**changes) -> F3AMDConfig:
    """The smallest network that still has every part."""
    return config_from_dict({"family": "F3AMD", **_TINY, "num_kept_modes": WINDOW // 2 + 1, **changes})


def tiny_camdm(**changes) -> CAMDMConfig:
    """The smallest CAMDM, told the four steps of its schedule."""
    levels = tuple(variance_preserving_cosine(4).levels.tolist())
    return CAMDMConfig(**{**_TINY, "num_heads": 2, "noise_levels": levels, **changes})


@functools.cache
def _built(config: NetworkConfig):
    return nnx.split(build_from_config(config, jax.random.key(0)))


def network_of(config: NetworkConfig) -> nnx.Module:
    """A network of its own, always with the same initial weights; built once per config."""
    graph, state = _built(config)
    return nnx.merge(graph, jax.tree.map(lambda leaf: leaf, state))


def stirred(network, seed: int = 0, scale: float = 0.2):
    """The network with random weights in place of its zeros."""
    graph, state = nnx.split(network)
    rng = np.random.default_rng(seed)  # JAX's would be compiled for each form of network
    moved = lambda leaf: jnp.asarray(np.asarray(leaf) + scale * rng.standard_normal(leaf.shape), leaf.dtype)
    return nnx.merge(graph, jax.tree.map(moved, state))


def evaluate(network, x_noisy, sigma, condition):
    """Encode and denoise, compiled once per form of the network and shape."""
    network = Compiled(network)
    return network(x_noisy, sigma, network.encode(condition))


def draw(*shape, seed: int = 0):
    """Normal numbers, float32."""
    return jnp.asarray(np.random.default_rng(seed).standard_normal(shape), jnp.float32)


def make_condition(batch: int = 2) -> Condition:
    """A condition of random numbers for the tiny network."""
    return Condition(
        history=draw(batch, HISTORY, CHANNELS, seed=1),
        path=draw(batch, WINDOW, 8, seed=2),
        style=jnp.eye(2)[jnp.arange(batch) % 2],
    )


def tiny_windows(split: str = "train", packed: PackedMotion | None = None):
    """Windows of the tiny data set, of the tiny network's length."""
    packed = tiny_packed() if packed is None else packed
    return build_windows(packed, split, window=WINDOW, num_history=HISTORY)


@functools.cache
def tiny_normaliser():
    """The normaliser of the tiny training windows."""
    return jax.jit(fit_normaliser)(tiny_windows(), jax.random.key(5))


def tiny_task(model=None, *, windows=None, **settings) -> DenoisingTask:
    """The tiny network to train on the tiny data set."""
    config = TrainingConfig.from_dict({"num_steps": 12, "batch_size": 8, **settings})
    windows = tiny_windows() if windows is None else windows
    return denoising_task(model or tiny_config(), config, SKELETON, tiny_normaliser(), windows)


def random_frames(shape, seed: int = 0) -> np.ndarray:
    """World frames [*shape, C] of random true rotations and root positions within a few metres."""
    rng = np.random.default_rng(seed)
    count = int(np.prod(shape, dtype=int))
    rotations = Rotation.random(count * SKELETON.num_joints, random_state=seed).as_matrix()
    sixes = rotation_6d_from_matrix(rotations).reshape(*shape, 6 * SKELETON.num_joints)
    return np.concatenate([rng.normal(size=(*shape, 3)), sixes], axis=-1)


def same_tree(first, second) -> bool:
    """Whether two trees hold exactly the same numbers."""
    one, two = jax.tree.leaves(first), jax.tree.leaves(second)
    return len(one) == len(two) and all(
        np.array_equal(np.asarray(a), np.asarray(b)) for a, b in zip(one, two, strict=True)
    )


class AnsweringNetwork:
    """In the place of a network: answers by a rule, `answer(x_noisy, sigma)`."""

    config = tiny_config()

    def __init__(self, answer):
        self.answer = answer

    def encode(self, condition):
        return condition

    def __call__(self, x_noisy, sigma, context):
        return self.answer(x_noisy, sigma)


def tiny_trained(record=None, config=None, diffusion=None, **changes) -> TrainedModel:
    """A trained model in form only: initial weights, real normaliser, real seed histories."""
    config = config or tiny_config(**changes)
    packed = tiny_packed()
    return TrainedModel(
        name="F3AMD-FNO-8",
        config=config,
        params=nnx.state(network_of(config)),
        normaliser=tiny_normaliser(),
        skeleton=SKELETON,
        styles=packed.styles,
        diffusion=diffusion or variance_exploding(),
        start_poses=starting_poses(packed, num_history=HISTORY),
        record={"note": "made by hand"} if record is None else record,
    )


def refused(match: str, call, /, *arguments, **settings):
    """A call must end in a ValueError with a text like this."""
    with pytest.raises(ValueError, match=match):
        call(*arguments, **settings)


def cut_off(png) -> bool:
    """Whether something dark touches the edge of a picture: a title or a label without its rest.

    Args:
      png: path or file object of a PNG.
    """
    with Image.open(png) as image:
        grey = np.asarray(image.convert("L"))
    return bool((np.concatenate([grey[0], grey[-1], grey[:, 0], grey[:, -1]]) < 160).any())


def captioned_walks(styles, splits, num_frames: int) -> TextMotions:
    """Six captioned walks a style, 20 frames a second; clips beyond the list of splits are of its last."""
    clips = []
    for style in styles:
        for seed in range(6):
            walk = synthetic.synthesize(style, seconds=num_frames / 20.0, seed=seed)
            motion, split = resample(walk, 20.0).slice(0, num_frames), splits[min(seed, len(splits) - 1)]
            clips.append((f"{style}_{seed}", motion, (f"a person walks {style}",), split, style))
    return text_motions(clips, skeleton=motion.skeleton, name="bandai", fps=20.0, licence="ours", credit="nobody")


def placed(path: RootPath, position, yaw: float = 0.0) -> RootPath:
    """Move a path so that its first frame lies at `position` (x, z) and faces `yaw`."""
    angle = float(yaw) - path.yaw[0]
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    turned = (path.position - path.position[0]) @ turn
    return RootPath(turned + np.asarray(position, np.float64), path.yaw + angle, path.fps)


@functools.cache
def load_commands(paper: str = "f3amd") -> dict[str, list[str]]:
    """Return what one types to measure each claim again: id -> command lines, in the order of `commands.toml`."""
    from f3amd_companion.ledger.claims import load_claims  # here: most tests do without the ledger
    from f3amd_lib.ground.papers import load_paper_file

    commands = load_paper_file("commands", paper)["command"]
    return {name: [one["run"] for one in commands if name in one["claims"]] for name in load_claims(paper)}
