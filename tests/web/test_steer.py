"""The steer page in a real browser: the network runs in it, and somebody drives."""

import json
from dataclasses import replace

import builders  # noqa: F401  (tests/ is on the path)
import numpy as np
import pytest
from steering_oracle import FPS, Steering, first_pose

from f3amd_companion.serving import steer
from f3amd_companion.serving.onnx_export import denoiser_program
from f3amd_companion.serving.steer import write_steer
from f3amd_companion.terminal import find_model
from f3amd_lib.diffusion.schedules import variance_exploding
from f3amd_lib.measures.walking import seam_kick, slide_speed
from f3amd_lib.rollout.rollout import MotionGenerator
from f3amd_lib.training.checkpoints import load_model

pytestmark = pytest.mark.needs("jax2onnx", "onnxruntime")
PHONE = (390, 844)
SMALL = (400, 300)
"""A window that software paints quickly, for tests of the network rather than of the picture."""


@pytest.fixture(scope="module")
def trained():
    return load_model(find_model("synthetic"))


@pytest.fixture(scope="module")
def program(trained):
    return denoiser_program(trained.network(), weights="int8")


@pytest.fixture(scope="module")
def page(trained, program, tmp_path_factory):
    return write_steer(tmp_path_factory.mktemp("steer") / "steer.html", trained, program=program)


def opened(browser, page):
    browser.open(page)
    browser.wait(
        "return document.documentElement.dataset.ready === 'yes' && !!window.steer"
        " || !document.getElementById('message').hidden",
        120,
    )
    assert browser.find("#message").text == ""
    return browser


def key(browser, kind: str, code: str) -> None:
    browser.script("dispatchEvent(new KeyboardEvent(arguments[0], {code: arguments[1]}))", kind, code)


def choose(browser, name: str, value) -> None:
    browser.script(f"document.querySelector('input[name={name}][value=\"{value}\"]').click()")


def pythons_rounds(trained, num_steps, rounds):
    """What Python makes of two characters, and what a page needs to be asked for the same."""
    config, rng = trained.config, np.random.default_rng(0)
    noise = rng.standard_normal((rounds, 2, config.window, config.channels)).astype(np.float32)
    names, paces, yaws = ("Neutral", "Old"), (1.22, 0.58), (0.3, -1.0)
    numbers = [trained.style_index(name) for name in names]
    style = np.eye(len(trained.styles))[numbers]
    style[1] = 0.5 * style[0] + 0.5 * style[1]
    poses = [first_pose(trained, name, (k, 2.0 * k), yaws[k]) for k, name in enumerate(names)]
    steering = Steering(MotionGenerator(trained, num_steps), np.stack(poses), yaws)
    asked = {
        "places": [{"x": k, "z": 2.0 * k, "yaw": yaws[k], "style": number} for k, number in enumerate(numbers)],
        "wishes": [{"speed": paces[k], "direction": (1.0, -1.0)[k]} for k in range(2)],
        "styles": style.tolist(),
        "noise": noise.reshape(rounds, -1).tolist(),
        "sigmas": variance_exploding(**dict(trained.diffusion.settings)).grid(num_steps).tolist(),
        "hop": steering.hop,
        "blend": steering.blend_frames,
    }
    return [steering.advance(paces, (1.0, -1.0), style, one) for one in noise], asked


def same_as_python(browser, trained, num_steps, rounds):
    wanted, asked = pythons_rounds(trained, num_steps, rounds)
    # No single call of the driver may take long: selenium gives up after two minutes.
    browser.script(
        "window.made = null; const done = (found) => { window.made = found; };"
        "steer.rehearse(JSON.parse(arguments[0])).then(done, (e) => done(String(e)))",
        json.dumps(asked),
    )
    browser.wait("return window.made !== null", 300)
    np.testing.assert_allclose(browser.script("return window.made"), wanted, atol=1e-4)


def test_rounds_are_pythons_for_the_same_noise(browser, page, trained):
    """The whole way: history, condition, the network in WebAssembly with the page's weights, sampler, blending."""
    opened(browser, page)
    for num_steps in (8, 1):
        same_as_python(browser, trained, num_steps, rounds=2)
    assert browser.find("#where").text == "in WebAssembly on one thread"  # the usual page asks for no card
    assert browser.errors() == [] and browser.requests() == []


