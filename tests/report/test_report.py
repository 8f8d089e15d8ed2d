"""The report page: its text, and what a real browser makes of it."""

import json
import re
import subprocess
import time
from html.parser import HTMLParser
from urllib.parse import quote, urlencode

import numpy as np
import pytest

from ngpt.errors import NgptError
from ngpt.report import display, pixelcodec
from ngpt.report.content import Entry, Scene
from ngpt.report.page import write_report

FACTS = {"command": "ngpt demo --spp 16", "footer": {"ngpt": "0.1.0", "device": "CPU"}}
HOSTILE = """<img src=x onerror="document.title='owned'"> & '</script>' {{PAGE}}"""

# Constant colours, so that a screenshot can be checked by the number of pixels of each; dark ones, so that the page's
# unit is not 1 and the error's epsilon counts.
COLOURS = {"primal": (0.125, 0.0625, 0.03125), "l1": (0.03125, 0.0625, 0.125), "reference": (0.0625, 0.0625, 0.0625)}
WIDTH, HEIGHT = 96, 32


def constant(colour) -> np.ndarray:
    return np.full((HEIGHT, WIDTH, 3), colour, dtype=np.float32)


def flat_scene(name="flat") -> Scene:
    entries = [
        Entry("primal", constant(COLOURS["primal"]), None, {"relMSE": 0.5, "PSNR": 10.0}),
        Entry("l1", constant(COLOURS["l1"]), 0.25, {"relMSE": 0.05, "PSNR": 14.0}),
    ]
    return Scene(name, "two colours", constant(COLOURS["reference"]), entries, {"dx": constant(-1.0)}, rising=("PSNR",))


def noise_scene(name="noise") -> Scene:
    """Every kind of number a renderer has ever made."""
    image = np.random.default_rng(0).gamma(1.0, 1.0, (20, 30, 3)).astype(np.float32)
    image[0, :6] = [[np.nan] * 3, [np.inf] * 3, [-np.inf] * 3, [-2.5] * 3, [1e12] * 3, [1e-30] * 3]
    layers = {
        "dx": image,
        "dy": np.zeros_like(image),
        "albedo": np.clip(image, 0, 1),
        "normal": image - 1,
        "depth": image[:, :, :1],
        "primal_var": image,
    }
    return Scene(name, "", None, [Entry("primal", image, 0.0, {"relMSE": np.nan, "FLIP": np.inf})], layers)


def written(tmp_path, *scenes, title="A report", **facts):
    return write_report(tmp_path / "report.html", title, list(scenes), **FACTS | facts)


class Page(HTMLParser):
    """Tags with their attributes, and the text outside scripts and styles."""

    def __init__(self, text):
        super().__init__()
        self.tags, self.text, self.inside = [], "", ""
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))
        self.inside = tag

    def handle_endtag(self, tag):
        self.inside = ""

    def handle_data(self, data):
        if self.inside not in ("script", "style"):
            self.text += data


# --- the text --------------------------------------------------------------------------------------------------------


def test_the_page_holds_every_scene_method_and_fact(tmp_path):
    path = written(tmp_path, flat_scene(), noise_scene())
    text = path.read_text()
    page = Page(text)
    names = [attrs["data-name"] for tag, attrs in page.tags if tag == "figure"]
    layers = ["dx", "dy", "albedo", "normal", "depth", "primal_var"]
    assert names == ["primal", "l1", "reference", "dx", "primal", *layers]
    for word in ("A report", "two colours", "ngpt demo --spp 16", "CPU", "relMSE 0.05", "0.25 s"):
        assert word in page.text
    assert "nan" not in page.text and "{{" not in text


def test_the_table_marks_the_best_and_compares_to_primal(tmp_path):
    text = written(tmp_path, flat_scene()).read_text()
    assert re.findall(r'class="best"><span>([^<]*)', text) == ["0.05", "14"]
    assert "<small>&times;0.1</small>" in text and "<small>+4.00</small>" in text


def test_nothing_comes_from_outside(tmp_path):
    text = written(tmp_path, flat_scene(), noise_scene()).read_text()
    assert not re.search(r"https?:|//[a-z]+\.|@import|url\(|\bfetch\(|XMLHttp|<link|<iframe", text)
    for tag, attrs in Page(text).tags:
        assert not any(key.startswith("on") or key in ("style", "href") for key in attrs), tag
        assert attrs.get("src", "data:image/png;base64,").startswith("data:image/png;base64,")
    policy = next(attrs["content"] for _, attrs in Page(text).tags if attrs.get("http-equiv"))
    assert policy.startswith("default-src 'none'; img-src data:;") and "unsafe" not in policy


