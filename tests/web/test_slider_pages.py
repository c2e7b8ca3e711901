"""Sliders of notebooks in a real browser: keys move what is drawn, and nobody else is asked."""

import json

import numpy as np
import pytest
from conftest import DESKTOP, PHONE
from f3amd_notebooks.sliders import slide
from test_sliders import NOTEBOOKS, sliders

from f3amd_lib.drawing.style import new_figure

MARKUP = "<img src=x onerror='window.ran=true'><script>window.ran=true</script>&amp;"
# As strict as sliders allow: they move by an attribute of their own.
HEAD = (
    "<!doctype html><meta charset='utf-8'><meta name='viewport' content='width=device-width'>"
    "<meta http-equiv=\"Content-Security-Policy\" content=\"default-src 'none'; style-src 'unsafe-inline'; "
    "img-src data:; script-src-attr 'unsafe-inline'\">"
)


@pytest.fixture(params=NOTEBOOKS)
def page(request, tmp_path):
    """A page with the committed sliders of one notebook."""
    path = tmp_path / f"{request.param}.html"
    path.write_text(HEAD + "<hr>".join(sliders(request.param)), encoding="utf-8")
    return path


def test_words_with_markup_are_text(browser, tmp_path):
    figure, axis = new_figure()
    frames = {word: [np.zeros((2, 2))] for word in (MARKUP, MARKUP + "2")}
    made = slide(figure, axis.plot([0, 1]), frames, label=MARKUP, alt=MARKUP)
    (tmp_path / "page.html").write_text(HEAD + made.data, encoding="utf-8")
    browser.open(tmp_path / "page.html").find("input").send_keys("\ue014")  # right
    assert browser.find("output").text == MARKUP + "2" and MARKUP in browser.find("label").text
    assert browser.script("return [document.images.length, window.ran]") == [1, None] and browser.errors() == []


def drawn(browser, number: int) -> dict:
    """What a slider shows: words, value of the slider, lines."""
    return browser.script(
        "const f = document.querySelectorAll('figure.slider')[arguments[0]], i = f.querySelector('input');"
        "return {words: f.querySelector('output').textContent, spoken: i.getAttribute('aria-valuetext'), at: +i.value,"
        " frames: i.dataset.frames, name: i.labels.length,"
        " lines: [...f.querySelectorAll('path[data-line]')].map((p) => p.getAttribute('d')),"
        " long: [...f.querySelectorAll('path[data-line]')].map((p) => p.getTotalLength())}",
        number,
    )


@pytest.mark.parametrize("size", [DESKTOP, PHONE], ids=["desktop", "phone"])
def test_keys_move_every_slider_through_all_its_places(browser, page, screenshots, size):
    browser.resize(*size, phone=size == PHONE)
    browser.open(page)
    browser.screenshot(screenshots / f"sliders_{page.stem[:2]}_{size[0]}.png")
    count = browser.script("return document.querySelectorAll('figure.slider').length")
    assert count == len(NOTEBOOKS[page.stem])
    for number in range(count):
        browser.script("document.querySelectorAll('figure.slider input')[arguments[0]].focus()", number)
        browser.keys("Home")
        frames = json.loads(drawn(browser, number)["frames"])
        for place, (words, lines) in enumerate(frames):
            now = drawn(browser, number)
            assert (now["at"], now["words"], now["spoken"], now["lines"]) == (place, words, words, lines)
            assert now["name"] == 1 and min(now["long"]) > 100  # it has a label, and lines are lines
            browser.keys("ArrowRight")
    assert browser.errors() == [] and browser.requests() == []
    assert browser.script("return document.documentElement.scrollWidth") <= size[0]


def test_lines_lie_on_the_picture_below_them(browser, page):
    browser.open(page)
    before = browser.screenshot()
    browser.script("document.querySelectorAll('path[data-line]').forEach((p) => p.remove())")
    changed = np.ptp(np.stack([before, browser.screenshot()]).astype(int), axis=0).max(axis=-1) > 60
    images = "[...document.querySelectorAll('figure.slider img')]"
    inside = np.zeros(changed.shape, bool)
    for box in browser.script(f"return {images}.map((e) => e.getBoundingClientRect().toJSON())"):
        part = np.s_[int(box["top"]) : int(box["bottom"]) + 1, int(box["left"]) : int(box["right"]) + 1]
        assert changed[part].sum() > 300
        inside[part] = True
    assert not changed[~inside].any()
