"""Figures of the notebooks on networks; each function draws numbers and computes nothing new."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import matplotlib
import numpy as np
import pandas as pd

from f3amd_lib.models.camdm import CAMDMConfig
from f3amd_lib.models.config import NetworkConfig
from f3amd_lib.models.f3amd import F3AMDConfig
from f3amd_lib.models.spectral import count_modes
from f3amd_lib.report.figures import PALETTE, new_figure
from f3amd_lib.report.plots import shades, styled

__all__ = [
    "spectral_kernel",
    "kept_modes",
    "influence_maps",
    "film_gate",
    "attention_maps",
    "token_strips",
    "complexity_curves",
    "prediction_error",
    "architecture_diagram",
]


@styled
def spectral_kernel(weights, kernel, signal, response):
    """Draw a spectral layer of one channel: weights on modes, kernel in time, what it does.

    Args:
      weights: complex, [m]; kernel: the same in time, [T]; signal, response: [T].
    """
    figure, axes = new_figure(8.8, 2.9, 1, 3)
    mode = np.arange(len(weights))
    axes[0].bar(mode, np.abs(weights), color=PALETTE["purple"])
    axes[0].set_title("weights |W| on modes")
    axes[0].set_xlabel("mode (turns a window)")
    frame = np.arange(len(kernel))
    axes[1].plot(frame, kernel, ".-", color=PALETTE["green"])
    axes[1].set_title("the same as a kernel")
    axes[1].set_xlabel("lag (frames, circular)")
    axes[2].plot(frame, signal, color=PALETTE["grey"], label="in")
    axes[2].plot(frame, response, color=PALETTE["purple"], label="out")
    axes[2].set_title("what it does to a signal")
    axes[2].set_xlabel("frame")
    axes[2].legend()
    return figure


@styled
def kept_modes(signal, cut: Mapping[int, np.ndarray], label: str):
    """Draw a signal [T] and what is left of it when only the first m modes are kept."""
    figure, axes = new_figure(8.8, 2.6, 1, len(cut), sharey=True, squeeze=False)
    for axis, (modes, values) in zip(axes[0], cut.items(), strict=True):
        axis.plot(signal, color=PALETTE["grey"], linewidth=3.0, label="in")
        axis.plot(values, color=PALETTE["purple"], linewidth=1.6, label="kept")
        axis.set_title(f"m = {modes}")
        axis.set_xlabel("frame")
    axes[0, 0].set_ylabel(label)
    axes[0, 0].legend(fontsize=8)
    return figure


def _map_row(
    maps: Mapping[str, np.ndarray], height: float, label: str, highest=None, **image_options
):
    """Draw maps side by side under one colour scale from 0; return the figure and its axes."""
    figure, axes = new_figure(8.8, height, 1, len(maps), sharey=True, squeeze=False)
    highest = highest or max(values.max() for values in maps.values())
    for axis, (title, values) in zip(axes[0], maps.items(), strict=True):
        image = axis.imshow(values, cmap="viridis", vmin=0.0, vmax=highest, **image_options)
        axis.set_title(title)
        axis.grid(visible=False)
    figure.colorbar(image, ax=list(axes[0]), label=label, shrink=0.85)
    return figure, list(axes[0])


@styled
def influence_maps(
    maps: Mapping[str, np.ndarray],
    across: str = "input frame",
    down: str = "output frame",
    highest: float | None = None,
    label: str = "size of the derivative",
):
    """Draw how strongly each input frame reaches each output frame, a panel for each layer.

    Args:
      maps: title -> [T out, T in], not negative.
      across, down: what the columns and the rows are.
      highest: where the colour scale ends; by default at the largest value.
      label: of the colour scale.
    """
    height = 3.2 if len(maps) < 4 else 2.6
    figure, axes = _map_row(maps, height, label, highest)
    for axis in axes:
        axis.set_xlabel(across)
    axes[0].set_ylabel(down)
    return figure


@styled
def film_gate(gamma, gate, z_base, z_tilde, gammas: Sequence[float]):
    """Draw the gate of Eq. 6 against gamma, and a signal under a few settings of it.

    Args:
      gamma, gate: [P]; z_base: [T]; z_tilde: one signal [T] for each of `gammas`.
    """
    figure, (left, right) = new_figure(8.2, 3.0, 1, 2)
    left.plot(gamma, gate, color=PALETTE["purple"], linewidth=2.4)
    left.axhline(1, color=PALETTE["grey"], linewidth=0.8)
    left.set_xlabel("γ")
    left.set_title("gate 1 + tanh γ")
    left.set_ylim(-0.1, 2.1)
    right.plot(z_base, color=PALETTE["black"], linewidth=3, alpha=0.35, label="z base")
    for value, signal, shade in zip(gammas, z_tilde, shades(len(gammas)), strict=True):
        right.plot(signal, color=shade, label=f"γ = {value:g}")
    right.set_title("a channel behind the gate (β = 0)")
    right.set_xlabel("frame")
    right.legend(fontsize=8, loc="upper right", ncols=2)
    right.set_ylim(top=1.75 * right.get_ylim()[1])
    return figure


@styled
def attention_maps(maps: Mapping[str, np.ndarray], num_history: int, window: int):
    """Draw attention of each future frame (row) to the context tokens, [T, H + T + 1] each."""
    figure, axes = _map_row(maps, 3.5, "attention weight", aspect="auto")
    for axis in axes:
        for edge in (num_history - 0.5, num_history + window - 0.5):
            axis.axvline(edge, color="white", linewidth=1.5)
        axis.set_xticks(
            [(num_history - 1) / 2, num_history + (window - 1) / 2, num_history + window],
            ["history", "path", "style"],
        )
        axis.set_xlabel("context token")
    axes[0].set_ylabel("future frame that asks")
    return figure


@styled
def prediction_error(sigmas, errors: Mapping[str, np.ndarray]):
    """Draw the error of the clean estimate against the noise level for kinds of prediction, [S]."""
    figure, axis = new_figure(6.6, 3.3)
    for (label, values), color, line in zip(
        errors.items(), ("purple", "vermilion", "orange"), ("-", "--", "-."), strict=False
    ):
        axis.plot(sigmas, values, color=PALETTE[color], linestyle=line, label=label)
    axis.set_xscale("log")
    axis.set_yscale("log")
    axis.set_xlabel("noise level σ")
    axis.set_ylabel("error of the clean estimate")
    axis.legend()
    return figure


TOKEN_COLORS = {
    "noise level": "black",
    "style": "vermilion",
    "path": "green",
    "history": "blue",
    "noisy frames": "purple",
}
"""Kinds of tokens, in CAMDM's order."""


