"""Commands that hand a model's work out: crowds, exports, benchmarks."""

import importlib.util
import json
import os
import re
import subprocess
import sys

import numpy as np
import pytest
from builders import WINDOW, tiny_trained

from f3amd_lib.__main__ import main
from f3amd_lib.benchmarking import machine, measurements
from f3amd_lib.generation.crowd import read_crowd
from f3amd_lib.generation.crowd_planning import MIN_DISTANCE, closest_approach
from f3amd_lib.motion.bvh import read_bvh
from f3amd_lib.training.checkpoints import save_model


@pytest.fixture(scope="module")
def weights(tmp_path_factory):
    path = tmp_path_factory.mktemp("model") / "tiny.safetensors"
    save_model(path, tiny_trained({"dataset": "tiny", "dataset_licence": "none", "dataset_credit": "nobody"}))
    return str(path)


def test_crowd_is_written_as_asked_and_never_over_another(weights, tmp_path, capsys):
    out = tmp_path / "crowd"
    words = ["crowd", "--weights", weights, "--out", str(out), "--steps", "1", "--chunk", "2"]
    seconds = ["--seconds", str(WINDOW / 30)]
    assert main([*words, *seconds, "--characters", "3", "--style", "proud"]) == 0
    crowd = read_crowd(out)
    assert len(crowd) == 3 and crowd.num_frames == WINDOW
    assert {crowd.style(k) for k in range(3)} == {"proud"}
    assert main([*words, *seconds, "--characters", "4"]) == 2
    assert "crowd" in capsys.readouterr().err
    assert len(read_crowd(out)) == 3
    assert main([*words, *seconds, "--characters", "4", "--overwrite"]) == 0
    assert len(read_crowd(out)) == 4


def test_rollout_writes_a_player_page_with_its_path_windows_and_terms(weights, tmp_path, capsys):
    words = ["rollout", "--weights", weights, "--out", str(tmp_path), "--steps", "1"]
    words += ["--style", "proud", "--path", "circle", "--seconds", "1"]
    assert main(words) == 0
    page = (tmp_path / "proud_circle_seed0.html").read_text(encoding="utf-8")
    data = json.loads(re.search(r'id="player-data">(.*?)</script>', page, re.S)[1])
    (scene,) = data["scenes"]
    assert (scene["title"], data["frames"]) == ("F3AMD-FNO-8, proud", 30)
    assert scene["boundaries"] == list(range(WINDOW, 30, WINDOW))
    assert [character["path"] for character in scene["characters"]] == [True]
    assert '<p class="credit">nobody</p>' in page
    (tmp_path / "proud_circle_seed0.bvh").unlink()
    assert main(words) == 2
    assert "proud_circle_seed0.html: exists already" in capsys.readouterr().err


def test_a_planned_crowd_keeps_apart_and_is_drawn_beside_its_folder(weights, tmp_path):
    out = tmp_path / "crowd"
    words = ["crowd", "--weights", weights, "--out", str(out), "--steps", "1", "--seconds", "1.6"]
    assert main([*words, "--characters", "5", "--plan", "1.5", "--pictures"]) == 0
    crowd = read_crowd(out)
    assert crowd.settings["min_distance"] == 1.5
    assert closest_approach(crowd.path[..., :2]).min() >= 1.5
    page = (tmp_path / "crowd.html").read_text(encoding="utf-8")
    data = json.loads(re.search(r'id="player-data">(.*?)</script>', page, re.S)[1])
    assert len(data["scenes"][0]["characters"]) == 5 and data["frames"] == 48
    assert (tmp_path / "crowd.png").stat().st_size > 5000


def test_pictures_of_another_crowd_are_not_written_over(weights, tmp_path, capsys):
    out = tmp_path / "crowd"
    words = ["crowd", "--weights", weights, "--out", str(out), "--steps", "1", "--characters", "2"]
    words += ["--seconds", "0.2", "--pictures"]
    for name in ("crowd.html", "crowd.png"):
        (tmp_path / name).write_text("of another crowd")
        assert main(words) == 2
        assert f"{tmp_path / name}: exists already; pass --overwrite" in capsys.readouterr().err
        assert (tmp_path / name).read_text() == "of another crowd"
        assert not out.exists()  # nothing was generated for nothing
        (tmp_path / name).unlink()
    (tmp_path / "crowd.html").write_text("of another crowd")
    assert main([*words, "--overwrite"]) == 0
    assert "player-data" in (tmp_path / "crowd.html").read_text(encoding="utf-8")


def test_a_plan_without_a_number_keeps_the_usual_distance(weights, tmp_path):
    words = ["crowd", "--weights", weights, "--steps", "1", "--seconds", "0.2", "--characters", "2"]
    for name, plan, distance in (("usual", ["--plan"], MIN_DISTANCE), ("free", [], None)):
        assert main([*words, *plan, "--out", str(tmp_path / name)]) == 0
        assert read_crowd(tmp_path / name).settings["min_distance"] == distance
    assert main([*words, "--plan", "1", "2", "--out", str(tmp_path / "two")]) == 2


@pytest.mark.parametrize("seconds", ["0", "-5", "nan", "3601"])
def test_lengths_that_make_no_crowd_are_refused(weights, tmp_path, capsys, seconds):
    out = tmp_path / "crowd"
    words = ["crowd", "--weights", weights, "--out", str(out), "--seconds", seconds]
    assert main([*words, "--steps", "1", "--characters", "2"]) == 2
    assert "--seconds must be between 0.1 and 3600, got" in capsys.readouterr().err
    assert not out.exists()


