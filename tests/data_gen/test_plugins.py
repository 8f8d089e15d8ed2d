"""Our integrators as plugins of Mitsuba, from Mitsuba's side: load_dict, print, render, and a stack of the tensor."""

import subprocess
import sys

import numpy as np
import pytest

import ngpt
from ngpt.errors import NgptError
from ngpt.system.install import install_command

pytest.importorskip("mitsuba")

from data_gen.render import render_stack
from data_gen.samplers import SAMPLERS
from data_gen.scenes.facts import Facts
from data_gen.scenes.load import load_scene

LOADED = (
    "integrator = {'type': 'gpt', 'max_depth': 4, 'shift': 'half-vector'}\n"
    "text = str(mi.load_dict(integrator)); assert 'GPT[' in text and 'shift = half-vector' in text, text\n"
)
RENDERED = LOADED + (
    "import numpy as np, ngpt\n"
    "scene = mi.load_dict(mi.cornell_box() | {'integrator': integrator}); assert 'max_depth = 4' in str(scene)\n"
    "mi.traverse(scene.sensors()[0])['film.size'] = [16, 12]\n"
    "stack = ngpt.GradientStack.from_aovs(mi.render(scene, spp=2), scene.integrator().aov_names())\n"
    "assert {'primal', 'direct', 'dx', 'dy', 'albedo', 'primal_var', 'dx_var'} <= set(stack.names)\n"
)
# All are made anew with another variant, those that share a base class beside the one of all as well.
THERE_AND_BACK = """import data_gen, mitsuba as mi
from data_gen.samplers import SAMPLERS
for variant in ("llvm_ad_rgb", "llvm_ad_spectral", "scalar_rgb", "llvm_ad_rgb"):
    mi.set_variant(variant)
    for name in NAMES:
        assert name in SAMPLERS
        try: assert isinstance(mi.load_dict({"type": name.replace("-", "_")}), mi.Integrator), name
        except RuntimeError as error:
            assert "variant 'scalar_rgb' is not vectorised" in str(error), error
            assert variant == "scalar_rgb"
"""
ORDERS = {
    "ours first": "import data_gen, sys; assert 'mitsuba' not in sys.modules\n"
    "import mitsuba as mi; assert mi.variant() is None; mi.set_variant('llvm_ad_rgb')\n" + LOADED,
    "Mitsuba first": "import mitsuba as mi; import data_gen; mi.set_variant('llvm_ad_rgb')\n" + LOADED,
    "variant first": "import mitsuba as mi; mi.set_variant('llvm_ad_rgb'); import data_gen\n" + LOADED,
}


def assert_runs(code):
    told = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert told.returncode == 0, told.stderr[-3000:]
    return told.stdout


@pytest.mark.parametrize("order", ORDERS)
def test_they_are_there_whatever_comes_first(renderer, order):
    assert_runs(ORDERS[order])


def test_they_are_there_whatever_the_variants(renderer):
    assert_there_whatever_the_variants("gpt", "gpt-basic", "ppm", "bre", "vcm")


def assert_there_whatever_the_variants(*names):
    assert_runs(f"NAMES = {names}\n{THERE_AND_BACK}{RENDERED}")


def test_without_mitsuba_the_package_is_imported():
    told = assert_runs(
        "import sys; sys.modules['mitsuba'] = None\nimport data_gen\n"
        "try: data_gen.render_scene('diffuse')\nexcept data_gen.session.NgptError as error: print(error)\n"
    )
    assert install_command("render") in told


# Those of studies are covered by the tests of studies.
ON_SURFACES = [n for n, e in SAMPLERS.items() if e.standing != "study" and not e.refuses(Facts("path", ()))]
PLUGINS = sorted({*ON_SURFACES} - {"primal"})


@pytest.mark.parametrize("name", PLUGINS)
def test_each_renders_what_its_sampler_does(renderer, name):
    scene, entry = load_scene("diffuse", (8, 8)), SAMPLERS[name]
    own = {"integrator": scene.integrator()} if name == "gpt-basic" else {"max_depth": 8}
    integrator = renderer.load_dict({"type": entry.plugin, **own})
    assert str(integrator).startswith(f"{type(integrator).__name__}[")
    spp = max(2, 2 * entry.batch)
    stack = ngpt.GradientStack.from_aovs(integrator.render(scene, spp=spp), integrator.aov_names())
    expected = render_stack(scene, spp, 0, name, unbiased=True)
    assert all(np.array_equal(stack[layer], expected[layer], equal_nan=True) for layer in stack.names)


def test_one_that_is_no_integrator_says_so(renderer):
    with pytest.raises(RuntimeError, match=r"is no integrator of Mitsuba; use data_gen.render_scene"):
        renderer.load_dict({"type": "primal"})


def test_a_tensor_that_is_no_stack_is_told_why():
    names = ["primal.R", "primal.G", "primal.B", "depth.Z"]
    stack = ngpt.GradientStack.from_aovs(np.arange(24.0).reshape(2, 3, 4), names, {"ngpt:spp": 4})
    assert stack["depth"][0, 1, 0] == 7 and stack["primal"][1, 0, 2] == 14 and stack.attributes["ngpt:spp"] == 4
    for shape, given, message in (
        ((2, 3, 4), names[:3], r"shape \(2, 3, 4\) and there are 3 names"),
        ((2, 3, 3), names[1:], "layer 'primal' lacks primal.R"),
        ((2, 3, 4), [*names[:3], "Q.X"], "no layer is called 'Q'"),
    ):
        with pytest.raises(NgptError, match=message):
            ngpt.GradientStack.from_aovs(np.zeros(shape), given)
