"""What a reader sees of a page: text that can be read, a view that fits its window, maps in the right colours."""

from urllib.parse import quote, urlencode

import numpy as np
import pytest

from ngpt.errors import NgptError
from ngpt.report import display
from ngpt.report.content import Entry, Scene
from ngpt.report.page import oversize, write_report

FACTS = {"command": "ngpt report", "footer": {"ngpt": "0.1.0"}}

# The contrast of WCAG 2 between an element's own text and what is behind it; here every background covers.
CONTRAST = """(() => {
  const light = text => {
    const [r, g, b] = text.match(/[\\d.]+/g).slice(0, 3).map(x => +x / 255)
      .map(x => x <= 0.04045 ? x / 12.92 : ((x + 0.055) / 1.055) ** 2.4);
    return 0.2126 * r + 0.7152 * g + 0.0722 * b;
  };
  const behind = node => {
    const colour = node ? getComputedStyle(node).backgroundColor : "rgb(25, 25, 25)";
    return /, 0\\)$|transparent/.test(colour) ? behind(node.parentElement) : colour;
  };
  window.contrast = node => {
    const [low, high] = [light(getComputedStyle(node).color), light(behind(node))].sort((a, b) => a - b);
    return (high + 0.05) / (low + 0.05);
  };
})()"""


# Chromium warns of canvases that are read again and again, but not of these.
COPY = """var copyOf = canvas => {
  const size = {width: canvas.width, height: canvas.height};
  const copy = Object.assign(document.createElement("canvas"), size).getContext("2d", {willReadFrequently: true});
  copy.drawImage(canvas, 0, 0);
  return copy;
};"""


def scene(height=24, width=36, maps=(), reference=True) -> Scene:
    rng = np.random.default_rng(0)
    image = rng.gamma(1.0, 1.0, (height, width, 3)).astype(np.float32)
    entries = [
        Entry(name, image * k, None, {"relMSE": 0.1 * k}, {m: np.full((height, width), 0.5) for m in maps})
        for k, name in ((1, "a picture with a rather long name"), (2, "other"))
    ]
    return Scene(f"{width}x{height}", "a caption", image if reference else None, entries)


@pytest.fixture
def opened(browser, tmp_path):
    """Opens a page of these scenes in a browser."""

    def open_page(*scenes, **view):
        path = write_report(tmp_path / "page.html", "A title", list(scenes), **FACTS)
        return browser(f"file://{quote(str(path))}#{urlencode(view)}")

    return open_page


def test_all_text_can_be_read_and_so_can_buttons_under_the_mouse(opened):
    session = opened(scene(maps=("FLIP",)), scene(), map="FLIP")
    session.ask(CONTRAST)
    texts = (
        "[...document.body.querySelectorAll('*')].filter(n => n.checkVisibility() && !n.disabled && "
        "[...n.childNodes].some(c => c.nodeType === 3 && c.data.trim()))"
    )
    found = session.ask(f"{texts}.map(n => [contrast(n), n.outerHTML.slice(0, 80)])")
    assert len(found) > 40
    assert [text for text in found if text[0] < 4.5] == []
    for group in ("tabs", "exposures", "zooms", "layouts", "maps"):
        buttons = f"[...document.querySelectorAll('#{group} button:enabled:not([hidden])')]"
        for index in range(session.ask(f"{buttons}.length")):
            x, y = session.ask(
                f"(b => [b.x + b.width / 2, b.y + b.height / 2])({buttons}[{index}].getBoundingClientRect())"
            )
            session.hover(x, y)
            assert session.ask(f"{buttons}[{index}].matches(':hover')") is True
            assert session.ask(f"contrast({buttons}[{index}])") >= 4.5, (group, index)


@pytest.mark.parametrize("shape", [(720, 1280), (90, 60)])
def test_the_picture_and_its_controls_fit_into_the_window(opened, shape):
    session = opened(scene(*shape), map="error")
    for layout, picture in (("wipe", "#canvas-a"), ("two", "#panes canvas"), ("all", "#panes canvas")):
        session.ask(f"document.querySelector('#layouts button[value={layout}]').click()")
        for width, height in ((1366, 768), (1366, 640), (1920, 1080)):
            session.resize(width, height)
            top, bottom = session.ask("(b => [b.top, b.bottom])($('viewer').getBoundingClientRect())")
            assert top >= 0 and bottom <= height, (layout, width, height)
            box = f"document.querySelector('{picture}').getBoundingClientRect()"
            across, down = session.ask(f"(b => [b.width, b.height])({box})")
            assert min(across, down) >= 100 and across / down == pytest.approx(shape[1] / shape[0], rel=0.02)


