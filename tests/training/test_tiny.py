"""The whole way on the built-in scenes: render, train, reconstruct what was held out."""

import json
import runpy

import pytest

import ngpt
from ngpt.measure.metrics import relmse_trimmed

TRAINING, HELD_OUT = ("diffuse", "glossy", "environment"), "lens"


def render_views(folder):
    from data_gen.render import render_stack
    from data_gen.scenes.load import load_scene

    for name in (*TRAINING, HELD_OUT):
        view = folder / name
        view.mkdir(parents=True)
        scene = load_scene(name, (128, 96))
        for spp in (4, 16):
            ngpt.write(view / f"{spp}.exr", render_stack(scene, spp, seed=spp))
        converged = render_stack(scene, 128, seed=0)
        reference = ngpt.GradientStack.from_arrays(primal=ngpt.denoise(converged, "wcv"), direct=converged["direct"])
        ngpt.write(view / "reference.exr", reference)


@pytest.mark.slow
def test_a_network_trained_in_a_minute_halves_the_error_of_a_scene_it_never_saw(renderer, tmp_path):
    render_views(tmp_path / "views")
    folders = [f"--set=data.folders=['{tmp_path / 'views'}']", f"--set=data.validation=['{HELD_OUT}']"]
    out = tmp_path / "run"
    assert runpy.run_path("train.py")["main"](["--config", "configs/tiny.toml", "--out", str(out), *folders]) == 0
    log = [json.loads(line) for line in (out / "log.jsonl").read_text().splitlines()]
    scores = [entry for entry in log if "relMSE" in entry]
    assert scores[-1]["relMSE"] < 0.5 * scores[-1]["relMSE primal"]
    # What a user gets from the weights is what training said.
    reference = ngpt.read(str(tmp_path / "views" / HELD_OUT / "reference.exr"))["primal"]
    stack = ngpt.read(str(tmp_path / "views" / HELD_OUT / "4.exr"))
    image = ngpt.denoise(stack, "ngpt", weights=str(out / "weights.safetensors"))
    assert relmse_trimmed(image, reference) < 0.5 * relmse_trimmed(stack["primal"], reference)
