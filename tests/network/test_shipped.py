"""The networks that come with the package, and the weights in the repository that they were made of."""

from pathlib import Path

import pytest

import ngpt
from ngpt.measure.metrics import relmse_trimmed
from ngpt.methods import METHODS
from ngpt.network.safetensors import load_weights

TWINS = Path(__file__).parents[2] / "export" / "weights"
SHIPPED = [
    pytest.param(name, marks=pytest.mark.skipif(bool(METHODS[name].missing()), reason=METHODS[name].missing()))
    for name in ("ngpt-fast", "ngpt-combine", "ngpt-primal", "ngpt")
    if (TWINS / f"{name}.safetensors").is_file()
]


@pytest.fixture(scope="module")
def views(renderer):
    """A stack of 8 samples and a reference of two built-in scenes."""
    from data_gen.render import render_stack
    from data_gen.scenes.load import load_scene

    result = {}
    for name in ("diffuse", "lens"):
        scene = load_scene(name, (96, 64))
        result[name] = (
            render_stack(scene, 8, seed=3, sampler="gpt", unbiased=True),
            render_stack(scene, 256, seed=4, sampler="primal", unbiased=True)["primal"],
        )
    return result


@pytest.mark.parametrize("name", SHIPPED)
def test_a_method_needs_what_its_weights_read_and_says_how_they_were_made(name):
    model, header = load_weights(TWINS / f"{name}.safetensors")
    assert {*METHODS[name].needs, *METHODS[name].estimates} == set(model.config.needs)
    assert {"step", "hours", "settings", "torch", "version"} <= header["training"].keys()
    assert "/" not in str(header["training"]["settings"]["data"]["folders"]), "paths of the machine it was trained on"


@pytest.mark.parametrize("name", SHIPPED)
def test_it_is_better_than_classical_methods_on_scenes_of_its_own_kind(views, name):
    classical = "l1" if "dx" in METHODS[name].needs else "nfor"
    for stack, reference in views.values():
        ours, theirs = (relmse_trimmed(ngpt.denoise(stack, method), reference) for method in (name, classical))
        # Which needs no more layers than it.
        assert ours < theirs