def test_nothing_is_cut_off_on_a_narrow_screen(opened):
    session = opened(scene(maps=("SSIM", "FLIP")), map="FLIP", exposure=-2.25)
    session.resize(420, 860)
    assert session.ask("document.documentElement.scrollWidth") == 420
    beyond = (
        "[...document.querySelectorAll('#viewer button, #viewer output, #viewer input, #viewer select, #viewer td')]"
        ".filter(n => n.checkVisibility()).map(n => [n.getBoundingClientRect(), n])"
        ".filter(([b]) => b.left < 0 || b.right > $('viewer').getBoundingClientRect().right || b.width === 0)"
        ".map(([, n]) => n.outerHTML)"
    )
    assert session.ask(beyond) == []
    assert session.ask("$('stops').textContent") == "\N{MINUS SIGN}2.25 EV"
    assert session.ask("$('stops').scrollWidth <= $('stops').clientWidth") is True


def test_stored_maps_show_in_the_colours_of_their_scale(opened):
    session = opened(scene(maps=("FLIP",)), scene(), b="reference", map="FLIP")
    pixel = "[...$('canvas-{}').getContext('2d').getImageData(9, 9, 1, 1).data].slice(0, 3)"
    assert session.ask(pixel.format("a")) == display.heat_table()[128].tolist()
    assert session.ask(pixel.format("b")) == display.heat_table()[0].tolist()  # the reference equals itself
    assert session.ask("$('legend').hidden") is False
    # The other scene has no such map.
    session.ask("document.querySelectorAll('[role=tab]')[1].click()")
    assert session.view()["map"] == ""
    disabled = session.ask("[...$('maps').children].map(button => [button.value, button.disabled])")
    assert disabled == [["error", False], ["signed", False], ["stops", False], ["FLIP", True]]
    for expected in ("error", "signed", "stops", "", "error"):
        session.key("m")
        assert session.view()["map"] == expected


def test_false_colour_shows_stops_from_middle_grey(opened):
    grey = np.full((24, 36, 3), 0.18, np.float32)
    grey[:, :12] *= 8  # three stops up
    grey[:2, 24:] = np.nan
    session = opened(Scene("s", "", None, [Entry("grey", grey), Entry("dark", grey / 4)]), map="stops")
    stops = session.ask("page.scenes[0].stops")
    session.ask(COPY)
    pixel = "[...copyOf($('canvas-a')).getImageData({}, {}, 1, 1).data].slice(0, 3)"
    for x, above in ((4, 3), (30, 0)):
        place = round(255 * (0.5 + (above + stops) / 12))
        found = np.array(session.ask(pixel.format(x, 9)))
        assert np.abs(found - display.heat_table()[place - 1 : place + 2].astype(int)).sum(axis=1).min() == 0
    assert session.ask(pixel.format(30, 1)) == list(display.MAGENTA)
    assert session.ask("$('ticks').textContent") == "≤ \N{MINUS SIGN}6\N{MINUS SIGN}30+3≥ +6"
    session.key("f")
    assert session.view()["map"] == ""


def test_the_histogram_has_both_pictures_where_their_light_is(opened):
    grey = np.full((24, 36, 3), 0.18, np.float32)
    session = opened(Scene("s", "", None, [Entry("grey", grey), Entry("dark", grey / 4)]))
    # Columns, in stops from middle grey, where a line of this colour goes up.
    peak = (
        COPY
        + """(colour => {
        const c = $('histogram'), d = copyOf(c).getImageData(0, 0, c.width, c.height / 2).data, found = [];
        for (let i = 0; i < d.length; i += 4)
          if (colour.every((v, k) => Math.abs(d[i + k] - v) < 40))
            found.push(((i / 4) % c.width + 0.5) / c.width * 16 - 8);
        return found.length ? found.reduce((a, b) => a + b) / found.length : null;
    })"""
    )
    amber, blue = [0xE3, 0xB2, 0x65], [0x7D, 0xB9, 0xDE]
    for exposure in (0, 2):
        session.ask(f"change({{exposure: {exposure}}})")
        session.settle()
        stops = session.ask("page.scenes[0].stops") + exposure
        assert session.ask(f"{peak}({amber})") == pytest.approx(stops, abs=0.2)
        assert session.ask(f"{peak}({blue})") == pytest.approx(stops - 2, abs=0.2)


def test_pages_above_their_size_say_so(tmp_path, monkeypatch):
    path = write_report(tmp_path / "page.html", "A title", [scene()], **FACTS)
    assert oversize(path) == ""
    monkeypatch.setattr("ngpt.report.page.PAGE_LIMIT", 40_000.0)
    assert "MB, more than the 0.04 MB" in oversize(path) and "show fewer pictures" in oversize(path)


def test_a_map_of_another_size_is_refused(tmp_path):
    wrong = scene()
    wrong.entries[1].maps = {"FLIP": np.zeros((3, 4))}
    with pytest.raises(NgptError, match=r"map 'FLIP' of 'other' is \(3, 4\), expected \(24, 36\)"):
        write_report(tmp_path / "page.html", "A title", [wrong], **FACTS)
    assert not list(tmp_path.iterdir())
