"""The report page: its text, and what a real browser makes of it."""

import base64
import io
import json
import re
import time
from html.parser import HTMLParser
from urllib.parse import quote, urlencode

import numpy as np
import pytest

from ngpt.errors import NgptError
from ngpt.image import display
from ngpt.report import pixelcodec
from ngpt.report.content import ReportEntry, Scene
from ngpt.report.page import write_report

FACTS = {"command": "ngpt demo --spp 16", "footer": {"ngpt": "0.1.0", "device": "CPU"}}
HOSTILE = """<img src=x onerror="document.title='owned'"> & '</script>' {{PAGE}}"""

# Constant colours, so that a screenshot can be checked by the number of pixels of each; dark ones, so that the page's
# unit is not 1 and the error's epsilon counts.
COLOURS = {"primal": (0.125, 0.0625, 0.03125), "l1": (0.03125, 0.0625, 0.125), "reference": (0.0625, 0.0625, 0.0625)}
WIDTH, HEIGHT = 96, 32


def constant(colour) -> np.ndarray:
    return np.full((HEIGHT, WIDTH, 3), colour, dtype=np.float32)


def shown(name, stops=0.0) -> np.ndarray:
    """How a colour looks at the exposure of the flat scene, and so many stops more."""
    return display.to_srgb8(constant(COLOURS[name]), display.auto_exposure(constant(COLOURS["reference"])) + stops)[
        0, 0
    ]


def flat_scene(name="flat") -> Scene:
    entries = [
        ReportEntry("primal", constant(COLOURS["primal"]), None, {"relMSE": 0.5, "PSNR": 10.0}),
        ReportEntry("l1", constant(COLOURS["l1"]), 0.25, {"relMSE": 0.05, "PSNR": 14.0}),
    ]
    return Scene(name, "two colours", constant(COLOURS["reference"]), entries, {"dx": constant(-1.0)}, rising=("PSNR",))


def noise_scene(name="noise") -> Scene:
    """Every kind of number a renderer has ever made."""
    image = np.random.default_rng(0).gamma(1.0, 1.0, (20, 30, 3)).astype(np.float32)
    image[0, :6] = [[np.nan] * 3, [np.inf] * 3, [-np.inf] * 3, [-2.5] * 3, [1e12] * 3, [1e-30] * 3]
    layers = {"dx": image, "dy": np.zeros_like(image), "albedo": np.clip(image, 0, 1), "normal": image - 1}
    layers |= {"depth": image[:, :, :1], "primal_var": image}
    return Scene(name, "", None, [ReportEntry("primal", image, 0.0, {"relMSE": np.nan, "FLIP": np.inf})], layers)


def plain_scene(height=24, width=36, maps=()) -> Scene:
    image = np.random.default_rng(0).gamma(1.0, 1.0, (height, width, 3)).astype(np.float32)
    entries = [
        ReportEntry(name, image * k, None, {"relMSE": 0.1 * k}, {m: np.full((height, width), 0.5) for m in maps})
        for k, name in ((1, "a picture with a rather long name"), (2, "other"))
    ]
    return Scene(f"{width}x{height}", "a caption", image, entries)


def written(folder, *scenes, title="A report", **facts):
    return write_report(folder / "report.html", title, list(scenes), **FACTS | facts)


class Page(HTMLParser):
    """Tags with their attributes, and the text outside scripts and styles."""

    def __init__(self, text):
        super().__init__()
        self.tags, self.text, self.inside = [], "", ""
        self.feed(text)
        self.figures = [attrs["data-name"] for tag, attrs in self.tags if tag == "figure"]

    def handle_starttag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))
        self.inside = tag

    def handle_endtag(self, tag):
        self.inside = ""

    def handle_data(self, data):
        if self.inside not in ("script", "style"):
            self.text += data


# --- the text --------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def both(tmp_path_factory):
    """A page of both scenes."""
    return written(tmp_path_factory.mktemp("both"), flat_scene(), noise_scene())


def test_the_page_holds_every_scene_method_and_fact(both):
    text = both.read_text()
    page = Page(text)
    layers = ["dx", "dy", "albedo", "normal", "depth", "primal_var"]
    assert page.figures == ["primal", "l1", "reference", "dx", "primal", *layers]
    for word in ("A report", "two colours", "ngpt demo --spp 16", "CPU", "relMSE 0.05", "0.25 s"):
        assert word in page.text
    assert "nan" not in page.text and "{{" not in text
    # The table marks the best and compares to primal.
    assert re.findall(r'class="best"><span>([^<]*)', text) == ["0.05", "14"]
    assert "<small>&times;0.1</small>" in text and "<small>+4.00</small>" in text