@pytest.fixture(scope="module")
def webgpu_page(trained, program, tmp_path_factory):
    return write_steer(tmp_path_factory.mktemp("gpu") / "gpu.html", trained, program=program, runtime="webgpu")


def test_rounds_by_webgpu_are_pythons(webgpu_browser, webgpu_page, trained):
    """The graphics card is played in software, slowly; its shaders are those that a card would run."""
    webgpu_browser.resize(*SMALL)
    opened(webgpu_browser, webgpu_page.as_uri() + "#software-webgpu")
    assert webgpu_browser.find("#where").text == "by WebGPU in software"
    for num_steps in (2, 1):
        same_as_python(webgpu_browser, trained, num_steps, rounds=1)
    assert webgpu_browser.script("return steer.state().runs") == "software"
    assert webgpu_browser.errors() == [] and webgpu_browser.requests() == []


NO_CARD = {
    "this browser lends no graphics card": "undefined",
    "this browser only plays a graphics card, in software": "{requestAdapter: async () => "
    "({info: {isFallbackAdapter: true}})}",
    "the card is gone": "{requestAdapter: async () => { throw new Error('the card is gone'); }}",
}
"""What a page for WebGPU says -> what its worker finds as `navigator.gpu`."""


@pytest.mark.parametrize("reason", NO_CARD)
def test_a_page_for_webgpu_says_why_it_walks_without_a_card(
    browser, trained, program, page, tmp_path, monkeypatch, reason
):
    """WebAssembly takes over, of the runtime that would do both."""
    made = steer._worker
    browser.resize(*SMALL)
    hidden = f"Object.defineProperty(self.navigator, 'gpu', {{value: {NO_CARD[reason]}}});\n"
    monkeypatch.setattr(steer, "_worker", lambda script: hidden + made(script))
    opened(browser, write_steer(tmp_path / "gpu.html", trained, program=program, runtime="webgpu"))
    assert browser.find("#where").text == f"in WebAssembly on one thread (not by WebGPU: {reason})"
    assert browser.script("return steer.state().runs") == "wasm"
    browser.wait("return steer.state().rounds > 1", 120)
    assert browser.errors() == [] and browser.requests() == []


NO_WEBASSEMBLY = {
    "this browser has no WebAssembly": "delete self.WebAssembly",
    "its memory is used up": "WebAssembly.instantiate = async () => { throw new Error('its memory is used up'); }",
    "the worker is broken": "throw new Error('the worker is broken')",
}
"""What the page says -> what its worker begins with."""


@pytest.mark.parametrize("reason", NO_WEBASSEMBLY)
def test_a_network_that_does_not_start_says_why(browser, trained, program, tmp_path, monkeypatch, reason):
    made = steer._worker
    monkeypatch.setattr(steer, "_worker", lambda script: f"{NO_WEBASSEMBLY[reason]};\n{made(script)}")
    browser.open(write_steer(tmp_path / "page.html", trained, program=program))
    browser.wait("return !document.getElementById('message').hidden", 60)
    assert reason in browser.find("#message").text


MARKUP = "<img src=x onerror='window.ran = true'><script>window.ran = true</script>$name"


def test_names_with_markup_are_text_and_the_page_may_ask_nobody(browser, trained, program, tmp_path):
    first, *others = trained.styles
    poses = trained.start_poses | {MARKUP: trained.start_poses[first]}
    renamed = replace(trained, name=MARKUP, styles=(MARKUP, *others), start_poses=poses)
    opened(browser, write_steer(tmp_path / "page.html", renamed, program=program))
    for place in ("title", "h1 small", "#first", "details:not(#settings) p"):
        assert MARKUP in browser.script("return document.querySelector(arguments[0]).textContent", place), place
    assert browser.script("return [document.images.length, window.ran]") == [0, None]
    assert browser.fetched("http://outside.invalid/") == "TypeError" and browser.outside() == []