@styled
def token_strips(strips: Mapping[str, Sequence[tuple[str, int]]]):
    """Draw the sequences that networks read, a square for each token.

    Args:
      strips: title -> (kind of `TOKEN_COLORS`, number of tokens) in order.
    """
    figure, axis = new_figure(8.8, 0.5 + 0.52 * len(strips))
    longest = max(sum(count for _, count in strip) for strip in strips.values())
    for row, (title, strip) in enumerate(strips.items()):
        first = 0
        for kind, count in strip:
            axis.bar(
                first + np.arange(count) + 0.5, 0.56, width=0.86, bottom=-row - 0.28,
                color=PALETTE[TOKEN_COLORS[kind]], label=kind if row == 0 else None, linewidth=0,
            )  # fmt: skip
            first += count
        axis.text(-1.5, -row, title, ha="right", va="center", fontsize=9)
        axis.text(first + 1, -row, f"{first}", va="center", fontsize=9)
    handles = [
        matplotlib.patches.Patch(color=PALETTE[color], label=kind)
        for kind, color in TOKEN_COLORS.items()
    ]
    axis.set_xlim(-0.15 * longest, 1.06 * longest)
    axis.set_ylim(0.5 - len(strips), 0.5)
    axis.axis("off")
    figure.legend(handles=handles, loc="outside upper right", ncols=len(handles), fontsize=8,
                  handlelength=1.0, columnspacing=1.4)  # fmt: skip
    return figure


PART_COLORS = {
    "transform": "sky",
    "mode product": "purple",
    "local convolutions": "vermilion",
    "scores and averages": "green",
    "query, key, value, output": "blue",
    "feed-forward": "orange",
}
"""Parts of a base block whose operations are counted apart."""


