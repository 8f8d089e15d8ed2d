"""What a reader sees of a page: text that can be read, a view that fits its window, maps in the right colours."""

from urllib.parse import quote, urlencode

import numpy as np
import pytest

from ngpt.report import display
from ngpt.report.content import Entry, Scene
from ngpt.report.page import write_report

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