def test_names_are_only_names(tmp_path):
    scene = flat_scene(HOSTILE)
    scene.caption = scene.entries[1].name = HOSTILE
    scene.entries[1].metrics = {HOSTILE: 1.0}
    path = written(tmp_path, scene, title=HOSTILE, command=HOSTILE, footer={HOSTILE: HOSTILE})
    page = Page(path.read_text())
    assert page.text.count(HOSTILE) >= 8
    assert all(attrs["src"].startswith("data:") for tag, attrs in page.tags if tag == "img")
    figures = [attrs["data-name"] for tag, attrs in page.tags if tag == "figure"]
    assert figures == ["primal", HOSTILE, "reference", "dx"]


def test_a_page_that_would_be_too_big_stores_its_noise_coarser(tmp_path, monkeypatch):
    rng = np.random.default_rng(0)
    noise, smooth = rng.gamma(1.0, 1.0, (300, 400, 3)), np.ones((300, 400, 3))
    scene = Scene("s", "", None, [Entry("primal", noise), Entry("l1", smooth)])
    limit = 600_000  # at full precision the page takes over 800 kB
    monkeypatch.setattr("ngpt.report.page.PAGE_LIMIT", limit)
    text = written(tmp_path, scene).read_text()
    assert 0.7 * limit < len(text) <= limit
    steps = json.loads(re.search(r'id="page">(.*?)</script>', text).group(1))["scenes"][0]["steps"]
    assert steps[0] < 64 and steps[1] == pixelcodec.LADDER[0]


def test_the_same_input_gives_the_same_bytes(tmp_path):
    first = written(tmp_path, flat_scene(), noise_scene()).read_bytes()
    again = write_report(tmp_path / "again.html", "A report", [flat_scene(), noise_scene()], **FACTS)
    assert again.read_bytes() == first


def test_no_overwriting_and_no_half_files(tmp_path):
    path = written(tmp_path, flat_scene())
    before = path.read_bytes()
    with pytest.raises(NgptError, match="exists already"):
        written(tmp_path, noise_scene())
    assert path.read_bytes() == before
    written(tmp_path, noise_scene(), overwrite=True)
    assert path.read_bytes() != before
    assert list(tmp_path.iterdir()) == [path]


def test_what_cannot_be_shown_is_refused(tmp_path):
    def refused(scenes, message):
        with pytest.raises(NgptError, match=message):
            written(tmp_path, *scenes)
        assert not list(tmp_path.iterdir())

    refused([], "at least one scene")
    refused([Scene("s", "", None, [])], "no entry")
    scene = flat_scene()
    scene.entries[1].image = scene.entries[1].image[:-1]
    refused([scene], r"'l1' is \(31, 96, 3\), expected \(32, 96, 3\)")
    scene = flat_scene()
    scene.entries[1].name = "reference"
    refused([scene], "two pictures named 'reference'")
    scene = flat_scene()
    scene.layers["depth"] = np.zeros((4, 4))
    refused([scene], "layer 'depth'")


# --- the browser -----------------------------------------------------------------------------------------------------


def address(path, **view) -> str:
    return f"file://{quote(str(path))}#{urlencode(view)}"


def browse(chromium, path, *, picture=None, **view) -> str:
    """Opens the page at a view and returns the DOM; with ``picture``, writes a screenshot there instead."""
    output = f"--screenshot={picture}" if picture else "--dump-dom"
    command = [*chromium, "--virtual-time-budget=5000", output, address(path, **view)]
    result = subprocess.run(command, capture_output=True, text=True, timeout=60)
    assert result.returncode == 0, result.stderr
    return result.stdout


def opened(chromium, path, **view) -> str:
    """The DOM of a page that has shown the view and has met no error."""
    dom = browse(chromium, path, **view)
    assert not re.search(r'data-error="([^"]*)', dom), re.search(r'data-error="([^"]*)', dom).group(1)
    assert '<html lang="en" data-ready="true"' in dom
    return dom


