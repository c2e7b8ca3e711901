"""The built site in a real browser, opened from the disk: `make site`, then `make test-web`."""

import os
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
SITE = ROOT / "docs" / "_build" / "html"

pytestmark = pytest.mark.skipif(
    not (SITE / "docs" / "index.html").is_file(), reason="the site is not built: `make site`"
)

PHONE, DESKTOP = (390, 844), (1280, 800)

LEDGERS = [f"paper_figures/{path.stem}.html" for path in sorted((ROOT / "paper_figures").glob("claims*.md"))]

PAGES = [
    *sorted(path.relative_to(SITE).as_posix() for path in (SITE / "docs").rglob("*.html")),
    *LEDGERS,
    "search.html",
]

# How far the page can be pushed sideways, and the widest thing that is to blame.
SIDEWAYS = """
const extra = document.documentElement.scrollWidth - document.documentElement.clientWidth;
if (extra <= 0) return "";
const inside = (e) => {  // what scrolls in itself pushes nobody
  for (let up = e.parentElement; up; up = up.parentElement)
    if (["auto", "scroll", "hidden"].includes(getComputedStyle(up).overflowX)) return true;
};
const wide = [...document.querySelectorAll(".bd-article *")].find(
  (e) => e.getBoundingClientRect().right > document.documentElement.clientWidth + 1 && !inside(e));
return `${extra} px: ${wide ? wide.outerHTML.slice(0, 120) : "?"}`;
"""

# Tables that are wider than what shows them.
CUT_OFF = """
return [...document.querySelectorAll(".bd-article table")].filter((table) => {
  for (let up = table; up && up.tagName != "ARTICLE"; up = up.parentElement)
    if (up.scrollWidth > up.clientWidth + 1 && getComputedStyle(up).overflowX != "visible") return true;
}).map((table) => table.rows[0].innerText);
"""

# What MathJax leaves where it does not understand: a message, or the unknown command in red.
NOT_UNDERSTOOD = '[data-mml-node="merror"], mjx-merror, [fill="red"]'


def notebooks() -> list[str]:
    """Addresses of the notebooks that the built site has."""
    return sorted(path.relative_to(SITE).as_posix() for path in (SITE / "notebooks").rglob("*.html"))


def open_with_equations(browser, name: str):
    """Open a page of the site and wait until its equations, if any, are drawn."""
    page = browser.open(SITE / name)
    if page.script("return !!document.querySelector('.math')"):
        page.wait("return window.MathJax && MathJax.startup && !!MathJax.startup.promise")
        page.driver.execute_async_script("MathJax.startup.promise.then(arguments[0])")
    return page


@pytest.mark.parametrize("name", PAGES)
def test_a_page_opens_from_the_disk_fits_a_phone_and_asks_nothing_of_the_outside(browser, name):
    browser.resize(*PHONE, phone=True)
    page = browser.open(SITE / name)
    assert page.errors() == []
    assert page.outside() == []
    assert page.script(SIDEWAYS) == ""
    assert any("companion.css" in address for address in page.requests())  # it was heard at all


def test_the_root_leads_to_the_first_page(browser):
    page = browser.open(SITE / "index.html")
    page.wait("return location.pathname.endsWith('/docs/index.html')")
    assert page.errors() == []


def test_the_first_screen_shows_its_title_and_a_walk(browser, screenshots):
    page = browser.open(SITE / "docs/index.html")
    page.wait("return [...document.images].every((image) => image.complete)")
    page.screenshot(screenshots / "site_first_page.png")
    seen = "const box = document.querySelector(arguments[0]).getBoundingClientRect();"
    seen += "return box.top >= 0 && box.bottom <= innerHeight && box.width > 100;"
    assert page.script(seen, ".bd-article h1") and page.script(seen, ".bd-article iframe.first")
    image = page.script("return document.querySelector(`meta[property='og:image']`).content")
    assert (SITE / "docs" / image).is_file()
    page.driver.switch_to.frame(page.find("iframe.first"))
    page.wait("return document.documentElement.dataset.ready === 'yes'", 60)
    panels = 2 if os.environ.get("F3AMD_DATA_DIR") else 1  # the real clip is no part of the repository
    assert page.script("return document.querySelectorAll('.panel').length") == panels
    page.driver.switch_to.default_content()
    page.resize(*PHONE, phone=True)
    page.screenshot(screenshots / "site_first_page_phone.png")


def test_every_notebook_is_whole_on_a_phone_and_on_a_small_laptop(browser):
    """Equations drawn, nothing wider than the screen, no table cut off, no errors, nothing asked of the outside."""
    equations = tables = 0
    for name in notebooks():
        browser.resize(*PHONE, phone=True)
        page = open_with_equations(browser, name)
        asked = page.script("return document.querySelectorAll('.math').length")
        drawn = page.script("return document.querySelectorAll('.math mjx-container svg').length")
        equations += asked
        assert drawn >= asked, name
        assert page.script(f"return document.querySelectorAll('{NOT_UNDERSTOOD}').length") == 0, name
        assert page.script(SIDEWAYS) == "", name
        assert page.errors() == [] and page.outside() == [], name
        browser.resize(*DESKTOP)
        tables += page.script("return document.querySelectorAll('.bd-article table').length")
        assert page.script(CUT_OFF) == [], name
    assert equations > 100 and tables > 50


def test_a_notebook_opens_with_folded_imports(browser):
    page = browser.open(SITE / "notebooks/05_rollout.html")
    assert page.script("return document.querySelector('.bd-article .cell details') !== null")
    shown = "return [...document.querySelectorAll('.cell pre')].find((e) => e.checkVisibility()).textContent"
    assert "import numpy" not in page.script(shown)


WORDS = {
    "alpha_bar": ("02_sampler_theory", "docs/api/diffusion"),
    "install": ("docs/start", "docs/commands"),
    "steer": ("docs/commands", "docs/api/serving"),
}
"""What is searched for -> pages that must be found."""


def test_a_word_is_found_and_leads_to_its_notebook(browser):
    for word, pages in WORDS.items():
        page = browser.open(f"{(SITE / 'search.html').as_uri()}?q={word}")
        page.wait("return /found \\d+ pages?/.test(document.querySelector('main').textContent)", 60)
        found = page.script("return [...document.querySelectorAll('#search-results li a')].map((a) => a.pathname)")
        assert all(any(name in address for address in found) for name in pages), (word, found)
        assert page.errors() == [] and page.outside() == []


def test_all_code_of_a_notebook_is_hidden_by_one_switch_and_a_cell_is_copied(browser):
    page = browser.open(SITE / "notebooks/05_rollout.html")
    shown = "return [...document.querySelectorAll('.cell_input')].filter((e) => e.checkVisibility()).length"
    assert page.script(shown) > 3 and page.script("return document.querySelectorAll('.cell_input .copy').length") > 3
    page.find(".hide-code").click()
    assert page.script(shown) == 0
    page.find(".hide-code").click()
    assert page.script(shown) > 3


def test_the_walk_stands_still_for_who_asked_for_less_motion(browser):
    browser.reduced_motion()
    page = browser.open(SITE / "docs/gallery/index.html")
    page.wait("return document.querySelector('canvas.moving') && !document.querySelector('img.moving')", 60)
    assert "Animation" in page.find("canvas.moving").get_attribute("aria-label")
    drawn = "const c = document.querySelector('canvas.moving'); return c.width * c.height"
    assert page.script(drawn) > 10_000
