"""Labs on conditions: guidance, a toe that was measured, and the class of an image."""

from __future__ import annotations

import functools
from pathlib import Path

import matplotlib
import numpy as np
import pandas as pd
from f3amd_lib.diffusion.oracles import GaussianMixture
from f3amd_lib.diffusion.predictions import guided
from PIL import Image, ImageDraw, ImageFont

from f3amd_notebooks.labs.judging import Verdict, counted, distance, grid_of, known, points
from f3amd_notebooks.walker_toes import walker_toes


def guide_without_overshoot(answer, rng: np.random.Generator) -> Verdict:
    """Judge `answer(told, free, x, w, grid, rng)`: samples of the tilted density p(x)^(1 - w) p(x | c)^w."""
    grid, count, rows = grid_of(np.inf, 24, 40.0, 0.02), 500, {}
    walks = {
        "w = 1, DDIM": lambda told, free, x, w, grid, rng: known("ddim", told, x, grid),
        "guided DDIM": lambda told, free, x, w, grid, rng: known("ddim", guided(told, free, w), x, grid),
        "guided DDPM": lambda told, free, x, w, grid, rng: known("ddpm", guided(told, free, w), x, grid, rng),
        "your sampler": answer,
    }
    for case in ("one", "two"):
        # Of one mode the width is near the crowd's, so that the tilted density depends on w.
        width = rng.uniform(0.65, 0.8) if case == "one" else rng.uniform(0.5, 0.65)
        side, w = rng.choice([-1.0, 1.0]), rng.uniform(2.5, 6.0)
        if case == "one":
            told, crowd = GaussianMixture([side * 0.8], width), GaussianMixture([0.0], rng.uniform(1.0, 1.15))
        else:
            modes = side * np.array([-1.6, 0.3, 1.8])
            told, crowd = GaussianMixture(modes[1:], width), GaussianMixture(modes, width)
        places = np.linspace(-8, 8, 4001)
        log = (1 - w) * crowd.log_density(places[:, None]) + w * told.log_density(places[:, None])
        weights = np.exp(log - log.max())
        middle = weights @ places / weights.sum()
        spread = np.sqrt(weights @ (places - middle) ** 2 / weights.sum())
        for name, walk in walks.items():
            asked, uses = zip(*(counted(data.denoise, 3000, count) for data in (told, crowd)), strict=True)
            start = grid[0] * rng.standard_normal((count, 1))
            found = points(walk(*asked, start, w, grid, np.random.default_rng(rng.integers(2**31))), start.shape)[:, 0]
            row = rows.setdefault(name, {})
            row[f"{case}: width"] = found.std() / spread
            row[f"{case}: beyond"] = side * (found.mean() - middle) / spread
            row[f"{case}: away"] = distance(found, places, weights) / spread
            row["evaluations"] = max(row.get("evaluations", 0), sum(used() for used in uses))
    mine = rows["your sampler"]
    fault = None
    for case in ("one", "two"):
        left, far, away = (mine[f"{case}: {what}"] for what in ("width", "beyond", "away"))
        where = "where the condition leaves one mode" if case == "one" else "where it leaves two modes"
        if away <= 0.2:
            continue
        if far < -2.0:
            fault = f"{where}: the samples lie on the wrong side: the guidance leads away from the condition"
        elif left < 0.75:
            fault = f"{where}: variety is lost: only {left:.0%} of the tilted density's width is left"
        elif left > 1.3:
            fault = f"{where}: the samples are too wide, {left:.0%} of the tilted density's width"
        elif far < -0.2:
            fault = f"{where}: the condition is obeyed too little: the mean stops {-far:.2f} widths short"
        else:
            fault = f"{where}: this overshoots: the mean lies {far:.2f} widths beyond that of the tilted density"
        break
    if fault is None and mine["evaluations"] > 2000:
        fault = f"{mine['evaluations']} evaluations are used, 2000 are allowed"
    return Verdict(pd.DataFrame(rows).T.astype({"evaluations": int}).rename_axis("sampler").reset_index(), fault)


_WALKS = ("Neutral", "March", "Tiptoe", "Sleepy", "Happy", "Shuffling", "Stomping", "Texting", "Relaxed")
"""Styles whose toes take turns."""

_AWAY, _KEPT = "right: away (widths)", "right: width kept"


@functools.cache
def _toes(style: str):
    return walker_toes(style, seconds=8.0, num_modes=24, width=0.2)