def cells(dom: str, row: str) -> list[str]:
    """The texts of one row of the readout, which starts at the centre of the picture."""
    inner = re.search(rf'<tr id="{row}">(.*?)</tr>', dom).group(1)
    return re.findall(r"<td[^>]*>([^<]*)</td>", inner)


def test_the_script_decodes_what_was_written(chromium, tmp_path):
    dom = opened(chromium, written(tmp_path, flat_scene(), noise_scene()))
    assert dom.count('role="tab"') == 2
    # Both methods are off by 1/16, 0 and 1/32.
    epsilon = display.ERROR_EPSILON * (0.0625 / 0.18) ** 2
    error = 100 * np.sqrt((2**-8 + 2**-10) / 3 / (2**-8 + epsilon))
    for row, name in (("value-a", "primal"), ("value-b", "l1"), ("value-reference", "reference")):
        *colour, shown = cells(dom, row)
        assert [float(value) for value in colour] == pytest.approx(COLOURS[name], rel=4e-3)  # TOE counts in the dark
        assert shown == "" if name == "reference" else float(shown[:-2]) == pytest.approx(error, rel=0.02)


def test_hostile_names_and_numbers_do_not_break_the_script(chromium, tmp_path):
    noise = noise_scene(HOSTILE)
    noise.entries.append(Entry(HOSTILE, np.full((20, 30, 3), 1e12)))
    dom = opened(chromium, written(tmp_path, flat_scene(), noise), scene=1, a=HOSTILE, b="dx", exposure=-4, zoom=4)
    assert "owned" not in re.search(r"<title>(.*?)</title>", dom).group(1)
    assert [float(cell) for cell in cells(dom, "value-a")[:3]] == pytest.approx([1e12] * 3, rel=2e-3)
    assert cells(dom, "value-b") == ["display colours"]


def test_a_screenshot_shows_a_left_and_b_right_at_the_exposure_asked(chromium, tmp_path):
    imageio = pytest.importorskip("imageio.v3")
    path = written(tmp_path, flat_scene())
    browse(chromium, path, picture=tmp_path / "shot.png", a="primal", b="l1", exposure=-2, split=30)
    shot = imageio.imread(tmp_path / "shot.png")[:, :, :3].astype(int)
    stops = display.auto_exposure(constant(COLOURS["reference"])) - 2
    left, right = (where(shot, display.to_srgb8(constant(COLOURS[name]), stops)[0, 0]) for name in ("primal", "l1"))
    row = (left | right).sum(axis=1).argmax()  # the stage is wider than all the thumbnails together
    a, b = np.flatnonzero(left[row]), np.flatnonzero(right[row])
    assert a.max() < b.min()
    border = (a.max() + b.min()) / 2
    assert (border - a.min()) / (b.max() + 1 - a.min()) == pytest.approx(0.3, abs=0.01)
    assert b.max() + 1 - a.min() == WIDTH * 11  # the largest whole factor that fits into the stage's 1150 pixels


def test_mouse_and_keyboard_drive_the_page(browser, tmp_path):
    session = browser(address(written(tmp_path, flat_scene(), noise_scene()), zoom="fit"))
    left, top, width, height = session.ask(
        "(({x, y, width, height}) => [x, y, width, height])($('frame').getBoundingClientRect())"
    )
    session.mouse("mousePressed", left + 0.5 * width, top + 0.5 * height)
    session.mouse("mouseMoved", left + 0.25 * width, top + 0.5 * height)
    session.mouse("mouseReleased", left + 0.25 * width, top + 0.5 * height)
    assert float(session.view()["split"]) == pytest.approx(25, abs=0.1)
    assert session.ask("$('where').textContent") == "x 24, y 16"
    session.key("ArrowRight")  # the drag left the focus on the border
    assert float(session.view()["split"]) == pytest.approx(26, abs=0.1)
    session.key("End")
    assert session.view()["split"] == session.ask("$('wipe').getAttribute('aria-valuenow')") == "100"

    session.ask("document.querySelector('#scene-0 figure[data-name=reference] button.a').click()")
    session.ask("document.querySelector('#exposures button[value=\"2\"]').click()")
    session.ask("document.querySelector('#maps button[value=error]').click()")
    session.ask("document.querySelector('#zooms button[value=\"4\"]').click()")
    expected = {"a": "reference", "b": "l1", "exposure": "2", "map": "error", "zoom": "4"}
    assert session.view().items() >= expected.items()
    assert session.ask("$('legend').hidden") is False

    # The other scene has neither an 'l1' nor a reference: the page falls back, it does not fail.
    session.ask("document.querySelectorAll('[role=tab]')[1].click()")
    expected = {"scene": "1", "a": "primal", "b": "primal", "map": ""}
    assert session.view().items() >= expected.items()
    assert session.ask("[...$('maps').children].filter(b => !b.disabled).map(b => b.value).join()") == "stops"
    session.ask("location.hash = '#scene=0&a=nonsense&exposure=nonsense&split=-7&zoom=toString'")
    assert session.ask("getComputedStyle($('scene-0')).display") != "none"
    assert session.ask("document.documentElement.dataset.error ?? null") is None