@styled
def complexity_curves(counts: pd.DataFrame, shares: pd.DataFrame):
    """Draw counted operations of base blocks against each of their sizes, and at the real sizes.

    Args:
      counts: columns block, variable, part, value (of the variable), operations, exponent (fitted
        over all values); a panel for each block and variable. A part that `PART_COLORS` lacks is
        drawn dotted.
      shares: columns model, part, operations.
    """
    panels = list(counts.groupby(["block", "variable"], sort=False))
    figure, axes = new_figure(8.8, 5.4, 2, 3)
    for axis, ((block, variable), rows) in zip(axes.flat, panels, strict=False):
        for part, line in rows.groupby("part", sort=False):
            color = PALETTE[PART_COLORS.get(part, "grey")]
            style = "o-" if part in PART_COLORS else ":"
            axis.plot(line["value"], line["operations"] / 1e6, style, color=color, markersize=4)
        values = sorted(rows["value"].unique())
        axis.set_xscale("log")
        axis.set_yscale("log")
        axis.set_xticks(values, [f"{value:g}" for value in values])
        axis.minorticks_off()
        axis.margins(x=0.16)
        _write_exponents(axis, rows)
        axis.set_title(f"{block}: against {variable}")
        axis.set_xlabel(variable)
    for axis in axes[:, 0]:
        axis.set_ylabel("MFLOP")
    _share_bars(axes.flat[-1], shares)
    handles = [
        matplotlib.patches.Patch(color=PALETTE[color], label=part)
        for part, color in PART_COLORS.items()
    ]
    others = [part for part in counts["part"].unique() if part not in PART_COLORS]
    handles += [
        matplotlib.lines.Line2D([], [], linestyle=":", color=PALETTE["grey"], label=part)
        for part in others
    ]
    figure.legend(handles=handles, loc="outside lower center", ncols=4, fontsize=8.5)
    return figure


def _write_exponents(axis, rows: pd.DataFrame) -> None:
    """Write each line's exponent at its end, lifted where two would lie on each other."""
    ends = rows.groupby("part", sort=False).last().sort_values("operations")
    low, high = np.log10(axis.get_ylim())
    step, previous = 0.085 * (high - low), -np.inf
    for part, end in ends.iterrows():
        previous = max(np.log10(end["operations"] / 1e6), previous + step)
        axis.annotate(
            f"{end['exponent']:.1f}", (end["value"], 10**previous), (6, 0), va="center",
            textcoords="offset points", fontsize=8.5,
            color=PALETTE[PART_COLORS.get(part, "grey")],
        )  # fmt: skip


def _share_bars(axis, shares: pd.DataFrame) -> None:
    """Draw operations by part, a bar for each model."""
    models = list(shares["model"].unique())
    for place, model in enumerate(models):
        base = 0.0
        rows = shares.loc[shares["model"] == model, ["part", "operations"]]
        for part, operations in rows.itertuples(index=False):
            axis.bar(place, operations / 1e6, 0.62, base, color=PALETTE[PART_COLORS[part]])
            base += operations / 1e6
        axis.text(place, base, f"{base:.1f}", ha="center", va="bottom", fontsize=9)
    axis.set_xticks(range(len(models)), models)
    axis.margins(y=0.12)
    axis.grid(axis="x", visible=False)
    axis.set_title("one block, T = 32")


# ------------------------------------------------------------------------ Figure 2, from a config

_FILL = {
    "fno": PALETTE["purple"],
    "transformer": "#B8690B",
    "linear": "#6B6B6B",
    "condition": PALETTE["green"],
    "inside": "#FFFFFF",
    "step": "#FFFFFF",
}
_CONDITIONING_TITLES = {
    "film": "FiLM",
    "concatenation": "output layer",
    "adaln_zero": "AdaLN-zero",
    "cross_attention": "cross-attention",
}


_LOW = 3.5  # height at which c runs to what lies below or left of the cross-attention


@dataclass(frozen=True)
class _Part:
    """A part of a diagram: a box, a round node, or plain text.

    Attributes:
      text: lines; the first one stands out, for a node what follows its sign stands above it.
      kind: a key of `_FILL` ("inside" has a line of numbers, "step" only words), "node" or "text".
      width: inches.
      ours: not in the paper, drawn dashed.
    """

    text: str
    kind: str = "inside"
    width: float = 0.9
    ours: bool = False


