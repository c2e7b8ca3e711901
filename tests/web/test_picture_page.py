"""Pictures to move in a real browser: what they work out is what the library works out, and sliders redraw them."""

import re
from pathlib import Path

import numpy as np
import pytest
from conftest import DESKTOP, PHONE

from f3amd_lib.diffusion.oracles import GaussianMixture
from f3amd_lib.diffusion.predictions import guided
from f3amd_lib.diffusion.samplers import SAMPLERS, sample

DOCS = Path(__file__).resolve().parents[2] / "docs"
PAIR, CROWD, TOLD = (GaussianMixture(means, width) for means, width in (([-1, 1], 0.3), ([-1, 1], 0.5), ([1], 0.5)))
TOP, BOTTOM = 80.0, 0.01


@pytest.fixture
def page(browser, tmp_path):
    """A page with the figures of docs/pictures.md, opened."""
    figures = re.findall(r"^<figure.*</figure>$", (DOCS / "pictures.md").read_text(encoding="utf-8"), re.M)
    head = "<!doctype html><meta charset='utf-8'><meta name='viewport' content='width=device-width'>"
    style, script = ((DOCS / "_static" / name).read_text(encoding="utf-8") for name in ("companion.css", "pictures.js"))
    path = tmp_path / "pictures.html"
    path.write_text(f"{head}<style>{style}</style>{''.join(figures)}<script>{script}</script>", encoding="utf-8")
    browser.open(path)
    assert len(figures) == browser.script("return document.querySelectorAll('figure svg svg').length") == 4
    return browser


def heun(denoise, x, levels):
    """Heun's walk without the library's last step, which is DDIM's."""
    return sample("heun", denoise, x, np.append(levels, levels[-1]))


def step(noise, place, left, way):
    sigma, x = 10.0**noise, place * np.hypot(np.hypot(1, 0.3), 10.0**noise) * np.ones((1, 1))
    shares = np.geomspace(1, 0.02, 61)
    guess = PAIR.denoise(x, sigma)
    first = SAMPLERS["ddim"].step(x, guess, sigma, left * sigma)
    landed = SAMPLERS["heun"].step(x, guess, sigma, left * sigma, PAIR.denoise) if way else first
    second = {"to the second guess": [[left, first], [0, PAIR.denoise(first, left * sigma)]]} if way else {}
    return second | {
        "exact flow": [[share, PAIR.flow(x, sigma, share * sigma)] for share in shares],
        "to the guess D": [[1, x], [0, guess]],
        "the step": [[1, x], [left, landed]],
        "exact": [[left, PAIR.flow(x, sigma, left * sigma)]],
    }


def paths(strength, seed, normals):
    levels = np.geomspace(40, 0.1, 201)
    noise = np.reshape(normals, (201, 300, 1))
    states = [40 * noise[0]]
    for sigma, lower, fresh in zip(levels[:-1], levels[1:], noise[1:], strict=True):
        x = states[-1]
        x = x + (1 + strength**2) * sigma * (sigma - lower) * PAIR.score(x, sigma)
        states.append(x + strength * np.sqrt(sigma**2 - lower**2) * fresh)
    x = np.linspace(-3, 3, 121)
    density = np.exp(PAIR.log_density(x[:, None], 0.1))
    own = lambda x, sigma: x / np.sqrt(1 + 0.3**2 + sigma**2)
    walked = {str(n): np.stack([levels, own(np.stack(states)[:, n, 0], levels)], -1) for n in range(25)}
    return walked | {"density at the end, exact": np.stack([0.1 * 0.25**density, own(x, 0.1)], -1)}


def guidance(w):
    z, x = np.linspace(-4, 4, 161), np.linspace(-3.5, 5, 341)
    levels = np.geomspace(TOP, BOTTOM, 121)
    ends = heun(guided(TOLD.denoise, CROWD.denoise, w), TOP * z[:, None], levels)[:, 0]
    spread = (ends[2:] - ends[:-2]) / (z[2:] - z[:-2])
    crowd, told = (np.exp(mixture.log_density(x[:, None])) for mixture in (CROWD, TOLD))
    tilted = crowd ** (1 - w) * told**w
    return {
        "the crowd": np.stack([x, crowd], -1),
        "the condition": np.stack([x, told], -1),
        "tilted, what w asks for": np.stack([x, tilted / tilted.sum() / (x[1] - x[0])], -1),
        "what the flow gives": np.stack([ends[1:-1], np.exp(-(z[1:-1] ** 2) / 2) / np.sqrt(2 * np.pi) / spread], -1),
    }


