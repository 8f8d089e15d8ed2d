"""Attributes of our names that hold something else: every verb that reads stacks takes them calmly."""

import json

import numpy as np
import pytest
from full_stack import full_stack

import ngpt
from ngpt.cli import main

NAMES = ("spp", "seconds", "seed", "sampler", "frame", "previousFrame", "discarded", "error", "normalSpace", "method")
VALUES = {"text": "many", "huge": 1e30, "nan": np.nan, "negative": -4, "vector": np.ones(2, np.float32), "empty": ""}


@pytest.fixture(params=VALUES)
def odd(request, tmp_path):
    """Two frames of a shot, all of whose attributes are of one kind."""
    for i in range(2):
        stack = full_stack(24, 20, seed=i)
        stack.attributes |= {f"ngpt:{name}": VALUES[request.param] for name in NAMES}
        ngpt.write(tmp_path / f"{i}.exr", stack.replace(motion=np.zeros((24, 20, 2), np.float32)))
    return tmp_path


def test_verbs_take_them_calmly(odd, capsys):
    files = [str(odd / f"{i}.exr") for i in range(2)]
    assert main(["info", files[0], "--json"]) == 0
    assert "ngpt:spp" in json.loads(capsys.readouterr().out)["attributes"]
    assert main(["info", files[0]]) == 0
    assert main(["denoise", *files, "-m", "l2", "-q", "-o", f"{odd}/out/"]) == 0
    assert main(["denoise", *files, "-m", "l2", "-q", "--temporal", "-o", f"{odd}/shot/"]) == 0
    assert main(["report", *files, "--ref", files[1], "-q", "-o", f"{odd}/page.html"]) == 0
    assert main(["report", files[0], "-q", "-o", f"{odd}/one.html"]) == 0
    capsys.readouterr()
    assert main(["merge", *files, "-o", f"{odd}/merged.exr"]) == 1
    errors = capsys.readouterr().err
    assert errors.count("\n") == 1 and "'ngpt:spp'" in errors


def test_numbers_are_numbers():
    stack = ngpt.GradientStack({"primal": np.zeros((2, 2, 3), np.float32)}, {"a": 3, "b": 0.5, "c": np.float32(2)})
    assert [stack.number(name) for name in "abc"] == [3, 0.5, 2] and stack.number("d") is None
    for value in ("3", True, np.nan, -np.inf, np.ones(2), None, [1.0]):
        stack.attributes["a"] = value
        assert stack.number("a") is None
