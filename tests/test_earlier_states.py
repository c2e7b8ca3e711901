"""States and weights of the long queue, made before the library was two packages, go on and load as they are."""

from pathlib import Path

import numpy as np
import pytest
from builders import packed_from, refused, wandering_motion

from f3amd_companion.measuring.campaign import find_recipe
from f3amd_lib.networks import presets
from f3amd_lib.training.checkpoints import load_model
from f3amd_lib.training.optimise import optimise, restore_state
from f3amd_lib.training.pipeline import PreparedData

EARLIER = Path(__file__).with_name("data") / "earlier"


@pytest.fixture
def data(monkeypatch) -> PreparedData:
    """The data and the narrow networks that the files were made with, after 4 of 8 steps."""
    build = presets.build_config
    monkeypatch.setattr(presets, "build_config", lambda *a, **k: build(*a, **{**k, "depth": 1, "latent_width": 4}))
    return PreparedData(packed_from([(wandering_motion(60, k), k % 2, k // 2) for k in range(4)]), 8, 4)


@pytest.mark.parametrize(
    ("name", "preset", "recipe", "held_out"),
    [
        pytest.param("readings", "F3AMD-FNO-96", "CAMDM-units+compressed-decay", 0.8362607, marks=pytest.mark.slow),
        ("steady", "F3AMD-FNO-96-steady", "paper", 53.65742),
    ],
)
def test_an_earlier_state_ends_where_it_would_have_ended(data, name, preset, recipe, held_out):
    row = find_recipe(recipe).on(preset)
    task = data.task(preset, row.config(8, 4, 0), network=row.network)
    state = restore_state(EARLIER / f"{name}.state.safetensors", task)
    how = {"held_out": data.windows("validation"), "chunk": 4, "checkpoint_every": 4, "progress": False}
    assert int(state.step) == 4
    assert optimise(task, state, **how)[1][-1]["held_out_loss"] == pytest.approx(held_out, rel=1e-4)


def test_an_earlier_state_of_other_settings_is_refused(data):
    other = data.task("F3AMD-FNO-96", find_recipe("compressed-decay").config(8, 4, 0))
    refused("loss", restore_state, EARLIER / "readings.state.safetensors", other)


def test_earlier_weights_load_with_the_network_that_they_are_of(data):
    trained = load_model(EARLIER / "steady.safetensors")
    assert trained.config == data.model_config("F3AMD-FNO-96-steady")
    x = np.zeros((1, 8, trained.config.channels), np.float32)
    assert trained.joint_positions(x).shape == (1, 8, trained.skeleton.num_joints, 3)
