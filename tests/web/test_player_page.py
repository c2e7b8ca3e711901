"""The motion player in a real browser: what a reader sees, presses and touches."""

import base64
import html
import json
import struct

import numpy as np
import pytest
from builders import wandering_motion
from conftest import DESKTOP, PHONE
from test_page_bvh import ASSUMED, CASES

from f3amd_companion.serving.player import Character, Scene, player_page, write_player
from f3amd_lib.drawing.pictures import crowd_colors
from f3amd_lib.motion.bvh import parse_bvh
from f3amd_lib.motion.root_paths import path_from_motion
from f3amd_lib.motion.skeleton import Skeleton, resample
from f3amd_lib.motion.synthetic import synthesize

FRAMES = 90
MARKUP = "<img src=x onerror='window.ran = true'><script>window.ran = true</script>&amp;$title"
TITLES = ["Real", "CAMDM, 8 steps", "F3AMD, 8 steps", "F3AMD, 1 step"]


@pytest.fixture(scope="module")
def walks():
    return [synthesize("Neutral", FRAMES / 30, seed=seed) for seed in range(4)]


@pytest.fixture(scope="module")
def side_by_side(walks, tmp_path_factory):
    """Four motions in step, with target paths and windows of 32 frames."""
    characters = [Character(walk, path=path_from_motion(walk)) for walk in walks]
    scenes = [Scene(one, title=title, boundaries=(32, 64)) for one, title in zip(characters, TITLES, strict=True)]
    return write_player(tmp_path_factory.mktemp("pages") / "four.html", scenes, strip=False)


@pytest.fixture(scope="module")
def alone(tmp_path_factory):
    """One small figure that does not start by itself."""
    path = tmp_path_factory.mktemp("pages") / "one.html"
    scene = Scene(wandering_motion(FRAMES), title="Wanderer")
    return write_player(path, scene, autoplay=False, strip=False)


def opened(browser, page):
    browser.open(page)
    browser.wait("return document.documentElement.dataset.ready === 'yes'")
    return browser


def state(browser) -> dict:
    return browser.script("return player.state()")


def settled(browser) -> dict:
    """The state after the next picture has been drawn."""
    browser.driver.execute_async_script(
        "const done = arguments[0];"
        "requestAnimationFrame(() => requestAnimationFrame(() => requestAnimationFrame(done)));"
    )
    return state(browser)


def pixels(browser, panel: int = 0) -> np.ndarray:
    """What a panel shows, [H, W, 3], without its title."""
    settled(browser)
    box = browser.script(
        "const b = document.querySelectorAll('.panel')[arguments[0]].getBoundingClientRect();"
        "const s = devicePixelRatio; return [b.left, b.top + 60, b.right, b.bottom].map((v) => Math.round(v * s))",
        panel,
    )
    return browser.screenshot()[box[1] : box[3], box[0] : box[2]]


def share_of(picture: np.ndarray, color: str) -> int:
    """Number of pixels of a colour's hue, lit or in shade; none of grey."""
    import matplotlib.colors as mcolors

    seen = mcolors.rgb_to_hsv(picture / 255.0)
    hue = mcolors.rgb_to_hsv(mcolors.to_rgb(color))[0]
    apart = np.abs(seen[..., 0] - hue)
    return int(((np.minimum(apart, 1 - apart) < 0.04) & (seen[..., 1] > 0.25) & (seen[..., 2] > 0.15)).sum())


# ------------------------------------------------------------------------------ the fixture itself


def test_the_fixture_hears_of_requests_and_errors(browser, tmp_path):
    page = tmp_path / "bad.html"
    page.write_text(
        "<img src='http://outside.invalid/x.png'><script>undefinedThing();</script>"
        "<iframe sandbox='allow-scripts' srcdoc=\"<script src='http://inner.invalid/y.js'></script>"
        '<script>otherThing();</script>"></iframe>'
    )
    browser.open(page)
    browser.wait("return document.readyState === 'complete'")
    asked = browser.outside()
    assert "http://outside.invalid/x.png" in asked
    assert "http://inner.invalid/y.js" in asked
    errors = " ".join(browser.errors())
    assert "undefinedThing" in errors and "otherThing" in errors


# ----------------------------------------------------------------------------------------- loading


