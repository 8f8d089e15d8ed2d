"""A headless Chromium for tests: started, driven, and asked what it shows."""

import json
import os
import select
import shlex
import shutil
import subprocess
import time
from urllib.parse import parse_qsl

import pytest


def browser_command(profile) -> list[str]:
    """A headless browser that keeps to itself, or the test is skipped."""
    names = ("chromium", "chromium-browser", "google-chrome")
    browser = next(filter(None, map(shutil.which, names)), None)
    if browser is None:
        pytest.skip(f"none of {', '.join(names)} is installed")
    quiet = "--disable-quic --no-first-run --disable-background-networking --disable-component-update --disable-sync"
    options = ["--headless", "--no-sandbox", "--disable-gpu", *quiet.split(), "--hide-scrollbars"]
    return [browser, *options, f"--user-data-dir={profile}", "--window-size=1200,900"]


class Session:
    """A page in a browser that stays open, driven over Chromium's own pipe: commands go in, answers and events out."""

    def __init__(self, profile, url):
        command = shlex.join([*browser_command(profile), "--remote-debugging-pipe"])
        into, out = profile.with_suffix(".in"), profile.with_suffix(".out")
        os.mkfifo(into)
        os.mkfifo(out)
        command = f"exec {command} 3<{shlex.quote(str(into))} 4>{shlex.quote(str(out))}"  # it reads 3 and writes 4
        self.process = subprocess.Popen(["sh", "-c", command], stderr=subprocess.DEVNULL)
        self.into, self.out = os.open(into, os.O_WRONLY), os.open(out, os.O_RDONLY)
        self.count, self.target, self.buffer, self.complaints = 0, {}, b"", []
        page = self.call("Target.createTarget", url="about:blank")["targetId"]
        self.target = {"sessionId": self.call("Target.attachToTarget", targetId=page, flatten=True)["sessionId"]}
        for domain in ("Runtime", "Log", "Page"):
            self.call(domain + ".enable")
        self.call("Page.navigate", url=url)
        self.settle()

    def call(self, method, **params):
        self.count += 1
        message = {"id": self.count, "method": method, "params": params} | self.target
        os.write(self.into, json.dumps(message).encode() + b"\0")
        while True:
            while b"\0" not in self.buffer:
                assert select.select([self.out], [], [], 20)[0], f"no answer to {method}"
                part = os.read(self.out, 1 << 16)
                assert part, f"the browser left at {method}"
                self.buffer += part
            text, self.buffer = self.buffer.split(b"\0", 1)
            answer = json.loads(text)
            if answer.get("method") in ("Runtime.exceptionThrown", "Runtime.consoleAPICalled", "Log.entryAdded"):
                self.complaints.append(answer["params"])
            if answer.get("id") == self.count:
                assert "error" not in answer, answer
                return answer["result"]

    def ask(self, expression):
        return self.call("Runtime.evaluate", expression=expression, returnByValue=True)["result"].get("value")

    def settle(self):
        """Waits until the page shows what it was asked to show, and has written it into its address."""
        end = time.monotonic() + 20
        while self.ask("document.documentElement.dataset.ready") != "true":
            assert time.monotonic() < end, "the page never became ready"
            time.sleep(0.02)
        time.sleep(0.4)

    def view(self):
        self.settle()
        return dict(parse_qsl(self.ask("location.hash.slice(1)"), keep_blank_values=True))

    def mouse(self, kind, x, y):
        self.call("Input.dispatchMouseEvent", type=kind, x=x, y=y, button="left", buttons=1, clickCount=1)

    def hover(self, x, y):
        self.call("Input.dispatchMouseEvent", type="mouseMoved", x=x, y=y)

    def resize(self, width, height):
        """The size of the window, in pixels; returns when the page has taken it up."""
        self.call("Emulation.setDeviceMetricsOverride", width=width, height=height, deviceScaleFactor=1, mobile=False)
        self.ask("new Promise(done => requestAnimationFrame(() => requestAnimationFrame(done)))")
        self.settle()

    def key(self, key):
        for kind in ("keyDown", "keyUp"):
            self.call("Input.dispatchKeyEvent", type=kind, key=key)

    def close(self):
        os.close(self.into)  # a browser whose pipe is closed leaves
        try:
            self.process.wait(20)
        except subprocess.TimeoutExpired:
            self.process.kill()
        os.close(self.out)
