"""What a notebook shows of a stack, and the tutorial, which runs as it is."""

import ast
import base64
import json
import re
from pathlib import Path

import numpy as np
import pytest

import ngpt
from ngpt.stack import GradientStack

DOCS = Path(__file__).parents[2] / "docs"
TUTORIAL = DOCS / "start" / "tutorial.ipynb"


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
    assert repr(stack) == "<GradientStack <b>.exr, 700x40, 16 spp: primal, dx>"
    picture = base64.b64decode(re.search(r'base64,([^"]*)"', html).group(1))
    width, height = (int.from_bytes(picture[i : i + 4], "big") for i in (16, 20))
    assert (width, height) == (140, 8) and len(html) < 60_000


def run(notebook, folder, monkeypatch):
    """Each cell as a notebook runs it: all in one namespace, which is returned, and what last expressions show."""
    cells = json.loads(notebook.read_text())["cells"]
    assert all(not cell["outputs"] and cell["execution_count"] is None for cell in cells if cell["cell_type"] == "code")
    monkeypatch.chdir(folder)
    made, shown = {"__name__": "__main__"}, []
    for cell in cells:
        if cell["cell_type"] == "code":
            source = "".join(line for line in cell["source"] if not line.startswith("%"))  # pip's line
            if not source:
                continue
            *statements, last = ast.parse(source).body
            if isinstance(last, ast.Expr):
                exec(compile(ast.Module(statements, []), cell["id"], "exec"), made)
                shown.append(eval(compile(ast.Expression(last.value), cell["id"], "eval"), made))
            else:
                exec(compile(ast.Module([*statements, last], []), cell["id"], "exec"), made)
    return made, shown


@pytest.mark.slow
def test_the_tutorial_runs(renderer, tmp_path, monkeypatch, capsys):
    made, shown = run(TUTORIAL, tmp_path, monkeypatch)
    first, second = (value for value in shown if isinstance(value, GradientStack))
    assert {"dx", "primal_var"} <= rows(first._repr_html_()).keys() and {"primal"} == rows(second._repr_html_()).keys()
    errors = dict(re.findall(r"^(\S+) +relMSE (\S+)", capsys.readouterr().out, re.M))
    assert float(errors["ngpt-fast"]) < 0.5 * float(errors["primal"])
    assert (tmp_path / "report.html").stat().st_size > 100_000
    assert made["difference"] < 1e-4


@pytest.mark.slow
def test_the_first_five_cells_lead_to_a_clean_image(renderer, tmp_path, monkeypatch):
    """The notebook for Colab has no others; its wheel is the one that `make wheel` makes."""
    colab = DOCS / "start" / "colab.ipynb"
    made, _ = run(colab, tmp_path, monkeypatch)
    cells = [cell for cell in json.loads(colab.read_text())["cells"] if cell["cell_type"] == "code"]
    assert len(cells) == 5 and f"ngpt_recon-{ngpt.__version__}-py3" in cells[0]["source"][0]
    assert made["image"].shape == (160, 240, 3) and (tmp_path / "clean.png").stat().st_size > 10_000
    tutorial = [cell for cell in json.loads(TUTORIAL.read_text())["cells"] if cell["cell_type"] == "code"][:5]
    for found in (cells, tutorial):
        text = "".join("".join(cell["source"]) for cell in found)
        assert text.startswith("%pip install") and "ngpt.denoise(" in text and "clean.exr" in text


@pytest.mark.slow
def test_a_sampler_of_ones_own(renderer, tmp_path, monkeypatch):
    from data_gen.samplers import SAMPLERS

    with monkeypatch.context() as patched:
        patched.setitem(SAMPLERS, "mine", None)  # which takes it out again
        del SAMPLERS["mine"]
        made, _ = run(DOCS / "samplers" / "own-sampler.ipynb", tmp_path, patched)
    assert "mine" not in SAMPLERS
    assert abs(made["z"]) < 4.5 and made["gains"]["gpt"] < made["gains"]["mine"] < 1


@pytest.mark.slow
def test_a_shot(renderer, tmp_path, monkeypatch):
    made, _ = run(DOCS / "use" / "shot.ipynb", tmp_path, monkeypatch)
    assert made["found"]["with history"] < 0.85 * made["found"]["frame by frame"]


@pytest.mark.slow
def test_training_on_ones_own_scenes(renderer, tmp_path, monkeypatch):
    made, shown = run(DOCS / "train" / "own-scenes.ipynb", tmp_path, monkeypatch)
    assert [value for value in shown if isinstance(value, int)] == [0, 0, 0, 0]
    assert made["image"].shape == (64, 96, 3) and np.isfinite(made["image"]).all()
