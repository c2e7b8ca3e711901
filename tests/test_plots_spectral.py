"""Figures of the notebook on spectra and conditions: lines and images hold the numbers given."""

import numpy as np
import pandas as pd

from f3amd_lib.report import plots_spectral as draw
from f3amd_lib.report.figures import PALETTE


def points(line):
    return np.stack([line.get_xdata(), line.get_ydata()])


def labelled(axis):
    return {line.get_label(): line for line in axis.lines if not line.get_label().startswith("_")}


def title(axis):
    return axis.get_title(loc="left")


def test_a_layer_is_a_column_with_its_kernel_around_lag_zero():
    pulse = np.eye(8)[3]
    layers = {"one": (np.arange(5.0), np.eye(8)[1], 2 * pulse), "two": (np.ones(5), pulse, -pulse)}
    figure = draw.layer_gallery(layers, pulse, fps=16.0)
    gains, kernels, answers = np.array(figure.axes).reshape(3, 2)
    assert [title(axis) for axis in gains] == ["one", "two"]
    np.testing.assert_allclose(points(gains[0].lines[0]), [[0, 2, 4, 6, 8], np.arange(5)])
    lag, kernel = points(kernels[0].lines[0])
    assert lag[kernel.argmax()] == 1 and list(lag) == list(range(-4, 4))
    np.testing.assert_allclose(labelled(answers[0])["out"].get_ydata(), 2 * pulse)
    np.testing.assert_allclose(labelled(answers[1])["in"].get_ydata(), pulse)
    assert "Hz" in gains[0].get_xlabel() and "frames" in kernels[0].get_xlabel()


def spectrum():
    return pd.DataFrame(
        [
            (band, group, hertz, scale / (1 + hertz))
            for band, scale in (("fourier", 1.0), ("cosine", 2.0))
            for group in ("root", "toes")
            for hertz in (0.0, 1.0, 2.0)
        ],
        columns=["band", "group", "frequency_hz", "amplitude_cm"],
    )


def test_spectra_leave_the_constant_out_and_have_a_line_for_each_body_part():
    figure = draw.spectrum_lines(spectrum())
    for axis, scale in zip(figure.axes, (1.0, 2.0), strict=True):
        lines = labelled(axis)
        assert list(lines) == ["root", "toes"] and axis.get_yscale() == "log"
        np.testing.assert_allclose(points(lines["toes"]), [[1, 2], [scale / 2, scale / 3]])
        assert lines["root"].get_marker() != lines["toes"].get_marker()
    assert [title(axis) for axis in figure.axes] == ["Fourier", "cosine"]


def test_errors_have_a_panel_for_each_band_and_leave_rounding_out():
    table = pd.DataFrame(
        [
            (band, modes, "legs", error)
            for band in ("fourier", "fourier beside a line", "cosine")
            for modes, error in ((1, 5.0), (4, 0.5), (17, 1e-14))
        ],
        columns=["band", "num_kept_modes", "group", "error_cm"],
    )
    figure = draw.mode_errors(table)
    assert [title(a) for a in figure.axes] == ["Fourier", "Fourier beside a line", "cosine"]
    for axis in figure.axes:
        np.testing.assert_allclose(points(labelled(axis)["legs"]), [[1, 4], [5.0, 0.5]])
        assert axis.get_yscale() == "log" and axis.get_ylim()[0] == 0.01
    assert "cm" in figure.axes[0].get_ylabel()


def test_a_seam_is_drawn_as_walked_and_as_cut():
    path = np.linspace(0, 1, 6)
    cut = {band: {2: path * 0.5, 4: path * 0.8} for band in ("fourier", "cosine")}
    errors = {"fourier": np.full(6, 3.0), "cosine": np.full(6, 0.3)}
    figure = draw.seam_paths(path, cut, errors)
    for axis in figure.axes[:2]:
        lines = labelled(axis)
        np.testing.assert_allclose(lines["in"].get_ydata(), path)
        np.testing.assert_allclose(lines["m = 4"].get_ydata(), path * 0.8)
        assert lines["m = 2"].get_linestyle() != lines["m = 4"].get_linestyle()
    lines = labelled(figure.axes[2])
    np.testing.assert_allclose(lines["cosine"].get_ydata(), 0.3)
    assert lines["Fourier"].get_color() == PALETTE["purple"]