@pytest.mark.parametrize("slow", [True, False])
def test_a_slow_picture_gets_fewer_pixels_and_the_page_says_so(browser, page, slow):
    """The browser's clock of pictures is made up: 100 ms apart, or 10."""
    step = 100 if slow else 10
    clock = (
        f"let now = 0; const ask = requestAnimationFrame; requestAnimationFrame = (f) => ask(() => f(now += {step}));"
    )
    added = browser.command("Page.addScriptToEvaluateOnNewDocument", source=clock)
    browser.resize(*SMALL)
    try:
        opened(browser, page)
        browser.wait(f"return {'steer.state().sharpness < 0.6' if slow else 'steer.state().pictures > 22'}", 120)
        words = " (fewer pixels, to be quicker)" if slow else ""
        browser.wait(f"return document.getElementById('coarse').textContent === '{words}'", 120)
        canvas = browser.script("const c = document.getElementById('view'); return c.width / c.clientWidth")
        assert canvas == pytest.approx(0.5 if slow else 1.0, abs=0.01)
    finally:
        browser.command("Page.removeScriptToEvaluateOnNewDocument", identifier=added["identifier"])


def test_a_square_driven_by_keys(browser, page, trained, screenshots, capsys):
    """20 s, a side each 5 s: the character follows the line, does not jump, and nothing complains."""
    opened(browser, page)
    choose(browser, "steps", 1)  # what a slow machine still makes in time
    browser.wait("return steer.state().timed >= 3", 60)
    sides = ("ArrowUp", "ArrowRight", "ArrowDown", "ArrowLeft")
    key(browser, "keydown", sides[0])
    browser.wait("return steer.state().rounds > 3")
    browser.script("steer.forget()")
    began = browser.script("return steer.state().newest")
    for side, following in zip(sides, (*sides[1:], None), strict=True):
        began += 150
        browser.wait(f"return steer.state().newest >= {began}", 90)
        if following:
            key(browser, "keydown", following)
        key(browser, "keyup", side)
    state, record = browser.script("return steer.state()"), browser.script("return steer.record()")
    browser.screenshot(screenshots / "steer.png")
    record = record[:600]
    points = np.reshape([row["points"] for row in record], (600, -1, 3))[:, : trained.skeleton.num_joints]
    ends = [(row["target"], points[k, 0, [0, 2]]) for k, row in enumerate(record) if row["target"]]
    error = float(np.mean([np.linalg.norm(np.subtract(target, root)) for target, root in ends]))
    kick = float(seam_kick(points, 8))
    corners = points[[0, 149, 299, 449, 599], 0][:, [0, 2]]
    legs = np.diff(corners, axis=0)
    with capsys.disabled():
        print(
            f"\nsquare: path error {100 * error:.1f} cm, seam kick {kick:.2f}, {state['rate']:.0f} pictures a second, "
            f"{state['ms']:.0f} ms a round in 1 step, waited {state['waits']} times"
        )
    assert state["hop"] in (8, 16, 24, 32) and len(ends) > 15
    assert error < 0.15
    if state["hop"] == 8:
        assert kick < 2.0
    assert np.abs(np.diff(points, axis=0)).max() < 0.3  # metres a frame: nobody is beamed
    # Up the picture is +Z, right of it -X: each side goes where its key said.
    for leg, wanted in zip(legs, ((0, 1), (-1, 0), (0, -1), (1, 0)), strict=True):
        assert leg @ wanted > 0.75 * np.linalg.norm(leg) and 3.0 < np.linalg.norm(leg) < 8.0
    assert np.linalg.norm(corners[-1] - corners[0]) < 4.0
    assert browser.errors() == [] and browser.requests() == []
    browser.script("steer.forget()")  # without a key it stops
    browser.wait("return steer.record().length > 90", 60)
    last = np.reshape([row["points"][:3] for row in browser.script("return steer.record()")[-10:]], (10, 3))
    assert FPS * np.linalg.norm(np.diff(last[:, [0, 2]], axis=0), axis=-1).mean() < 0.3