class _Sheet:
    """A drawing in inches: parts, arrows between them, and panels behind them."""

    def __init__(self, width: float, height: float):
        self.figure, self.axis = new_figure(width, height)
        self.figure.set_layout_engine("none")
        self.axis.set_position([0.0, 0.0, 1.0, 1.0])
        self.axis.set(xlim=(0.0, width), ylim=(0.0, height))
        self.axis.axis("off")
        self.width, self.height = width, height

    def text(self, x, y, text, size=8.5, **options):
        options = {"ha": "center", "va": "center", "color": PALETTE["black"]} | options
        self.axis.text(x, y, text, fontsize=size, **options)

    def arrow(self, *points, head: bool = True, **line):
        """Draw straight lines through points, with a head at the last one."""
        line = {"color": PALETTE["black"], "linewidth": 1.2} | line
        for start, end in zip(points[:-2], points[1:-1], strict=True):
            self.axis.plot(*zip(start, end, strict=True), solid_capstyle="round", **line)
        shape = {"arrowstyle": "-|>" if head else "-", "mutation_scale": 9}
        self.axis.annotate(
            "", points[-1], points[-2], zorder=3,
            arrowprops={"shrinkA": 0, "shrinkB": 0} | shape | line,
        )  # fmt: skip

    def panel(self, left, right, bottom, top, title: str, color):
        """Draw a rounded background, outlined if white, with a title in its upper left corner."""
        edge = {"edgecolor": "#9A9A9A", "linewidth": 1.0} if color == "white" else {}
        self.rectangle(left, bottom, right - left, top - bottom, facecolor=color, zorder=0, **edge)
        self.text(left + 0.1, top - 0.14, title, ha="left", fontweight="bold")

    def rectangle(self, x, y, width, height, rounding=0.07, **look):
        """Draw a rectangle from its lower left corner."""
        look = {"linewidth": 0, "zorder": 2} | look
        self.axis.add_patch(
            matplotlib.patches.FancyBboxPatch(
                (x + rounding, y + rounding), width - 2 * rounding, height - 2 * rounding,
                boxstyle=f"round,pad={rounding}", **look,
            )
        )  # fmt: skip

    def part(self, x, y, part: _Part, height: float = 0.5) -> None:
        """Draw a part with its centre at (x, y)."""
        dashes = (0, (3, 2)) if part.ours else "-"
        edge = {"edgecolor": PALETTE["black"], "linewidth": 1.0, "linestyle": dashes}
        first, *rest = part.text.split("\n")
        if part.kind == "node":
            circle = matplotlib.patches.Circle((x, y), 0.13, facecolor="white", zorder=2, **edge)
            self.axis.add_patch(circle)
            self.text(x, y - 0.005, first, 10, zorder=3)
            if rest:
                self.text(x, y + 0.18, "\n".join(rest), 7.5, va="bottom", color="#444444")
            return
        if part.kind != "text":
            filled = _FILL[part.kind] != "#FFFFFF"
            look = {} if filled and not part.ours else edge
            self.rectangle(x - part.width / 2, y - height / 2, part.width, height,
                            facecolor=_FILL[part.kind], **look)  # fmt: skip
            color = "white" if filled else PALETTE["black"]
        else:
            color = PALETTE["black"]
        weight = "normal" if color != "white" and part.kind != "text" else "bold"
        for row, line in enumerate([first, *rest]):
            smaller = row > 0 and part.kind != "step"
            self.text(x, y + 0.155 * (len(rest) / 2 - row), line, 7.5 if smaller else 8.5,
                      color=color, zorder=3, fontweight="normal" if row else weight)  # fmt: skip

    def chain(self, left, right, y, parts: Sequence[_Part], height: float = 0.5) -> list[float]:
        """Draw parts from left to right with arrows between; return their centres."""
        gap = (right - left - sum(part.width for part in parts)) / (len(parts) - 1)
        centres, edge = [], left
        for number, part in enumerate(parts):
            centres.append(edge + part.width / 2)
            self.part(centres[-1], y, part, height)
            if number:
                self.arrow((edge - gap, y), (edge, y))
            edge += part.width + gap
        return centres

    def zoom(self, x, y, width, left, right, top) -> None:
        """Join the lower edge of a box to a panel below it."""
        for start, end in ((x - width / 2, left + 0.05), (x + width / 2, right - 0.05)):
            self.axis.plot([start, end], [y, top], ":", color="#777777", linewidth=1.0, zorder=0)


def _node(sign: str, label: str = "", ours: bool = False) -> _Part:
    return _Part(f"{sign}\n{label}" if label else sign, "node", 0.26, ours)


