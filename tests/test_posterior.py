"""What history, path and style leave open, on motion whose spread is known and on known answers."""

import dataclasses

import jax
import numpy as np
import pytest
from builders import HISTORY, SKELETON, WINDOW, packed_from, straight_motion, tiny_packed, tiny_windows
from scipy.spatial.transform import Rotation

from f3amd_companion.measuring import measure, posterior
from f3amd_lib.data.features import frame_positions
from f3amd_lib.data.windows import spread_windows
from f3amd_lib.ground.profiles import RESULTS_DIR_VARIABLE, load_profile
from f3amd_lib.ground.records import read_table
from f3amd_lib.motion.skeleton import turn
from f3amd_lib.training.denoising_task import network_inputs
from f3amd_lib.training.pipeline import PreparedData

SPAN = HISTORY + WINDOW
SWING = np.deg2rad(30.0)
LEG = SKELETON.names.index("LeftUpLeg")
TOE = np.array([0.0, -0.8, 0.1])  # of the left leg, in the frame of its thigh


def kick(angle: float, *, early: bool = False, facing: float = 0.0):
    """A stiff walk of one window whose left leg kicks by `angle`, in the future or all along."""
    motion = straight_motion(SPAN)
    rotations = np.array(motion.rotations)
    rotations[0 if early else HISTORY :, LEG] = Rotation.from_rotvec([angle, 0, 0]).as_matrix()
    return turn(motion.replace(rotations=rotations), facing)


def spread_of(count_up: int, count_down: int) -> float:
    """The deviation over neighbours that kick up or down, in cm, worked out by hand."""
    up, down = (Rotation.from_rotvec([a, 0, 0]).apply(TOE) for a in (SWING, -SWING))
    count = count_up + count_down
    variance = np.sum((up - down) ** 2) * count_up * count_down / (count * (count - 1))
    return 100 * np.sqrt(variance / SKELETON.num_joints)  # one of the joints moves


def windows_of(clips):
    """Windows of (motion, style) pairs, all for training, and some held out that are like them."""
    pool = packed_from([(motion, style, 0) for motion, style in clips])
    asked = packed_from([(motion, style, 1) for motion, style in clips])
    prepared = [PreparedData(packed, WINDOW, HISTORY) for packed in (asked, pool)]
    return prepared[0].windows("validation"), prepared[1].windows("train")


def spreads(clips, **settings):
    return posterior.continuation_spread(SKELETON, *windows_of(clips), **settings).set_index("given")


# ------------------------------------------------------------------------------- real motion


def test_a_hidden_coin_is_the_spread_that_history_and_path_leave():
    clips = [(kick(sign * SWING), 0) for sign in (1, -1, 1, -1)]
    table = spreads(clips, num_neighbours=4)
    assert table["value"].to_numpy() == pytest.approx(3 * [spread_of(2, 2)], rel=1e-3)
    assert (table["neighbours"] == 4).all() and (table["repeats"] == 4).all()
    assert table["history_apart"].max() < 0.1 and table["path_apart"].max() < 0.1


def test_a_coin_that_the_history_shows_is_no_spread():
    clips = [(kick(sign * SWING, early=True), 0) for sign in (1, -1) for _ in range(3)]
    table = spreads(clips, num_neighbours=3)
    assert table.loc["style, path, history", "value"] == pytest.approx(0.0, abs=1e-2)
    assert table.loc["style", "value"] > 0.5 * spread_of(1, 2)
    # Histories of the other kind lie as far away as the leg swings.
    up, down = (Rotation.from_rotvec([a, 0, 0]).apply(TOE) for a in (SWING, -SWING))
    apart = 100 * np.linalg.norm(up - down) / np.sqrt(SKELETON.num_joints)
    assert 0 < table.loc["style", "history_apart"] < apart
    assert table.loc["style, path, history", "history_apart"] < 0.1


def test_paths_are_told_apart_where_histories_are_alike():
    def bent(sign):
        motion = straight_motion(SPAN)
        place = np.array(motion.root_position)
        place[HISTORY:, 0] += sign * np.linspace(0.1, 1.0, WINDOW)
        return kick(sign * SWING).replace(root_position=place)

    table = spreads([(bent(sign), 0) for sign in (1, -1) for _ in range(3)], num_neighbours=3)
    assert table.loc["style, path", "value"] == pytest.approx(0.0, abs=1e-2)
    assert table.loc["style", "value"] > 0.5 * spread_of(1, 2)
    assert table.loc["style, path", "path_apart"] < 0.1 < table.loc["style", "path_apart"]


def test_windows_that_overlap_are_not_counted_twice_and_nobody_is_their_own_neighbour():
    starts = np.array([0, 3, 12, 13, 40])
    assert posterior._apart(np.array([1, 0, 2, 3, 4]), starts, 10, 4) == [1, 3, 4]
    assert posterior._apart(np.array([4, 2, 1]), starts, 10, 2) == [4, 2]
    windows, _ = windows_of([(kick(sign * SWING), 0) for sign in (1, -1, -1, -1)])
    table = posterior.continuation_spread(SKELETON, windows, windows, num_neighbours=3).set_index("given")
    # The one who kicks up sees three who kick down, each of those sees one up and two down.
    expected = np.sqrt(3 / 4) * spread_of(1, 2)
    assert table.loc["style, path, history", "value"] == pytest.approx(expected, rel=1e-3)