def test_feet_stand_while_the_tick_is_there(browser, page, trained, screenshots, capsys):
    """The lower toe of one who walks straight on, with the tick and without."""
    opened(browser, page)
    choose(browser, "steps", 1)
    assert browser.script("return document.getElementById('feet').checked")
    key(browser, "keydown", "ArrowUp")
    slides = []
    for held in (True, False):
        browser.wait("return steer.state().rounds > 3 && steer.state().timed >= 3", 60)
        browser.script("steer.forget()")
        browser.wait("return steer.record().length >= 120", 90)
        points = np.reshape([row["points"] for row in browser.script("return steer.record()")[:120]], (120, -1, 3))
        slides.append(float(slide_speed(points[:, : trained.skeleton.num_joints], trained.skeleton)))
        if held:
            browser.screenshot(screenshots / "steer_feet.png")
            browser.find("#feet").click()
            browser.wait(f"return steer.state().newest >= {browser.script('return steer.state().newest') + 60}", 60)
    with capsys.disabled():
        print(f"\nthe lower toe slides at {slides[0]:.1f} cm/s held, {slides[1]:.1f} cm/s as the network moves it")
    assert slides[0] < 0.5 * slides[1]
    assert browser.errors() == [] and browser.requests() == []


def test_the_style_slider_and_the_finger_are_heard(browser, page, screenshots):
    browser.resize(*PHONE, phone=True)
    opened(browser, page)
    choose(browser, "steps", 1)
    browser.script("const b = document.getElementById('blend'); b.value = 100; b.dispatchEvent(new Event('input'))")
    browser.script("document.getElementById('made').click()")
    browser.touch("touchStart", (200, 200))
    browser.touch("touchMove", (200, 120))
    browser.wait("return steer.state().rounds > 6", 60)
    browser.script("steer.forget()")
    browser.wait("return steer.record().length > 8", 60)
    browser.screenshot(screenshots / "steer_phone.png")
    wish = browser.script("return steer.record().at(-1).wish")
    paces = browser.script("return JSON.parse(document.getElementById('steer-data').textContent).paces")
    second = browser.script("return document.getElementById('second').selectedIndex")
    assert abs(wish["speed"] - paces[second]) < 1e-3 and abs(wish["direction"]) < 1e-6
    browser.touch("touchEnd")
    wide = browser.script("return document.documentElement.scrollWidth - innerWidth")
    panel = browser.find("#panel").rect
    assert wide <= 0 and panel["x"] >= 0 and panel["x"] + panel["width"] <= PHONE[0]
    assert panel["y"] >= 0.75 * PHONE[1]  # the picture has three quarters
    assert browser.errors() == []


def test_mouse_and_gamepad_are_heard(browser, page):
    """The picture's right is -X: the camera stands behind one who faces +Z. A wish is looked at a round later.

    The mouse points far away: nobody may arrive before the wish is looked at, however slow the machine is.
    """
    opened(browser, page)
    choose(browser, "steps", 1)

    def wish(row="at(-1)"):
        rounds = browser.script("return steer.state().rounds")
        browser.wait(f"return steer.state().rounds > {rounds + 1}", 60)
        return browser.script(f"return steer.record().{row}.wish")

    def mouse(kind, x):
        browser.command("Input.dispatchMouseEvent", type=kind, x=x, y=200, button="left", clickCount=1)

    mouse("mousePressed", 1240)
    wish()  # heard: from now on nobody walks by itself
    mouse("mouseReleased", 1240)
    assert wish()["speed"] == 0
    for x, side in ((1240, -1), (420, 1)):
        browser.script("steer.forget()")
        mouse("mousePressed", x)
        # The first that is heard: the camera turns with the walker, and so does what a held mouse points at.
        wanted = wish("find((row) => row.wish.speed > 0.3)")
        mouse("mouseReleased", x)
        assert wanted["speed"] > 0.3 and side * wanted["direction"] > 0.2
        assert wish()["speed"] == 0
    browser.script("navigator.getGamepads = () => [{connected: true, axes: [1, 0, 0, 0], buttons: []}]")
    wanted = wish()
    assert wanted["speed"] > 0.3 and abs(wanted["direction"] + np.pi / 2) < 1e-3
    browser.script("navigator.getGamepads = () => []")
    assert wish()["speed"] == 0
    assert browser.errors() == []
