"""Pictures that several notebooks on networks share: Figure 2 from a config, and influence maps."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import matplotlib
import numpy as np

from f3amd_lib.drawing.plots import styled
from f3amd_lib.drawing.style import PALETTE, new_figure
from f3amd_lib.networks.camdm import CAMDMConfig
from f3amd_lib.networks.conditioning import PATH_CHANNELS
from f3amd_lib.networks.config import NetworkConfig
from f3amd_lib.networks.f3amd import F3AMDConfig
from f3amd_lib.networks.spectral import count_modes


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
      highest: where the colour scale ends, all above in its last colour; by default at the largest
        value.
      label: of the colour scale.
    """
    height = 3.2 if len(maps) < 4 else 2.6
    figure, axes = new_figure(len(maps) * (height - 0.75) + 1.4, height, 1, len(maps), sharey=True, squeeze=False)
    limits = {"vmin": 0.0, "vmax": highest or max(values.max() for values in maps.values())}
    for axis, (title, values) in zip(axes[0], maps.items(), strict=True):
        image = axis.imshow(values, cmap="viridis", **limits)
        axis.set_title(title)
        axis.set_xlabel(across)
        axis.grid(visible=False)
    axes[0, 0].set_ylabel(down)
    beyond = any(values.max() > limits["vmax"] for values in maps.values())
    figure.colorbar(image, ax=list(axes[0]), label=label, shrink=0.85, extend="max" if beyond else "neither")
    return figure


TOKEN_COLORS = {
    "noise level": "black",
    "style": "vermilion",
    "path": "green",
    "history": "blue",
    "noisy frames": "purple",
}
"""Kinds of tokens, in CAMDM's order."""


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


def _coder_part(config: F3AMDConfig, name: str, *widths: int) -> _Part:
    shown = " → ".join(map(str, widths))
    if config.encoder_decoder == "linear":
        return _Part(f"{name}\nlinear\n{shown}", "linear", 1.02)
    frames = config.window + config.frames_before
    modes = min(config.num_kept_modes, count_modes("fourier", frames))
    return _Part(f"{name}\nFNO, m = {modes}\n{shown}", "fno", 1.02)


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
    parts, width_in = [_state(config, "noisy x")], config.channels
    if config.facing_frame:
        parts.append(_node("↻", "to face\nthe path", ours=True))
    if config.input_scaling:
        parts.append(_node("×", r"$c_{in}$", ours=True))
    if config.history_input:
        width_in += PATH_CHANNELS + 1  # the last one says which frames are given
        text = f"history, then x\nbeside it the path\n{frames} × {width_in}"
        parts.append(_Part(text, "inside", 1.12, ours=True))
    parts.append(_coder_part(config, "encoder", width_in, width))
    place = {}
    if way == "concatenation":
        place["c"] = len(parts)
        parts.append(_Part(f"c, then z\n{frames} frames", "condition", 0.82))
    if config.base_block == "transformer":
        parts.append(_node("+", "position\ncode"))
    place["first"] = len(parts)
    condition = _Part(f"{_CONDITIONING_TITLES[way]}\n{_conditioning_line(config)}", "condition", 1.08)
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
    hidden = [config.decoder_hidden_width] if config.decoder_hidden_width else []
    parts.append(_coder_part(config, "decoder", width, *hidden, config.channels))
    if config.history_input:
        parts.append(_Part(f"last\n{config.window}", "step", 0.5, ours=True))
    if config.output_scaling:
        parts.append(_node("+", "skip\n$c_{skip}$ x", ours=True))
    if config.history_anchor:
        parts.append(_node("+", "last\nframe", ours=True))
    if config.residual_prior:
        parts.append(_node("g", "gain on\nresidual", ours=True))
    if config.facing_frame:
        parts.append(_node("↺", "turned\nback", ours=True))
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
    if config.facing_frame:
        sheet.text(0.1, _LOW, "history and path turned (↻) as x is", 7.5, ha="left",
                   color="#444444")  # fmt: skip
    label = (f"c   {config.window + config.frames_before} × {width}", 8)
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
    first, last = left + 0.28, right - 0.77
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
    sheet.arrow((last + 0.23, mid), (right - 0.43, mid))
    sheet.text(right - 0.41, mid, "z base", 8.5, ha="left", fontweight="bold")


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
        sheet.text((left + right) / 2, 0.22, "the linear layer starts at zero", 7.5, color="#444444")
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
