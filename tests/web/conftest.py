"""A browser for tests of pages: headless Chromium, driven over its own protocol by selenium.

Tests that take `browser` are skipped, with the reason, where selenium or Chromium is missing;
`make test-web` installs both. F3AMD_SCREENSHOTS names a folder that keeps the pictures.
"""

from __future__ import annotations

import io
import json
import os
import shutil
import time
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

HERE = Path(__file__).parent
SCREENSHOTS_VARIABLE = "F3AMD_SCREENSHOTS"
DESKTOP = (1280, 800)
PHONE = (390, 844)

_BROWSERS = ("chromium", "chromium-browser", "google-chrome", "chrome")
_BROWSER_OPTIONS = (
    "--headless=new",
    "--no-sandbox",  # a container's root may not have one; the pages are our own
    "--disable-dev-shm-usage",
    "--disable-background-networking",
    "--disable-component-update",
    # A sandboxed iframe in a process of its own would make requests that our log never sees.
    "--disable-features=IsolateSandboxedIframes",
    "--no-first-run",
    "--hide-scrollbars",
)


class Browser:
    """A tab: open a page, look at it, and hear what it asked for and complained about."""

    def __init__(self, driver):
        self.driver = driver
        self._asked: list[str] = []
        self._errors: list[str] = []
        self._page = ""

    def reset(self) -> None:
        """Go back to an empty desktop tab: light, motion allowed."""
        self.driver.switch_to.default_content()
        self.driver.get("about:blank")
        self._media = {"prefers-color-scheme": "light", "prefers-reduced-motion": "no-preference"}
        self._emulate()
        self.resize(*DESKTOP)
        self._listen()
        self._asked, self._errors, self._page = [], [], ""

    def command(self, name: str, **arguments):
        """Send a command of the browser's own protocol."""
        return self.driver.execute_cdp_cmd(name, arguments)

    def resize(self, width: int, height: int, *, phone: bool = False) -> None:
        """Set the size of the page in CSS pixels; a phone has two dots a pixel and a finger."""
        size = {"width": width, "height": height, "deviceScaleFactor": 2 if phone else 1}
        self.command("Emulation.setDeviceMetricsOverride", **size, mobile=phone)
        self.command("Emulation.setTouchEmulationEnabled", enabled=phone, maxTouchPoints=5)

    def dark(self, wanted: bool = True) -> None:
        """Say that the reader's system is dark."""
        self._media["prefers-color-scheme"] = "dark" if wanted else "light"
        self._emulate()

    def reduced_motion(self, wanted: bool = True) -> None:
        """Say that the reader asked for reduced motion."""
        self._media["prefers-reduced-motion"] = "reduce" if wanted else "no-preference"
        self._emulate()

    def _emulate(self) -> None:
        features = [{"name": name, "value": value} for name, value in self._media.items()]
        self.command("Emulation.setEmulatedMedia", features=features)

    def open(self, page) -> Browser:
        """Open a file or an address, and forget what an earlier page asked for."""
        self._listen()
        self._asked, self._errors = [], []
        address = page.resolve().as_uri() if isinstance(page, Path) else str(page)
        self._page = address.partition("#")[0]  # as it is asked for
        self.driver.get(address)
        # A busy machine's driver may answer for the empty page before.
        self.wait("return document.readyState === 'complete' && location.href !== 'about:blank'")
        return self

    def _listen(self) -> None:
        """Take over what the browser has logged since the last time; it tells it only once."""
        for entry in self.driver.get_log("performance"):
            message = json.loads(entry["message"])["message"]
            if message["method"] == "Network.requestWillBeSent":
                self._asked.append(message["params"]["request"]["url"])
        for entry in self.driver.get_log("browser"):
            if entry["level"] == "SEVERE":
                self._errors.append(entry["message"])

    def errors(self) -> list[str]:
        """Errors on the console since `open`, uncaught exceptions and missing files included."""
        self._listen()
        return list(self._errors)

    def requests(self) -> list[str]:
        """Addresses asked for since `open`, but for the page itself and what it carries in it."""
        self._listen()
        inside = ("data:", "blob:", "about:")
        return [url for url in self._asked if url != self._page and not url.startswith(inside)]

    def outside(self) -> list[str]:
        """Addresses asked for that are no files of this machine."""
        return [url for url in self.requests() if not url.startswith("file:")]

    def script(self, text: str, *arguments):
        """Run JavaScript; `return` hands a value back."""
        return self.driver.execute_script(text, *arguments)

    def fetched(self, address: str) -> str:
        """Let the page ask for an address: "sent", or the name of the error."""
        return self.driver.execute_async_script(
            "const done = arguments[1]; fetch(arguments[0]).then(() => done('sent'), (error) => done(error.name))",
            address,
        )

    def wait(self, text: str, seconds: float = 20.0) -> None:
        """Wait until a script answers with something true."""
        until = time.monotonic() + seconds
        while not self.script(text):
            if time.monotonic() > until:
                pytest.fail(f"after {seconds:g} s still not: {text}; console: {self.errors()}")
            time.sleep(0.03)

    def find(self, selector: str):
        """Return the element of a CSS selector."""
        return self.driver.find_element("css selector", selector)

    def keys(self, *names: str) -> None:
        """Press keys, by their JavaScript name such as "ArrowRight", wherever the focus is."""
        from selenium.webdriver.common.action_chains import ActionChains
        from selenium.webdriver.common.keys import Keys

        named = lambda name: getattr(Keys, name.replace("Arrow", "ARROW_").upper(), name)
        ActionChains(self.driver).send_keys(*map(named, names)).perform()

    def touch(self, kind: str, *points: tuple[float, float]) -> None:
        """Send "touchStart", "touchMove" or "touchEnd" with fingers at these places."""
        fingers = [{"x": x, "y": y, "id": k} for k, (x, y) in enumerate(points)]
        self.command("Input.dispatchTouchEvent", type=kind, touchPoints=fingers)

    def screenshot(self, path=None) -> np.ndarray:
        """Return the page as seen, [H, W, 3] of uint8, and write it where a path is given."""
        image = Image.open(io.BytesIO(self.driver.get_screenshot_as_png())).convert("RGB")
        if path is not None:
            Path(path).parent.mkdir(parents=True, exist_ok=True)
            image.save(path)
        return np.asarray(image)


