"""Figures of the notebooks on training and rollout, and the results stored by an earlier run.

Each function draws one figure from a table (or from arrays that a reader has just seen made) and
measures nothing. Colours follow `figures.model_style`.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import pandas as pd
from matplotlib.ticker import MaxNLocator

from f3amd_lib.profiles import repository_root
from f3amd_lib.report.figures import PALETTE, model_style, new_figure, plot_style
from f3amd_lib.report.records import read_table
from f3amd_lib.report.tables import markdown_table

__all__ = [
    "windows_from_above",
    "noise_levels",
    "noisy_channel",
    "loss_terms_by_guess",
    "training_schedules",
    "loss_curves",
    "error_against_sigma",
    "windows_beside_real",
    "rounds_diagram",
    "paths_from_above",
    "inside_a_window",
    "along_a_rollout",
    "stored_result",
]

_REAL = model_style("real").line | {"linewidth": 1.4, "zorder": 4}


def _line(label: str) -> dict:
    """Style of a label's line; ours apart from the paper's presets, one step dotted and open."""
    name, _, steps = label.partition(", ")
    line = model_style(name).line
    if name.endswith("-plus"):
        # One family, but here they stand side by side, and a dash alone does not keep them apart.
        line |= {"color": PALETTE["vermilion"], "linestyle": "-"}
    if steps == "1 step":
        line |= {"linestyle": ":", "markerfacecolor": "white"}
    return line


def windows_from_above(history, future, path):
    """Draw some windows of a batch on the ground plane.

    Args:
      history: frames [B, H, C], metres, x and z relative to the last history frame.
      future: frames [B, T, C].
      path: path condition [B, T, 8], metres.

    Returns:
      A figure: what is given (history, path) and what is to be made (future) of each window.
    """
    figure, axes = new_figure(9.0, 2.3, 1, len(history), squeeze=False)
    reach = 1.1 * float(np.abs(np.asarray(future)[..., [0, 2]]).max())
    with plot_style():
        for axis, past, ahead, wanted in zip(axes[0], history, future, path, strict=True):
            axis.plot(ahead[:, 0], ahead[:, 2], color=PALETTE["sky"], lw=5, label="future, to make")
            axis.plot(wanted[:, 0], wanted[:, 1], "--", color=PALETTE["vermilion"], label="path")
            axis.plot(past[:, 0], past[:, 2], color=PALETTE["black"], lw=3, label="history")
            axis.plot(0, 0, "o", color=PALETTE["black"], markersize=5)
            axis.set(xlim=(reach, -reach), ylim=(-reach, reach), aspect="equal", xlabel="x (m)")
            axis.locator_params(nbins=5)
        axes[0, 0].set_ylabel("z (m)")
        for axis in axes[0, 1:]:
            axis.tick_params(labelleft=False)
        handles, labels = axes[0, 0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside upper center", ncols=3)
    return figure


def noise_levels(draws: Mapping[str, np.ndarray], sigmas):
    """Draw how often each noise level is trained on.

    Args:
      draws: label -> drawn sigmas, [N].
      sigmas: levels that a sampler visits, marked on the axis; zeros are left out.

    Returns:
      A figure with one histogram over log sigma a label.
    """
    edges = np.geomspace(min(d.min() for d in draws.values()), 128.0, 41)
    figure, axes = new_figure(8.0, 2.9, 1, len(draws), sharey=True, squeeze=False)
    with plot_style():
        for axis, (label, drawn) in zip(axes[0], draws.items(), strict=True):
            share = 100.0 * np.histogram(drawn, edges)[0] / len(drawn)
            axis.stairs(share, edges, fill=True, color=PALETTE["sky"], edgecolor=PALETTE["blue"])
            visited = np.asarray(sigmas)[np.asarray(sigmas) > 0]
            axis.plot(
                visited,
                np.zeros(len(visited)),
                "^",
                color=PALETTE["vermilion"],
                clip_on=False,
                label=f"visited by {len(visited)} steps",
                zorder=5,
            )
            axis.set(xscale="log", title=label, xlabel="noise level σ")
        axes[0, 0].set_ylabel("share of draws (%)")
        axes[0, 0].legend(loc="upper left")
    return figure


def noisy_channel(clean, noise, sigmas):
    """Draw one feature over a window at several noise levels.

    Args:
      clean: the channel in network units, [T].
      noise: standard normal, [T].
      sigmas: noise levels, one panel each.

    Returns:
      A figure; each panel has its own scale, which is the point.
    """
    figure, axes = new_figure(9.0, 2.4, 1, len(sigmas), squeeze=False)
    with plot_style():
        for axis, sigma in zip(axes[0], sigmas, strict=True):
            noisy = np.asarray(clean) + sigma * np.asarray(noise)
            axis.plot(noisy, color=PALETTE["grey"], marker=".", lw=0.8, label="x_noisy")
            axis.plot(clean, color=PALETTE["purple"], label="x0")
            axis.set(title=f"sigma = {sigma:g}", xlabel="frame")
        axes[0, 0].set_ylabel("one feature (network units)")
        axes[0, 0].legend(loc="best")
    return figure


def loss_terms_by_guess(table: pd.DataFrame, *, smallest: float = 1e-5):
    """Draw each loss term for several guesses.

    Args:
      table: columns term, guess, value.
      smallest: values below this (zeros above all) are drawn on the lower edge.

    Returns:
      A figure with a logarithmic axis, one column of dots a term.
    """
    terms = list(dict.fromkeys(table["term"]))
    markers = dict(zip(dict.fromkeys(table["guess"]), "oDsv^", strict=False))
    colors = [PALETTE[c] for c in ("black", "vermilion", "orange", "blue", "green")]
    figure, axis = new_figure(8.6, 3.5)
    with plot_style():
        for number, (guess, marker) in enumerate(markers.items()):
            rows = table[table["guess"] == guess].set_index("term")["value"]
            place = np.arange(len(terms)) + 0.13 * (number - (len(markers) - 1) / 2)
            axis.plot(
                place,
                np.maximum(rows[terms], smallest),
                marker,
                color=colors[number],
                markersize=7,
                clip_on=False,
                label=guess,
            )
        axis.set(yscale="log", ylim=(smallest, None), ylabel="value of the term")
        axis.set_xticks(np.arange(len(terms)), [term.replace("_", "\n") for term in terms])
        axis.grid(False, axis="x")
        axis.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0))
    return figure


def training_schedules(paper: Mapping[str, np.ndarray], ours: np.ndarray, ema_decay: float):
    """Draw learning rates and the weights of the moving average.

    Args:
      paper: label -> learning rate at evenly spaced steps from 0 to 3e5.
      ours: learning rate at each step of our run.
      ema_decay: of the moving average.

    Returns:
      A figure with three panels.
    """
    figure, axes = new_figure(9.0, 2.8, 1, 3)
    with plot_style():
        for (label, rate), color in zip(paper.items(), ("purple", "orange"), strict=False):
            steps = np.linspace(0.0, 3e5, len(rate))
            axes[0].plot(steps / 1e5, 1e4 * rate, color=PALETTE[color], label=label)
        axes[0].set(title="the paper's text", xlabel="step / 100,000", ylim=(0, None))
        axes[0].set_ylabel("learning rate x 10,000")
        axes[0].legend()
        axes[1].plot(np.arange(len(ours)), 1e4 * ours, color=PALETTE["green"])
        axes[1].set(title="this run", xlabel="step", ylim=(0, None))
        axes[1].set_ylabel("learning rate x 10,000")
        back = np.arange(0, int(5.0 / (1.0 - ema_decay)))
        axes[2].plot(back, 100 * (1 - ema_decay) * ema_decay**back, color=PALETTE["blue"])
        axes[2].set(title=f"moving average, {ema_decay:g}", xlabel="steps back", ylim=(0, None))
        axes[2].set_ylabel("weight (%)")
    return figure


def loss_curves(history: pd.DataFrame, terms=("sample", "position")):
    """Draw loss terms against steps: thin for training batches, thick for held-out clips.

    Args:
      history: columns model, step, and `<term>` and `held_out_<term>` for each term; held-out
        figures may be missing (NaN) in most rows.
      terms: which terms, one panel each.

    Returns:
      A figure with logarithmic axes. Terms are unweighted, so that models trained with unlike
      weights can be compared.
    """
    units = {"sample": "network units squared", "position": "m squared"}
    figure, axes = new_figure(9.0, 3.2, 1, len(terms), squeeze=False)
    with plot_style():
        for axis, term in zip(axes[0], terms, strict=True):
            for model, rows in history.groupby("model", sort=False):
                style = _line(model)
                axis.plot(
                    rows["step"],
                    rows[term],
                    color=style["color"],
                    marker="." if len(rows) < 8 else "",
                    lw=0.9,
                    alpha=0.8,
                    label=f"{model}, training",
                )
                held = rows.dropna(subset=[f"held_out_{term}"])
                axis.plot(
                    held["step"],
                    held[f"held_out_{term}"],
                    **style | {"linewidth": 2.2},
                    label=f"{model}, held out",
                )
            axis.set(title=f"{term} loss", xlabel="step", ylabel=units.get(term, ""), yscale="log")
        handles, labels = axes[0, 0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside lower center", ncols=2)
    return figure


def error_against_sigma(table: pd.DataFrame):
    """Draw the error of the clean estimate against the noise level.

    Args:
      table: columns model, sigma, x0_error, joint_error_cm, input_error.

    Returns:
      A figure: features on the left beside the error of the noisy input itself, joints on the
      right.
    """
    figure, axes = new_figure(9.0, 3.5, 1, 2)
    with plot_style():
        first = table[table["model"] == table["model"].iloc[0]]
        top = 2.0 * table["x0_error"].max()
        axes[0].plot(first["sigma"], first["input_error"], **_REAL, label="the noisy input itself")
        for model, rows in table.groupby("model", sort=False):
            axes[0].plot(rows["sigma"], rows["x0_error"], **_line(model), label=model)
            axes[1].plot(rows["sigma"], rows["joint_error_cm"], **_line(model), label=model)
        low = min(0.7 * first["sigma"].min(), 0.5 * table["x0_error"].min())
        axes[0].set(xscale="log", yscale="log", ylim=(low, top))
        axes[0].set(xlabel="noise level σ", ylabel="x0 error (network units)")
        axes[1].set(xscale="log", ylim=(0, None))
        axes[1].set(xlabel="noise level σ", ylabel="joint error (cm)")
        axes[0].legend(loc="lower right")
    return figure


def windows_beside_real(table: pd.DataFrame):
    """Draw joint error, acceleration and seam step of sampled windows beside the real ones.

    Args:
      table: columns label, joint_error_cm, joint_acceleration_cm, real_joint_acceleration_cm,
        seam_cm, real_seam_cm.

    Returns:
      A figure with three panels of bars, paler for one step; dashed lines are real motion's own.
    """
    panels = (
        ("joint_error_cm", None, "joint error (cm)"),
        ("joint_acceleration_cm", "real_joint_acceleration_cm", "acceleration (cm/frame²)"),
        ("seam_cm", "real_seam_cm", "step into the window (cm)"),
    )
    figure, axes = new_figure(9.0, 1.1 + 0.36 * len(table), 1, 3, sharey=True)
    names = table["label"].tolist()
    colors = [_line(name)["color"] for name in names]
    shades = [0.55 if name.endswith(" 1 step") else 1.0 for name in names]
    with plot_style():
        for axis, (column, real, title) in zip(axes, panels, strict=True):
            bars = axis.barh(np.arange(len(names)), table[column], color=colors, height=0.6)
            for bar, shade in zip(bars, shades, strict=True):
                bar.set_alpha(shade)
            if real is not None:
                axis.axvline(table[real].iloc[0], **_REAL, label="real")
            axis.set(xlabel=title, xlim=(0, None))
            axis.grid(False, axis="y")
        axes[0].set_yticks(np.arange(len(names)), names)
        axes[0].invert_yaxis()
        figure.legend(*axes[2].get_legend_handles_labels(), loc="outside upper right")
    return figure


def rounds_diagram(window: int, num_history: int, rounds: int = 3):
    """Draw which frames a round sees and which it makes.

    Args:
      window, num_history: frames.
      rounds: how many to draw.

    Returns:
      A figure: time to the right, one row a round.
    """
    figure, axis = new_figure(8.6, 0.75 + 0.55 * rounds)
    kinds = (("history, given", "grey"), ("path and style, given", "orange"), ("made", "purple"))
    with plot_style():
        for number in range(rounds):
            start = number * window
            bars = (
                ((start - num_history, num_history), 0.0, 0.5),
                ((start, window), 0.36, 0.14),
                ((start, window), 0.0, 0.3),
            )
            for (span, base, height), (label, color) in zip(bars, kinds, strict=True):
                axis.broken_barh(
                    [span],
                    (number + base, height),
                    color=PALETTE[color],
                    label=label if number == 0 else None,
                )
            axis.axvline(start, color=PALETTE["black"], lw=0.8, ls=":")
        axis.set(xlabel="frame", xlim=(-num_history - 1, rounds * window + 1), ylim=(rounds, -0.15))
        axis.set_xticks([-num_history, *(k * window for k in range(rounds + 1))])
        axis.set_yticks(np.arange(rounds) + 0.25, [f"round {k + 1}" for k in range(rounds)])
        axis.grid(False)
        figure.legend(loc="outside upper center", ncols=3)
    return figure


def paths_from_above(targets: Mapping[str, np.ndarray], walked: Mapping[str, np.ndarray]):
    """Draw target and walked line of several characters over a whole rollout.

    Args:
      targets: style -> [T, 2], x and z in metres.
      walked: the same styles -> [T, 2].

    Returns:
      A figure, one plan a style, +Z up the page as in the film strips.
    """
    columns = min(4, len(targets))
    rows = -(-len(targets) // columns)
    figure, axes = new_figure(2.4 * columns + 0.4, 2.5 * rows + 0.3, rows, columns, squeeze=False)
    with plot_style():
        for axis, (style, target) in zip(axes.flat, targets.items(), strict=False):
            line = walked[style]
            axis.plot(*target.T, "--", color="#C2649A", lw=1.4, label="target", zorder=3)
            axis.plot(*line.T, color=PALETTE["grey"], lw=1.8, label="walked")
            axis.plot(*line[0], "o", color=PALETTE["black"], markersize=4, label="start", zorder=4)
            both = np.concatenate([target, line])
            middle = 0.5 * (both.min(axis=0) + both.max(axis=0))
            half = max(1.0, 0.55 * np.ptp(both, axis=0).max())
            axis.set(xlim=(middle[0] + half, middle[0] - half))
            axis.set(ylim=(middle[1] - half, middle[1] + half), aspect="equal")
            axis.set_title(style, fontsize=9)
            axis.locator_params(nbins=4)
            axis.tick_params(labelsize=7)
        for axis in axes.flat[len(targets) :]:
            axis.axis("off")
        axes[-1, 0].set_xlabel("x (m)")
        axes[-1, 0].set_ylabel("z (m)")
        handles, labels = axes[0, 0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside upper center", ncols=3)
    return figure


def inside_a_window(table: pd.DataFrame):
    """Draw joint step and acceleration against the place in a window.

    Args:
      table: columns label ("real", or model and steps), place, step_cm, acceleration_cm.

    Returns:
      A figure; a mark at place 0 that leaves the line is a seam that can be seen.
    """
    return _two_panels(
        table,
        "place",
        (("step_cm", "joint step (cm)"), ("acceleration_cm", "acceleration (cm/frame²)")),
        "frame within its window (0 is the seam)",
    )


def along_a_rollout(table: pd.DataFrame):
    """Draw distance from the target and joint acceleration round by round.

    Args:
      table: columns label, round, gap_m, acceleration_cm; the label "real" has its acceleration
        alone.

    Returns:
      A figure; lines that rise are a rollout that loses its way or falls apart.
    """
    return _two_panels(
        table,
        "round",
        (
            ("gap_m", "distance from the target (m)"),
            ("acceleration_cm", "acceleration (cm/frame²)"),
        ),
        "round",
    )


def _two_panels(table: pd.DataFrame, across: str, panels, xlabel: str):
    """Draw two columns of a table against a third, a line a label, real motion dashed."""
    figure, axes = new_figure(9.0, 3.3, 1, 2)
    with plot_style():
        for axis, (column, title) in zip(axes, panels, strict=True):
            for label, rows in table.groupby("label", sort=False):
                if rows[column].isna().all():
                    continue
                line = _REAL if label == "real" else _line(label) | {"marker": ""}
                axis.plot(rows[across], rows[column], **line, label=label)
            axis.set(xlabel=xlabel, ylabel=title, ylim=(0, None))
            axis.xaxis.set_major_locator(MaxNLocator(integer=True))
        handles, labels = axes[1].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside lower center", ncols=3)
    return figure


def stored_result(dataset: str, name: str, *, profile: str = "laptop", digits: int = 2) -> str:
    """Render a table that `make figures` left, with what it was measured on.

    Args:
      dataset: a name of `profiles.DATASETS`.
      name: of the table, without ending.
      profile: whose results.
      digits: decimals.

    Returns:
      Markdown: the table and a line on its origin, or a sentence that there is none yet.
    """
    path = repository_root() / "paper_figures" / dataset / profile / "tables" / f"{name}.csv"
    if not path.exists():
        return f"No stored `{name}` of `{profile}` on `{dataset}` yet: `make figures` makes it."
    frame, record = read_table(path)
    origin = (
        f"Stored result: `{name}`, profile {record['profile']}, data {record['dataset']}, "
        f"{record['cores']} cores ({record['device_platform']}), {record['date_utc'][:10]}."
    )
    return f"{origin}\n\n{markdown_table(frame, digits=digits)}"
