"""What CONTRIBUTING tells one to change is there, and each way to add something is short."""

import re

from f3amd_lib.ground.profiles import repository_root

ROOT = repository_root()
CONTRIBUTING = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
PAPER_FILES = {"paper.toml", "presets.toml", "readings.toml", "claims.toml", "commands.toml", "numbers/"}


def named_files(text: str) -> set[str]:
    """Files and folders that a text names, but those to be written, whose names have a word in capitals."""
    words = {word for quoted in re.findall(r"`([^`]+)`", text) for word in quoted.split()}
    files = {word for word in words if re.fullmatch(r"[\w./-]+\.(py|toml|md|ipynb|csv)|[\w./-]+/", word)}
    return {word for word in files if not re.search(r"(?<![A-Za-z])[A-Z]{4,}(?![\w]*\.md)", word)}


def test_contributing_names_files_that_are_there():
    files = named_files(CONTRIBUTING)
    assert len(files) > 20
    missing = {
        name
        for name in files - PAPER_FILES
        if not any((ROOT / top / name).exists() for top in ("", "f3amd_lib", "f3amd_companion"))
    }
    assert missing == set()
    papers = [folder for folder in (ROOT / "f3amd_lib/papers").iterdir() if (folder / "paper.toml").is_file()]
    assert all((folder / name).exists() for folder in papers for name in PAPER_FILES)


def test_a_file_that_has_gone_is_noticed():
    assert named_files("Write `f3amd_lib/none.py`, then `f3amd_lib/papers/NAME/` and `first_metrics`.") == {
        "f3amd_lib/none.py"
    }
