"""What a notebook shows first: a model that has weights, and a real clip whose path it may follow."""

from pathlib import Path

import numpy as np
from f3amd_lib.data.features import world_frames
from f3amd_lib.data.packed import PackedMotion
from f3amd_lib.ground.profiles import PRETRAINED_DIR, Profile, load_profile
from f3amd_lib.measures.real_clips import own_path, reference_clips
from f3amd_lib.motion.root_paths import RootPath
from f3amd_lib.motion.skeleton import Motion
from f3amd_lib.training.checkpoints import TrainedModel, load_model
from f3amd_lib.training.pipeline import PreparedData, model_files, obtain_model


def shipped_weights(dataset: str) -> Path | None:
    """Return the weights whose motion is shown of a data set, None where none ship."""
    weights = model_files(load_profile("laptop", dataset), folder=PRETRAINED_DIR / dataset).model
    return weights if weights.is_file() else None


def shown_model(prepared: PreparedData, profile: Profile, *, progress: bool = True) -> tuple[TrainedModel, str]:
    """Return the model whose motion a reader sees: what ships for the data set, in any profile.

    Args:
      prepared: the data; its styles must be among the model's.
      profile: names the data set; where nothing ships for it, the profile's own model is obtained.
      progress: as for `obtain_model`.

    Returns:
      (model, origin), origin as from `obtain_model`.
    """
    shipped = shipped_weights(profile.dataset)
    if profile.name == "smoke" and shipped:
        trained = load_model(shipped)
        if set(prepared.packed.styles) <= set(trained.styles) and trained.skeleton == prepared.packed.skeleton:
            return trained, "shipped"
    trained, _, origin = obtain_model(prepared, profile, progress=progress)
    return trained, origin


def follow_clip(
    packed: PackedMotion, clip: int, *, num_history: int, num_frames: int
) -> tuple[np.ndarray, RootPath, Motion]:
    """Return what a model needs to walk where a real clip walked, and what that clip did.

    Args:
      packed: the data set.
      clip: its number.
      num_history: frames that the model is given, the clip's first.
      num_frames: frames that it is to make after them.

    Returns:
      (history, path, motion): world frames [1, num_history, C]; the clip's own line (`own_path`)
      and its motion over the frames that follow, num_frames each.

    Raises:
      ValueError: if there is no such clip, or it is too short.
    """
    whole = packed.motion(clip)
    end = num_history + num_frames
    if whole.num_frames < end:
        raise ValueError(f"clip {whole.name!r} has {whole.num_frames} frames, {end} are needed: ask for fewer")
    history = world_frames(whole)[None, :num_history].astype(np.float32)
    return history, own_path(whole).slice(num_history, end), whole.slice(num_history, end)


def follow_longest(
    packed: PackedMotion, style: str, *, num_history: int, num_frames: int
) -> tuple[np.ndarray, RootPath, Motion]:
    """Return what `follow_clip` does of the longest held-out clip of a style."""
    clips = reference_clips(packed, [style], window=num_frames)
    longest = max(clips, key=lambda clip: packed.motion(clip).num_frames)
    return follow_clip(packed, longest, num_history=num_history, num_frames=num_frames)