def phases(count, gap):
    fine, edges = np.geomspace(TOP, BOTTOM, 81), np.geomspace(TOP, BOTTOM, count + 1)
    start = TOP * np.linspace(-1.75, 1.75, 8)[:, None]
    path, jump, guess = [start], [start], [start]
    for sigma, lower in zip(fine[:-1], fine[1:], strict=True):
        path.append(PAIR.flow(path[-1], sigma, lower))
    for sigma, lower in zip(edges[:-1], edges[1:], strict=True):
        jump.append(PAIR.flow(jump[-1], max(sigma * (1 - gap), lower), lower))
        guess.append(SAMPLERS["ddim"].step(guess[-1], PAIR.denoise(guess[-1], sigma), sigma, lower))
    own = lambda states, levels: np.stack(states)[..., 0].T / np.hypot(1, levels)
    every = {"path": (path, fine), "jump": (jump, edges), "guess": (guess, edges)}
    return {f"{name} {n}": np.stack([levels, places], -1)
            for name, (states, levels) in every.items() for n, places in enumerate(own(states, levels))}  # fmt: skip


@pytest.mark.parametrize(
    "expected, values",
    [
        (step, {"noise": 0.2, "place": 0.6, "left": 0.25, "way": 0}),
        (step, {"noise": -0.7, "place": -1.1, "left": 0.6, "way": 1}),
        (paths, {"strength": 0.0, "seed": 1}),
        (paths, {"strength": 1.3, "seed": 4}),
        (guidance, {"w": 1.0}),
        (guidance, {"w": 4.5}),
        (phases, {"count": 1, "gap": 0.0}),
        (phases, {"count": 5, "gap": 0.3}),
    ],
)
def test_a_picture_shows_what_the_library_computes(page, expected, values):
    name = expected.__name__
    found = page.script("return pictures[arguments[0]].compute(arguments[1])", name, values)["lines"]
    normals = lambda: page.script("return pictures.normals(arguments[0], 60300)", values["seed"])
    known = expected(**values, **({"normals": normals()} if name == "paths" else {}))
    assert found.keys() == known.keys()
    for line, points in known.items():
        points = [[float(np.squeeze(value)) for value in point] for point in points]
        np.testing.assert_allclose(found[line], points, rtol=1e-6, atol=1e-6, err_msg=line)


def test_the_noise_of_paths_is_normal(page):
    drawn = np.array(page.script("return pictures.normals(3, 60300)"))
    assert abs(drawn.mean()) < 0.02 and abs(drawn.std() - 1) < 0.02 and abs(np.mean(drawn**4) - 3) < 0.2
    assert abs(np.corrcoef(drawn[:-1], drawn[1:])[0, 1]) < 0.02


@pytest.mark.parametrize("size", [DESKTOP, PHONE], ids=["desktop", "phone"])
def test_every_slider_redraws_its_picture_and_says_what_it_shows(page, screenshots, size):
    page.resize(*size, phone=size == PHONE)
    page.screenshot(screenshots / f"pictures_{size[0]}.png")
    inputs = page.script("return document.querySelectorAll('figure input').length")
    state = "const i = document.querySelectorAll('figure input')[arguments[0]], f = i.closest('figure');"
    for number in range(inputs):
        look = state + "return [f.querySelector('svg').innerHTML, i.labels.length, i.getAttribute('aria-valuetext')]"
        before = page.script(look, number)
        page.script(state + "i.focus()", number)
        page.keys("ArrowRight")
        after = page.script(look, number)
        assert after[0] != before[0] and after[2] != before[2] and after[1] == 1
    assert page.errors() == [] and page.requests() == []
    assert page.script("return document.documentElement.scrollWidth") <= size[0]
