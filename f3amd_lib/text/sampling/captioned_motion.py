"""Motion that a caption tells: from a trained model and words to positions in metres, whole, controlled or as a stream.

What a user asks for is checked here, once; `text.sampling.text_to_motion` has the samplers.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from scipy.ndimage import binary_opening

from f3amd_lib.ground.names import nearest_hint
from f3amd_lib.motion.inverse_kinematics import fitted
from f3amd_lib.motion.root_paths import read_points_csv
from f3amd_lib.motion.rotations import matrix_from_yaw
from f3amd_lib.motion.skeleton import Motion, Skeleton
from f3amd_lib.text.data.redundant import smoothed_yaw
from f3amd_lib.text.data.text_encoders import check_captions, check_words, embed_captions
from f3amd_lib.text.data.text_motions import FEWEST_FRAMES, UNIT, frame_mask
from f3amd_lib.text.networks.acmdm import Control, MaskedACMDMConfig, TextCondition, branch_with
from f3amd_lib.text.sampling import text_to_motion
from f3amd_lib.text.sampling.motionpcm_sampling import latent_motions
from f3amd_lib.text.stages.text_models import LatentModel, TextModel
from f3amd_lib.training.checkpoints import network_with

NEAR = 4
"""Starts of a stream among which the seed chooses: those whose captions are nearest to the first one."""

STREAM_PRESET = "ACMDM-n4-PS22-prefix"
"""The model of the prefix form that two cores can train."""


# ------------------------------------------------------------------------------------------------------- what is asked


def told_captions(
    trained: TextModel | LatentModel, encoder, captions: Sequence[str], *, any_words: bool = False
) -> np.ndarray:
    """Return pooled embeddings of captions, [captions, W].

    Args:
      trained: the model that will be told.
      encoder: of captions.
      captions: what the person does.
      any_words: let words through that the model has never seen; of a published model nobody knows them.

    Raises:
      ValueError: for a caption that is empty, too long or has unknown words, or another encoder than the model's.
    """
    if encoder.identity != trained.text_encoder:
        raise ValueError(f"{trained.name} reads captions of {trained.text_encoder}, not of {encoder.identity}")
    check_captions(captions)
    if trained.words and not any_words:
        for caption in captions:
            check_words(caption, trained.words)
    return embed_captions(list(captions), encoder).pooled


def told_frames(trained: TextModel | LatentModel, seconds: float) -> int:
    """Return the frames of a length, a multiple of 4; ValueError if the model makes none of that length."""
    least, most = (frames / trained.fps for frames in (FEWEST_FRAMES, trained.most_frames // UNIT * UNIT))
    if not least <= seconds <= most:  # also catches NaN
        raise ValueError(f"--seconds must be between {least:g} and {most:g} for {trained.name}, got {seconds:g}")
    return max(FEWEST_FRAMES, round(seconds * trained.fps / UNIT) * UNIT)


def told_windows(trained: TextModel, seconds: float) -> int:
    """Return the windows of a stream that a caption is told for; ValueError unless for up to 600 seconds."""
    if not 0 < seconds <= 600:  # also catches NaN
        raise ValueError(f"--seconds of a stream must be over 0 and at most 600 a caption, got {seconds:g}")
    return max(1, round(seconds * trained.fps / window_frames(trained)))


def window_frames(trained: TextModel) -> int:
    """Return the frames of motion that one window of a stream adds; ValueError if the model is for no stream."""
    if not trained.starts:
        how = f"--model {STREAM_PRESET}, after f3amd train --preset {STREAM_PRESET} --data bandai"
        raise ValueError(f"{trained.name} makes whole motions, a stream needs the prefix form: {how}")
    given = len(next(iter(trained.starts.values())))
    return (trained.config.window - given) * trained.codec.frames_per_state


def read_control_csv(path, num_frames: int) -> tuple[np.ndarray, np.ndarray]:
    """Read where a joint should be, from a CSV file with the header frame,x,y,z: frames from 0, metres.

    Args:
      path: the file.
      num_frames: of the clip.

    Returns:
      (frames [K], points [K, 3]).

    Raises:
      ValueError: naming file and line, as `read_points_csv`, or for a frame that is outside the clip or comes twice,
        or no row at all.
    """
    points: dict[int, list[float]] = {}
    for where, row in read_points_csv(path, "frame,x,y,z"):
        frame = row["frame"]
        if frame != int(frame) or not 0 <= frame < num_frames:
            raise ValueError(f"{where} frame {frame:g} is not one of the clip's, 0 to {num_frames - 1}; see --seconds")
        if frame in points:
            raise ValueError(f"{where} frame {frame:g} occurs twice; keep one of its points")
        points[int(frame)] = [row[axis] for axis in "xyz"]
    if not points:
        raise ValueError(f"{path}: needs at least one row below its header")
    return np.array(list(points)), np.array(list(points.values()))


def find_joint(trained: TextModel, name: str) -> int:
    """Return a joint that the control branch was trained for, by its role or its own name; ValueError lists them."""
    known = trained.controlled
    own = {trained.skeleton.names[joint]: joint for joint in known.values()}
    if name not in known | own:
        raise ValueError(f"unknown joint {name!r}{nearest_hint(name, known)}")
    return (known | own)[name]


def check_solver(num_steps: int | None, guidance: float | None) -> None:
    """Raise ValueError for a number of steps or a guidance that makes no sense."""
    if num_steps is not None and not 1 <= num_steps <= 1000:
        raise ValueError(f"--steps must be between 1 and 1000, got {num_steps}")
    if guidance is not None and not 0 <= guidance <= 20:  # also catches NaN
        raise ValueError(f"--guidance must be between 0 and 20, got {guidance}")


# ------------------------------------------------------------------------------------------------------- what is made


class Told(NamedTuple):
    """What a model made of captions.

    Attributes:
      motion: bones keep their lengths; its name is what was told.
      boundaries: frames at which a caption of a stream begins.
      moved: how far joints were moved for the bones' sake (`inverse_kinematics.fitted`), metres.
      missed: how far the controlled joint is from each point it was to be at, [K], metres; None without control.
    """

    motion: Motion
    boundaries: range
    moved: np.ndarray
    missed: np.ndarray | None


def animate(
    trained: TextModel | LatentModel, encoder, captions: Sequence[str], *, seconds: float = 4.0, seed: int = 0,
    guidance: float | None = None, num_steps: int | None = None, control=None, joint: str = "pelvis",
    any_words: bool = False,
) -> Told:  # fmt: skip
    """Animate one caption, or several as a stream: what `f3amd text` does.

    Args:
      trained, encoder, captions, any_words: as for `told_captions`.
      seconds: of each caption.
      seed: of the noise.
      guidance, num_steps: as for `draw_motions`.
      control: CSV file, see `read_control_csv`: where a joint should be.
      joint: see `find_joint`.

    Raises:
      ValueError: for what the model cannot do, as the functions above.
    """
    check_solver(num_steps, guidance)
    if isinstance(trained, LatentModel) and (len(captions) > 1 or control):
        raise ValueError(f"{trained.name} makes whole motions of one caption: leave out --then and --control")
    pooled = told_captions(trained, encoder, captions, any_words=any_words)
    key, how = jax.random.key(seed), {"guidance": guidance, "num_steps": num_steps}
    boundaries = range(0)
    if len(captions) > 1 or getattr(trained, "starts", ()):
        windows, starts = told_windows(trained, seconds), embed_captions(list(trained.starts), encoder).pooled
        positions = stream_motions(trained, pooled, [windows] * len(captions), key, starts=starts, **how)
        each = windows * window_frames(trained)
        boundaries = range(len(positions) - each * len(captions), len(positions), each)
    else:
        num_frames = told_frames(trained, seconds)
        if control is not None:
            which, (frames, points) = find_joint(trained, joint), read_control_csv(control, num_frames)
            how["control"] = control_of(trained, which, frames, points, num_frames)
        positions = draw_motions(trained, pooled, num_frames, key, **how)[0]
    if control is None:  # whose points lie where they are
        positions = as_shown(trained.skeleton, positions, trained.fps)
    motion, moved = fitted(Motion.from_positions(trained.skeleton, positions, trained.fps, ", then ".join(captions)))
    missed = None if control is None else np.linalg.norm(motion.positions[frames, which] - points, axis=-1)
    return Told(motion, boundaries, moved, missed)


def as_shown(skeleton: Skeleton, positions, fps: float) -> np.ndarray:
    """Begin at the origin, take out trembling, and keep people in place who stand (ours): what a viewer gets.

    Networks tremble: a frame becomes half itself and a quarter of each neighbour, which moves joints of captured motion
    by 2 mm in the mean. Networks that make steps of the root glide a little with feet at rest: where both toes move
    alike for a second, that is taken from all joints. Alike are speeds over the ground that differ by less than
    0.45 m/s; a skeleton without toes may glide. Who walks goes as far as before.

    Args:
      skeleton: J joints.
      positions: [T, J, 3], metres.
      fps: frames per second.
    """
    at = positions - positions[0, 0] * (1, 0, 1)
    positions = np.concatenate([at[:1], (at[:-2] + 2 * at[1:-1] + at[2:]) / 4, at[-1:]])
    if not {"left_toe", "right_toe"} <= {*skeleton.roles}:
        return positions
    steps = np.diff(positions[:, list(skeleton.toes)], axis=0) * (1, 0, 1)
    alike = np.linalg.norm(steps[:, 0] - steps[:, 1], axis=-1) * fps < 0.45
    glides = np.where(binary_opening(alike, np.ones(round(fps)))[:, None], steps.mean(axis=1), 0.0)
    return positions - np.cumsum(np.pad(glides, ((1, 0), (0, 0))), axis=0)[:, None]


def _asked(trained: TextModel, guidance: float | None, num_steps: int | None) -> dict:
    """Return what the samplers are told: a guidance, asked for or the model's own, and Euler's steps where given."""
    guidance = trained.record.get("guidance") if guidance is None else guidance
    told = {} if guidance is None else {"guidance": guidance}
    return told if num_steps is None else told | {"sampler": trained.schedule.sampler, "num_steps": num_steps}


def motion_drawer(
    trained: TextModel, *, guidance: float | None = None, num_steps: int | None = None, controlled: bool = False,
    mesh: bool = False,
) -> Callable:  # fmt: skip
    """Return `draw(pooled, mask, key, control)`, compiled once for a shape: normalised positions [B, L, J, 3].

    Args:
      trained: a model of whole motions.
      guidance, num_steps, mesh: as for `draw_motions`.
      controlled: whether a control is given to it, or None.

    Raises:
      ValueError: for a control and no branch.
    """
    config, schedule = trained.config, trained.schedule
    asked = _asked(trained, guidance, num_steps)
    if controlled:
        trained.control_branch()  # says how to train one if there is none
    weights = {"network": trained.params, "branch": trained.branch if controlled else None}

    @jax.jit
    def compiled(weights, codec, pooled, mask, noise, key, control):
        network, condition = network_with(config, weights["network"]), TextCondition(pooled, codec.state_mask(mask))
        if controlled:
            branch = branch_with(config, codec.frames_per_state, weights["branch"])
            given = network, branch, schedule, condition, control, noise
            state = text_to_motion.sample_control(*given, key=key, **asked)
        elif isinstance(config, MaskedACMDMConfig):
            state = text_to_motion.sample_masked(network, schedule, condition, key, **asked)
        else:
            sample = text_to_motion.sample_blocks if config.block_frames else text_to_motion.sample_text
            state = sample(network, schedule, condition, noise, key=key, **asked)
        return codec.decode_vertices(state) if mesh else codec.decode(state, mask)

    def draw(pooled, mask, key, control=None):
        key_noise, key_solver = jax.random.split(key)
        frames = trained.codec.state_mask(mask).shape
        noise = jax.random.normal(key_noise, (*frames, config.num_joints, config.channels))
        return compiled(weights, trained.codec, jnp.asarray(pooled), mask, noise, key_solver, control)

    return draw


def draw_motions(
    trained: TextModel | LatentModel, pooled, num_frames, key, *,
    guidance: float | None = None, num_steps: int | None = None, control: Control | None = None, mesh: bool = False,
    draw: Callable | None = None,
) -> np.ndarray:  # fmt: skip
    """Draw a motion for each caption, whole at once, or block by block or masked, as the model is made for.

    Args:
      trained: the model; one of the prefix form goes on from frames and is for `stream_motions`. Of MotionPCM
        a teacher or a student.
      pooled: captions, [B, W].
      num_frames: of each motion, [B] or one for all; multiples of 4.
      key: JAX random key.
      guidance: w; by default what the model's record says (`guidance`), else the form's own.
      num_steps: of Euler's method; by default the model's own sampler. Of MotionPCM as `motionpcm_sampling.steps_of`.
      control: where joints should be, normalised, [B, L, J, 3].
      mesh: return the vertices of a model of meshes, [B, L, V, 3], whose `codec.mesh` has joints and faces of them.
      draw: a `motion_drawer` (of MotionPCM a `latent_sampler`) that is compiled already, told guidance and steps.

    Returns:
      Positions, [B, L, J, 3], metres, starting near the origin facing +Z; L the longest; 0 in the padding.

    Raises:
      ValueError: for a model of the prefix form, a control and no branch, or a mesh of a model that makes joints.
    """
    if mesh and (isinstance(trained, LatentModel) or trained.codec.mesh is None):
        raise ValueError(f"{trained.name} makes joints, no mesh; a model that makes one: ACMDM-S-PS28-n2")
    if isinstance(trained, LatentModel):
        if control is not None:
            raise ValueError(f"{trained.name} has no control branch: leave --control out, or name a model of ACMDM")
        return latent_motions(trained, pooled, num_frames, key, draw=draw, num_steps=num_steps, guidance=guidance)
    if trained.starts:
        raise ValueError(f"{trained.name} goes on from earlier frames: stream it (--then), or name another --model")
    how = {"guidance": guidance, "num_steps": num_steps, "controlled": control is not None, "mesh": mesh}
    lengths, draw = np.broadcast_to(num_frames, len(pooled)), draw or motion_drawer(trained, **how)
    mask = frame_mask(lengths, int(lengths.max()))
    made = np.asarray(draw(pooled, mask, key, control))
    return trained.codec.axes.restore(made) * np.asarray(mask)[..., None, None]


def control_of(trained: TextModel, joint: int, frames, points, num_frames: int) -> Control:
    """Return the control of one motion: a joint at points [K, 3], metres, in frames [K]."""
    positions = np.zeros((1, num_frames, trained.config.num_joints, 3), np.float32)
    positions[0, frames, joint] = trained.codec.axes.normalise(points)
    asked = np.zeros(positions.shape[:-1], np.float32)
    asked[0, frames, joint] = 1.0
    return Control.of(jnp.asarray(positions), asked)


def stream_motions(
    trained: TextModel, pooled, windows: Sequence[int], key, *,
    guidance: float | None = None, num_steps: int | None = None, starts=None,
) -> np.ndarray:  # fmt: skip
    """Go on from frames of a clip, window after window, under captions that change on the way (ACMDM App. G, prefix).

    Before each window the last frames are moved to the origin and turned to +Z, as clips begin, and what comes is
    moved back: a stream may go anywhere and last for ever.

    Args:
      trained: a model of the prefix form.
      pooled: captions in their order, [captions, W].
      windows: how many windows each is told for.
      key: JAX random key; it also chooses the start.
      guidance, num_steps: as for `draw_motions`.
      starts: captions of `trained.starts` embedded, [starts, W], to begin near the first caption; by default anyhow.

    Returns:
      Positions, [frames, J, 3], metres: the start and all windows.

    Raises:
      ValueError: for a model that is not of the prefix form.
    """
    window_frames(trained)  # refuses a model that is for no stream
    codec, asked = trained.codec, _asked(trained, guidance, num_steps)
    states = np.stack(list(trained.starts.values()))
    near = np.arange(len(states))
    if starts is not None:
        near = np.argsort(-(starts @ pooled[0]) / np.linalg.norm(starts, axis=-1))[:NEAR]
    chosen = states[int(jax.random.choice(jax.random.fold_in(key, 0), near))][None]
    given = chosen.shape[1] * codec.frames_per_state

    @jax.jit
    def go_on(before, caption, key):
        prefix = codec.encode(before, jnp.ones((1, given), bool))
        (made,) = text_to_motion.continue_prefix(trained.network(), trained.schedule, prefix, [caption], key, **asked)
        state = jnp.concatenate([prefix, made], axis=1)
        return codec.decode(state, jnp.ones((1, state.shape[1] * codec.frames_per_state), bool))[:, given:]

    metres = lambda normalised: codec.axes.restore(np.asarray(normalised, np.float64)[0])
    parts = [metres(codec.decode(jnp.asarray(chosen), jnp.ones((1, given), bool)))]
    told = [caption for caption, count in zip(pooled, windows, strict=True) for _ in range(count)]
    for number, caption in enumerate(told, 1):
        before = np.concatenate(parts)[-given:]
        place = before[0, 0] * [1.0, 0.0, 1.0]
        turned = matrix_from_yaw(smoothed_yaw(trained.skeleton, before[:1], 0.0)[0])
        here = codec.axes.normalise((before - place) @ turned).astype(np.float32)
        after = go_on(here[None], caption[None], jax.random.fold_in(key, number))
        parts.append(metres(after) @ turned.T + place)
    return np.concatenate(parts)
