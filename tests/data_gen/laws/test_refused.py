"""What samplers cannot render they refuse by name, with what can: one table."""

import media_scenes
import pytest
from bdpt_scenes import SCENES
from data_gen_scenes import fog, hidden_lamp, polished
from unbiased import load

from data_gen.render import render_stack
from data_gen.samplers import find
from data_gen.scenes.facts import Facts
from ngpt.errors import NgptError

FLAT = {"sensor": {"type": "orthographic"}}
PROJECTED = {"lamp": {"type": "projector", "irradiance": 1.0}}


def points(change):
    return lambda: SCENES["points"]() | change


def endless():
    return media_scenes.haze() | {"sky": {"type": "constant"}}


def unseen_fog():
    return fog() | {"integrator": {"type": "path"}}


TABLE = [
    *((name, points(FLAT), {}, "light paths cannot reach a camera 'orthographic'") for name in ("bdpt", "vcm")),
    ("bdpt", points(PROJECTED), {}, r"from emitter 'lamp' \(Projector\); use --sampler gpt"),
    ("vcm", points(PROJECTED), {}, r"from emitter 'lamp' \(Projector\)"),
    *((name, unseen_fog, {}, rf"there are media .*, which '{name}' does not see") for name in ("bdpt", "vcm")),
    ("gpt", unseen_fog, {}, "there are media.*--sampler gpt-basic"),
    ("gpt-simple", lambda: polished(0.01), {}, r"floor.bsdf \(RoughConductor\).*use --sampler gpt"),
    ("gpt-simple", "environment", {}, r"ball.bsdf \(SmoothPlastic\); use --sampler gpt"),
    (
        "gpt-simple",
        "glossy",
        {},
        r"glass.bsdf \(SmoothDielectric\), lacquer.bsdf .*, mirror.bsdf .*; use",
    ),
    ("gpt-simple", fog, {}, "knows only 'path'; use --sampler gpt, or gpt-basic"),
    ("gpt-simple", hidden_lamp, {}, "hides emitters; use --sampler gpt"),
    ("bre", endless, {}, "infinitely far away comes through a medium without end"),
    ("gpt", media_scenes.haze, {"shift": "half-vector"}, "gpt: shift 'half-vector' does not go through media"),
]


@pytest.mark.parametrize(("sampler", "scene", "options", "message"), TABLE)
def test_refused(renderer, sampler, scene, options, message):
    is_refused(renderer, sampler, scene, options, message)


def is_refused(renderer, sampler, scene, options, message):
    with pytest.raises(NgptError, match=message) as refusal:
        render_stack(load(renderer, scene, (8, 8)), 64 if options else 1, sampler=sampler, unbiased=True, **options)
    assert sampler in str(refusal.value)


def test_plugins_refuse_too(renderer):
    with pytest.raises(NgptError, match=r"media \(interior\), which 'gpt-simple' does not see; use --sampler "):
        renderer.load_dict({"type": "gpt_simple"}).prepare(load(renderer, media_scenes.smoke, (8, 8)))


def test_where_there_are_no_media_points_on_surfaces_do():
    with pytest.raises(NgptError, match="there are no media, and 'ppm' has the same image"):
        find("bre", Facts("volpath", ()))


@pytest.mark.parametrize(("sampler", "option", "memory"), [("ppm", "photons", 100), ("vcm", "joined_depth", 13)])
def test_maps_larger_than_memory_are_refused_with_what_fits(renderer, sampler, option, memory):
    scene = load(renderer, "diffuse", (64, 64))
    with pytest.raises(NgptError, match=rf"pass --memory \d+, or .* or no more than -O {option}=\d+") as caught:
        render_stack(scene, 1, 0, sampler, memory=memory, unbiased=True, **{option: 64})
    words = str(caught.value)
    fits, needed = int(words.rsplit("=", 1)[1]), int(words.split("--memory ")[1].split(",")[0])
    assert 1 < fits < 64 and needed > memory
    render_stack(scene, 1, 0, sampler, memory=memory, unbiased=True, **{option: fits})
    with pytest.raises(NgptError, match=r"render a smaller image$"):
        render_stack(scene, 1, 0, sampler, memory=5, unbiased=True)
