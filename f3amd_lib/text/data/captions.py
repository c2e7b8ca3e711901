"""Captions for the Bandai clips, composed from what a clip's name and its motion say.

A caption joins a subject or a manner (style), an action (content) and a detail that is measured on
the clip (how fast, how high the hands go). All words stand in `captions.toml`; which of them a clip
gets follows from its name alone. Some phrases are held out: no training caption has them.
"""

import hashlib
import re
from pathlib import Path

import numpy as np

from f3amd_lib.ground.files import read_toml
from f3amd_lib.ground.names import nearest_hint
from f3amd_lib.motion.skeleton import Motion

_WORDS = read_toml(Path(__file__).with_name("captions.toml"))

CAPTIONED = tuple(_WORDS["content"])
"""Contents that have words."""

_SIDES = {"left": "right", "right": "left"}


def other_side(text: str) -> str:
    """Return a caption or a content's name with left and right exchanged, for a mirrored clip."""
    return re.sub(r"\b(left|right)\b", lambda found: _SIDES[found[0]], text)


def caption_wordings(content: str, *, held_out: bool = False) -> tuple[str, ...]:
    """Return the actions that captions of a content name, such as "raises the left hand".

    Args:
      content: one of `CAPTIONED`.
      held_out: those that training never sees, instead of the others.
    """
    return tuple(_WORDS["content"][content]["held_out" if held_out else "action"])


def plain_style(style: str) -> str:
    """Return a style of either part of the set without its number, by one name: "1-old" is "elderly"."""
    style = style.partition("-")[2]
    return _WORDS["same_style"].get(style, style)


def shown_content(content: str, motion: Motion) -> str:
    """Return a content with the side that the motion turns to, where its name tells another."""
    if "-turn-" not in content:
        return content
    yaw = np.unwrap(motion.yaw)
    turned = "left" if yaw[-1] > yaw[0] else "right"
    return content if turned in content else other_side(content)


def measured_detail(kind: str, motion: Motion) -> str:
    """Say how fast somebody walks or runs, or how high hands go, in the words of `captions.toml`.

    Args:
      kind: "walk", "run", "hands", "left hand" or "right hand".
      motion: a clip whose head and wrists are known.

    Returns:
      A phrase with a space in front, or nothing where the clip is neither fast nor slow.
    """
    positions, skeleton = motion.positions, motion.skeleton
    if kind in ("walk", "run"):
        steps = np.linalg.norm(np.diff(positions[:, 0, ::2], axis=0), axis=-1)
        number = steps.mean() * motion.fps
    else:
        sides = ("left", "right") if kind == "hands" else (kind.partition(" ")[0],)
        wrists = positions[:, [skeleton.role(f"{side}_wrist") for side in sides], 1].min(axis=1)
        number = np.max(wrists - positions[:, skeleton.role("head"), 1])
    words = _WORDS["detail"][kind]
    return next(phrase for limit, phrase in zip(words["limits"], words["phrases"], strict=True) if number < limit)


def compose_captions(name: str, content: str, style: str, motion: Motion, *, count: int = 4, held_out=False) -> tuple:
    """Compose different captions of a clip.

    Args:
      name: of the clip, which decides the choice.
      content: such as "walk-turn-left", one of `CAPTIONED`.
      style: a style of `captions.toml`, from `plain_style`.
      motion: the clip, for the details.
      count: captions; fewer where words run out.
      held_out: use the wordings that training never sees, instead of the others.

    Returns:
      Captions, a tuple of str, none twice; the same for the same clip, always.

    Raises:
      ValueError: for a content or a style without words.
    """
    for kind, known in (("content", content), ("style", style)):
        if known not in _WORDS[kind]:
            raise ValueError(f"no words for {kind} {known!r} in captions.toml{nearest_hint(known, _WORDS[kind])}")
    content_words, style_words = _WORDS["content"][content], _WORDS["style"][style]
    actions = caption_wordings(content, held_out=held_out)
    if held_out:
        style_words = style_words["held_out"]
    detail = measured_detail(content_words["detail"], motion) if "detail" in content_words else ""
    every = [
        pattern.format(subject=subject, action=action, detail=known_detail, manner=manner)
        for pattern in _WORDS["patterns"]
        for subject, manner in zip(style_words["subject"], style_words["manner"], strict=True)
        for action in actions
        for known_detail in dict.fromkeys(("", detail))
    ]
    rank = lambda text: hashlib.sha256(f"{name}: {text}".encode()).digest()
    return tuple(sorted(dict.fromkeys(every), key=rank)[:count])