def test_a_decay_carries_its_exponent():
    table = pd.DataFrame(
        [(band, m, float(m) ** slope) for band, slope in (("fourier", -0.5), ("cosine", -1.5))
         for m in (2, 4)],
        columns=["band", "num_kept_modes", "error"],
    )  # fmt: skip
    (axis,) = draw.ramp_decay(table, {"fourier": -0.5, "cosine": -1.5}).axes
    lines = labelled(axis)
    assert list(lines) == ["Fourier: exponent -0.50", "cosine: exponent -1.50"]
    np.testing.assert_allclose(points(lines["cosine: exponent -1.50"]), [[2, 4], [2**-1.5, 1 / 8]])
    assert axis.get_xscale() == axis.get_yscale() == "log"


def test_filters_are_matrices_under_one_scale_and_shares_are_in_per_cent():
    maps = {"wanted": np.eye(3), "found": 0.5 * np.eye(3)}
    shares = pd.DataFrame(
        [("spectral", 1, 0.0), ("spectral", 2, 0.1), ("both", 1, 0.0), ("both", 2, 0.02)],
        columns=["branches", "taps", "share"],
    )
    figure = draw.wrapped_filters(maps, shares)
    for axis, values in zip(figure.axes, maps.values(), strict=False):
        (image,) = axis.images
        np.testing.assert_allclose(image.get_array(), values)
        assert image.get_clim() == (0.0, 1.0)
    lines = labelled(figure.axes[-1])
    np.testing.assert_allclose(points(lines["both"]), [[1, 2], [0, 2]])


def test_families_have_a_row_for_each_condition_and_zero_in_the_middle_of_the_colours():
    filters = np.eye(4, 8)
    figure = draw.filter_families({"delay": filters, "twice": -2 * filters})
    for axis, highest in zip(figure.axes, (1, 2), strict=True):
        (image,) = axis.images
        assert image.get_clim() == (-highest, highest)
    shown = np.asarray(figure.axes[0].images[0].get_array())
    left, right, bottom, top = figure.axes[0].images[0].get_extent()
    assert (left, right, bottom, top) == (-4.5, 3.5, 4.5, 0.5)
    assert list(shown[1] == 1) == [lag == 1 for lag in range(-4, 4)]


def test_shares_are_in_per_cent_and_those_of_adding_lie_beside_the_axis():
    shares = {"delay": [1.0, 0.5, 0.0], "gain": [1.0, 0.0, 0.0]}
    (axis,) = draw.channel_shares(shares, {"delay": 0.9, "gain": 0.2}).axes
    lines = labelled(axis)
    np.testing.assert_allclose(points(lines["delay"]), [[0, 1, 2], [100, 50, 0]])
    beside = {line.get_color(): line for line in axis.lines if list(line.get_xdata()) == [-2.0]}
    np.testing.assert_allclose(beside[lines["gain"].get_color()].get_ydata(), [20])
    np.testing.assert_allclose(beside[lines["delay"].get_color()].get_ydata(), [90])


def test_delayed_pulses_have_a_row_each_from_top_to_bottom():
    pulse = np.eye(6)[1]
    figure = draw.delayed_pulses(pulse, {"a": np.roll(pulse, 1), "b": np.roll(pulse, 3)})
    (axis,) = figure.axes
    assert [label.get_text() for label in axis.get_yticklabels()] == ["in", "a", "b"]
    assert list(axis.get_yticks()) == [0, -1, -2]
    for area, place, at in zip(axis.collections, (0, -1, -2), (1, 2, 4), strict=True):
        outline = area.get_paths()[0].vertices
        assert outline[outline[:, 1].argmax(), 0] == at
        np.testing.assert_allclose(outline[:, 1].max(), place + 0.8)
        np.testing.assert_allclose(outline[:, 1].min(), place)