@styled
def architecture_diagram(config: NetworkConfig, title: str = ""):
    """Draw a network as in Figure 2, with the numbers of its config.

    Above the conditions, in the middle the way from noisy to clean motion, below what is inside
    the repeated block. What the paper's figure does not have is dashed.

    Args:
      config: of a network of any family.
      title: such as the preset's name.
    """
    draw = _draw_camdm if isinstance(config, CAMDMConfig) else _draw_f3amd
    sheet = draw(config)
    sheet.text(0.1, sheet.height - 0.16, title, 11, ha="left", fontweight="bold")
    return sheet.figure


def _state(config: NetworkConfig, name: str) -> _Part:
    return _Part(f"{name}\n{config.window} × {config.channels}", "text", 0.72)


def _coder_part(config: F3AMDConfig, name: str, width_in: int, width_out: int) -> _Part:
    if config.encoder_decoder == "linear":
        return _Part(f"{name}\nlinear\n{width_in} → {width_out}", "linear", 1.02)
    modes = min(config.num_kept_modes, count_modes("fourier", config.window))
    return _Part(f"{name}\nFNO, m = {modes}\n{width_in} → {width_out}", "fno", 1.02)


def _base_part(config: NetworkConfig) -> _Part:
    width = config.latent_width
    if isinstance(config, CAMDMConfig) or config.base_block == "transformer":
        heads = f"{config.num_heads} head" + "s" * (config.num_heads > 1)
        return _Part(f"Transformer\n{heads}\n{width} → {width}", "transformer", 1.12)
    return _Part(
        f"FNO block\nm = {config.num_kept_modes} of {config.count_block_modes()}\n"
        f"{width} → {width}", "fno", 1.12
    )  # fmt: skip


def _draw_f3amd(config: F3AMDConfig) -> _Sheet:
    width, frames = config.latent_width, config.block_frames
    way = config.conditioning
    parts = [_state(config, "noisy x")]
    if config.input_scaling:
        parts.append(_node("×", r"$c_{in}$", ours=True))
    parts.append(_coder_part(config, "encoder", config.channels, width))
    place = {}
    if way == "concatenation":
        place["c"] = len(parts)
        parts.append(_Part(f"c, then z\n{frames} frames", "condition", 0.82))
    if config.base_block == "transformer":
        parts.append(_node("+", "position\ncode"))
    place["first"] = len(parts)
    condition = _Part(
        f"{_CONDITIONING_TITLES[way]}\n{_conditioning_line(config)}", "condition", 1.08
    )
    if way == "adaln_zero":
        place["c"] = len(parts)
        place["base"] = len(parts) + 1
        parts += [condition, _base_part(config), _node("×"), _node("+")]
    else:
        place["base"] = len(parts)
        place.setdefault("c", len(parts) + 1)
        parts += [_base_part(config), condition]
        if config.block_residual:
            parts.append(_node("+", ours=True))
    place["last"] = len(parts) - 1
    if way == "concatenation":
        parts.append(_Part(f"last\n{config.window}", "step", 0.5))
    parts.append(_coder_part(config, "decoder", width, config.channels))
    if config.history_anchor:
        parts.append(_node("+", "last\nframe", ours=True))
    if config.residual_prior:
        parts.append(_node("g", "gain on\nresidual", ours=True))
    parts.append(_state(config, "clean x̂₀"))

    total = max(9.0, sum(part.width for part in parts) + 0.3 * (len(parts) - 1) + 0.2)
    sheet, y = _Sheet(total, 5.15), 2.62
    gap = (total - 0.2 - sum(part.width for part in parts)) / (len(parts) - 1)
    centres = sheet.chain(0.1, total - 0.1, y, parts, height=0.62)
    edge = lambda number, side: centres[number] + side * (parts[number].width / 2 + 0.45 * gap)
    left, right = edge(place["first"], -1), edge(place["last"], 1)
    sheet.panel(left, right, y - 0.5, y + 0.72, f"{config.depth} ×", "white")
    sheet.text(right - 0.1, y + 0.58, f"{frames} × {width}", 8, ha="right")
    if place["last"] != place["base"] + 1 or way == "adaln_zero":
        # The way around the block.
        end = centres[place["last"]]
        start = centres[place["first"]] - parts[place["first"]].width / 2 - 0.2 * gap
        dashes = {} if way == "adaln_zero" else {"linestyle": (0, (3, 2))}
        sheet.arrow((start, y), (start, y - 0.42), (end, y - 0.42), (end, y - 0.13), **dashes)
    _draw_condition(sheet, config, y, centres[place["c"]])
    if way == "adaln_zero":
        gate = centres[place["base"] + 1]
        sheet.arrow((centres[place["c"]], _LOW), (gate, _LOW), (gate, y + 0.13))
    sheet.text(total - 0.1, 4.99, "dashed: not drawn in the paper", 7.5, ha="right",
               color="#444444")  # fmt: skip

    fno, top = config.base_block == "fno", 1.66
    layer = place["c"] if way == "adaln_zero" else place["base"] + 1
    zooms = [
        (place["base"], "FNO block" if fno else "Transformer", "#ECE7F4" if fno else "#FBEFDD",
         0.59, _draw_base),
        (layer, _CONDITIONING_TITLES[way], "#E9F3F2", 0.41, _draw_conditioning),
    ]  # fmt: skip
    left = 0.1
    for number, name, color, share, inside in sorted(zooms, key=lambda zoom: zoom[0]):
        right = left + share * (total - 0.34)
        sheet.panel(left, right, 0.1, top, f"inside: {name}", color)
        sheet.zoom(centres[number], y - 0.31, parts[number].width, left, right, top)
        inside(sheet, config, left + 0.1, right - 0.1)
        left = right + 0.14
    return sheet


