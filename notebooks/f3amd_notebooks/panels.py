"""What notebooks draw again and again, or what is long to draw and has nothing to teach."""

from __future__ import annotations

from f3amd_lib.drawing.style import PALETTE

from f3amd_notebooks.drawings import arrow, boxes


def label_windows(axis, millions) -> None:
    """Label the horizontal axis at these numbers of windows, in millions, and nowhere else."""
    axis.set_xticks(millions, [f"{length:g}" for length in millions])
    axis.minorticks_off()


def draw_block_and_film(axis, *, frames: int, width: int, modes: int, kernel_size: int) -> None:
    """Draw the inside of an FNO block and of FiLM below the network of Figure 2 (8.8 units wide, 1.6 high).

    Args:
      axis: with the network's block and FiLM at 3.45 to 4.85 and 5.2 to 6.2, above 1.98.
      frames, width, modes, kernel_size: T, D, m, and of the convolutions.
    """
    for color, (left, right, title) in {"#ECE7F4": (0.02, 5.3, "FNO block"), "#E9F3F2": (5.45, 8.78, "FiLM")}.items():
        axis.fill_between([left, right], 0.0, 1.62, color=color, linewidth=0)
        axis.text(left + 0.08, 1.47, f"inside: {title}", weight="bold", fontsize=8.5, va="center")
    for left, right, ends in ((3.45, 4.85, (0.1, 5.2)), (5.2, 6.2, (5.5, 8.7))):
        axis.plot([left, ends[0]], [1.98, 1.62], ":", color=PALETTE["grey"], linewidth=1)
        axis.plot([right, ends[1]], [1.98, 1.62], ":", color=PALETTE["grey"], linewidth=1)
    spectrum = f"weights W\n{modes} × {width} × {width}, complex"
    fourier = [(0.95, f"RFFT\n{frames} → {modes}", "white"), (2.45, spectrum, "white")]
    fourier = boxes(axis, 1.1, [*fourier, (3.95, f"inverse\n{modes} → {frames}", "white")])
    local = ["SiLU", f"conv {kernel_size}"] * 2 + ["SiLU"]
    local = boxes(axis, 0.32, list(zip((0.85, 1.6, 2.4, 3.2, 3.95), local, ["white"] * 5, strict=True)))
    (z,) = boxes(axis, 0.71, [(0.2, "z", "none")])
    total, _ = boxes(axis, 0.71, [(4.55, "+", "white"), (5.05, "z base", "none")])
    for branch in (fourier, local):
        arrow(axis, z, branch[0], bend="angle,angleA=90,angleB=0")
        arrow(axis, branch[-1], total, bend="angle,angleA=0,angleB=90")
    film = [(5.78, "z base", "none"), (6.55, "×", "white"), (7.1, "+", "white"), (7.65, "linear", "white")]
    _, scale, shift, *_ = boxes(axis, 0.4, [*film, (8.2, "SiLU", "white"), (8.65, "z", "none")])
    _, mixed = boxes(axis, 1.15, [(5.58, "c", "none"), (6.0, "linear", "white")])
    for node, text in ((scale, "1 + tanh γ"), (shift, "β")):
        arrow(axis, mixed, node, bend="angle,angleA=0,angleB=90")
        axis.text(node.get_position()[0] - 0.05, 0.8, text, fontsize=7.5, ha="right")