def one_toe_is_measured(answer, rng: np.random.Generator) -> Verdict:
    """Judge `answer(denoise, x, observed, grid, rng)`: both toes of the walker, the left one as it was measured."""
    grid, count, rows = grid_of(np.inf, 24, 20.0, 0.01), 100, {}
    eased = lambda denoise, x, observed, grid, rng: known("ddim", denoise, x, grid)

    def at_the_end(*given):
        x = eased(*given)
        x[:, 0] = given[2]
        return x

    def in_every_step(denoise, x, observed, grid, rng):
        for here, lower in zip(grid[:-1], grid[1:], strict=True):
            x = known("ddim", denoise, x, np.array([here, lower]))
            x[:, 0] = observed + lower * rng.standard_normal(len(x))
        return x

    walks = {"DDIM, nothing told": eased, "put in at the end": at_the_end, "put in at every step": in_every_step,
             "your sampler": answer}  # fmt: skip
    styles = rng.choice(_WALKS, 3, replace=False)
    for number, style in enumerate(styles):
        toes = _toes(str(style))
        both = toes.both
        lefts = np.sort(both.means[:, 0])
        observed = float(lefts[4] if number % 2 else lefts[-4])  # near the floor, or in the air
        log = -0.5 * ((both.means[:, 0] - observed) / both.width) ** 2
        places = np.linspace(-5, 6, 4001)
        weights = np.exp(log - log.max()) @ np.exp(-0.5 * ((places - both.means[:, 1:]) / both.width) ** 2)
        mean = weights @ places / weights.sum()
        spread = np.sqrt(weights @ (places - mean) ** 2 / weights.sum())
        for name, walk in walks.items():
            denoise, used = counted(both.denoise, 2500, 2 * count)
            start = grid[0] * rng.standard_normal((count, 2))
            found = points(
                walk(denoise, start, observed, grid, np.random.default_rng(rng.integers(2**31))), start.shape
            )
            row = rows.setdefault(name, dict.fromkeys(("left: off (cm)", _AWAY, "evaluations"), 0.0) | {_KEPT: np.inf})
            left = toes.scale * float(np.abs(found[:, 0] - observed).mean())
            row["left: off (cm)"] = max(row["left: off (cm)"], left)
            row[_AWAY] = max(row[_AWAY], distance(found[:, 1], places, weights) / spread)
            row[_KEPT] = min(row[_KEPT], found[:, 1].std() / spread)
            row["evaluations"] = max(row["evaluations"], used())
    mine = rows["your sampler"]
    fault = None
    if mine["left: off (cm)"] > 0.2:
        fault = f"the left toe is {mine['left: off (cm)']:.1f} cm off the height that was measured"
    elif mine["evaluations"] > 1000:
        fault = f"{mine['evaluations']:.0f} evaluations are used, 1000 are allowed"
    elif mine[_KEPT] < 0.5:
        fault = f"the right toe has lost its spread: {mine[_KEPT]:.0%} of its width is left"
    elif mine[_AWAY] > 0.4:
        fault = (f"the right toe does not listen: its heights lie {mine[_AWAY]:.2f} widths away from those that "
                 "go with this left toe")  # fmt: skip
    table = pd.DataFrame(rows).T.astype({"evaluations": int}).rename_axis(", ".join(styles))
    return Verdict(table.reset_index(), fault)


@functools.cache
def digits() -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Draw the ten digits in the fonts that come with matplotlib, shifted and turned, as images of 8 x 8.

    Returns:
      Images [N, 64], roughly centred and of deviation about 1, and their digits [N], then those of fonts that the
      first do not have.
    """
    folder = Path(matplotlib.get_data_path(), "fonts/ttf")
    names = (
        "DejaVuSans DejaVuSans-Bold DejaVuSans-Oblique DejaVuSansMono DejaVuSansMono-Bold DejaVuSerif "
        "DejaVuSerif-Bold STIXGeneral STIXGeneralBol cmr10 cmss10 cmtt10"
    ).split()
    rng, kinds = np.random.default_rng(0), ([], [], [], [])
    for place, name in enumerate(names):
        font = ImageFont.truetype(str(folder / f"{name}.ttf"), 66)
        for digit in range(10):
            for _ in range(6):
                image = Image.new("L", (64, 64))
                ImageDraw.Draw(image).text(32 + rng.uniform(-2, 2, 2), str(digit), fill=255, font=font, anchor="mm")
                image = image.rotate(rng.uniform(-6, 6), resample=Image.Resampling.BILINEAR)
                image = image.resize((8, 8), Image.Resampling.BOX)
                unseen = place % 4 == 3
                kinds[2 * unseen].append(np.asarray(image, float).ravel() / 80 - 0.8)
                kinds[2 * unseen + 1].append(digit)
    return tuple(np.array(kind) for kind in kinds)


_BLURS = 0.3, 0.5
"""Least and largest width of what a denoiser knows around each of its images."""


def which_digit(answer, rng: np.random.Generator) -> Verdict:
    """Judge `answer(denoisers, image, rng)`: the digit of an image, by ten denoisers that each know one digit."""
    images, labels, unseen, truth = digits()
    order = rng.permutation(len(truth))
    unseen, truth = unseen[order], truth[order]
    blurs = rng.permutation(np.linspace(*_BLURS, 10))
    denoisers, uses = zip(
        *(counted(GaussianMixture(images[labels == digit], blurs[digit]).denoise, 10**6, 64) for digit in range(10)),
        strict=True,
    )
    middle = np.array([images[labels == digit].mean(0) for digit in range(10)])
    said = np.array([points(answer(list(denoisers), image.copy(), rng), ()) for image in unseen])
    near = lambda others: np.argmin(np.square(unseen[:, None] - others).sum(-1), axis=1)
    lists = {"chance": np.arange(len(truth)) % 10, "nearest mean": near(middle),
             "nearest image": labels[near(images)], "your classifier": said}  # fmt: skip
    right = {name: float(np.mean(given == truth)) for name, given in lists.items()}
    table = pd.DataFrame({"right": right}).rename_axis("by").reset_index()
    spent = sum(used() for used in uses) // len(truth)
    table["evaluations an image"] = [0, 0, 0, spent]
    mine, fault = right["your classifier"], None
    if spent > 200:
        fault = f"{spent} evaluations an image, and 200 are allowed: every noisy copy of an image counts"
    elif spent == 0:
        fault = "no denoiser was asked"
    elif mine < 0.05:
        fault = f"{mine:.0%} are right, fewer than by chance: the digit's own denoiser errs least, not most"
    elif mine < 0.95 * right["nearest image"]:
        fault = (
            f"{mine:.0%} are right, and {right['nearest image']:.0%} by the nearest image: at little noise a denoiser "
            "returns what it is shown, the most blurred one best, and at much it knows the mean of its digit alone"
        )
    return Verdict(table, fault)