def _conditioning_line(config: F3AMDConfig) -> str:
    width = config.latent_width
    return {
        "film": f"{width} → 2 × {width}",
        "concatenation": f"{width} → {width}",
        "adaln_zero": f"{width} → 3 × {width}",
        "cross_attention": "z asks c",
    }[config.conditioning]


def _draw_condition(sheet: _Sheet, config: F3AMDConfig, y, end) -> None:
    """Draw the way from history, path, style and noise level to c, down to (end, y)."""
    width, middle = config.latent_width, 3.98
    tokens = config.num_history + config.window + 1
    rows = (
        ("history", f"{config.num_history} × {config.channels}"),
        ("path", f"{config.window} × 8"),
        ("style", f"{config.num_styles}"),
    )
    for row, (name, shape) in enumerate(rows):
        at = middle + 0.28 * (1 - row)
        sheet.text(0.1, at, name, ha="left", fontweight="bold")
        sheet.text(1.3, at, shape, 7.5, ha="right")
        sheet.part(1.72, at, _Part("linear", width=0.52), height=0.22)
        sheet.arrow((1.34, at), (1.46, at))
        sheet.arrow((1.98, at), (2.16, at))
    sheet.part(2.53, middle, _Part(f"{tokens}\ntokens\n× {width}", "condition", 0.74), height=0.82)
    upper = middle + 0.7
    sheet.text(0.1, upper, "noise level σ", ha="left", fontweight="bold")
    sheet.arrow((1.04, upper), (1.2, upper))
    sheet.part(1.66, upper, _Part("embedding", width=0.92), height=0.24)
    sheet.part(2.53, upper, _node("+", ours=True))
    sheet.arrow((2.12, upper), (2.4, upper))
    sheet.text(2.72, upper + 0.02, "position code", 7.5, ha="left", va="bottom", color="#444444")
    heads = config.num_condition_heads
    asks = _Part(f"cross-attention\n{heads} head{'s' * (heads > 1)}", "condition", 1.2)
    sheet.part(4.2, middle, asks)
    sheet.arrow((2.66, upper), (4.2, upper), (4.2, middle + 0.25))
    sheet.text(4.26, upper - 0.16, "question", 7.5, ha="left", color="#444444")
    sheet.arrow((2.9, middle), (3.6, middle))
    label = (f"c   {config.window} × {width}", 8)
    if end < 4.9:  # the box is not to the right of the cross-attention: go down first
        sheet.arrow((4.2, middle - 0.25), (4.2, _LOW), (end, _LOW), (end, y + 0.31))
        sheet.text(4.27, _LOW + 0.02, *label, ha="left", va="bottom")
    else:
        sheet.arrow((4.8, middle), (end, middle), (end, y + 0.31))
        sheet.text(4.9, middle + 0.03, *label, ha="left", va="bottom")


