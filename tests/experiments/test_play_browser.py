"""The page as visitors have it: in Chromium, with the model and the robot that ship.

The tests share a server and go on from each other, on software's OpenGL: minutes.
They are skipped without playwright or Chromium, which CHROMIUM may name, and so in CI.
PICTURES names a folder for the picture that they make.
"""

import contextlib
import io
import os
import queue
import re
import shutil
import threading
import time
from pathlib import Path

import numpy as np
import pytest

sync_api = pytest.importorskip("playwright.sync_api", reason="playwright is missing")
viser = pytest.importorskip("viser", reason="the extra jaxpets[play] is not installed")

import msgspec  # noqa: E402
from PIL import Image  # noqa: E402
from websockets.exceptions import ConnectionClosed  # noqa: E402
from websockets.sync.client import connect  # noqa: E402

from experiments.play import serve  # noqa: E402

CHROMIUM = os.environ.get("CHROMIUM") or shutil.which("chromium")
pytestmark = pytest.mark.skipif(not CHROMIUM, reason="there is no Chromium here")
PATIENCE = 240.0  # s, on a machine that does much else
FLAGS = (
    "--headless", "--no-sandbox", "--disable-gpu", "--use-gl=angle",
    "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--no-first-run",
    "--disable-background-networking", "--disable-component-update", "--disable-sync",
)  # fmt: skip
COARSE = "?fixedDpr=0.25"  # few pixels, as they are all drawn by the processor


@pytest.fixture(scope="module")
def address():
    """Where a page is served, until the tests are over."""
    told, is_over = queue.Queue(), threading.Event()
    options = serve.Options("pretrained/best", port=0, host="127.0.0.1")
    thread = threading.Thread(
        target=serve.serve, args=(options, is_over, told.put), kwargs={"rate": 5.0}
    )
    thread.start()
    yield told.get(timeout=PATIENCE)
    is_over.set()
    thread.join(PATIENCE)
    assert not thread.is_alive()


@pytest.fixture(scope="module")
def browser():
    with sync_api.sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=FLAGS)
        yield browser
        browser.close()


class Visitor:
    """Somebody who looks at the page."""

    def __init__(self, browser, address, width=460, height=900, query=COARSE):
        self.page = browser.new_page(viewport={"width": width, "height": height})
        self.page.set_default_timeout(1000 * PATIENCE)
        self.errors, self.sent = [], []
        self.page.on("pageerror", lambda error: self.errors.append(str(error)))
        self.page.on("console", self._hears)
        self.page.on("websocket", self._listens)
        self.page.goto(address + query)

    def _listens(self, websocket):
        def sends(message):  # playwright marks it, as it cannot mark a list's method
            self.sent.append(message)

        websocket.on("framesent", sends)

    def _hears(self, message):
        if message.type == "error":
            self.errors.append(message.text)

    @property
    def text(self):
        return self.page.inner_text("body").replace("\xa0", " ")

    @property
    def line(self):
        kinds = "self::input or self::textarea"
        path = f"//*[normalize-space(text())='reward']/following::*[{kinds}][1]"
        return self.page.locator(f"xpath={path}")

    def press(self, name):
        self.page.get_by_role("button", name=name, exact=True).click()

    def number(self, name):
        """Returns a number that the page says, NaN while it says none."""
        found = re.search(rf"{name}\s+(-?\d+\.\d+)", self.text)
        return float(found[1]) if found else float("nan")

    def sees(self, text):
        self.page.get_by_text(text).first.wait_for()


def wait(is_so):
    """Waits until something is so."""
    deadline = time.monotonic() + PATIENCE
    while not is_so():
        assert time.monotonic() < deadline
        time.sleep(0.2)


@pytest.fixture(scope="module")
def visitor(browser, address):
    visitor = Visitor(browser, address)
    visitor.sees("It performs forward.")
    yield visitor
    assert not visitor.errors


def test_the_robot_moves(visitor):
    wait(lambda: visitor.number("velocity") > 0.5)
    assert visitor.line.input_value() == "velocity - 0.1 * effort"
    assert "steps a second" in visitor.text
    wait(lambda: visitor.number("earned") > 0)
    assert np.isfinite(visitor.number("promised"))
    assert visitor.number("disagreement") > 0


def test_a_button_changes_the_sign_of_the_return(visitor):
    visitor.press("backward")
    visitor.sees("It performs backward.")
    assert visitor.line.input_value() == "-velocity - 0.1 * effort"
    wait(lambda: visitor.number("velocity") < -0.5)
    wait(lambda: visitor.number("earned") > 0)  # for what was a loss before


def test_a_typed_reward_takes_effect(visitor):
    visitor.line.fill("-(velocity - 1)**2 - 0.01 * effort")
    visitor.sees("It does what the line says.")
    wait(lambda: visitor.number("velocity") > 0.3)


