"""The three live figures of the path notebook in a real browser: their numbers are the notebook's, to 1e-3."""

import shutil

import builders  # noqa: F401  (tests/ is on the path)
import numpy as np
import pytest
from builders import refused
from conftest import PHONE
from f3amd_notebooks.walker_toes import walker_toes
from test_site import DOCS, load

from f3amd_companion.serving.onnx_export import denoiser_program
from f3amd_lib.diffusion.samplers import ddim_step
from f3amd_lib.diffusion.schedules import variance_exploding
from f3amd_lib.ground.records import committed_table

pytestmark = pytest.mark.needs("jax2onnx")
live = load(DOCS / "live.py")
CELL = '<div class="tag_live-{0}"><div class="cell_output"><img alt="still"></div></div><p>Caption of {0}.</p>'


@pytest.fixture(scope="module")
def names():
    """What the notebook's cells leave, with its own errors (9), sampler (26) and clips of few steps (38)."""
    return live.notebook_names(*live.CELLS, "path-09", "path-26", "path-38")


@pytest.fixture(scope="module")
def page(names, tmp_path_factory):
    page = tmp_path_factory.mktemp("live") / "page.html"
    head = "<!doctype html><meta charset='utf-8'><meta name='viewport' content='width=device-width'>"
    body = f"<body>{''.join(map(CELL.format, live.FIGURES))}<p><a>Live on the site</a></p></body>"
    page.write_text(head + body, encoding="utf-8")
    live.make_live(page, live.scripts(*live.figures_data(names), denoiser_program(names["network"], weights="int8")))
    return page


def begun(browser, *figures):
    for name in figures:
        browser.script(f"document.querySelector('.tag_live-{name}').scrollIntoView()")
        browser.wait(f"return document.getElementById('live-{name}')?.dataset.ready === 'yes'", 300)


def number(browser, name) -> float:
    return float(browser.script("return document.getElementById(arguments[0]).value", name))


def move(browser, **sliders):
    for name, value in sliders.items():
        browser.script(
            "const s = document.getElementById(arguments[0]); s.value = arguments[1];"
            "s.dispatchEvent(new Event('input'))", name.replace("_", "-"), value,
        )  # fmt: skip


def test_noise_level_and_steps_show_the_notebooks_numbers_and_follow_keys(browser, page, names, screenshots):
    browser.open(page)
    begun(browser, "noise", "steps")
    errors, apart, x0 = (
        committed_table("synthetic", "04_x0_error_by_sigma", kind="tables")[0],
        names["apart"],
        names["x0"],
    )
    errors = errors[errors["model"] == names["model"].name]
    for place in (0, 60, 100):
        move(browser, noise_level=place)
        sigma = 0.01 * 12800 ** (place / 100)
        browser.wait(f"return Math.abs(document.getElementById('sigma').value / {sigma} - 1) < 1e-9", 60)
        noisy = x0 + np.float32(sigma) * names["noise"]
        wanted = [apart(x, x0)[0] for x in (noisy, names["denoise"](noisy, sigma))]
        wanted += [np.interp(np.log(sigma), np.log(errors["sigma"]), errors["joint_error_cm"])]
        shown = [number(browser, name) for name in ("noisy-cm", "guess-cm", "mean-cm")]
        np.testing.assert_allclose(shown, wanted, rtol=1e-3)
    clips = names["clips"]
    wanted = [apart(clips[count], clips[8])[0] for count in (4, 2, 1)] + [apart(clips[8][1:], clips[8][:1])[0]]
    steps = ["off-4", "off-2", "off-1", "off-other"]
    np.testing.assert_allclose([number(browser, name) for name in steps], wanted, rtol=1e-3)
    assert all(number(browser, f"ms-{count}") > 0 for count in (8, 4, 2, 1))
    browser.screenshot(screenshots / "live_steps.png")
    browser.script("document.getElementById('noise-level').focus()")
    browser.keys("ArrowLeft")
    browser.wait("return document.getElementById('sigma').value < 127", 60)
    browser.find(".again").click()
    browser.wait(f"return Math.abs(document.getElementById('off-1').value - {wanted[2]}) > 1e-3", 120)
    assert browser.script("return [...document.images].map((image) => image.checkVisibility())") == [False, False, True]
    assert "Live on the site" not in browser.script("return document.body.innerText")
    assert browser.errors() == [] and browser.outside() == []


LADDERS = [(3.0, 100, 8), (7.0, 50, 4), (1.0, 100, 1), (12.0, 0, 16)]
"""rho, place of the slider of sigma_max, steps."""


def test_the_ladder_shows_what_python_computes_and_is_bent_by_a_finger(browser, page, screenshots):
    browser.resize(*PHONE, phone=True)
    browser.open(page)
    begun(browser, "ladder")
    toes = walker_toes().both
    start = np.array(browser.script("return Array.from(document.getElementById('live-ladder').particles)")).reshape(
        -1, 2
    )
    assert len(start) == 500 and np.abs(start.mean(axis=0)).max() < 1e-6
    for rho, place, steps in LADDERS:
        move(browser, bend=rho, top=place, number=steps)
        browser.wait(f"return +document.getElementById('num-steps').value === {steps}")
        sigmas = variance_exploding(128 ** (place / 100), 0.01, rho).grid(steps)
        x = sigmas[0] * start
        for here, there in zip(sigmas[:-1], sigmas[1:], strict=True):
            x = ddim_step(x, toes.denoise(x, here), here, there)
        left = 100 * np.sqrt(x.var(axis=0).sum() / (toes.means.var(axis=0).sum() + 2 * toes.width**2))
        shown = [number(browser, name) for name in ("sigma-max", "spread", "lost")]
        np.testing.assert_allclose(shown, [sigmas[0], left, 100 - left], rtol=1e-3, atol=1e-3)
    move(browser, bend=3, top=100, number=8)
    over = "const over = document.querySelector('.levels .u-over'); over.scrollIntoView({block: 'center'});"
    box = browser.script(f"{over} return over.getBoundingClientRect().toJSON()")
    rung = (box["x"] + box["width"] * 4 / 8, box["y"] + 0.3 * box["height"])  # pulled down, the ladder bends more
    browser.touch("touchStart", rung)
    browser.touch("touchMove", (rung[0], box["y"] + 0.7 * box["height"]))
    browser.touch("touchEnd")
    browser.wait("return document.getElementById('rho').value > 3.5")
    browser.screenshot(screenshots / "live_ladder_phone.png")
    assert browser.script("return document.documentElement.scrollWidth") <= PHONE[0]
    assert browser.errors() == [] and browser.outside() == []


def test_without_its_network_the_page_keeps_the_still_pictures_and_says_so(browser, page, tmp_path):
    alone = shutil.copy(page, tmp_path / page.name)
    shutil.copy(page.with_name("live.js"), tmp_path)
    browser.open(alone)
    begun(browser, "ladder")
    browser.wait("return document.body.innerText.includes('does not run here: live_network.js did not come')")
    assert browser.script("return [...document.images].every((image) => image.checkVisibility())")
    alone.write_text(CELL.format("noise"), encoding="utf-8")
    refused("no cell has the tag live-steps", live.make_live, alone, {})
