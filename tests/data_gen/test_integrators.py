"""Scenes whose integrators our samplers do not follow by name: rendered as by Mitsuba, or refused in a line."""

import mitsuba as mi
import numpy as np
import pytest

import data_gen
from data_gen.inspect import inspect_scene
from data_gen.paths.walk import Limits
from data_gen.samplers import choose, described
from data_gen.scenes.facts import scene_facts
from data_gen.scenes.integrators import followed, plugin_name
from ngpt.errors import NgptError

SCENE = """<scene version="3.0.0">{integrator}
<sensor type="perspective"><float name="fov" value="50"/>
<transform name="to_world"><lookat origin="0,-3,5" target="0,0,0" up="0,0,1"/></transform>
<film type="hdrfilm"><integer name="width" value="16"/><integer name="height" value="12"/><rfilter type="box"/></film>
</sensor>
<emitter type="constant"><rgb name="radiance" value=".3,.4,.5"/></emitter>
<shape type="sphere"><point name="center" x="0.5" y="-0.6" z="2"/><float name="radius" value="0.4"/>
<emitter type="area"><rgb name="radiance" value="3,2,1"/></emitter></shape>
<shape type="rectangle"><transform name="to_world"><scale value="2"/></transform></shape>
<shape type="cube"><transform name="to_world"><scale value="0.5"/></transform></shape>
</scene>"""
# The scene's integrator, the integrator whose image it is, and the sampler that "auto" takes for it
CASES = {
    "none": ("path", "gpt"),
    "prb": ("path", "gpt"),
    "prb, hiding": ("path", "gpt"),
    "prb_basic": ("path", "gpt"),
    "prb_projective": ("path", "gpt"),
    "prb_projective, hiding": ("prb_projective", "gpt-basic"),
    "direct_projective": ("path", "gpt"),
    "direct_projective, hiding": ("direct_projective", "gpt-basic"),
    "prbvolpath": ("volpath", "gpt"),
    "direct": ("direct", "gpt-basic"),
    "aov": ("path", "gpt"),
    "volprim_rf_basic": ("volprim_rf_basic", "gpt-basic"),
}
AOV = '<integrator type="aov"><string name="aovs" value="z:depth"/>{}</integrator>'
DEPTH_2 = '<integrator type="prb" name="inmost"><integer name="max_depth" value="2"/></integrator>'


def integrator(case):
    name, _, hiding = case.partition(", ")
    if name == "aov":
        return AOV.format(f'<integrator type="moment" name="inner">{DEPTH_2}</integrator>')
    hides = '<boolean name="hide_emitters" value="true"/>' if hiding else ""
    return "" if name == "none" else f'<integrator type="{name}">{hides}</integrator>'


@pytest.fixture
def scene_file(renderer, tmp_path):
    def write(integrator):
        path = tmp_path / "scene.xml"
        path.write_text(SCENE.format(integrator=integrator))
        return str(path)

    return write


@pytest.mark.parametrize("case", CASES)
def test_a_loaded_scene_and_its_file_are_told_apart_alike(scene_file, case):
    followed, sampler = CASES[case]
    file = scene_file(integrator(case))
    facts, told = scene_facts(data_gen.load_scene(file)), inspect_scene(file)
    assert facts.integrator == followed and choose(facts)[0] == sampler
    assert described(facts)[0] == told["sampler"] == "primal"
    outer = case.split(",")[0]
    line = f"integrator '{outer}': the image of '{followed}' is rendered"
    assert (line in told["plan"]) == (followed not in (outer, "path" if outer == "none" else ""))


QUICK = ["prbvolpath", "prb_projective, hiding"]
SLOW = [case for case in CASES if case not in (*QUICK, "none", "volprim_rf_basic")]