def test_nothing_comes_from_outside(both):
    text = both.read_text()
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
    assert page.figures == ["primal", HOSTILE, "reference", "dx"]


def test_a_page_that_would_be_too_big_stores_its_noise_coarser(tmp_path, monkeypatch):
    noise, smooth = np.random.default_rng(0).gamma(1.0, 1.0, (300, 400, 3)), np.ones((300, 400, 3))
    scene = Scene("s", "", None, [ReportEntry("primal", noise), ReportEntry("l1", smooth)])
    limit = 600_000  # at full precision the page takes over 800 kB
    monkeypatch.setattr("ngpt.report.page.PAGE_LIMIT", limit)
    text = written(tmp_path, scene).read_text()
    assert 0.7 * limit < len(text) <= limit
    steps = json.loads(re.search(r'id="page">(.*?)</script>', text).group(1))["scenes"][0]["steps"]
    assert steps[0] < 64 and steps[1] == pixelcodec.LADDER[0]


def test_the_same_input_gives_the_same_bytes_and_nothing_is_overwritten(both, tmp_path):
    path = written(tmp_path, flat_scene(), noise_scene())
    assert path.read_bytes() == both.read_bytes()
    with pytest.raises(NgptError, match="exists already"):
        written(tmp_path, noise_scene())
    assert path.read_bytes() == both.read_bytes()
    written(tmp_path, noise_scene(), overwrite=True)
    assert path.read_bytes() != both.read_bytes() and list(tmp_path.iterdir()) == [path]


def changed(change) -> list[Scene]:
    scene = flat_scene()
    change(scene)
    return [scene]


@pytest.mark.parametrize(
    ("scenes", "message"),
    [
        ([], "at least one scene"),
        ([Scene("s", "", None, [])], "no entry"),
        (
            changed(lambda scene: setattr(scene.entries[1], "image", scene.entries[1].image[:-1])),
            r"'l1' is \(31, 96, 3\), expected \(32, 96, 3\)",
        ),
        (changed(lambda scene: setattr(scene.entries[1], "name", "reference")), "two pictures named 'reference'"),
        (changed(lambda scene: scene.layers.update(depth=np.zeros((4, 4)))), "layer 'depth'"),
        (changed(lambda scene: scene.entries[0].maps.update(FLIP=np.zeros((4, 4)))), "map 'FLIP' of 'primal'"),
    ],
)
def test_what_cannot_be_shown_is_refused(tmp_path, scenes, message):
    with pytest.raises(NgptError, match=message):
        written(tmp_path, *scenes)
    assert not list(tmp_path.iterdir())


# --- the browser -----------------------------------------------------------------------------------------------------


def address(path, **view) -> str:
    return f"file://{quote(str(path))}#{urlencode(view)}"


def cells(session, row: str) -> list[str]:
    """The texts of one row of the readout, which starts at the centre of the picture."""
    return session.ask(f"[...$('{row}').querySelectorAll('td')].map(cell => cell.textContent)")


def press(session, group, value):
    session.ask(f"document.querySelector('#{group} button[value=\"{value}\"]').click()")


def colour(session, canvas) -> list[int]:
    return session.ask(f"[...$('{canvas}').getContext('2d').getImageData(9, 9, 1, 1).data].slice(0, 3)")


def unbroken(session) -> bool:
    return session.ask("document.documentElement.dataset.error ?? null") is None


def test_the_script_decodes_what_was_written(browser, both):
    session = browser(address(both, map="error"))
    assert session.ask("document.querySelectorAll('[role=tab]').length") == 2
    assert session.ask("document.documentElement.lang") == "en" and unbroken(session)
    # Both methods are off by 1/16, 0 and 1/32.
    epsilon = display.ERROR_EPSILON * (0.0625 / 0.18) ** 2
    error = np.sqrt((2**-8 + 2**-10) / 3 / (2**-8 + epsilon))
    for row, name in (("value-a", "primal"), ("value-b", "l1"), ("value-reference", "reference")):
        *values, told = cells(session, row)
        assert [float(value) for value in values] == pytest.approx(COLOURS[name], rel=4e-3)  # TOE counts in the dark
        assert told == "" if name == "reference" else float(told[:-2]) == pytest.approx(100 * error, rel=0.02)
    # The map of errors is logarithmic over its range: black is 1 %, pale yellow all.
    low, high = np.log10(display.ERROR_RANGE)
    place = round(255 * (np.log10(error**2) - low) / (high - low))
    assert np.abs(np.subtract(colour(session, "canvas-a"), display.heat_table()[place])).max() <= 3


