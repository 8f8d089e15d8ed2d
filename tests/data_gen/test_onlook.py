"""Who looks on while a render goes on: the render stays as it is, costs little more, and ends when it is told to."""

import http.client

import numpy as np
import pytest
from unbiased import load

from ngpt.errors import NgptError
from ngpt.io.exr import read
from ngpt.report.live import LivePage
from ngpt.report.preview import Preview
from ngpt.stack import GradientStack

pytest.importorskip("mitsuba")

from data_gen import passes
from data_gen.adaptive import Adaptive
from data_gen.cli import onlook
from data_gen.render import render_stack


@pytest.mark.parametrize("adaptive", [False, True])
def test_looking_at_a_render_changes_no_bit(renderer, monkeypatch, adaptive):
    scene, seen = load(renderer, "diffuse", (32, 24)), []
    monkeypatch.setattr(passes, "FIRST_LANES", 1 << 13)  # several passes
    options = {"seed": 3, "adaptive": Adaptive(method="wcv") if adaptive else None}
    plain = render_stack(scene, 64, sampler="gpt", unbiased=True, **options)
    looked = render_stack(scene, 64, sampler="gpt", newest=lambda stack: seen.append(stack()), unbiased=True, **options)
    assert len(seen) > 1 and seen[0].attributes["ngpt:spp"] < 64 and "primal_var" in seen[0]
    assert plain.names == looked.names
    assert all(np.array_equal(plain[name], looked[name], equal_nan=True) for name in plain.names)


class Clock:
    """Seconds that pass when it is told so."""

    def __init__(self):
        self.now = 0.0

    def perf_counter(self):
        return self.now


class Page:
    watched, enough, ended = True, False, False
    shown = 0

    def tell(self, line):
        self.line = line

    def show(self, preview, caption):
        self.shown += 1


def test_images_are_made_so_seldom_that_they_cost_two_per_cent(renderer, monkeypatch):
    clock, page = Clock(), Page()
    monkeypatch.setattr(onlook, "time", clock)
    image = np.ones((8, 8, 3), np.float32)

    def slow(stack):
        clock.now += 1.5
        return Preview({"noisy": image})

    monkeypatch.setattr(onlook, "preview", slow)
    stack = GradientStack({"primal": image}, {"ngpt:spp": 1, "ngpt:seconds": 1.0})
    looking = onlook.Onlookers(page, print, "spp")
    for done in range(1, 601):
        clock.now += 1.0
        looking.newest(lambda: stack)
        looking.progress(done, 600)
    assert looking.spent == pytest.approx(1.5 * page.shown)
    assert page.shown >= 4 and looking.spent <= 0.02 * clock.now
    assert page.line.startswith("600 of 600 samples per pixel, ")
    # Nobody looks on: nothing is made.
    page.watched, before = False, page.shown
    clock.now += 1000.0
    looking.newest(lambda: pytest.fail("made for nobody"))
    assert page.shown == before


def test_enough_ends_a_render_as_ctrl_c_does(renderer, command, monkeypatch):
    def pressed(title, command):
        page = LivePage(title, command, port=0)
        connection = http.client.HTTPConnection("127.0.0.1", page.server.server_port, timeout=10)
        connection.request("POST", "/enough", headers={"Origin": page.url.rstrip("/")})
        assert connection.getresponse().status == 204
        connection.close()
        return page

    monkeypatch.setattr(onlook, "LivePage", pressed)
    said = command("render diffuse --size 32x24 --sampler gpt --time 60 --live -o a.exr", 130)
    done = read("a.exr").attributes["ngpt:spp"]
    assert f"enough: a.exr holds the {done} samples per pixel done by then" in said
    assert "live: http://127.0.0.1:" in said and command.output == ""


def test_a_page_that_cannot_be_had_stops_no_render(renderer, command, monkeypatch):
    def refused(*_):
        raise NgptError("--live: no port of 127.0.0.1 can be had for it")

    monkeypatch.setattr(onlook, "LivePage", refused)
    said = command("render diffuse --size 16x12 --sampler primal --spp 16 --live -o a.exr")
    errors = [line for line in said.splitlines() if "error" in line]
    assert len(errors) == 1 and errors[0].endswith("can be had for it; the render goes on")
    assert read("a.exr").attributes["ngpt:spp"] == 16
