"""Motion as people look at it: seams blended, feet held; crowds of it as files and pictures."""

import contextlib
import re
from pathlib import Path

from tqdm import tqdm

from f3amd_companion.serving import motion_files
from f3amd_companion.serving.foot_locking import lock_feet
from f3amd_companion.serving.player import Character, Scene, write_player
from f3amd_lib.data.features import motion_from_frames, world_frames
from f3amd_lib.drawing import pictures, style
from f3amd_lib.ground import log
from f3amd_lib.ground.files import whole_folder
from f3amd_lib.rollout.blending import blend_seams


def held(lock, made):
    """Return a motion or a rollout with supporting feet held in place, if its legs are hip, knee, ankle and toe."""
    try:
        return lock(made)
    except ValueError as error:
        log.info("feet         not held: %s", error)
        return made


def finished(motion, window: int):
    """Blend a motion's seams over 4 frames and hold its feet, as where people look."""
    frames = blend_seams(world_frames(motion), window, min(4, window))
    return held(lock_feet, motion_from_frames(motion.skeleton, frames, motion.fps, motion.name))


def crowd_motions(crowd, shown, credit: str, folder: Path, formats) -> None:
    """Write a file a character and format, one after the other, so that no crowd is too large: NUMBER_STYLE.bvh.

    Files of an earlier crowd are removed first; what else lies there stays. A new folder is there whole or not at all.
    """
    digits = len(str(len(crowd) - 1))
    for file in folder.glob("*"):
        if re.fullmatch(r"\d+_.*\.(bvh|glb|csv)", file.name):
            file.unlink()
    with contextlib.nullcontext(folder) if folder.exists() else whole_folder(folder) as place:
        for character in tqdm(range(len(crowd)), "writing motions"):
            motion, name = shown(character), f"{character:0{digits}d}_{crowd.style(character)}"
            for ending in formats:
                motion_files.write_motion(place / f"{name}{ending}", motion, credit=credit)


def crowd_pictures(crowd, shown, credit: str, still: Path, page: Path) -> None:
    """Draw a crowd half way through, and write a page that plays up to 100 of it; `shown` gives a motion by number."""
    name = crowd.settings["model"]["name"]
    motions = [shown(k) for k in tqdm(range(min(100, len(crowd))), "finishing motions")]
    colors = pictures.crowd_colors([motion.name for motion in motions])
    characters = [Character(motion, path=crowd.target(k), color=colors[k]) for k, motion in enumerate(motions)]
    write_player(page, Scene(characters, title=name), strip=False, credit=credit)
    style.save_figure(pictures.crowd_figure({name: (motions, colors)}, crowd.num_frames // 2), still)
