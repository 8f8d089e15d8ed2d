"""Laws of samplers in scenes that are of interest for studies; those of quick scenes are in tests/data_gen/laws."""

import media_scenes
import pytest
from bdpt_scenes import SCENES as OF_ALL_LAMPS
from camera_cases import CAMERAS
from data_gen_scenes import caustics, fog, hidden_lamp
from reference_scenes import BENT, SMALL
from registered import slow
from test_bits import have_the_same_bits
from test_cameras import check
from test_energy import have_no_gradients
from test_frozen import assert_a_scene_goes_with_its_last_render, assert_paths_are_recorded_once
from test_plugins import assert_there_whatever_the_variants
from test_points import assert_claims_are_those_over_seeds
from test_refused import FLAT, endless, is_refused, points
from test_unbiased import LONG, Case, holds
from unbiased import FAR, load

from data_gen.adaptive import Adaptive
from data_gen.samplers import SAMPLERS, find
from data_gen.scenes.facts import Facts
from ngpt.errors import NgptError

QUICK = [Case("gbdpt", "lit: sky", (FAR,))]
CASES = [
    Case("gbdpt", "curtains", (FAR,), spp=64),
    Case("gbdpt", "few_edges", (FAR,), size=SMALL, spp=64),
    *(Case("gbdpt", f"lit: {scene}", (FAR,), spp=64) for scene in OF_ALL_LAMPS),
    *(Case("gbdpt", "lit: areas", (FAR,), {"joined_depth": depth}, spp=64) for depth in (1, 3)),
    *(Case("gbdpt", scene, by="bdpt", spp=64) for scene in BENT),
    *(Case("gpt-tiles", scene, spp=64) for scene in ("diffuse", "glossy", "lens", "courtyard")),
    Case("gpt-tiles", "courtyard", (1,), {"tile": 2}, **LONG),
    Case("gpt-tiles", "courtyard", (1,), {"tile": 4}, **LONG),
    *(Case("split", scene, **LONG) for scene in ("glossy", "environment", "lens", "everything")),
]


@pytest.mark.parametrize("case", [*QUICK, *(slow(case, id=f"{case}-long") for case in CASES)], ids=str)
def test_unbiased(renderer, case):
    holds(renderer, case)


REFUSED = [
    ("gbdpt", points(FLAT), {}, "light paths cannot reach a camera 'orthographic'"),
    ("gpt-tiles", fog, {}, "'gpt-tiles' knows only 'path'"),
    ("gpt-tiles", hidden_lamp, {}, "hides emitters; use --sampler gpt"),
    ("gpt-tiles", "diffuse", {"adaptive": Adaptive()}, "'gpt-tiles' depend on each other and cannot be adaptive"),
    ("gbeams", media_scenes.smoke, {}, r"density varies.* use --sampler gpt, .*bre \(no gradients\), .*gvpm"),
    ("vpm", endless, {}, "infinitely far away comes through a medium without end"),
    ("split", fog, {}, "'split' knows only 'path'"),
    ("split", hidden_lamp, {}, "hides emitters; use --sampler gpt"),
]


@pytest.mark.parametrize(("sampler", "scene", "options", "message"), REFUSED)
def test_refused(renderer, sampler, scene, options, message):
    is_refused(renderer, sampler, scene, options, message)


def test_plugins_refuse_too(renderer):
    with pytest.raises(NgptError, match=r"'gbre' .* media whose density varies, .*; use --sampler gpt, .* bre"):
        renderer.load_dict({"type": "gbre"}).prepare(load(renderer, media_scenes.smoke, (8, 8)))


def test_plugins_are_made_anew_for_each_variant(renderer):
    """Those that share a base class beside the one of all as well."""
    assert_there_whatever_the_variants("vpm", "gvpm", "gvcm")


def test_where_there_are_no_media_points_on_surfaces_do():
    with pytest.raises(NgptError, match="there are no media, and 'ppm' has the same image"):
        find("vpm", Facts("volpath", ()))


@pytest.mark.slow
@pytest.mark.parametrize("name", ["vpm", "gvpm", "beams"])
def test_photons_in_grids_give_the_same_bits_whatever_the_passes(renderer, monkeypatch, name):
    have_the_same_bits(renderer, monkeypatch, name, media_scenes.wisps, 3)


@pytest.mark.slow
def test_paths_from_both_ends_give_the_same_bits_whatever_the_passes(renderer, monkeypatch):
    have_the_same_bits(renderer, monkeypatch, "gbdpt", caustics, 32)


CLAIMS = [
    # Over passes of eight: two, which say nothing of a net, and three, where the claim was 1.3 times the noise
    ("gbdpt", "diffuse", (48, 32), 16),
    ("gbdpt", "diffuse", (48, 32), 24),
    ("gpm", "glossy", (32, 24), 9),
    ("gbre", fog, (32, 24), 9),
]


@pytest.mark.slow
@pytest.mark.parametrize(("name", "scene", "size", "spp"), CLAIMS)
def test_claims_are_those_over_seeds(renderer, name, scene, size, spp):
    assert_claims_are_those_over_seeds(renderer, name, scene, size, spp)


@pytest.mark.parametrize("scene", [slow("diffuse"), "lens"])
def test_paths_from_both_ends_are_recorded_once(renderer, recordings, scene):
    assert_paths_are_recorded_once(renderer, recordings, "gbdpt", scene)


@pytest.mark.parametrize("name", [slow("gpm"), "gbdpt", "restir"])
def test_a_scene_goes_with_its_last_render(renderer, name):
    assert_a_scene_goes_with_its_last_render(renderer, name)


@pytest.mark.parametrize("name", ["split", "gpt-tiles", "gpm", "gvcm", "gbdpt"])
def test_paths_of_no_edge_and_of_one_have_no_gradients(renderer, name):
    have_no_gradients(renderer, name)


@pytest.mark.slow
@pytest.mark.parametrize("view", CAMERAS)
@pytest.mark.parametrize("name", [name for name, entry in SAMPLERS.items() if entry.standing == "study"])
def test_cameras(renderer, name, view):
    check(renderer, name, view, batches=10, spp=8 if SAMPLERS[name].batch == 1 else 16)
