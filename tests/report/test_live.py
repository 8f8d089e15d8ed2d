"""The page of a render that goes on: what its server answers to whom, and what a browser makes of it."""

import http.client
import json
import socket
import threading
from contextlib import suppress

import numpy as np
import pytest
from processes import wait_for

from ngpt.report import live
from ngpt.report.live import LivePage
from ngpt.report.preview import Preview, preview
from ngpt.stack import GradientStack
from ngpt.system.text import printable


def stack(level, seed=0):
    rng = np.random.default_rng(seed)
    image = rng.gamma(20.0, level / 20, (24, 36, 3)).astype(np.float32)
    layers = {"primal": image, "albedo": np.full_like(image, 0.5), "normal": np.full_like(image, 0.577)}
    variance = np.full_like(image, level**2 / 20)
    return GradientStack.from_arrays(**layers, primal_var=variance, samples=np.full((24, 36, 1), 16.0))


@pytest.fixture
def page():
    served = LivePage("a scene, live", "ngpt render a --live", port=0)
    yield served
    if served.thread.is_alive():
        served._asked = -1e9  # Nobody looks on any more.
        served.close("ended")


def asked(page, method, path, **headers):
    """Status, headers and text of an answer."""
    connection = http.client.HTTPConnection("127.0.0.1", page.server.server_port, timeout=10)
    try:
        connection.request(method, path, headers=headers)
        answer = connection.getresponse()
        return answer.status, answer.headers, answer.read().decode()
    finally:
        connection.close()


def test_nobody_but_this_machine_is_served_and_nothing_but_three_paths(page):
    assert page.server.server_address[0] == "127.0.0.1" and page.url.startswith("http://127.0.0.1:")
    assert not page.watched
    status, headers, text = asked(page, "GET", "/")
    assert status == 200 and "first image" in text and page.watched
    assert headers["Cache-Control"] == "no-store" and headers["X-Frame-Options"] == "DENY"
    page.tell("64 of 256 <b>")
    assert "64 of 256 &lt;b&gt;" in asked(page, "GET", "/")[2]
    assert json.loads(asked(page, "GET", "/status")[2]) == {"number": 0, "text": "64 of 256 <b>", "ended": False}
    for method, path in (("GET", "/etc/passwd"), ("GET", "/../live.py"), ("GET", "/enough"), ("POST", "/")):
        origin = {"Origin": page.url.rstrip("/")}
        assert asked(page, method, path, **origin)[0] == 404, path
    for method in ("PUT", "DELETE", "OPTIONS"):
        assert asked(page, method, "/enough")[0] == 501
    assert page.enough is False


def test_only_the_page_itself_ends_the_render(page):
    port = page.server.server_port
    for headers in (
        {},
        {"Origin": "null"},
        {"Origin": "http://evil.example"},
        {"Origin": f"https://127.0.0.1:{port}"},
        {"Origin": f"http://evil.example:{port}", "Host": f"evil.example:{port}"},  # a name that was bound anew
    ):
        assert asked(page, "POST", "/enough", **headers)[0] == 403
        assert not page.enough
    assert asked(page, "GET", "/", Host="evil.example")[0] == 403
    assert asked(page, "POST", "/enough", Origin=f"http://127.0.0.1:{port}")[0] == 204
    assert page.enough


def test_many_and_slow_connections_take_little_and_keep_nobody_out(page):
    """200 clients that send a bit of a request and then nothing more, as long as they like."""
    address, before = page.server.server_address, threading.active_count()
    slow = [socket.create_connection(address, 5) for _ in range(200)]
    try:
        for connection in slow:
            with suppress(OSError):  # some are hung up on by now
                connection.sendall(b"GET / HTTP/1.1\r\nX-A: b\r\n")
        assert asked(page, "GET", "/")[0] == 200
        assert threading.active_count() <= before + live.MOST and len(page.server._open) <= live.MOST
    finally:
        for connection in slow:
            connection.close()


def test_a_browser_sees_newer_images_and_ends_the_render(page, browser):
    first = stack(0.25)
    del first.layers["samples"]
    page.show(preview(first), "the first")
    session = browser(page.url)
    names = session.ask("page.scenes[0].pictures")
    assert names[0] == "noisy" and len(names) == 2
    value = "+document.querySelectorAll('#value-a td')[1].textContent"
    assert session.ask(value) == pytest.approx(0.25, rel=1)
    maps = "[...$('maps').children].filter(b => !b.disabled).map(b => b.value).join()"
    assert session.ask(maps) == "stops,std. error"
    session.ask("document.querySelector('#maps button[value=\"std. error\"]').click()")
    session.settle()
    assert "relative to the light" in session.ask("$('meaning').textContent")
    session.ask("change({map: '', exposure: 1, split: 30})")
    session.settle()
    page.tell("32 of 64")
    page.show(preview(stack(8.0, 1)), "the second")
    assert session.wait_for("page.live === 2")
    session.settle()
    assert session.ask("document.querySelector('.caption').textContent") == "the second"
    assert session.ask(maps) == "stops,std. error,samples"
    assert session.ask(value) == pytest.approx(8, rel=1) and session.ask("told.textContent") == "32 of 64"
    # What was chosen stays.
    assert session.view().items() >= {"exposure": "1", "split": "30", "a": "noisy", "map": ""}.items()
    session.resize(420, 860)
    assert session.ask("document.documentElement.scrollWidth") == 420
    session.ask("enough.click()")
    assert wait_for(lambda: page.enough, 20)
    page.close("ended: it is written")
    assert session.ask("told.textContent") == "ended: it is written" and session.ask("enough.hidden") is True


def test_a_browser_says_when_the_render_was_killed(page, browser):
    page.show(preview(stack(0.25)), "the first")
    session = browser(page.url)
    page.server.shutdown()
    page.server.server_close()
    assert session.wait_for("told.textContent === 'the render is gone'")
    assert session.ask("document.documentElement.dataset.error ?? null") is None
    session.complaints.clear()  # of addresses that do not answer


def test_names_turn_no_text_around_and_hide_nothing(page):
    evil = "gnp.\u202egpj\u2066 \u200f\u061c\u3164"
    image = np.ones((8, 8, 3), np.float32)
    page.title = page.command = evil
    page.show(Preview({evil: image}), evil)
    text = asked(page, "GET", "/")[2]
    assert "\\u202egpj\\u2066 \\u200f\\u061c\\u3164" in text and not set(evil[4:]) & set(text) - set("gpj ")
    page.tell(f"ended: {evil} is written")
    assert json.loads(asked(page, "GET", "/status")[2])["text"] == f"ended: {printable(evil)} is written"
