"""The stopwatch and the yardstick: they count right, whatever the machine is."""

import os
import platform
import subprocess
import sys
import threading

import pytest
from builders import refused

from f3amd_companion.speed import machine
from f3amd_companion.speed.machine import fast_xla_flags
from f3amd_companion.speed.timing import median_interval, take_turns


class Clock:
    """A clock that moves only when somebody works."""

    def __init__(self):
        self.now = 0.0
        self.calls = []

    def work(self, name, durations):
        durations = iter(durations)

        def call():
            self.calls.append(name)
            self.now += next(durations)

        return call

    def __call__(self):
        return self.now


def test_median_and_spread_leave_the_warm_up_out():
    clock = Clock()
    call = clock.work("a", [9.0, 9.0, 9.0, *range(1, 102)])
    timing = take_turns({"a": call}, min_rounds=101, min_seconds=1e9, clock=clock)["a"]
    assert timing.median == 51.0
    assert (timing.low, timing.high) == (6.0, 96.0)
    assert timing.rounds == 101


def test_a_medians_interval_is_that_of_its_order_statistics():
    """Of 1 to 9, a drawn median is at most 2 in 3 % of all draws, and at most 1 in none: P(binomial(9, 2 / 9) >= 5)."""
    assert median_interval(range(1, 10)) == (2.0, 8.0) and median_interval(range(9, 0, -1)) == (2.0, 8.0)
    assert median_interval([3.0] * 5) == (3.0, 3.0)


def test_candidates_run_by_turns():
    clock = Clock()
    calls = {name: clock.work(name, [1.0] * 9) for name in "ab"}
    take_turns(calls, min_rounds=3, warmup=2, min_seconds=1e9, clock=clock)
    assert "".join(clock.calls) == "abab" + "ababab"


def test_a_slow_candidate_stops_by_its_seconds_and_the_quick_one_goes_on():
    clock = Clock()
    calls = {"slow": clock.work("slow", [4.0] * 99), "quick": clock.work("quick", [0.01] * 999)}
    found = take_turns(calls, min_rounds=100, min_seconds=10.0, fewest_rounds=2, clock=clock)
    assert found["slow"].rounds == 3
    assert found["quick"].rounds == 100


def test_a_processor_without_a_name_has_that_of_its_kind(tmp_path, monkeypatch):
    monkeypatch.setattr(machine, "Path", lambda name: tmp_path / "none")
    assert machine._processor() == (platform.processor() or platform.machine())


@pytest.mark.slow
def test_fast_flags_start_jax_with_as_many_devices(monkeypatch):
    monkeypatch.setattr(machine, "_FAST_FLAGS", (*machine._FAST_FLAGS, "--xla_no_such_flag=1"))
    flags = fast_xla_flags(3)
    assert "no_such_flag" not in flags
    asked = subprocess.run(
        [sys.executable, "-c", "import jax; print(len(jax.devices()))"],
        env=os.environ | {"XLA_FLAGS": flags, "JAX_PLATFORMS": "cpu"},
        capture_output=True, text=True, timeout=120, check=True,
    )  # fmt: skip
    assert asked.stdout.split()[-1] == "3"


def test_all_is_prepared_at_once_for_a_gpu_and_one_after_the_other_for_a_cpu(monkeypatch):
    together = threading.Barrier(2)

    def prepare(item):
        if item == "broken":
            raise ValueError("no such product")
        together.wait(timeout=20)  # breaks where one waits for the other to be done
        return item.upper()

    monkeypatch.setattr(machine, "device_name", lambda: "GPU")
    monkeypatch.setattr(machine, "usable_cores", lambda: 3)
    ready = machine.prepared_at_once(prepare, ["a", "b", "broken"])
    assert (ready["b"](), ready["a"]()) == ("B", "A")
    refused("no such product", ready["broken"])
    monkeypatch.setattr(machine, "device_name", lambda: "CPU")
    asked = []
    ready = machine.prepared_at_once(lambda item: asked.append(item) or item, ["a", "b"])
    assert asked == [] and ready["b"]() == "b" and asked == ["b"]
