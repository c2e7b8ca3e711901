"""`scripts/gpu_package.py`: what a GPU elsewhere needs, whole and small enough."""

import os
import subprocess
import sys

import gpu_package
import pytest
from builders import refused


@pytest.mark.slow
def test_a_package_is_laid_out_whole_and_its_command_is_understood_there(tmp_path, cache_dir, capsys):
    folder = tmp_path / "away"
    words = [str(folder), "--package", "A", "--minutes", "9"]
    assert gpu_package.main(words) == 2 and "no packed clips of Bandai" in capsys.readouterr().err
    packed = cache_dir / "bandai-0123456789abcdef-v2.safetensors"
    packed.parent.mkdir(parents=True)
    packed.write_bytes(b"no clips")
    assert gpu_package.main(words) == 0
    names = {path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file()}
    assert {"run.sh", "pyproject.toml", packed.name, "f3amd_lib/papers/f3amd/gpu_plan.toml"} <= names
    assert not [name for name in names if "pretrained/" in name or "__pycache__" in name]
    subprocess.run(["bash", "-n", "run.sh"], cwd=folder, check=True)
    # Another Python is there: the one of the tests, behind the name that the script calls.
    (tmp_path / "bin").mkdir()
    (tmp_path / "bin" / "python3").write_text(f'#!/bin/sh\nexec {sys.executable} "$@"\n')
    (tmp_path / "bin" / "python3").chmod(0o755)
    environment = {name: value for name, value in os.environ.items() if name not in ("PYTHONPATH", "XLA_FLAGS")}
    environment["PATH"] = f"{tmp_path / 'bin'}{os.pathsep}{environment['PATH']}"
    script = (folder / "run.sh").read_text(encoding="utf-8")
    assert "autotune_level" not in script.split("export", 1)[1]
    (folder / "run.sh").write_text(script.replace("export XLA_FLAGS", "UNUSED"), encoding="utf-8")  # no GPU here
    ran = subprocess.run(["bash", "run.sh"], cwd=folder, env=environment, capture_output=True, text=True)
    assert ran.returncode == 2 and f"{packed.name}: " in ran.stderr, ran.stderr  # all it lacks are clips


def test_what_cannot_be_laid_out_is_refused(tmp_path, monkeypatch):
    packed = tmp_path / "bandai.safetensors"
    packed.write_bytes(b"0" * 2_000_000)
    refused("package 'a'", gpu_package.lay_out, tmp_path / "x", "a", 9.0, packed)
    refused("is there already", gpu_package.lay_out, tmp_path, "A", 9.0, packed)
    refused("no such file", gpu_package.lay_out, tmp_path / "x", "A", 9.0, tmp_path / "none.safetensors")
    monkeypatch.setattr(gpu_package, "MOST_BYTES", 1_000_000)
    message = r"MB, more than 1; the largest: bandai.safetensors 2.0 MB"
    refused(message, gpu_package.lay_out, tmp_path / "x", "A", 9.0, packed)
    assert not (tmp_path / "x").exists()
