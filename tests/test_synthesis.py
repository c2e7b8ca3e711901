"""Benchmarks: what is timed does what is said, and its table counts right."""

import os
import subprocess
import sys
import textwrap
from unittest import mock

import jax
import numpy as np
import pytest
from builders import CHANNELS, WINDOW, network_of, refused, tiny_camdm, tiny_config

from f3amd_companion.measuring.times import PARTS, SUITES, Candidate, plan, time_group
from f3amd_companion.speed import implementations
from f3amd_companion.speed.implementations import NotPossible, Workload, prepare_round, random_condition
from f3amd_lib.diffusion.samplers import num_evaluations
from f3amd_lib.networks import presets
from f3amd_lib.networks.conditioning import Condition
from f3amd_lib.rollout.rounds import sample_round

QUICK = {"min_rounds": 3, "min_seconds": 0.0, "fewest_rounds": 2, "warmup": 1}


def tiny(model, window=WINDOW):
    return tiny_camdm() if model.startswith("CAMDM") else tiny_config()


def workload(model="F3AMD-FNO-96", **changes):
    return Workload(model, tiny(model), **{"steps": 2, "characters": 2, **changes})


def test_operations_of_a_round():
    for model in ("F3AMD-FNO-96", "CAMDM"):
        encode, evaluate = presets.count_model_flops(tiny(model))
        asked = workload(model, steps=4, characters=3)
        calls = num_evaluations(asked.sampler, 4)
        assert implementations.round_flops(asked) == 3 * (encode + calls * evaluate)
        assert asked.sampler == {"F3AMD-FNO-96": "ddim", "CAMDM": "ddpm"}[model] and asked.sigmas.shape == (5,)


@pytest.mark.parametrize("model", ["F3AMD-FNO-96", "CAMDM"])
def test_jit_runs_the_round(model):
    asked = workload(model)
    network = presets.build_from_config(asked.config, jax.random.key(0))
    given = Condition(*map(jax.numpy.asarray, random_condition(asked.config, 2)))
    expected = sample_round(network, given, asked.sigmas, jax.random.key(0), sampler=asked.sampler)
    ready = prepare_round("jit", asked)
    np.testing.assert_allclose(ready.call(), expected, atol=1e-4)
    assert ready.compile_seconds > 0


def test_fft_form_runs_the_same_round():
    results = [np.asarray(prepare_round(name, workload()).call()) for name in ("jit", "jit, FFT")]
    np.testing.assert_allclose(*results, atol=1e-4)


@pytest.mark.parametrize(
    ("name", "model"),
    [
        pytest.param("IREE", "F3AMD-FNO-96", marks=pytest.mark.needs("iree.compiler", "iree.runtime")),
        pytest.param("IREE", "CAMDM", marks=pytest.mark.needs("iree.compiler", "iree.runtime")),
        pytest.param("PyTorch", "CAMDM", marks=pytest.mark.needs("torch")),
    ],
)
def test_a_peer_runs_a_round_of_finite_numbers(name, model):
    found = np.asarray(prepare_round(name, workload(model)).call())
    assert found.shape == (2, WINDOW, CHANNELS) and np.isfinite(found).all()


def test_what_cannot_be_done_says_why():
    with pytest.raises(NotPossible, match="Fourier blocks"):
        prepare_round("jit, FFT", workload("CAMDM"))
    with pytest.raises(NotPossible, match="one device"):
        prepare_round("jit, all devices", workload())
    refused("did you mean.*jit", prepare_round, "jitt", workload())
    refused("tf32", workload, precision="tf23")


@pytest.mark.slow
def test_a_group_is_timed_and_counted():
    candidates = [Candidate("F3AMD-FNO-96", steps, 2, "jit", WINDOW) for steps in (1, 2)] + [
        Candidate("CAMDM", 2, 2, name, WINDOW) for name in ("jit", "jit, FFT")
    ]
    table, failed = time_group(candidates, tiny, **QUICK)
    assert list(table["steps"]) == [1, 2, 2] and (table["rounds"] >= 2).all()
    assert list(failed) == [str(candidates[-1])]
    assert (table["low"] <= table["value"]).all() and (table["value"] <= table["high"]).all()
    np.testing.assert_allclose(table["gflops"], table["flops"] / table["value"] / 1e6)
    np.testing.assert_allclose(table["share_of_peak"], table["gflops"] / table["peak_gflops"])
    assert table["peak_gflops"].nunique() == 1
    assert table["flops"].iloc[0] == implementations.round_flops(workload(steps=1))


def test_plans_name_presets_and_implementations_that_exist_each_once():
    for suite in SUITES:
        members = [c for group in plan(suite).values() for c in group]
        assert members and len(members) == len(set(members))
        for candidate in members:
            assert presets.find_preset(candidate.model).name == candidate.model
            assert candidate.way in implementations.IMPLEMENTATIONS
    refused("unknown suite", plan, "bar")


def test_parts_are_left_out():
    network = network_of(tiny_config())
    given, x_noisy = Condition(*random_condition(network.config, 2)), np.zeros((2, WINDOW, CHANNELS), np.float32)

    def products():
        program = jax.make_jaxpr(lambda x: network(x, 1.0, network.encode(given)))
        return str(program(x_noisy)).count("dot_general")

    whole = products()
    for replaced in PARTS.values():
        with mock.patch.object(*replaced):
            assert products() < whole
    assert products() == whole


ON_TWO_DEVICES = """
    import sys
    sys.path.insert(0, {tests!r})
    from test_synthesis import *
    asked = workload(characters=4)
    made = prepare_round("jit, all devices", asked).call()
    assert len(made.sharding.device_set) == 2 == len(jax.devices())
    given = random_condition(asked.config, 4)
    for device in range(2):
        mine, key = slice(2 * device, 2 * device + 2), jax.random.fold_in(jax.random.key(0), device)
        rows = Condition(*(jax.numpy.asarray(part[mine]) for part in given))
        np.testing.assert_allclose(made[mine], sample_round(asked.network, rows, asked.sigmas, key), atol=1e-4)
"""


@pytest.mark.slow
def test_each_of_two_devices_samples_its_characters():
    program = textwrap.dedent(ON_TWO_DEVICES).format(tests=os.path.dirname(__file__))
    flags = {"XLA_FLAGS": "--xla_force_host_platform_device_count=2", "JAX_PLATFORMS": "cpu"}
    how = {"capture_output": True, "text": True, "timeout": 300, "check": False}
    done = subprocess.run([sys.executable, "-c", program], env=os.environ | flags, **how)
    assert done.returncode == 0, done.stderr[-2000:]
