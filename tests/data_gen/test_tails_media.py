"""Paths that end in the cache within media: which may, and how they scatter there."""

import math

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from media_scenes import filled, hovering
from unbiased import load

from data_gen.paths import media
from data_gen.render import render_stack
from data_gen.scenes.facts import media_of
from data_gen.tails import matt
from data_gen.tails.cache import Trail
from data_gen.tails.table import INSIDE, octahedral
from ngpt.errors import WrongUse


def hg(g):
    return {"type": "hg", "g": g}


# Phase functions, and whether a path may end where they scatter
PHASES = {
    "isotropic": ({"type": "isotropic"}, True),
    "rayleigh": ({"type": "rayleigh"}, True),
    "a little forward": (hg(0.3), True),
    "backward": (hg(-0.5), True),
    "far forward": (hg(0.8), False),
    "table": ({"type": "tabphase", "values": "1, 1, 1"}, False),
}


def values(phase):
    """f in 2,000 directions, for each of their angles to the way the path has come."""
    lanes = 2000
    cosine = dr.linspace(mi.Float, -1, 1, lanes)
    x = dr.zeros(mi.MediumInteraction3f, lanes)
    x.wi = mi.Vector3f(0, 0, 1)
    x.sh_frame = mi.Frame3f(x.wi)
    wo = mi.Vector3f(dr.safe_sqrt(1 - cosine * cosine), 0, cosine)
    return np.array(phase.eval_pdf(mi.PhaseFunctionContext(), x, wo, mi.Bool(True))[0])[0]


@pytest.mark.parametrize("name", PHASES)
def test_what_is_left_of_a_phase_function_is_nowhere_negative(renderer, name):
    """ρ is 4π times the least value: less would make the rest of a path longer, and more would make it negative."""
    description, ends = PHASES[name]
    phase = mi.load_dict(description)
    ρ = matt.even_part(phase)
    assert (ρ > 0) == ends
    if ends:
        assert ρ == pytest.approx(4 * math.pi * values(phase).min(), rel=1e-4)


LANES = 200_000


def scattering(g):
    """Vertices in a medium, seen from above, and where they are."""
    scene = mi.load_dict(filled({"albedo": 0.9, "phase": hg(g)})())
    x = dr.zeros(mi.SurfaceInteraction3f)
    x.sh_frame = mi.Frame3f(mi.Vector3f(1, 0, 0), mi.Vector3f(0, 1, 0), mi.Vector3f(0, 0, 1))
    x.wi, x.t = dr.normalize(mi.Vector3f(0.3, -0.5, 0.8)), mi.Float(1)
    (medium, *_) = media_of(scene)
    return scene, x, media.Place(mi.MediumPtr(medium), mi.Bool(True))


@pytest.mark.parametrize("both", [False, True])
def test_records_sample_all_directions(renderer, both):
    """f / p has mean 1 and 1 / 4πp too, whether half of the directions come evenly; then 1 / 4πp is at most 2."""
    _, x, place = scattering(0.6)
    random = mi.PCG32(LANES)
    u = random.next_float32(), mi.Point2f(random.next_float32(), random.next_float32())
    light = dr.normalize(mi.Vector3f(-1, 2, 0.5))
    f, p, sample, f_p = matt.evaluate_and_sample(mi.BSDFPtr(None), x, place, light, u, mi.Bool(both))
    even = np.array(matt.matt_lobe(x, place, sample.wo) / sample.pdf)
    for weight in (np.array(f_p.x), even):
        assert abs(weight.mean() - 1) < 4 * weight.std() / math.sqrt(len(weight)) + 1e-4
    assert (even.max() <= 2 + 1e-3) == both
    # The density of emitter sampling's direction is the same mixture.
    assert np.allclose(p, 0.5 * (f.x + 1 / (4 * math.pi)) if both else f.x, rtol=1e-4)


def test_a_vertex_in_a_medium_has_no_side(renderer):
    """A step of length t with density p widens the path by t / sqrt(p), at whatever angle it meets the axes."""
    _, x, _ = scattering(0.0)
    trail = Trail.to(mi.Float(1)).on(x, mi.Bool(True), mi.Bool(True), mi.Float(0.25), mi.Bool(True))
    assert trail.spread[0] == pytest.approx(2)
    normals = np.random.default_rng(1).normal(size=(3, 1000))
    assert INSIDE not in np.array(octahedral(dr.normalize(mi.Vector3f(normals))))


def test_the_first_segment_counts_as_a_whole(renderer):
    """Also behind boundaries that bend nothing: the last piece of it may be short."""
    from data_gen.paths.space import Filled

    scene = load(mi, hovering, (8, 8))
    x = dr.zeros(mi.SurfaceInteraction3f, 1)
    x.p, x.t = mi.Point3f(0, 0, 4), mi.Float(0.5)
    assert Filled(scene).length(mi.Point3f(0, 3, 0), x)[0] == 5


def test_who_cannot_share_in_media_says_so(renderer):
    """The light of other integrators of Mitsuba."""
    description = filled({"albedo": 0.9})() | {"integrator": {"type": "direct"}}
    with pytest.raises(WrongUse, match="tails=shared is not possible: the integrator is 'direct'"):
        render_stack(load(mi, description, (8, 8)), 4, 0, "primal", tails="shared")