def _draw_base(sheet: _Sheet, config: NetworkConfig, left, right) -> None:
    if isinstance(config, F3AMDConfig) and config.base_block == "fno":
        _draw_fno(sheet, config, left, right)
        return
    width, hidden = config.latent_width, config.feed_forward_factor * config.latent_width
    y, tokens = 0.72, getattr(config, "num_tokens", None) or config.block_frames
    heads = f"{config.num_heads} head" + "s" * (config.num_heads > 1)
    parts = (
        _Part("z", "text", 0.15),
        _Part(f"self-attention\n{heads}, {tokens} × {tokens}", width=1.12),
        _Part("add,\nnorm", "step", 0.5),
        _Part(f"feed-forward\n{width} → {hidden} → {width}", width=1.22),
        _Part("add,\nnorm", "step", 0.5),
        _Part("z base", "text", 0.46),
    )
    centres = sheet.chain(left, right, y, parts, height=0.44)
    for start, end in ((0, 2), (2, 4)):
        x = centres[start] + parts[start].width / 2 + 0.08
        sheet.arrow((x, y), (x, y + 0.42), (centres[end], y + 0.42), (centres[end], y + 0.22))


_TRANSFORMS = {"fourier": "RFFT", "cosine": "DCT", "reduced_rank": "RFFT", "weighted": "RFFT"}


def _draw_fno(sheet: _Sheet, config: F3AMDConfig, left, right) -> None:
    width, modes, variant = config.latent_width, config.num_kept_modes, config.spectral_variant
    weights = {
        "fourier": (f"weights W\n{modes} × {width} × {width}, complex", 1.75),
        "cosine": (f"weights W\n{modes} × {width} × {width}, real", 1.6),
        "reduced_rank": (f"weights U V, rank {config.spectral_rank}\n"
                         f"{modes} × {width} × {config.spectral_rank} × 2, complex", 1.9),
        "weighted": (f"gain · weights W\n{modes} × {width} × {width}, complex", 1.75),
    }[variant]  # fmt: skip
    transform = _TRANSFORMS[variant]
    high, low, mid = 1.16, 0.4, 0.78
    first, last = left + 0.28, right - 0.72
    sheet.text(left + 0.02, mid, "z", 8.5, ha="left", fontweight="bold")
    bins = f"{config.block_frames} → {modes}"
    upper = (
        _Part(f"{transform}\n{bins}", width=0.72),
        _Part(weights[0], width=weights[1]),
        _Part(f"inverse\n{modes} → {config.block_frames}", width=0.72),
    )
    convolution = f"conv {config.kernel_size}"
    lower = [
        _Part(text, width=0.62 if text == convolution else 0.5)
        for text in ("SiLU", convolution, "SiLU", convolution, "SiLU")
    ]
    inner = (first + 0.16, last - 0.16)
    sheet.chain(*inner, high, upper, height=0.4)
    sheet.chain(*inner, low, lower, height=0.28)
    sheet.part(last + 0.1, mid, _node("+"))
    sheet.arrow((left + 0.14, mid), (first, mid), head=False)
    for y in (high, low):
        sheet.arrow((first, mid), (first, y), (inner[0], y))
        side = 1 if y > mid else -1
        sheet.arrow((inner[1], y), (last + 0.1, y), (last + 0.1, mid + 0.13 * side))
    sheet.arrow((last + 0.23, mid), (right - 0.38, mid))
    sheet.text(right - 0.36, mid, "z base", 8.5, ha="left", fontweight="bold")


def _draw_conditioning(sheet: _Sheet, config: F3AMDConfig, left, right) -> None:
    y = 0.5
    out = (_Part("linear", width=0.5), _Part("SiLU", width=0.46), _Part("z", "text", 0.12))
    if config.conditioning == "film":
        parts = (_Part("z base", "text", 0.5), _node("×"), _node("+"), *out)
        centres = sheet.chain(left, right, y, parts, height=0.3)
        _draw_modulation(sheet, left, centres[1:3], y)
        sheet.text(centres[1] - 0.05, 0.86, "1 + tanh γ", 7.5, ha="right")
        sheet.text(centres[2] + 0.05, 0.86, "β", 8.5, ha="left")
    elif config.conditioning == "cross_attention":
        parts = (_Part("z base", "text", 0.5), _Part("asks\nc", "step", 0.52), _node("+"), *out)
        centres = sheet.chain(left, right, y, parts, height=0.42)
        sheet.text(centres[1], 1.2, "c  (keys, values)", 8.5, fontweight="bold")
        sheet.arrow((centres[1], 1.1), (centres[1], y + 0.21))
        x = centres[0] + 0.3
        sheet.arrow((x, y), (x, 0.86), (centres[2], 0.86), (centres[2], y + 0.13))
    elif config.conditioning == "adaln_zero":
        parts = (_Part("z", "text", 0.12), _Part("norm", width=0.5), _node("×"), _node("+"),
                 _Part("to base", "text", 0.5))  # fmt: skip
        centres = sheet.chain(left, right - 0.1, y, parts, height=0.3)
        up = _draw_modulation(sheet, left, centres[2:4], y)
        sheet.arrow((centres[3], up), (right - 0.5, up))
        sheet.text(centres[2] - 0.05, 0.86, "1 + scale", 7.5, ha="right")
        sheet.text(centres[3] + 0.05, 0.86, "shift", 7.5, ha="left")
        sheet.text(right - 0.47, up, "gate", 7.5, ha="left")
        sheet.text(
            (left + right) / 2, 0.22, "the linear layer starts at zero", 7.5, color="#444444"
        )
    else:
        parts = (_Part("z base", "text", 0.5), *out)
        sheet.chain(left, right - 0.3, y, parts, height=0.3)
        sheet.text((left + right) / 2, 1.05, "c has entered as frames:\nthe base block mixes", 7.5,
                   color="#444444")  # fmt: skip


