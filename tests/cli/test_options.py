"""Options of methods from the command line, and methods that are others with options of their own."""

import json

import numpy as np
import pytest
from full_stack import full_stack

import ngpt
from ngpt.cli import main
from ngpt.denoisers import oidn
from ngpt.methods import METHODS, by_standing


@pytest.fixture
def source(tmp_path):
    return str(ngpt.write(tmp_path / "stack.exr", full_stack(20, 24)))


def denoise(source, *arguments):
    """The image and what the header says of it."""
    target = f"{source}.out.exr"
    assert main(["denoise", source, "-o", target, "--force", "-q", *arguments]) == 0
    return ngpt.read_image(target), ngpt.read(target).attributes


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        ("l1 -O alpha=0.5", {"alpha": 0.5}),
        ("l1 --alpha 0.5", {"alpha": 0.5}),
        ("l2 --option alpha=auto", {}),
        ("ngpt-fast -O memory=700", {"memory": 700}),
    ],
)
def test_an_option_of_any_method(source, words, expected):
    image, header = denoise(source, "-m", *words.split())
    assert np.array_equal(image, ngpt.denoise(ngpt.read(source), words.split()[0], **expected))
    assert header.get("ngpt:options", "") == ", ".join(f"{name}={value}" for name, value in expected.items())


@pytest.mark.skipif(bool(oidn.missing()), reason=oidn.missing())
@pytest.mark.parametrize("name", [name for name, method in METHODS.items() if method.variant])
def test_rows_of_tables_are_methods(source, name):
    image, header = denoise(source, "-m", name)
    entry = METHODS[name]
    assert header["ngpt:method"] == name and "ngpt:options" not in header
    options = {option: value.default for option, value in entry.options.items()}
    assert np.array_equal(image, ngpt.denoise(ngpt.read(source), entry.variant, **options))


def test_help_and_lists_have_methods_by_standing(source, capsys):
    """Entries of standing "use" with a line each; rows of tables and studies are asked for by name."""
    with pytest.raises(SystemExit):
        main(["denoise", "--help"])
    words = " ".join(capsys.readouterr().out.split())
    assert all(f"{name}: {' '.join(entry.summary.split())}" in words for name, entry in by_standing("use").items())
    assert all(f"{name}, " in words for name in ("primal", "l2", "cv", "wl2"))
    assert "oidn-clean" not in words and "nlm" not in words
    assert main(["info", "l1", "--json"]) == 0
    about = json.loads(capsys.readouterr().out)
    assert about["standing"] == "use" and "a number from 1e-15 to 1e+15, or auto" in about["options"]["alpha"]
    assert main(["info", source, "--json"]) == 0
    able = json.loads(capsys.readouterr().out)["methods"]
    assert {"l2", "wcv"} <= set(able) <= set(by_standing("use", "niche"))