def test_data_without_neighbours_are_refused():
    clips = [(kick(SWING), 0), (kick(-SWING), 1)]
    with pytest.raises(ValueError, match="take more data"):
        spreads(clips)  # one window of each style


# ----------------------------------------------------------------------------- known answers


def poses(frames):
    positions = np.asarray(frame_positions(SKELETON, frames), np.float64)
    return positions - positions[..., :1, :]


def test_a_blind_network_has_no_spread_and_one_error(model_that):
    trained, windows = model_that(lambda x_noisy, sigma: 0.0 * x_noisy), tiny_windows()
    table = posterior.answer_spread(trained, windows, (0.1, 100.0), num_windows=8, num_draws=3)
    by = table.set_index(["quantity", "sigma"])["value"]
    assert by["answer spread"].max() < 1e-3
    batch = spread_windows(windows, 8)
    blind = trained.normaliser.denormalise(np.zeros(batch.future.shape, np.float32))
    error = np.sum((poses(blind) - poses(batch.future)) ** 2, axis=-1)
    assert by["error"].to_numpy() == pytest.approx(2 * [100 * np.sqrt(error.mean())], rel=1e-3)
    x0 = np.asarray(network_inputs(batch, trained.normaliser)[0])
    assert by["x0 error"].to_numpy() == pytest.approx(2 * [np.sqrt(np.mean(x0**2))], rel=1e-3)


@pytest.mark.slow
def test_a_network_that_passes_its_input_on_scatters_as_the_noise_does(model_that):
    trained, windows = model_that(lambda x_noisy, sigma: x_noisy), tiny_windows()
    draws = 6
    table = posterior.answer_spread(trained, windows, (0.05,), num_windows=8, num_draws=draws)
    by = table.set_index("quantity")
    batch = spread_windows(windows, 8)
    x0, _ = network_inputs(batch, trained.normaliser)
    keys = jax.random.split(jax.random.key(0), draws)
    noise = np.stack([jax.random.normal(key, x0.shape) for key in keys])
    made = poses(trained.normaliser.denormalise(np.asarray(x0) + np.float32(0.05) * noise))
    spread = made.var(axis=0, ddof=1).sum(axis=-1).mean()
    error = np.sum((made - poses(batch.future)) ** 2, axis=-1).mean()
    assert by.loc["answer spread", "value"] == pytest.approx(100 * np.sqrt(spread), rel=1e-3)
    assert by.loc["error", "value"] == pytest.approx(100 * np.sqrt(error), rel=1e-3)
    size = 0.05 * np.sqrt(np.mean(noise**2))
    assert by.loc["x0 error", "value"] == pytest.approx(size, rel=1e-3)
    assert list(by.loc[["answer spread", "x0 error"], "unit"]) == ["cm", "network units"]
    assert (by["low"] < by["value"]).all() and (by["value"] < by["high"]).all()


# ------------------------------------------------------------------------------- measurement


@pytest.mark.slow
def test_the_measurement_leaves_a_tidy_table_with_its_record(model_that, monkeypatch, tmp_path):
    monkeypatch.setenv(RESULTS_DIR_VARIABLE, str(tmp_path))
    trained = model_that(lambda x_noisy, sigma: 0.5 * x_noisy)
    monkeypatch.setattr(measure, "available_models", lambda profile: ["F3AMD-FNO-32"])
    monkeypatch.setattr(measure, "obtain_model", lambda *a, **k: (trained, None, "shipped"))
    packed = dataclasses.replace(tiny_packed(), dataset="synthetic")
    prepared = PreparedData(packed, WINDOW, HISTORY)
    profile = load_profile("smoke", "synthetic", window=WINDOW, num_history=HISTORY)
    path = measure.measure_posterior(prepared, profile)
    assert path == tmp_path / "synthetic" / "smoke" / "records" / "posterior.csv"
    table, record = read_table(path)
    assert record["measurement"] == "posterior" and record["settings"] == posterior.POSTERIOR["smoke"]
    real = table[table["model"] == "real"]
    assert list(real["given"]) == list(posterior.GIVEN) and real["sigma"].isna().all()
    mine = table[table["model"] == "F3AMD-FNO-32"]
    assert set(mine["quantity"]) == {"answer spread", "error", "x0 error"}
    assert len(mine) == 3 * posterior.POSTERIOR["smoke"]["num_levels"] and mine["sigma"].max() == pytest.approx(128.0)
    assert record["weights_digests"] == {"F3AMD-FNO-32": [mine["weights"].iloc[0]]}
    # Of another model alone: what was measured of the first is kept.
    other, _ = read_table(measure.measure_posterior(prepared, profile, ["F3AMD-FNO-48"]))
    assert set(other["model"]) == {"real", "F3AMD-FNO-48"}
    assert read_table(path.with_name("posterior.old1.csv"))[0].equals(table)