def test_rollout_is_blended_only_if_asked(weights, tmp_path):
    def positions(name, *more):
        words = ["rollout", "--weights", weights, "--out", str(tmp_path / name), "--steps", "1"]
        words += ["--style", "calm", "--path", "circle", "--seconds", "1"]
        assert main([*words, *more]) == 0
        return read_bvh(tmp_path / name / "calm_circle_seed0.bvh").positions

    plain, blended = positions("plain", "--raw"), positions("blended", "--blend", "4", "--slide")
    keep = np.arange(30) % WINDOW >= 4
    np.testing.assert_allclose(blended[keep], plain[keep], atol=1e-5)
    assert np.abs(blended - plain).max() > 1e-3


def test_export_without_iree_is_what_jax_alone_can_run(weights, tmp_path, monkeypatch, capsys):
    found = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda n: None if n == "iree" else found(n))
    out = tmp_path / "round"
    words = ["export", "--weights", weights, "--out", str(out), "--steps", "1"]
    assert main(words) == 0
    assert (out / "round.jax_export").is_file() and not list(out.glob("*.vmfb"))
    # Asked for by name, a target that cannot be had is one line and no traceback.
    assert main([*words[:-4], "--out", str(tmp_path / "other"), "--target", "llvm-cpu"]) == 2
    assert "make bench-tools" in capsys.readouterr().err


@pytest.mark.needs("iree.compiler", "iree.runtime")
def test_export_is_an_artefact_that_loads(weights, tmp_path):
    from f3amd_lib.serving.artefact import load_artefact

    out = tmp_path / "round"
    words = ["export", "--weights", weights, "--out", str(out), "--steps", "2"]
    assert main([*words, "--characters", "3"]) == 0
    artefact = load_artefact(out)
    shapes = artefact.input_shapes
    assert shapes["noise"][0] == 3 and artefact.manifest["model"] == "F3AMD-FNO-8"
    answer = artefact(*(np.zeros(shape, np.float32) for shape in shapes.values()))
    assert np.isfinite(answer).all()
    assert main([*words, "--target", "cuda-sm_90"]) == 2


@pytest.fixture
def no_fast_flags(monkeypatch):
    monkeypatch.setenv("XLA_FLAGS", "")  # so that what a command sets is taken back
    monkeypatch.delenv("XLA_FLAGS")
    monkeypatch.setattr(machine, "fast_xla_flags", lambda: "--fast")


def test_bench_refuses_what_it_does_not_know(no_fast_flags, capsys):
    assert main(["bench", "--profile", "smoke", "--suite", "bar"]) == 2
    assert "unknown suite 'bar'" in capsys.readouterr().err


def test_bench_hands_its_options_on_and_starts_jax_with_fast_flags(no_fast_flags, monkeypatch):
    asked = {}

    def note(prepared, profile, suites, **options):
        asked.update(options, suites=suites, flags=os.environ["XLA_FLAGS"])
        raise ValueError("enough")

    monkeypatch.setattr("f3amd_lib.training.pipeline.prepare", lambda profile, path: None)
    monkeypatch.setattr(measurements, "measure_synthesis_time", note)
    words = ["bench", "--suite", "bars", "--suite", "main", "--again", "--characters", "8", "--characters", "1"]
    assert main(words) == 2
    assert asked == {"suites": ["bars", "main"], "again": True, "characters": (8, 1), "flags": "--fast"}
    monkeypatch.setenv("XLA_FLAGS", "--mine")
    assert main(["bench", "--suite", "bars"]) == 2
    assert asked["flags"] == "--mine"


def test_flags_of_bench_are_set_before_jax_looks_for_devices():
    script = """
import os, sys
from f3amd_lib.__main__ import main
from f3amd_lib.benchmarking import machine
machine.fast_xla_flags = lambda: "--xla_force_host_platform_device_count=3"
assert main(["bench", "--profile", "smoke", "--suite", "bar"]) == 2
import jax
sys.exit(jax.device_count())
"""
    environment = {name: value for name, value in os.environ.items() if name != "XLA_FLAGS"}
    assert subprocess.run([sys.executable, "-c", script], env=environment, check=False).returncode == 3


@pytest.mark.parametrize(
    "command", "data presets train rollout crowd export bench measure figures claims cards".split()
)
def test_every_command_has_help(command, capsys):
    with pytest.raises(SystemExit) as caught:
        main([command, "--help"])
    assert caught.value.code == 0
    assert f"f3amd {command}" in capsys.readouterr().out


def test_a_misspelt_option_is_refused_with_the_nearest(capsys):
    with pytest.raises(SystemExit) as caught:
        main(["train", "--preste", "CAMDM"])
    assert caught.value.code == 2
    assert "--preset" in capsys.readouterr().err


def test_help_does_not_wait_for_jax():
    script = """
import sys
from f3amd_lib.__main__ import main
try:
    main(["--help"])
except SystemExit:
    sys.exit("jax" in sys.modules)
"""
    assert subprocess.run([sys.executable, "-c", script], stdout=subprocess.DEVNULL, check=False).returncode == 0


def test_the_ledger_is_judged_by_its_own_command(monkeypatch):
    seen = []
    monkeypatch.setattr("f3amd_lib.reports.claims.main", lambda words: seen.append(words) or 1)
    assert [main(["claims"]), main(["claims", "--accept"])] == [1, 1]
    assert seen == [[], ["--accept"]]