@pytest.mark.parametrize("case", [*QUICK, *(pytest.param(case, marks=pytest.mark.slow) for case in SLOW)])
def test_the_image_is_the_one_that_mitsuba_renders(renderer, scene_file, case):
    file = scene_file(integrator(case))
    scene = renderer.load_file(file)
    theirs = [np.array(renderer.render(scene, spp=64, seed=100 + i))[..., :3] for i in range(6)]
    for sampler in ("auto", "primal"):
        ours = [data_gen.render_scene(file, 32, i, sampler, points="independent") for i in range(6)]
        a, b = np.array([stack["primal"] for stack, _ in ours]), np.array(theirs)
        # Means of quarters of the image, which are independent of each other
        a, b = (x.reshape(6, 2, 6, 2, 8, 3).mean(axis=(2, 4, 5)) for x in (a, b))
        z = (a.mean(axis=0) - b.mean(axis=0)) / np.sqrt((a.var(axis=0, ddof=1) + b.var(axis=0, ddof=1)) / 6 + 1e-12)
        assert b.mean() > 0.01 and np.abs(z).max() < 5, f"{sampler}: {z}"


def test_depths_and_what_hides_are_taken_over(renderer):
    given = {"max_depth": 4, "rr_depth": 3, "hide_emitters": True}
    for name, same in {"prb": "path", "prb_basic": "path", "prbvolpath": "volpath"}.items():
        found = followed(renderer.load_dict({"type": name, **given}))
        assert plugin_name(found) == same and Limits.of(found).parameters() == given
    assert Limits.of(followed(renderer.load_dict({"type": "prb", "max_depth": -1}))).parameters()["max_depth"] == -1
    assert Limits.of(followed(renderer.load_dict({"type": "direct_projective"}))).max_depth == 2


def test_an_integrator_of_ones_own_is_called_as_mitsuba_calls_it(renderer):
    """As ``ADIntegrator.render`` does: with keywords. The integrator may leave some of them to ``**kwargs``."""

    class Grey(mi.ad.integrators.common.ADIntegrator):
        def sample(self, mode, scene, sampler, ray, active, **kwargs):
            assert {"depth", "δL", "δaovs", "state_in"} == kwargs.keys()
            return mi.Spectrum(0.25), active, [], None

    class Broken(Grey):
        def sample(self, mode, scene, sampler, ray, active, **kwargs):
            raise KeyError("no such thing")

    mi.register_integrator("grey", lambda props: Grey(props))
    mi.register_integrator("broken", lambda props: Broken(props))
    camera = {"type": "perspective", "film": {"type": "hdrfilm", "width": 4, "height": 3}}
    parts = {"type": "scene", "sensor": camera, "shape": {"type": "sphere"}}
    grey, broken = (mi.load_dict({**parts, "integrator": {"type": name}}) for name in ("grey", "broken"))
    for sampler in ("auto", "primal", "gpt-basic"):
        assert np.all(data_gen.render_scene(grey, 2, sampler=sampler).stack["primal"] == 0.25), sampler
        with pytest.raises(NgptError, match=r"integrator 'Broken' fails .*KeyError: 'no such thing'"):
            data_gen.render_scene(broken, 2, sampler=sampler)
    with pytest.raises(NgptError, match="the integrator is 'Grey', and 'gpt' knows only 'path'"):
        data_gen.render_scene(grey, 2, sampler="gpt")


@pytest.mark.parametrize(
    ("inside", "message"),
    [
        ('<integrator type="ptracer"/>', "integrator 'ptracer' does not trace paths from the camera"),
        (AOV.format(""), "integrator 'aov' has no other in it, so it renders no colour; put a 'path'"),
    ],
)
def test_what_has_no_image_for_a_stack_is_refused_by_all_alike(scene_file, inside, message):
    file = scene_file(inside)
    for sampler in ("auto", "gpt", "primal", "gpt-basic", "bdpt"):
        with pytest.raises(NgptError, match=message):
            data_gen.render_scene(file, 1, sampler=sampler)
    assert any(message in line for line in inspect_scene(file)["plan"])
