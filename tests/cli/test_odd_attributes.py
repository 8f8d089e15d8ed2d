"""Attributes of our names that hold something else: every verb that reads stacks takes them calmly."""

import json

import numpy as np
import pytest
from full_stack import full_stack

import ngpt
from ngpt.cli import main

NAMES = ("spp", "seconds", "seed", "sampler", "frame", "previousFrame", "discarded", "error", "normalSpace", "method")
VALUES = {"text": "many", "huge": 1e30, "nan": np.nan, "negative": -4, "vector": np.ones(2, np.float32), "empty": ""}


QUICK = ("text", "nan", "vector")


@pytest.mark.parametrize(
    "kind", [pytest.param(kind, marks=[] if kind in QUICK else pytest.mark.slow) for kind in VALUES]
)
def test_verbs_take_them_calmly(kind, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    for i in range(2):
        stack = full_stack(12, 10, seed=i).replace(motion=np.zeros((12, 10, 2)))
        stack.attributes |= {f"ngpt:{name}": VALUES[kind] for name in NAMES}
        ngpt.write(f"{i}.exr", stack)
    assert main(["info", "0.exr", "--json"]) == 0
    assert "ngpt:spp" in json.loads(capsys.readouterr().out)["attributes"]
    for line in (
        "info 0.exr",
        "denoise 0.exr 1.exr -m l2 -q -o out/",
        "denoise 0.exr 1.exr -m l2 -q --temporal -o shot/",
        "report 0.exr 1.exr --ref 1.exr -q -o page.html",
        "report 0.exr -q -o one.html",
    ):
        assert main(line.split()) == 0, line
    capsys.readouterr()
    assert main(["merge", "0.exr", "1.exr", "-o", "merged.exr"]) == 1
    errors = capsys.readouterr().err
    assert errors.count("\n") == 1 and "'ngpt:spp'" in errors