def test_hostile_names_and_numbers_do_not_break_the_script(browser, tmp_path):
    noise = noise_scene(HOSTILE)
    noise.entries.append(ReportEntry(HOSTILE, np.full((20, 30, 3), 1e12)))
    path = written(tmp_path, flat_scene(), noise)
    session = browser(address(path, scene=1, a=HOSTILE, b="dx", exposure=-4, zoom=4))
    assert "owned" not in session.ask("document.title") and unbroken(session)
    assert [float(cell) for cell in cells(session, "value-a")[:3]] == pytest.approx([1e12] * 3, rel=2e-3)
    assert cells(session, "value-b") == ["display colours"]


def test_a_screenshot_shows_a_left_and_b_right_at_the_exposure_asked(browser, tmp_path):
    imageio = pytest.importorskip("imageio.v3")
    session = browser(address(written(tmp_path, flat_scene()), a="primal", b="l1", exposure=-2, split=30))
    picture = base64.b64decode(session.call("Page.captureScreenshot", format="png")["data"])
    pixels = imageio.imread(io.BytesIO(picture), extension=".png")[:, :, :3].astype(int)
    left, right = (np.abs(pixels - shown(name, -2).astype(int)).max(axis=2) <= 1 for name in ("primal", "l1"))
    row = (left | right).sum(axis=1).argmax()  # the stage is wider than all the thumbnails together
    a, b = np.flatnonzero(left[row]), np.flatnonzero(right[row])
    assert a.max() < b.min()
    border = (a.max() + b.min()) / 2
    assert (border - a.min()) / (b.max() + 1 - a.min()) == pytest.approx(0.3, abs=0.01)
    assert b.max() + 1 - a.min() == WIDTH * 11  # the largest whole factor that fits into the stage's 1150 pixels


def test_mouse_and_keyboard_drive_the_page(browser, both):
    session = browser(address(both, zoom="fit"))
    left, top, width, height = session.ask(
        "(({x, y, width, height}) => [x, y, width, height])($('frame').getBoundingClientRect())"
    )
    middle = top + 0.5 * height
    session.drag((left + 0.5 * width, middle), (left + 0.25 * width, middle))
    assert float(session.view()["split"]) == pytest.approx(25, abs=0.1)
    assert session.ask("$('where').textContent") == "x 24, y 16"
    session.key("ArrowRight")  # the drag left the focus on the border
    assert float(session.view()["split"]) == pytest.approx(26, abs=0.1)
    session.key("End")
    assert session.view()["split"] == session.ask("$('wipe').getAttribute('aria-valuenow')") == "100"
    session.ask("document.querySelector('#scene-0 figure[data-name=reference] button.a').click()")
    for group, value in (("exposures", 2), ("maps", "error"), ("zooms", 4)):
        press(session, group, value)
    expected = {"a": "reference", "b": "l1", "exposure": "2", "map": "error", "zoom": "4"}
    assert session.view().items() >= expected.items() and session.ask("$('legend').hidden") is False
    # The other scene has neither an 'l1' nor a reference: the page falls back, it does not fail.
    session.ask("document.querySelectorAll('[role=tab]')[1].click()")
    assert session.view().items() >= {"scene": "1", "a": "primal", "b": "primal", "map": ""}.items()
    assert session.ask("[...$('maps').children].filter(b => !b.disabled).map(b => b.value).join()") == "stops"
    session.ask("location.hash = '#scene=0&a=nonsense&exposure=nonsense&split=-7&zoom=toString'")
    assert session.wait_for("getComputedStyle($('scene-0')).display !== 'none'") and unbroken(session)


