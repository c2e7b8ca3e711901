"""Readings of the paper: each changes what it says, a queue trains it, and a walk that diverged is told."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from builders import CHANNELS, SKELETON, random_frames, refused
from test_campaign import PROFILE, STYLES, judges, packed, small  # noqa: F401  (fixtures)

from f3amd_companion.measuring import campaign, fingerprint
from f3amd_companion.measuring.campaign import Run, find_recipe, queue, run_campaign
from f3amd_lib.data.windows import spread_windows
from f3amd_lib.ground.records import read_table
from f3amd_lib.motion.root_paths import named_path
from f3amd_lib.networks.conditioning import Condition
from f3amd_lib.networks.config import LayerKeys
from f3amd_lib.networks.presets import build_config, build_from_config
from f3amd_lib.networks.spectral import SpectralConvolution
from f3amd_lib.networks.variants import VariantConfig
from f3amd_lib.rollout.generated import Rollout
from f3amd_lib.training.losses import loss_terms
from f3amd_lib.training.pipeline import PreparedData
from f3amd_lib.training.recipe import learning_rate_schedule, paper_recipe

# ------------------------------------------------------------------------------------------- what a reading changes


def test_camdms_units_compare_metres_and_6d_numbers_where_todays_compare_deviations(packed):  # noqa: F811
    prepared = PreparedData(packed, 32, 10)
    task = lambda recipe: prepared.task("F3AMD-FNO-32", find_recipe(recipe).on("F3AMD-FNO-32").config(10, 4, 0))
    deviation = np.asarray(task("paper").normaliser.deviation)
    x0 = jnp.zeros((2, 32, len(deviation)))
    off = x0.at[..., 5].set(1.0)  # one channel is wrong by its deviation
    batch = spread_windows(prepared.windows("train"), 2)
    future = task("paper").normaliser.denormalise(x0)
    sample = {name: float(task(name).compared(off, x0, future, batch)["sample"]) for name in ("paper", "CAMDM-units")}
    assert sample["paper"] == pytest.approx(1 / len(deviation), rel=1e-5)
    assert sample["CAMDM-units"] == pytest.approx(deviation[5] ** 2 / len(deviation), rel=1e-4)


def test_the_squared_seam_is_the_square_of_each_joints_step():
    x0 = jnp.asarray(random_frames((1, 4)), jnp.float32)
    moved = x0.at[..., :3].add(jnp.array([0.3, 0.0, 0.4]))
    terms = {form: loss_terms(SKELETON, x0, x0, moved, x0, x0[:, 0], form)["ird"] for form in ("literal", "squared")}
    assert float(terms["literal"]) == pytest.approx(0.5, rel=1e-5)
    assert float(terms["squared"]) == pytest.approx(0.25, rel=1e-5)


@pytest.mark.parametrize(("schedule", "left"), [("square", 0.0416), ("sqrt", 0.4518)])
def test_a_compressed_decay_ends_where_the_papers_does(schedule, left):
    for steps in (100, 40_000):
        config = paper_recipe("F3AMD-FNO-96", steps, schedule=f"compressed_inverse_{schedule}")
        rate = learning_rate_schedule(config)
        assert float(rate(0)) == pytest.approx(5e-4)
        assert float(rate(steps)) == pytest.approx(left * 5e-4, rel=2e-3)
    whole = learning_rate_schedule(paper_recipe("F3AMD-FNO-96", 390_000, schedule=f"inverse_{schedule}"))
    assert float(whole(390_000)) == pytest.approx(left * 5e-4, rel=2e-3)


def test_losses_of_several_readings_add_up_and_the_same_one_twice_is_refused():
    recipe = find_recipe("CAMDM-units+geometry-in-centimetres")
    centimetres = {"position": 1e4, "joint_velocity": 1e4, "foot": 1e4, "ird": 1e2}
    assert recipe.loss == {"raw_features": True, **centimetres}
    for twice in ("geometry-in-centimetres+no-IRD", "CAMDM-units+CAMDM-units"):
        refused("the same setting", find_recipe, twice)


def test_camdm_in_its_own_units_keeps_its_losses_and_no_other_change_of_them():
    loss = find_recipe("CAMDM-units").on("CAMDM").config(10, 4, 0).loss
    assert loss.raw_features and loss.ird == 0.0
    for recipe, why in (("IRD-squared", "loss"), ("small-spectral-weights", "spectral")):
        refused(why, find_recipe(recipe).on, "CAMDM")
    assert find_recipe("small-spectral-weights").on("F3AMD-Transformer-64").preset == "F3AMD-Transformer-64"


def test_spectral_weights_of_li_et_al_begin_small_and_positive():
    layer = SpectralConvolution(8, 4, 3, small_weights=True, rngs=LayerKeys(jax.random.key(0)))
    values = np.asarray(layer.weight_real[...])
    assert values.min() >= 0.0 and values.max() <= 1 / 32 < 2 * values.max()


def _network(**fields):
    config = build_config("F3AMD-FNO-32", channels=CHANNELS, num_styles=2, depth=2, latent_width=8, window=8, **fields)
    return build_from_config(config, jax.random.key(0))


def test_a_bypass_adds_each_blocks_input_and_changes_nothing_else():
    plain, bypass = _network(), _network(block_bypass=True)
    draw = lambda *shape: jax.random.normal(jax.random.key(sum(shape)), shape)
    condition, x = Condition(draw(1, 10, CHANNELS), draw(1, 8, 8), jnp.eye(2)[:1]), draw(1, 8, CHANNELS)
    stations = [dict(net.stages(x, 1.0, net.encode(condition))) for net in (plain, bypass)]
    np.testing.assert_allclose(stations[1]["block 1"], stations[0]["block 1"] + stations[0]["encoder"], atol=1e-5)
    refused("bypass", VariantConfig, channels=9, num_styles=1, block_bypass=True, block_residual=True)


def test_a_coordinate_tells_the_encoder_where_a_frame_is():
    x = jnp.zeros((1, 8, CHANNELS))
    condition = Condition(jnp.zeros((1, 10, CHANNELS)), jnp.zeros((1, 8, 8)), jnp.eye(2)[:1])
    networks = [_network(coordinate_channel=told, kernel_size=1) for told in (False, True)]
    encoded = [dict(net.stages(x, 1.0, net.encode(condition)))["encoder"] for net in networks]
    assert np.ptp(encoded[0], axis=1).max() < 1e-5 < np.ptp(encoded[1], axis=1).max()


# ------------------------------------------------------------------------------------------- queue, plan and measures


def test_queue_and_plan_hold_each_reading_beside_camdms_units():
    runs = {run.recipe for run, _ in queue(campaign.QUEUES["readings"])}
    assert {"paper", "CAMDM-units", "letter", "CAMDM-units+compressed-decay"} <= runs
    plan = queue(campaign.GPU_PLAN, "A")
    assert [windows for _, windows in plan] == [3_200_000, 6_400_000, 19_400_000] * 2
    config = plan[0][0].config(194_000, 128)
    assert (config.batch_size, config.num_steps, config.loss.raw_features) == (512, 37_890, True)
    refused("package", queue, campaign.GPU_PLAN, "AA")


@pytest.mark.slow
def test_a_package_keeps_weights_that_are_measured_elsewhere(packed, judges, small, tmp_path, monkeypatch):  # noqa: F811
    monkeypatch.setenv("F3AMD_RESULTS_DIR", str(tmp_path / "results"))
    monkeypatch.setattr(fingerprint, "NUM_FRAMES", 66)
    monkeypatch.setattr(campaign, "compiled_steps", lambda *_: None)
    snapshots = [(Run("F3AMD-FNO-32", length=1), 8), (Run("F3AMD-FNO-32", seed=1), 8)]
    how = {"folder": tmp_path, "batch_size": 4, "progress": False}
    states = list(run_campaign(PreparedData(packed, 32, 10), PROFILE, snapshots=snapshots[:1], **how))
    assert states == [("F3AMD-FNO-32-1k-seed0", 8, "kept")]
    how |= {"snapshots": snapshots, "table": "readings", "found_alone": True}
    states = list(run_campaign(PreparedData(packed, 32, 10), PROFILE, *judges, **how))
    assert [state for *_, state in states] == ["measured", "not there"]
    rows, _ = read_table(tmp_path / "results/synthetic/smoke/records/readings.csv")
    ours = rows[rows["run"] == "F3AMD-FNO-32-1k-seed0"]
    walks = ours[ours["walks"] > 0].drop_duplicates(["grid", "update", "steps"])
    assert len(walks) == 3 * 4 + 1 and set(walks["walks"]) == {len(STYLES)}
    assert {"held_out_error", "use_of_x", "seed_spread", "window_from_half_the_steps"} <= set(ours["metric"])
    assert "bone_swing" in set(rows.loc[rows["run"] == "real", "metric"])


def test_a_walk_that_leaves_its_path_the_earth_or_the_numbers_has_diverged():
    path = named_path("straight", 40)
    frames = np.zeros((4, 40, CHANNELS), np.float32)
    frames[..., [0, 2]] = path.position
    frames[1, 20, 0] += 6.0
    frames[2, 30, 1] = 1.5
    frames[3, 39, 7] = np.nan
    rollout = Rollout(SKELETON, frames, np.zeros((4, 10, CHANNELS)), (path,) * 4, ("a",) * 4, 32)
    assert fingerprint.diverged(rollout).tolist() == [False, True, True, True]