def test_panes_zoom_and_pan_together_and_keys_drive_them(browser, tmp_path):
    session = browser(address(written(tmp_path, flat_scene(), noise_scene()), layout="all"))
    assert session.ask("document.querySelectorAll('#panes canvas').length") == 3
    first = "c.getContext('2d').getImageData(9, 9, 1, 1).data[0]"
    drawn = f"[...document.querySelectorAll('#panes canvas')].map(c => {first})"
    stops = display.auto_exposure(constant(COLOURS["reference"]))
    expected = [display.to_srgb8(constant(colour), stops)[0, 0, 0] for colour in COLOURS.values()]
    assert session.ask(drawn) == pytest.approx(expected, abs=1)
    session.ask("document.querySelector('#zooms button[value=\"8\"]').click()")
    assert session.ask("[...document.querySelectorAll('#panes canvas')].every(c => c.offsetWidth === 8 * 96)")
    session.ask("document.querySelector('#panes .view').scrollTo(33, 20)")
    time.sleep(0.3)
    places = "[...document.querySelectorAll('#panes .view')].map(v => [v.scrollLeft, v.scrollTop]).join(' ')"
    assert session.ask(places) == "33,20 33,20 33,20"
    session.ask("document.activeElement.blur()")
    for key in ("l", "0", "d", "v", "v", "ArrowRight", "x", "."):
        session.key(key)
    expected = {"zoom": "fit", "map": "signed", "layout": "wipe", "a": "reference", "b": "primal"}
    assert session.view().items() >= (expected | {"exposure": "0.5"}).items()
    session.key("?")
    assert session.ask("$('help').open") is True
    assert session.ask("document.documentElement.dataset.error ?? null") is None


def where(shot: np.ndarray, colour: np.ndarray) -> np.ndarray:
    return np.abs(shot - colour.astype(int)).max(axis=2) <= 1


def test_the_frames_of_a_shot_are_played_at_one_exposure(browser, tmp_path):
    frames = [
        Scene(
            f"{i:04}", "", None, [Entry("shot", np.full((6, 8, 3), 0.1 * (i + 1)), maps={"change": np.zeros((6, 8))})]
        )
        for i in range(3)
    ]
    page = write_report(tmp_path / "p.html", "t", frames, command="", footer={}, shot=True)
    session = browser(page.as_uri())
    assert session.ask("$('tabs').hidden") is True and session.ask("$('player').hidden") is False
    assert session.ask("$('frame-name').textContent") == "0000, 1 of 3"
    middle = """(() => {
        const copy = document.createElement("canvas").getContext("2d", {willReadFrequently: true});
        copy.drawImage($("canvas-a"), 0, 0);
        return copy.getImageData(4, 3, 1, 1).data[0];
    })()"""
    levels = [session.ask(middle)]
    for number in ("1", "2"):
        session.key("]")
        assert session.view()["scene"] == number
        levels.append(session.ask(middle))
    assert levels[0] < levels[1] < levels[2]
    assert session.ask("[...$('maps').children].find(b => b.value === 'change').disabled") is False
    session.ask(
        "$('fps').value = 24; window.seen = new Set(); "
        "new MutationObserver(() => seen.add($('at-frame').value)).observe($('frame-name'), {childList: true});"
    )
    session.ask("$('play').click()")
    end = time.monotonic() + 20
    while session.ask("seen.size") < 3 and time.monotonic() < end:
        time.sleep(0.05)
    assert session.ask("seen.size") == 3 and session.ask("$('play').textContent") == "pause"
    session.ask("$('play').click()")
    stopped = session.view()["scene"]
    assert session.ask("$('play').textContent") == "play"
    time.sleep(0.3)
    assert session.view()["scene"] == stopped
