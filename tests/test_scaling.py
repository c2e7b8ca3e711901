"""What more machines bring: the arithmetic by hand, and a page that says what the records say."""

import pytest
import scaling
from builders import refused

from f3amd_companion.measuring.sweep import Leg

LEGS = [Leg("one", "a"), Leg("two", "a", after="one-a"), Leg("one", "b"), Leg("one", "c")]
SECONDS = {"one-a": 2.0, "two-a": 5.0, "one-b": 4.0, "one-c": 1.0}


@pytest.mark.parametrize(
    ("machines", "ends"),
    [
        (1, {"one-a": 2.0, "two-a": 7.0, "one-b": 11.0, "one-c": 12.0}),
        (2, {"one-a": 2.0, "two-a": 7.0, "one-b": 4.0, "one-c": 5.0}),
        (100, {"one-a": 2.0, "two-a": 7.0, "one-b": 4.0, "one-c": 1.0}),
    ],
)
def test_machines_take_the_first_leg_that_may_begin(machines, ends):
    assert scaling.finished_after(LEGS, SECONDS, machines) == ends


@pytest.mark.slow
def test_the_page_says_what_the_records_say():
    page = scaling.PAGE.read_text(encoding="utf-8")
    assert scaling.written(page) == page
    refused("no `<!-- costs: begin -->`", scaling.written, page.replace("<!-- costs: begin -->", ""))
