"""What a notebook shows of a stack, and the tutorial, which runs as it is."""

import base64
import re

import numpy as np

from ngpt.stack import GradientStack


def rows(html):
    """Layer -> the texts of its cells."""
    found = re.findall(r"<tr><th>([^<]*)</th>((?:<td>[^<]*</td>)+)</tr>", html)
    return {name: re.findall(r"<td>([^<]*)", cells) for name, cells in found}


def test_a_stack_shows_a_picture_and_the_range_of_its_layers():
    primal = np.full((40, 700, 3), 0.25, np.float32)
    primal[3, 4] = [np.nan, 1.0, 0.0]
    dx = np.full((40, 700, 3), -0.5, np.float32)
    stack = GradientStack.from_arrays(primal=primal, dx=dx, attributes={"ngpt:spp": 16}, path="<b>.exr")
    html = stack._repr_html_()
    assert rows(html) == {"primal": ["0", "0.25", "1", "1"], "dx": ["-0.5", "-0.5", "-0.5", "0"]}
    assert "GradientStack &lt;b&gt;.exr, 700x40, 16 spp" in html and "<b>" not in html
    picture = base64.b64decode(re.search(r'base64,([^"]*)"', html).group(1))
    width, height = (int.from_bytes(picture[i : i + 4], "big") for i in (16, 20))
    assert (width, height) == (140, 8) and len(html) < 60_000


def test_a_stack_without_primal_or_numbers_shows_itself_too():
    stack = GradientStack.from_arrays(depth=np.full((1, 1), np.inf, np.float32))
    assert rows(stack._repr_html_()) == {"depth": ["nan", "nan", "nan", "1"]}
