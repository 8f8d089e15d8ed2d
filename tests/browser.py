"""A headless Chromium for tests: started once, driven, and asked what its pages show."""

import json
import os
import select
import shlex
import shutil
import subprocess
import time
from urllib.parse import parse_qsl

import pytest

COMPLAINTS = ("Runtime.exceptionThrown", "Runtime.consoleAPICalled", "Log.entryAdded")


class Browser:
    """A browser that keeps to itself, driven over its own pipe: commands go in, answers and events out."""

    def __init__(self, folder):
        names = ("chromium", "chromium-browser", "google-chrome")
        program = next(filter(None, map(shutil.which, names)), None)
        if program is None:
            pytest.skip(f"none of {', '.join(names)} is installed")
        quiet = (
            "--disable-quic --no-first-run --disable-background-networking --disable-component-update --disable-sync"
        )
        options = ["--headless", "--no-sandbox", "--disable-gpu", *quiet.split(), "--hide-scrollbars"]
        options += [f"--user-data-dir={folder / 'profile'}", "--remote-debugging-pipe"]
        into, out = folder / "in", folder / "out"
        os.mkfifo(into)
        os.mkfifo(out)
        command = f"exec {shlex.join([program, *options])} 3<{shlex.quote(str(into))} 4>{shlex.quote(str(out))}"
        self.process = subprocess.Popen(["sh", "-c", command], stderr=subprocess.DEVNULL)
        self.into, self.out = os.open(into, os.O_WRONLY), os.open(out, os.O_RDONLY)
        self.count, self.buffer = 0, b""
        self.complaints = {}  # of each page, by the name of its session

    def call(self, method, session="", **params):
        self.count += 1
        message = {"id": self.count, "method": method, "params": params} | ({"sessionId": session} if session else {})
        os.write(self.into, json.dumps(message).encode() + b"\0")
        while True:
            while b"\0" not in self.buffer:
                assert select.select([self.out], [], [], 20)[0], f"no answer to {method}"
                part = os.read(self.out, 1 << 16)
                assert part, f"the browser left at {method}"
                self.buffer += part
            text, self.buffer = self.buffer.split(b"\0", 1)
            answer = json.loads(text)
            if answer.get("method") in COMPLAINTS:
                self.complaints.setdefault(answer.get("sessionId"), []).append(answer["params"])
            if answer.get("id") == self.count:
                assert "error" not in answer, answer
                return answer["result"]

    def close(self):
        os.close(self.into)  # a browser whose pipe is closed leaves
        try:
            self.process.wait(20)
        except subprocess.TimeoutExpired:
            self.process.kill()
        os.close(self.out)


class Session:
    """A page that knows of no other: 1200x900 pixels at first."""

    def __init__(self, browser, url):
        self.browser, self.session = browser, ""
        self.context = self.call("Target.createBrowserContext")["browserContextId"]
        page = self.call("Target.createTarget", url="about:blank", browserContextId=self.context)["targetId"]
        self.session = self.call("Target.attachToTarget", targetId=page, flatten=True)["sessionId"]
        self.complaints = browser.complaints.setdefault(self.session, [])
        for domain in ("Runtime", "Log", "Page"):
            self.call(domain + ".enable")
        self._size(1200, 900)
        self.call("Page.navigate", url=url)
        self.settle()

    def call(self, method, **params):
        return self.browser.call(method, self.session, **params)

    def ask(self, expression):
        return self.call("Runtime.evaluate", expression=expression, returnByValue=True)["result"].get("value")

    def wait_for(self, expression):
        """Waits until the page says so; returns what it says in the end."""
        end = time.monotonic() + 20
        while not (found := self.ask(expression)) and time.monotonic() < end:
            time.sleep(0.02)
        return found

    def settle(self):
        """Waits until the page shows what it was asked to show."""
        assert self.wait_for("document.documentElement?.dataset.ready === 'true'"), "the page never became ready"

    def view(self):
        """What the page shows, as it has written it into its address."""
        self.settle()
        assert self.wait_for("location.hash === '#' + new URLSearchParams(state)"), "the address tells of another view"
        return dict(parse_qsl(self.ask("location.hash.slice(1)"), keep_blank_values=True))

    def mouse(self, kind, x, y):
        self.call("Input.dispatchMouseEvent", type=kind, x=x, y=y, button="left", buttons=1, clickCount=1)

    def drag(self, start, end):
        for kind, place in (("mousePressed", start), ("mouseMoved", end), ("mouseReleased", end)):
            self.mouse(kind, *place)

    def _size(self, width, height):
        self.call("Emulation.setDeviceMetricsOverride", width=width, height=height, deviceScaleFactor=1, mobile=False)

    def resize(self, width, height):
        """The size of the window, in pixels; returns when the page has taken it up."""
        self._size(width, height)
        for _ in range(2):
            self.call(
                "Runtime.evaluate", expression="new Promise(done => requestAnimationFrame(done))", awaitPromise=True
            )
        self.settle()

    def key(self, key):
        for kind in ("keyDown", "keyUp"):
            self.call("Input.dispatchKeyEvent", type=kind, key=key)

    def close(self):
        self.session = ""
        self.call("Target.disposeBrowserContext", browserContextId=self.context)