@pytest.mark.parametrize("size", [DESKTOP, PHONE], ids=["desktop", "phone"])
def test_the_page_opens_without_errors_or_requests(browser, side_by_side, screenshots, size):
    browser.resize(*size, phone=size == PHONE)
    opened(browser, side_by_side)
    browser.wait("return player.state().frame > 20")
    name = "phone" if size == PHONE else "desktop"
    picture = browser.screenshot(screenshots / f"player_{name}.png")
    assert picture.shape[1] == size[0] * (2 if size == PHONE else 1)
    assert browser.errors() == []
    assert browser.requests() == []
    # Nothing sticks out: what is wider than the window would have to be scrolled to.
    assert browser.script("return document.documentElement.scrollWidth") <= size[0]
    assert browser.script("return document.documentElement.scrollHeight") <= size[1]


def test_the_browser_reads_the_positions_that_python_wrote(browser, side_by_side, walks):
    opened(browser, side_by_side)
    for scene, frame in ((0, 0), (3, FRAMES - 1), (2, 47)):
        read = [browser.script("return player.position(...arguments)", scene, 0, frame, place) for place in (0, 5)]
        expected = walks[scene].positions[frame, [0, 5]] * 1000
        np.testing.assert_allclose(read, expected, atol=1.5)


def test_every_panel_shows_a_figure_in_the_colours_of_the_pictures(browser, side_by_side):
    from f3amd_lib.drawing.stick_figures import LIMB_COLORS

    opened(browser, side_by_side)
    for panel in range(4):
        for body in (True, False):
            browser.script("player.setBody(arguments[0])", body)
            picture = pixels(browser, panel)
            for side in ("left", "right"):
                assert share_of(picture, LIMB_COLORS[side]) > 300, (panel, side, body)


# -------------------------------------------------------------------------------------------- time


def test_play_advances_frames_and_pause_holds_them(browser, alone):
    opened(browser, alone)
    assert state(browser)["playing"] is False and state(browser)["frame"] == 0
    button = browser.find("#play")
    assert button.accessible_name == "Play"
    before = pixels(browser)
    button.click()
    browser.wait("return player.state().frame >= 5")
    assert button.accessible_name == "Pause"
    assert settled(browser)["draws"] > 3
    button.click()
    held = settled(browser)
    assert (pixels(browser) != before).any()
    assert held["playing"] is False and held["time"] == held["frame"]
    later = settled(browser)
    assert later["frame"] == held["frame"] and later["draws"] == held["draws"]  # no idle work


def test_playing_keeps_time_and_starts_again_at_the_end(browser, alone):
    opened(browser, alone)
    browser.script("player.seek(60); player.setPlaying(true)")
    seen = browser.driver.execute_async_script(
        "const done = arguments[0]; const seen = []; const began = performance.now();"
        "(function look() { seen.push([performance.now() - began, player.state().time]);"
        " if (performance.now() - began < 2400) requestAnimationFrame(look); else done(seen); })();"
    )
    milliseconds, time = np.array(seen).T
    assert time.max() == FRAMES - 1
    again = int(np.argmax(np.diff(time) < -50))  # from the last frame back to the first
    assert again > 0 and time[again + 1] < 20
    # 30 frames a second by the page's own clock, until the last frame is reached.
    first = slice(1, int(np.argmax(time == FRAMES - 1)))
    gaps = np.diff(milliseconds[first])
    if len(gaps) > 5 and gaps.max() < 200:  # longer gaps are cut, and do not tell
        slope = np.polyfit(milliseconds[first], time[first], 1)[0]
        assert slope == pytest.approx(0.03, rel=0.15)


