"""A headless Chromium, driven by the DevTools protocol over a pipe."""

import base64
import io
import json
import os
import select
import shutil
import subprocess
import time

from matplotlib.image import imread
import pytest

TIMEOUT = 120.0
"""s, for one command to be answered.  Without a GPU a picture takes about 0.2 s."""

WIDTH, HEIGHT = 1280, 720

FLAGS = (
    "--headless",
    "--no-sandbox",  # Root cannot have one.
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-dev-shm-usage",  # Containers have little of it.
    "--disable-quic",
    "--disable-sync",
    # WebGL on the processor.
    "--disable-gpu",
    "--use-gl=angle",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    # There is no network: no name is found but that of this machine.
    "--host-resolver-rules=MAP * ~NOTFOUND , EXCLUDE localhost",
    "--remote-debugging-pipe",
    "about:blank",
)

# What pages say that is no fault of theirs: of reading WebGL back without a GPU.
HARMLESS = "GPU stall due to ReadPixels"


class Browser:
    """A running Chromium, which hears commands on its descriptor 3 and answers on 4."""

    def __init__(self, executable, profile):
        command_read, self._command = os.pipe()
        self._answer, answer_write = os.pipe()
        # The shell puts the pipes' ends where Chromium looks for them.
        script = f'exec "$0" "$@" 3<&{command_read} 4>&{answer_write}'
        self._process = subprocess.Popen(
            ["/bin/bash", "-c", script, executable, f"--user-data-dir={profile}", *FLAGS],
            pass_fds=(command_read, answer_write),
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        os.close(command_read)
        os.close(answer_write)
        self._buffer = b""
        self._number = 0
        self.events = []

    def send(self, method, session=None, **params):
        """Gives a command and returns its result; events that come before it are kept."""
        self._number += 1
        message = {"id": self._number, "method": method, "params": params}
        if session is not None:
            message["sessionId"] = session
        os.write(self._command, json.dumps(message).encode() + b"\0")
        deadline = time.monotonic() + TIMEOUT
        while True:
            answer = self._receive(deadline)
            if answer.get("id") == self._number:
                assert "error" not in answer, f"{method}: {answer['error']}"
                return answer["result"]
            self.events.append(answer)

    def close(self):
        try:
            self.send("Browser.close")
            self._process.wait(TIMEOUT)
        finally:
            self._process.kill()
            self._process.wait()
            os.close(self._command)
            os.close(self._answer)

    def _receive(self, deadline):
        while b"\0" not in self._buffer:
            left = max(deadline - time.monotonic(), 0.0)
            ready, _, _ = select.select([self._answer], [], [], left)
            assert ready, f"Chromium did not answer within {TIMEOUT} s"
            part = os.read(self._answer, 1 << 20)
            assert part, "Chromium has ended, or could not start"
            self._buffer += part
        message, _, self._buffer = self._buffer.partition(b"\0")
        return json.loads(message)


class Page:
    """A tab of the browser that shows one address."""

    def __init__(self, browser, url):
        self._browser = browser
        self._target = browser.send("Target.createTarget", url="about:blank")["targetId"]
        self._session = browser.send(
            "Target.attachToTarget", targetId=self._target, flatten=True
        )["sessionId"]
        for domain in ("Page", "Network", "Runtime", "Log"):
            self._send(f"{domain}.enable")
        self.resize(WIDTH, HEIGHT)
        answer = self._send("Page.navigate", url=url)
        assert "errorText" not in answer, f"{url}: {answer['errorText']}"
        self.wait_until("document.readyState === 'complete'")

    def bring_to_front(self):
        """Has the page before the others: one that lies behind may not be drawn, and wait."""
        self._send("Page.bringToFront")

    def resize(self, width, height, mobile=False):
        """Makes the window this large, in pixels; as a phone shows it, or a desktop."""
        self._send(
            "Emulation.setDeviceMetricsOverride",
            width=width,
            height=height,
            deviceScaleFactor=1,
            mobile=mobile,
        )

    def emulate(self, medium="screen", scheme="light"):
        """Shows the page on a medium, `screen` or `print`, in a colour scheme."""
        features = [{"name": "prefers-color-scheme", "value": scheme}]
        self._send("Emulation.setEmulatedMedia", media=medium, features=features)

    def evaluate(self, expression):
        """Returns the value of an expression in JavaScript, or of what it promises."""
        answer = self._send(
            "Runtime.evaluate", expression=expression, awaitPromise=True, returnByValue=True
        )
        assert "exceptionDetails" not in answer, answer["result"]["description"]
        return answer["result"].get("value")

    def wait_until(self, condition):
        """Waits until an expression is true, which is looked up with every new picture."""
        self.evaluate(
            "new Promise(done => { const look = () => "
            f"({condition}) ? done() : requestAnimationFrame(look); look(); }})"
        )

    def drag(self, begin, end):
        """Presses the mouse at a place (x, y) in pixels, and lets it go at another."""
        for kind, (x, y) in (
            ("mousePressed", begin),
            ("mouseMoved", end),
            ("mouseReleased", end),
        ):
            self._send(
                "Input.dispatchMouseEvent", type=kind, x=x, y=y, button="left", clickCount=1
            )

    def screenshot(self):
        """Returns the next picture as (height, width, 3) in [0, 1], and as a PNG file."""
        self.evaluate("new Promise(done => requestAnimationFrame(() => setTimeout(done)))")
        png = base64.b64decode(self._send("Page.captureScreenshot", format="png")["data"])
        return imread(io.BytesIO(png), format="png")[..., :3], png

    def requests(self):
        """Returns the addresses that were asked for, web sockets too."""
        return [
            event["request"]["url"] for event in self._events("Network.requestWillBeSent")
        ] + [event["url"] for event in self._events("Network.webSocketCreated")]

    def complaints(self):
        """Returns what the page said on its console, and the exceptions that it met."""
        said = [
            " ".join(str(part.get("value", part.get("description"))) for part in event["args"])
            for event in self._events("Runtime.consoleAPICalled")
        ]
        logged = [event["entry"]["text"] for event in self._events("Log.entryAdded")]
        thrown = [str(event) for event in self._events("Runtime.exceptionThrown")]
        return [text for text in said + logged + thrown if HARMLESS not in text]

    def close(self):
        self._browser.send("Target.closeTarget", targetId=self._target)

    def _send(self, method, **params):
        return self._browser.send(method, self._session, **params)

    def _events(self, method):
        return [
            event["params"]
            for event in self._browser.events
            if event["method"] == method and event.get("sessionId") == self._session
        ]


@pytest.fixture(scope="package")
def browser(tmp_path_factory):
    executable = shutil.which("chromium")
    if executable is None:
        pytest.fail("these tests need Chromium: apt-get install chromium")
    browser = Browser(executable, tmp_path_factory.mktemp("profile"))
    yield browser
    browser.close()


@pytest.fixture(scope="package")
def open_page(browser):
    """Opens an address in a tab of its own: (url) -> Page."""
    pages = []

    def open_page(url):
        pages.append(Page(browser, url))
        return pages[-1]

    yield open_page
    for page in pages:
        page.close()