def test_a_wrong_reward_is_explained_while_typing(visitor):
    visitor.press("pause")  # its plans take most of the time of these tests
    visitor.line.press("End")
    visitor.line.press_sequentially(" + heigt")
    visitor.sees("There is no 'heigt', but height")
    visitor.line.press("Backspace")
    visitor.line.press_sequentially("ht")
    visitor.sees("It does what the line says.")


def test_two_visitors_see_one_robot(visitor, browser, address):
    other = Visitor(browser, address)
    other.sees("It does what the line says.")
    assert other.line.input_value() == visitor.line.input_value()
    other.press("go on")
    visitor.sees("steps a second")
    other.press("pause")
    visitor.sees("paused")
    assert other.number("velocity") == visitor.number("velocity")
    other.page.close()
    visitor.press("one step")
    assert "paused" in visitor.text
    assert not other.errors


def test_a_moment_that_is_gone_back_to(visitor):
    now = visitor.number("velocity")
    slider = visitor.page.get_by_role("slider").nth(4)
    assert slider.get_attribute("aria-valuenow") == "0"
    for _ in range(20):  # of 0.05 s
        slider.press("ArrowLeft")
    visitor.sees("1.0 s ago")
    wait(lambda: visitor.number("velocity") != now)
    visitor.press("go on from here")
    visitor.sees("steps a second")
    visitor.press("pause")


def test_what_was_seen_replays_without_a_server(visitor, browser, tmp_path):
    with visitor.page.expect_download() as download:
        visitor.press("3D (html)")
    path = tmp_path / "seen.html"
    download.value.save_as(path)
    requests = []
    page = browser.new_page(viewport={"width": 300, "height": 200})
    page.on("request", lambda request: requests.append(request.url))
    errors = []
    page.on("pageerror", lambda error: errors.append(str(error)))
    page.goto(f"{path.as_uri()}{COARSE}")
    page.locator("canvas").first.wait_for(timeout=1000 * PATIENCE)
    wait(lambda: colors(page) > 99)
    page.close()
    away = [url for url in requests if not url.startswith(("file:", "data:", "blob:"))]
    assert not away and not errors


def seen(page):
    return Image.open(io.BytesIO(page.screenshot())).convert("RGB")


def colors(page):
    """Returns how many colors there are in the left half of what is seen."""
    picture = np.asarray(seen(page))
    return len(np.unique(picture[:, : picture.shape[1] // 2].reshape(-1, 3), axis=0))


def talk(address, messages):
    """Sends messages as a page would, and leaves, or is shown out."""
    protocol = f"viser-v{viser.__version__}"
    url = address.replace("http", "ws")
    with (
        contextlib.suppress(ConnectionClosed),
        connect(url, subprotocols=[protocol]) as socket,
    ):
        for message in messages:
            socket.send(message)


def test_garbage_and_a_storm_do_not_stop_it(visitor, address):
    slider = visitor.page.get_by_role("slider").nth(0)
    slider.press("ArrowRight")
    wait(lambda: visitor.line.input_value().startswith("-abs(velocity"))
    updates = [msgspec.msgpack.decode(x) for x in visitor.sent if isinstance(x, bytes)]
    moved = [x for x in updates if x["type"] == "GuiUpdateMessage"][-1]

    def with_value(value, name="value"):
        return msgspec.msgpack.encode(moved | {"updates": {name: value}})

    bad = [None, "x", [1], {"a": 1}, float("nan"), float("inf"), 1e300, 2**63, b"\xff"]
    garbage = [with_value(x) for x in bad]
    garbage += [
        with_value(1, name) for name in ("disabled", "no_such", "removed", "update_cb")
    ]
    draw = np.random.default_rng(0)
    garbage += [draw.bytes(n) for n in (1, 10, 1000, 100_000)]
    garbage += ["text", msgspec.msgpack.encode({"type": "NoSuchMessage"})]
    for message in garbage:  # each in its own visit, as it may end it
        talk(address, [message])
    storm = [with_value(x) for x in np.linspace(-6, 6, 2000).round(1).tolist()]
    talk(address, [*storm, with_value(2.0)])
    visitor.press("forward")
    visitor.sees("It performs forward.")
    visitor.press("go on")
    before = visitor.number("velocity")
    wait(lambda: visitor.number("velocity") != before)


def test_the_picture(visitor, browser, address, tmp_path):
    wait(lambda: visitor.number("velocity") > 1.0)
    visitor.press("pause")  # or all time goes into pixels
    other = Visitor(browser, address, width=1040, height=585, query="?fixedDpr=1")
    other.sees("It performs forward.")
    hidden = "[class*=mantine-Notifications] {display: none}"
    other.page.add_style_tag(content=hidden)  # of a browser without a GPU
    wait(lambda: colors(other.page) > 999)
    folder = Path(os.environ.get("PICTURES", tmp_path))
    seen(other.page).quantize(256).save(folder / "play.png", optimize=True)
    assert not other.errors


def test_without_the_token_nobody_sees_it(browser, address):
    page = browser.new_page()
    root = address[: address.rstrip("/").rindex("/") + 1]
    assert root != address
    assert page.goto(root).status == 403
    assert "token" in page.inner_text("body")