def test_scrubbing_seeks(browser, side_by_side):
    opened(browser, side_by_side)
    browser.script("player.setPlaying(false)")
    slider = browser.find("#scrub")
    assert slider.accessible_name == "Time" and slider.aria_role == "slider"
    box = slider.rect
    # The middle of the thumb's road is the middle frame.
    middle = (box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
    for kind in ("mousePressed", "mouseReleased"):
        browser.command("Input.dispatchMouseEvent", type=kind, x=middle[0], y=middle[1], button="left", clickCount=1)
    now = settled(browser)
    assert abs(now["frame"] - (FRAMES - 1) / 2) <= 1.5
    assert now["window"] == 2
    spoken = slider.get_attribute("aria-valuetext")
    assert spoken.startswith(f"{now['frame'] / 30:.1f} of 3.0 seconds, window 2 of 3")
    assert f"frame {now['frame'] + 1} of {FRAMES}" in spoken


# -------------------------------------------------------------------------------- keys and fingers


def press(browser, letter: str, shift: bool = False) -> dict:
    """The view after a letter key, with or without shift."""
    key, code = letter.upper() if shift else letter, f"Key{letter.upper()}"
    for kind in ("keyDown", "keyUp"):
        browser.command("Input.dispatchKeyEvent", type=kind, key=key, code=code, modifiers=8 if shift else 0)
    return browser.script("return {...player.view}")


def test_keyboard(browser, alone):
    opened(browser, alone)
    there = ("ArrowRight", 1), ("ArrowRight", 2), ("ArrowLeft", 1), ("End", FRAMES - 1), ("ArrowRight", FRAMES - 1)
    for key, expected in (*there, ("Home", 0), ("ArrowLeft", 0)):
        browser.keys(key)
        assert settled(browser)["frame"] == expected, key
    zoom = browser.script("return player.view.zoom")
    browser.keys("+")
    assert browser.script("return player.view.zoom") == pytest.approx(1.2 * zoom)
    browser.keys("-")
    before = browser.script("return {...player.view}")
    assert before["zoom"] == pytest.approx(zoom)
    assert press(browser, "d")["around"] == pytest.approx(before["around"] + 0.12)
    moved = press(browser, "d", shift=True)
    assert np.hypot(moved["panX"], moved["panZ"]) > 0.1
    assert press(browser, "a", shift=True)["panX"] == pytest.approx(0, abs=1e-9)
    browser.keys("ArrowUp")
    assert state(browser)["speed"] == 2 and browser.find("#speed").get_attribute("value") == "2"
    browser.keys("ArrowDown", "ArrowDown")
    assert state(browser)["speed"] == 0.5
    browser.keys(" ")
    browser.wait("return player.state().playing && player.state().frame > 0")
    browser.keys(" ")
    assert state(browser)["playing"] is False
    assert browser.errors() == []


def test_every_control_has_a_name(browser, alone):
    opened(browser, alone)
    browser.find("#turn").click()
    browser.find("#more").click()
    controls = browser.driver.find_elements("css selector", "button, input, select, #timeline, summary")
    controls = [control for control in controls if control.is_displayed()]
    names = [control.accessible_name for control in controls]
    assert len(names) >= 30 and all(names)
    assert len(set(names)) == len(names)


def test_dragging_orbits_and_the_wheel_zooms(browser, alone):
    opened(browser, alone)
    before = browser.script("return {...player.view}")
    picture = pixels(browser)
    for kind, x, y in (("mousePressed", 600, 300), ("mouseMoved", 700, 250), ("mouseReleased", 700, 250)):
        browser.command("Input.dispatchMouseEvent", type=kind, x=x, y=y, button="left", buttons=1, clickCount=1)
    settled(browser)
    after = browser.script("return {...player.view}")
    high = browser.find("#stage").rect["height"]
    assert after["around"] == pytest.approx(before["around"] - 2 * np.pi * 100 / high)
    assert after["elevation"] < before["elevation"]
    assert (pixels(browser) != picture).any()
    browser.command("Input.dispatchMouseEvent", type="mouseWheel", x=600, y=300, deltaX=0, deltaY=-200)
    browser.wait("return player.view.zoom > 1.05")
    browser.find("#reset").click()
    again = browser.script("return {...player.view}")
    assert again == pytest.approx(before)


def test_touch_orbits_and_pinches(browser, alone):
    browser.resize(*PHONE, phone=True)
    opened(browser, alone)
    before = browser.script("return {...player.view}")
    browser.touch("touchStart", (200, 300))
    browser.touch("touchMove", (250, 300))
    browser.touch("touchEnd")
    after = browser.script("return {...player.view}")
    assert -1.5 < after["around"] - before["around"] < -0.3
    assert after["zoom"] == pytest.approx(before["zoom"])
    browser.touch("touchStart", (150, 300), (250, 300))
    browser.touch("touchMove", (100, 300), (300, 300))
    browser.touch("touchEnd")
    assert browser.script("return player.view.zoom") == pytest.approx(2.0, rel=0.05)
    browser.find("#play").click()
    browser.wait("return player.state().frame > 2")


def test_follow_and_from_above(browser, alone):
    opened(browser, alone)
    follow, above = browser.find("#follow"), browser.find("#top")
    assert follow.get_attribute("aria-pressed") == "true"
    follow.click()
    assert follow.get_attribute("aria-pressed") == "false"
    # Without following, the whole walk is in the picture: the figure is at both ends of it.
    for frame in (0, FRAMES - 1):
        browser.script("player.seek(arguments[0])", frame)
        settled(browser)
        assert share_of(pixels(browser), "#EF9A26") > 50
    standing = pixels(browser)
    above.click()
    settled(browser)
    assert above.get_attribute("aria-pressed") == "true"
    assert (pixels(browser) != standing).any()
    assert abs(browser.script("return player.view.around")) == pytest.approx(np.pi, abs=1e-3)  # +Z up the page
    above.click()
    settled(browser)
    difference = pixels(browser).astype(int) - standing
    assert np.abs(difference).max() < 16  # the edges' shades depend on who draws, CPU or GPU


# ------------------------------------------------------------------------------------ surroundings


def test_buttons_orbit_and_move_the_view_without_a_drag(browser, alone):
    opened(browser, alone)
    browser.find("#turn").click()
    view = lambda: browser.script("const v = player.view; return [v.around, v.elevation, v.panX, v.panZ]")
    start = view()
    pairs = "orbit-right orbit-left", "orbit-up orbit-down", "move-right move-left", "move-forward move-back"
    for there, back in map(str.split, pairs):
        browser.find(f"#{there}").click()
        assert np.abs(np.subtract(view(), start)).max() > 0.1
        browser.find(f"#{back}").click()
        np.testing.assert_allclose(view(), start, atol=1e-9)
    browser.find("#turn").click()
    assert not browser.find("#pad").is_displayed()


def test_it_starts_by_itself_unless_motion_is_unwanted(browser, side_by_side):
    opened(browser, side_by_side)
    browser.wait("return player.state().frame > 2")
    browser.reduced_motion()
    opened(browser, side_by_side)
    assert settled(browser)["playing"] is False
    assert state(browser)["frame"] == 0
    browser.find("#play").click()  # but it plays when asked
    browser.wait("return player.state().frame > 2")


def test_it_works_in_the_iframe_of_a_notebook(browser, walks, tmp_path):
    inner = html.escape(player_page(walks[0]), quote=True)
    attributes = 'title="Motion player" sandbox="allow-scripts allow-downloads" style="width:100%;height:480px"'
    iframe = f'<iframe {attributes} srcdoc="{inner}"></iframe>'
    page = tmp_path / "notebook.html"
    page.write_text(f"<!doctype html><title>Notebook</title><body>{iframe}</body>")
    browser.open(page)
    frame = browser.find("iframe")
    assert frame.accessible_name == "Motion player"
    browser.driver.switch_to.frame(frame)
    browser.wait("return document.documentElement.dataset.ready === 'yes'")
    browser.wait("return player.state().frame > 2")
    # On its own: neither the notebook around it nor its storage is within reach.
    outer = browser.script("try { return String(window.parent.document); } catch (error) { return error.name; }")
    assert outer in ("SecurityError", "null")
    browser.driver.switch_to.default_content()
    assert share_of(browser.screenshot(), "#EF9A26") > 300
    assert browser.errors() == [] and browser.requests() == []


def test_the_page_forbids_itself_any_request_and_any_script_in_markup(browser, alone, tmp_path):
    """As if a name had been written down as markup, after all."""
    page, path = alone.read_text(encoding="utf-8"), tmp_path / "page.html"
    path.write_text(page.replace("<header></header>", f"<header>{MARKUP}</header>"), encoding="utf-8")
    opened(browser, path)
    assert browser.script("return [document.images.length, window.ran]") == [1, None]
    assert browser.fetched("http://outside.invalid/") == "TypeError"
    assert any("Content Security Policy" in message for message in browser.errors())
    assert browser.outside() == []


def test_damaged_data_are_told_of(browser, tmp_path):
    page = player_page(wandering_motion(20), autoplay=False)
    broken = page.replace('"frames":20', '"frames":19')
    assert broken != page
    path = tmp_path / "broken.html"
    path.write_text(broken, encoding="utf-8")
    browser.open(path)
    browser.wait("return !document.getElementById('message').hidden")
    assert "cannot be shown" in browser.find("#message").text


def crowd_of(count):
    """People in rows, who walk in place of each other."""
    base = [synthesize("Neutral", 2.0, seed=seed) for seed in range(4)]
    place = lambda walk, k: walk.root_position + np.array([1.5 * (k % 10), 0.0, 1.5 * (k // 10)])
    return [base[k % 4].replace(root_position=place(base[k % 4], k)) for k in range(count)]


def test_a_hundred_characters_play_in_their_colours_where_python_put_them(browser, tmp_path):
    crowd, colors = crowd_of(100), crowd_colors(20 * ["one", "two", "three", "four", "five"])
    characters = [Character(motion, color=color) for motion, color in zip(crowd, colors, strict=True)]
    page = write_player(tmp_path / "crowd.html", Scene(characters), strip=False)
    assert page.stat().st_size < 1_500_000  # small enough to send
    opened(browser, page)
    browser.wait("return player.state().frame > 5", seconds=60)
    # Far more than a page of grey controls would show.
    vivid = np.ptp(browser.screenshot().astype(int), axis=-1) > 60
    assert 2e-3 < vivid.mean() < 0.6
    for character in (0, 37, 99):
        seen = browser.script("return player.position(0, arguments[0], 41, 0)", character)
        np.testing.assert_allclose(seen, 1000 * crowd[character].positions[41, 0], atol=1.1)
    assert browser.errors() == [] and browser.requests() == []


CARD = "A graphics card"
PRETENDED = """
const ask = WebGL2RenderingContext.prototype.getParameter;
WebGL2RenderingContext.prototype.getParameter = function (name) {{
  return [37446, 7937].includes(name) ? "{card}" : ask.call(this, name);
}};
const now = performance.now.bind(performance);
performance.now = () => {speed} * now();
"""
"""What draws, and a clock that goes so many times as fast: drawing seems to take as long as a case wants."""


@pytest.mark.parametrize(
    ("count", "card", "speed", "says"),
    [
        (100, "SwiftShader", 1e-6, "Drawn as sticks: this browser draws without a graphics card"),
        (16, CARD, 1e4, "Drawn as sticks: a picture with bodies takes "),
        (16, CARD, 1e-6, ""),
        (1, "SwiftShader", 1e4, "Drawn as sticks: a picture with bodies takes "),
        (1, "SwiftShader", 1e-6, ""),
    ],
    ids=["crowd in software", "crowd, slow", "crowd, quick", "one, slow", "one, quick"],
)
def test_who_draws_too_slowly_gets_sticks_is_told_and_may_have_bodies(browser, tmp_path, count, card, speed, says):
    path = write_player(tmp_path / "crowd.html", Scene(crowd_of(count)), strip=False, autoplay=False)
    source = PRETENDED.format(card=card, speed=speed)
    added = browser.command("Page.addScriptToEvaluateOnNewDocument", source=source)
    try:
        browser.open(path)
        browser.wait("return document.documentElement.dataset.ready === 'yes'", 120)
        said = browser.find("#notice").text
        assert said.startswith(says) if says else said == ""
        assert said.count(". ") == bool(says) and said.endswith("The button Sticks brings bodies back." * bool(says))
        assert state(browser)["body"] is not bool(says)
        assert browser.find("#sticks").get_attribute("aria-pressed") == str(bool(says)).lower()
        browser.find("#sticks").click()  # overridden, either way
        assert state(browser)["body"] is bool(says) and browser.find("#notice").text == ""
    finally:
        browser.command("Page.removeScriptToEvaluateOnNewDocument", identifier=added["identifier"])
    assert browser.errors() == []


def test_bodies_of_a_crowd_take_as_many_draws_as_one(browser, tmp_path):
    """Whatever the number of people: bodies are instances of one, limb by limb."""
    draws = []
    for count in (20, 40):
        opened(browser, write_player(tmp_path / f"{count}.html", Scene(crowd_of(count)), strip=False, autoplay=False))
        calls = []
        for body in (True, False):
            browser.script("player.setBody(arguments[0]); player.stage.castShadows(false)", body)
            settled(browser)
            calls.append(browser.script("return player.stage.renderer.info.render.calls"))
        draws.append(calls[0] - calls[1])  # bodies instead of sticks, trails apart
    limbs = browser.script("return player.characters[0].figure.skeleton.capsules.length")
    assert draws == [limbs - 2, limbs - 2]  # sticks and heads are two


# ----------------------------------------------------------------------------- files in, files out


def test_what_the_page_saves_as_bvh_is_what_python_reads(browser, side_by_side, walks, tmp_path):
    opened(browser, side_by_side)
    text = browser.script("return player.bvhText(player.characters[1])")
    again = parse_bvh(text, "page")
    assert again.skeleton.names == walks[1].skeleton.names
    np.testing.assert_allclose(again.positions, walks[1].positions, atol=2e-3)
    assert np.abs(again.positions - walks[2].positions).max() > 0.02


def test_what_the_page_saves_as_glb_has_skin_joints_and_every_frame(browser, side_by_side, walks):
    opened(browser, side_by_side)
    packed = browser.driver.execute_async_script(
        "const done = arguments[0]; player.glbOf(player.characters[0]).then((made) =>"
        " done(btoa(Array.from(new Uint8Array(made), (k) => String.fromCharCode(k)).join(''))))"
    )
    data = base64.b64decode(packed)
    size = struct.unpack_from("<I", data, 12)[0]
    file = json.loads(data[20 : 20 + size])
    assert data[:4] == b"glTF" and file["asset"]["version"] == "2.0"
    joints = [file["nodes"][k]["name"] for k in file["skins"][0]["joints"]]
    assert joints == list(walks[0].skeleton.names)
    assert len(file["animations"][0]["channels"]) == 1 + len(joints)
    times = file["accessors"][file["animations"][0]["samplers"][0]["input"]]
    assert (times["count"], times["max"][0]) == (FRAMES, pytest.approx((FRAMES - 1) / 30))


def drop(browser, content: str, name: str) -> None:
    """Let go of a file over the page; its content is JavaScript."""
    browser.script(
        f"const items = new DataTransfer(); items.items.add(new File([{content}], arguments[0]));"
        "document.dispatchEvent(new DragEvent('drop', {dataTransfer: items, bubbles: true, cancelable: true}))",
        name,
    )


def notice(browser, words: str) -> str:
    """What the page says, as soon as these words are in it."""
    browser.wait(f"return document.getElementById('notice').textContent.includes({json.dumps(words)})")
    return browser.find("#notice").text


@pytest.mark.parametrize("name", ["plain", "metres", "CMU", "six channels, no OFFSET", "one frame", "Z up"])
def test_a_dropped_bvh_walks_beside_the_first(browser, alone, screenshots, name):
    content, motion = CASES[name]
    opened(browser, alone)
    drop(browser, json.dumps(content.decode()), f"{name}.bvh")
    said = notice(browser, f"{name}: {motion.skeleton.num_joints} joints")
    assert "another skeleton" in said and ASSUMED.get(name, "") in said
    motion = resample(motion, 30.0)
    browser.script("player.seek(40)")
    settled(browser)
    browser.screenshot(screenshots / f"player_dropped_{name}.png")
    joints = range(0, motion.skeleton.num_joints, 4)
    for frame in (0, 40):
        read = [browser.script("return player.position(0, 1, ...arguments)", frame, joint) for joint in joints]
        expected = 1000 * motion.positions[min(frame, motion.num_frames - 1), joints]
        beside = [read[0][0] - expected[0, 0], 0, read[0][2] - expected[0, 2]]  # on the same floor
        np.testing.assert_allclose(read, expected + beside, atol=1.5)
    assert browser.errors() == []


def test_a_file_that_cannot_be_shown_is_refused_and_one_too_large_is_not_even_read(browser, alone):
    opened(browser, alone)
    drop(browser, "'nonsense'", "<b>bad</b>.bvh")
    assert "<b>bad<" in notice(browser, "it does not begin with HIERARCHY")
    browser.script("Blob.prototype.arrayBuffer = Blob.prototype.text = () => { window.wasRead = true; }")
    drop(browser, "new Uint8Array(50e6 + 1)", "large.bvh")
    assert "51 MB" in notice(browser, "large.bvh") and "50 at most" in notice(browser, "large.bvh")
    assert browser.script("return [player.characters.length, window.wasRead]") == [1, None]


def test_names_with_markup_are_text(browser, tmp_path):
    one = wandering_motion(FRAMES)
    skeleton = Skeleton([MARKUP, *one.skeleton.names[1:]], one.skeleton.parents, one.skeleton.offsets)
    scene = Scene(
        [Character(one.replace(skeleton=skeleton), name=MARKUP), one], title=MARKUP, note=MARKUP, boundaries=(9,)
    )  # fmt: skip
    opened(browser, write_player(tmp_path / "page.html", scene, title=MARKUP, credit=MARKUP, strip=False))
    browser.script("player.characters[0].panel.follows = player.characters[0]")
    browser.keys("n")
    settled(browser)
    drop(browser, json.dumps(CASES["one frame"][0].decode()), f"{MARKUP.replace('/', '')}.bvh")
    notice(browser, "<img")
    places = "title", "h1", "figcaption strong", "figcaption span", ".credit", ".labels span", "#person option"
    for place in places:
        assert MARKUP in browser.script("return document.querySelector(arguments[0]).textContent", place), place
    assert browser.script("return [document.images.length, window.ran]") == [0, None]


# --------------------------------------------------------------------------------- loop, names, ghost


def test_a_loop_plays_its_frames_only(browser, alone):
    opened(browser, alone)
    browser.script("player.seek(20)")
    browser.keys("i")
    browser.script("player.seek(30)")
    browser.keys("o")
    assert state(browser)["loop"] == [20, 30]
    browser.script("player.seek(20); player.setPlaying(true)")
    seen = browser.driver.execute_async_script(
        "const done = arguments[0]; const seen = []; const began = performance.now();"
        "(function look() { seen.push(player.state().time);"
        " if (performance.now() - began < 1500) requestAnimationFrame(look); else done(seen); })();"
    )
    assert min(seen) >= 20 and max(seen) <= 30 and np.diff(seen).min() < -5
    browser.keys("l")
    assert state(browser)["loop"] == [0, FRAMES - 1]


def test_names_ghost_and_persons(browser, walks, tmp_path, screenshots):
    two = [Character(walks[0], name="one", ghost=walks[2]), Character(walks[1], name="two")]
    opened(browser, write_player(tmp_path / "two.html", Scene(two, title="Two"), strip=False, autoplay=False))
    shown = "return document.querySelectorAll('.labels span').length"
    assert browser.script(shown) == 0
    browser.keys("n")
    settled(browser)
    assert browser.script(shown) == 23
    assert browser.script("return document.querySelector('.labels span').textContent") == "Hips"
    legend = browser.script("return document.querySelector('.legend').innerText")
    assert "walked" in legend and "ghost" in legend  # and what is not there is not named
    assert "target path" not in legend and "a window begins" not in legend
    with_ghost = pixels(browser)
    browser.keys("g")
    assert (pixels(browser) != with_ghost).any()
    browser.find("#more").click()
    chosen = "const list = document.getElementById('person'); list.value = '2';"
    browser.script(f"{chosen} list.dispatchEvent(new Event('change'))")
    browser.screenshot(screenshots / "player_person.png")
    assert browser.script("return player.view.follow") is True
    assert browser.script("return player.stage.views[0].target.toArray()") == pytest.approx(
        [*walks[1].root_position[0, [0]], 0.88, *walks[1].root_position[0, [2]]], abs=0.15
    )
    browser.script("player.followPerson(player.characters[0])")


def test_titles_stand_over_their_panels(browser, side_by_side):
    opened(browser, side_by_side)
    captions = browser.script(
        "return [...document.querySelectorAll('.panel')].map((one) =>"
        " [one.querySelector('strong').textContent, one.getBoundingClientRect().left,"
        "  one.querySelector('.labels').getAttribute('aria-label')])"
    )
    assert [title for title, _, _ in captions] == TITLES
    lefts = [left for _, left, _ in captions]
    assert lefts == sorted(lefts) and len(set(lefts)) == 4  # side by side on a desktop
    assert all(label == f"{title}: 1 character of 23 joints, 3.0 seconds" for title, _, label in captions)
