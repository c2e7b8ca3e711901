"""A hundred characters on one page, in a real browser: it opens, moves, seeks, and asks nobody."""

import numpy as np
import pytest
from conftest import DESKTOP, PHONE

from f3amd_companion.serving.crowd import plan_crowd
from f3amd_companion.serving.player import Character, Scene, write_player
from f3amd_lib.drawing.pictures import crowd_colors
from f3amd_lib.motion.skeleton import turn
from f3amd_lib.motion.synthetic import synthesize

COUNT, FRAMES = 100, 60
STYLES = ("Neutral", "Old", "March", "Zombie", "ArmsWide")


@pytest.fixture(scope="module")
def motions():
    """Synthetic walkers, each put where a planned path starts."""
    walks = {style: synthesize(style, FRAMES / 30) for style in STYLES}
    paths = plan_crowd(COUNT, FRAMES, seed=1)
    placed = []
    for character, path in enumerate(paths):
        style = STYLES[character % len(STYLES)]
        walk = turn(walks[style], path.yaw[0] - walks[style].yaw[0])
        shift = np.array([path.position[0, 0], 0.0, path.position[0, 1]])
        start = walk.root_position[0] * np.array([1.0, 0.0, 1.0])
        placed.append(walk.replace(root_position=walk.root_position - start + shift, name=style))
    return placed


@pytest.fixture(scope="module")
def crowd_page(motions, tmp_path_factory):
    colors = crowd_colors([motion.name for motion in motions])
    characters = [Character(motion, color=color) for motion, color in zip(motions, colors, strict=True)]
    path = tmp_path_factory.mktemp("pages") / "crowd.html"
    return write_player(path, Scene(characters, title="A hundred"), strip=False)


def opened(browser, page):
    browser.open(page)
    browser.wait("return document.documentElement.dataset.ready === 'yes'")
    return browser


@pytest.mark.parametrize("size", [DESKTOP, PHONE], ids=["desktop", "phone"])
def test_a_hundred_characters_play_without_errors_or_requests(browser, crowd_page, tmp_path, size):
    browser.resize(*size, phone=size == PHONE)
    opened(browser, crowd_page)
    browser.wait("return player.state().frame > 5", seconds=60)
    assert browser.errors() == []
    assert browser.outside() == []
    picture = browser.screenshot(tmp_path / "crowd.png")
    # Colours of five styles: far more than a page of grey controls would show.
    vivid = np.ptp(picture.astype(int), axis=-1) > 60
    assert 2e-3 < vivid.mean() < 0.6


def test_scrubbing_seeks_and_everybody_is_where_python_put_them(browser, crowd_page, motions):
    opened(browser, crowd_page)
    browser.script("player.setPlaying(false); player.seek(41)")
    state = browser.script("return player.state()")
    assert (state["frame"], state["playing"], state["numFrames"]) == (41, False, FRAMES)
    for character in (0, 37, COUNT - 1):
        seen = browser.script("return player.position(0, arguments[0], 41, 0)", character)
        expected = 1000 * motions[character].positions[41, 0]
        np.testing.assert_allclose(seen, expected, atol=1.1)  # a root is stored to a millimetre


def test_the_page_of_a_hundred_is_small_enough_to_send(crowd_page):
    assert crowd_page.stat().st_size < 1_500_000