def _draw_modulation(sheet: _Sheet, left, targets, y) -> float:
    """Draw c through a linear layer to the nodes that scale and shift; return its height."""
    up = 1.2
    sheet.text(left + 0.08, up, "c", 8.5, fontweight="bold")
    sheet.part(left + 0.54, up, _Part("linear", width=0.5), height=0.26)
    sheet.arrow((left + 0.14, up), (left + 0.29, up))
    for x in targets:
        sheet.arrow((left + 0.79, up), (x, up), (x, y + 0.13))
    return up


def _draw_camdm(config: CAMDMConfig) -> _Sheet:
    width, frames, channels = config.latent_width, config.window, config.channels
    sheet, y = _Sheet(9.0, 3.6), 2.45
    told = f"1 of {len(config.noise_levels)}" if config.noise_levels else "σ"
    rows = [("noise level", told, "two layers", 1), ("style", f"{config.num_styles}", "table", 1)]
    for part in (2, 6) if config.split_path else (8,):
        rows.append(("path", f"{frames} × {part}", "linear", frames))
    rows += [
        ("history", f"{config.num_history} × {channels}", "linear", config.num_history),
        ("noisy frames", f"{frames} × {channels}", "linear", frames),
    ]
    step, middle = 2.5 / len(rows), 1.85
    for row, (kind, shape, layer, count) in enumerate(rows):
        at = middle + step * ((len(rows) - 1) / 2 - row)
        sheet.text(0.1, at, "noisy x" if kind == "noisy frames" else kind, ha="left",
                   fontweight="bold")  # fmt: skip
        sheet.text(1.42, at, shape, 7.5, ha="right")
        sheet.part(1.92, at, _Part(layer, width=0.74), height=0.26)
        sheet.arrow((1.46, at), (1.55, at))
        sheet.arrow((2.29, at), (2.45, at))
        sheet.rectangle(2.46, at - step / 2, 0.5, step, 0.01,
                        facecolor=PALETTE[TOKEN_COLORS[kind]])  # fmt: skip
        sheet.text(2.71, at, f"{count}", color="white", zorder=3, fontweight="bold")
    sheet.text(2.71, middle - 1.25 - 0.14, f"{config.num_tokens} tokens")
    parts = (
        _node("+", "position\ncode"),
        _base_part(config),
        _Part(f"last\n{frames}", "step", 0.5),
        _Part(f"linear\n{width} → {channels}", "linear", 0.9),
        _Part(f"clean x̂₀\n{frames} × {channels}", "text", 0.72),
    )
    centres = sheet.chain(3.3, 8.9, y, parts, height=0.62)
    sheet.arrow((2.96, y), (3.3, y))
    half = parts[1].width / 2 + 0.2
    sheet.panel(centres[1] - half, centres[1] + half, y - 0.45, y + 0.72, f"{config.depth} ×",
                "white")  # fmt: skip
    sheet.text(centres[1] + half - 0.1, y + 0.58, f"{config.num_tokens} × {width}", 8, ha="right")
    left, top = 3.2, 1.62
    sheet.panel(left, 8.9, 0.1, top, "inside: Transformer", "#FBEFDD")
    sheet.zoom(centres[1], y - 0.31, parts[1].width, left, 8.9, top)
    _draw_base(sheet, config, left + 0.15, 8.75)
    return sheet
