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


def named_functions(text: str) -> set[str]:
    """Names of Python that a text calls, as `name` or `name(...)`."""
    return {
        word
        for word in re.findall(r"`([A-Za-z]\w*_\w+|_\w+|[A-Z]\w+[a-z]\w*)(?:\([^`]*\))?`", text)
        if "NAME" not in word
    }


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


def test_contributing_names_functions_that_are_there():
    files = [path for package in ("f3amd_lib", "f3amd_companion") for path in (ROOT / package).rglob("*.py")]
    source = "\n".join(path.read_text(encoding="utf-8") for path in files)
    names = named_functions(CONTRIBUTING)
    assert {"_find_archive", "first_metrics", "ConditionedConfig"} <= names
    assert {name for name in names if not re.search(rf"\b{name}\b", source)} == set()


def test_each_way_to_add_something_has_less_than_ten_steps():
    sections = re.findall(r"^## Add (.+)\n((?:.*\n)*?)(?=^## )", CONTRIBUTING, re.M)
    assert [title for title, _ in sections] == ["a data set", "a model", "a metric", "a notebook", "a paper"]
    for title, text in sections:
        steps = [int(number) for number in re.findall(r"^(\d+)\.", text, re.M)]
        assert steps == list(range(1, len(steps) + 1)) and 3 < len(steps) < 10, title


def test_a_file_that_has_gone_is_noticed():
    assert named_files("Write `f3amd_lib/none.py`, then `f3amd_lib/papers/NAME/` and `first_metrics`.") == {
        "f3amd_lib/none.py"
    }
    assert named_functions("Call `_find_nothing(path)` and `make test`.") == {"_find_nothing"}