def _start(*options_besides: str):
    """Start a browser; the test is skipped, with the reason, where selenium, Chromium or its driver is missing."""
    webdriver = pytest.importorskip("selenium.webdriver", reason="selenium: see `make test-web`")
    binary = next(filter(None, map(shutil.which, _BROWSERS)), None)
    helper = shutil.which("chromedriver")
    if binary is None or helper is None:
        missing = "Chromium" if binary is None else "chromedriver"
        pytest.skip(f"no {missing} on this machine (Debian: apt install chromium chromium-driver)")
    options = webdriver.ChromeOptions()
    options.binary_location = binary
    for option in (*_BROWSER_OPTIONS, *options_besides):
        options.add_argument(option)
    options.set_capability("goog:loggingPrefs", {"browser": "ALL", "performance": "ALL"})
    return webdriver.Chrome(options=options, service=webdriver.ChromeService(helper))


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(config, items):
    """With `--dist loadgroup`, tests of a file keep their process and its pages; those of the built site need none."""
    for item in items if config.pluginmanager.hasplugin("xdist") else ():
        if item.path.parent == HERE and item.path.stem != "test_site_pages":
            item.add_marker(pytest.mark.xdist_group(item.path.stem))


@pytest.fixture(scope="session")
def _driver():
    driver = _start()
    yield driver
    driver.quit()


@pytest.fixture
def browser(_driver) -> Browser:
    """An empty tab, 1280 x 800."""
    tab = Browser(_driver)
    tab.reset()
    return tab


@pytest.fixture
def webgpu_browser(tmp_path) -> Browser:
    """An empty tab of a browser that computes WebGPU in software; skipped where it has no such adapter."""
    driver = _start(
        "--enable-unsafe-webgpu", "--use-webgpu-adapter=swiftshader", "--enable-features=Vulkan"
    )  # fmt: skip
    tab = Browser(driver)
    tab.reset()
    (tmp_path / "empty.html").write_text("<title>empty</title>", encoding="utf-8")
    tab.open(tmp_path / "empty.html")
    found = driver.execute_async_script(
        "const done = arguments[0], tell = (adapter) => done(!!adapter);"
        "Promise.resolve(navigator.gpu?.requestAdapter()).then(tell, () => tell(null))"
    )
    if found:
        yield tab
    driver.quit()
    if not found:
        pytest.skip("this Chromium has no WebGPU adapter, in software neither")


@pytest.fixture
def screenshots(tmp_path) -> Path:
    """Where pictures of pages go: F3AMD_SCREENSHOTS, or a folder that is forgotten."""
    return Path(os.environ.get(SCREENSHOTS_VARIABLE) or tmp_path)
