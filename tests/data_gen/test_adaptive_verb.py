"""``ngpt render --adaptive`` and ``--error``."""

import json

import pytest

import ngpt
from ngpt.cli import main


def test_an_error_is_reached_and_said(renderer, tmp_path, capsys):
    target = str(tmp_path / "stack.exr")
    options = ["--error", "0.5", "--spp", "48", "--size", "24x16", "--for", "wcv", "--sampler", "gpt", "--json"]
    assert main(["render", "diffuse", "-o", target, *options]) == 0
    printed = capsys.readouterr()
    assert json.loads(printed.out)["adaptive"] == "wcv" and json.loads(printed.out)["error"] <= 0.5
    assert "'wcv' is expected to have an error of" in printed.err


def test_samples_differ_and_are_written(renderer, tmp_path, capsys):
    target = str(tmp_path / "stack.exr")
    options = ["--adaptive", "--spp", "48", "--size", "24x16", "--for", "wcv", "--sampler", "gpt"]
    assert main(["render", "diffuse", "-o", target, *options]) == 0
    stack = ngpt.read(target)
    assert stack.attributes["ngpt:spp"] == 48 and stack["samples"].mean() == 48 and stack["samples"].max() > 48
    assert main(["info", target]) == 0
    assert "samples" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--for", "wcv"], "--for says what --adaptive and --error go by"),
        (["--error", "0.1", "--frames", "0:2"], "--adaptive, --error and --for are for single images"),
        (["--adaptive", "--spp", "64", "--sampler", "bdpt"], "depend on each other"),
    ],
)
def test_refusals(renderer, tmp_path, capsys, options, message):
    target = str(tmp_path / ("frame-{frame}.exr" if "--frames" in options else "stack.exr"))
    assert main(["render", "diffuse", "-o", target, "--size", "8x8", *options]) != 0
    assert message in capsys.readouterr().err


def test_a_pilot_chooses_for_a_method(renderer, tmp_path, capsys, monkeypatch):
    """What it chose is rendered, in the time that is left, and written down."""
    from data_gen.choosing import plans

    asked = []

    def plan(scene, seconds, method, memory, **told):
        asked.append((seconds, method))
        return plans.Plan("primal", "oidn", True, 1.5, "for a test")

    monkeypatch.setattr(plans, "plan", plan)
    target = str(tmp_path / "stack.exr")
    assert main(["render", "diffuse", "-o", target, "--size", "24x16", "--time", "60", "--for", "auto"]) == 0
    said, stack = capsys.readouterr().err, ngpt.read(target)
    assert asked == [(60.0, "auto")] and "method 'oidn': for a test" in said
    assert f"then: ngpt denoise {target}, which takes method 'oidn'" in said
    assert stack.attributes["ngpt:for"] == "oidn" and stack.attributes["ngpt:sampler"] == "primal"
    # The first 16 samples of those that are shared out are rendered in any case, and may have taken all the time.
    assert "samples shared out" in said and stack.attributes["ngpt:spp"] >= 16
    assert stack.attributes["ngpt:seconds"] < 50