def test_panes_zoom_and_pan_together_and_keys_drive_them(browser, both):
    session = browser(address(both, layout="all"))
    first = (
        "[...document.querySelectorAll('#panes canvas')].map(c => c.getContext('2d').getImageData(9, 9, 1, 1).data[0])"
    )
    assert session.ask(first) == pytest.approx([shown(name)[0] for name in COLOURS], abs=1)
    press(session, "zooms", 8)
    assert session.ask("[...document.querySelectorAll('#panes canvas')].every(c => c.offsetWidth === 8 * 96)")
    session.ask("document.querySelector('#panes .view').scrollTo(33, 20)")
    places = "[...document.querySelectorAll('#panes .view')].map(v => [v.scrollLeft, v.scrollTop]).join(' ')"
    assert session.wait_for(f"{places} === '33,20 33,20 33,20'")
    session.ask("document.activeElement.blur()")
    for key in ("l", "0", "d", "v", "v", "ArrowRight", "x", "."):
        session.key(key)
    expected = {"zoom": "fit", "map": "signed", "layout": "wipe", "a": "reference", "b": "primal", "exposure": "0.5"}
    assert session.view().items() >= expected.items()
    session.key("?")
    assert session.ask("$('help').open") is True and unbroken(session)


def test_the_frames_of_a_shot_are_played_at_one_exposure(browser, tmp_path):
    change = {"change": np.zeros((6, 8))}
    frames = [
        Scene(f"{i:04}", "", None, [ReportEntry("shot", np.full((6, 8, 3), 0.1 * (i + 1)), maps=change)])
        for i in range(3)
    ]
    session = browser(written(tmp_path, *frames, shot=True).as_uri())
    assert session.ask("$('tabs').hidden") is True and session.ask("$('player').hidden") is False
    assert session.ask("$('frame-name').textContent") == "0000, 1 of 3"
    middle = "+document.querySelectorAll('#value-a td')[0].textContent"
    levels = [session.ask(middle)]
    for number in ("1", "2"):
        session.key("]")
        assert session.view()["scene"] == number
        levels.append(session.ask(middle))
    assert levels == pytest.approx([0.1, 0.2, 0.3], rel=0.01)
    assert session.ask("[...$('maps').children].find(b => b.value === 'change').disabled") is False
    session.ask(
        "$('fps').value = 24; window.seen = new Set(); "
        "new MutationObserver(() => seen.add($('at-frame').value)).observe($('frame-name'), {childList: true});"
    )
    session.ask("$('play').click()")
    assert session.wait_for("seen.size === 3") and session.ask("$('play').textContent") == "pause"
    session.ask("$('play').click()")
    stopped = session.view()["scene"]
    assert session.ask("$('play').textContent") == "play"
    time.sleep(0.3)
    assert session.view()["scene"] == stopped


# --- what a reader sees ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("shape", "windows"), [((700, 300), [(1366, 640)]), ((90, 60), [(1366, 640)])])
def test_the_picture_and_its_controls_fit_into_the_window(browser, tmp_path, shape, windows):
    session = browser(address(written(tmp_path, plain_scene(*shape)), map="error"))
    for layout, picture in (("wipe", "#canvas-a"), ("two", "#panes canvas"), ("all", "#panes canvas")):
        press(session, "layouts", layout)
        for width, height in windows:
            session.resize(width, height)
            top, bottom = session.ask("(b => [b.top, b.bottom])($('viewer').getBoundingClientRect())")
            assert top >= 0 and bottom <= height, (layout, width, height)
            box = f"document.querySelector('{picture}').getBoundingClientRect()"
            across, down = session.ask(f"(b => [b.width, b.height])({box})")
            assert min(across, down) >= 100 and across / down == pytest.approx(shape[1] / shape[0], rel=0.02)


def test_stored_maps_show_in_the_colours_of_their_scale(browser, tmp_path):
    path = written(tmp_path, plain_scene(maps=("FLIP",)), plain_scene())
    session = browser(address(path, b="reference", map="FLIP"))
    assert colour(session, "canvas-a") == display.heat_table()[128].tolist()
    assert colour(session, "canvas-b") == display.heat_table()[0].tolist()  # the reference equals itself
    assert session.ask("$('legend').hidden") is False
    # The other scene has no such map.
    session.ask("document.querySelectorAll('[role=tab]')[1].click()")
    assert session.view()["map"] == ""
    disabled = session.ask("[...$('maps').children].map(button => [button.value, button.disabled])")
    assert disabled == [["error", False], ["signed", False], ["stops", False], ["FLIP", True]]
    for expected in ("error", "signed", "stops", "", "error"):
        session.key("m")
        assert session.view()["map"] == expected
