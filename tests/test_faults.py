"""The list of planted faults is whole, and what the last run of `scripts/faults.py` says is good enough."""

from __future__ import annotations

from pathlib import Path

import faults
import pytest
from builders import refused

ROOT = Path(__file__).resolve().parents[1]


@pytest.fixture(scope="module")
def listed():
    return faults.read_faults()


def test_a_fault_changes_its_place_and_names_test_files_that_are_there(listed):
    for fault in listed:
        assert fault.old != fault.new and fault.old.strip()
        files = [word for word in fault.tests if word.endswith(".py")]
        assert files and all((ROOT / file).is_file() for file in files), fault.name


def test_a_fault_whose_place_has_gone_is_refused(listed):
    refused("occurs 0 times", listed[0].planted, "another text")
    refused("occurs 2 times", listed[0].planted, 2 * listed[0].old)
    gone = [fault.name for fault in listed if (ROOT / fault.file).read_text(encoding="utf-8").count(fault.old) != 1]
    assert not gone  # the script refuses to run until they are mended


def test_nineteen_of_twenty_faults_are_caught(listed):
    rows = faults.read_results()
    caught = [row["caught"] == "yes" for row in rows.values()]
    assert caught and sum(caught) >= faults.BAR * len(caught)
    assert all(row["by"].startswith("tests/") for row in rows.values() if row["caught"] == "yes")


def test_the_page_says_what_the_rows_say(listed):
    assert faults.PAGE.read_text(encoding="utf-8") == faults.page(listed, faults.read_results())
