"""What is particular to ``vcm``: weights with merging, and the light of photons as a layer."""

import numpy as np
import pytest
from bdpt_ends import (
    Ends,
    check_weights,
    compare,
    plan_of,
    without_hole,
)
from bdpt_scenes import SCENES
from renders import dr, mi
from unbiased import light_of_gradients, load

from data_gen.paths.vertex import Materials
from data_gen.render import render_stack
from data_gen.samplers.bdpt import mis
from data_gen.samplers.bdpt.vertex import RADIANCE, Vertex, cosine, evaluate, scatters_smoothly
from data_gen.samplers.photons.map.vertices import Photon
from data_gen.samplers.vcm.merging import Merging
from ngpt.layers import GATHERED

ETA = 0.05


@pytest.fixture(scope="module")
def ends(renderer):
    return ends_of(ETA)


def ends_of(η):
    scene = load(mi, without_hole, (24, 24))
    return Ends(scene, η, Materials(scene, 0.05).connectable, spp=64)


@pytest.mark.parametrize("η", [0.0, ETA])
def test_weights_are_those_of_all_densities(ends, η):
    """Brute force in float64, on stored paths, without merging and with it: no z-test sees every wrong term."""
    check_weights(ends if η else ends_of(η))


def test_weights_of_merging_are_those_of_all_densities(ends):
    """So the weights of all ways to find a path sum to 1, merging at each of its vertices among them."""

    class Gathered:
        η = mi.Float(ETA)

    merging = Merging(Gathered, plan_of(ends.scene, 10))
    for t in range(3):
        for s in range(2, 4):
            y = ends.from_light[s - 1]
            good = ends.from_light[s - 2].sharp & scatters_smoothly(y.bsdf) & ends.connectable(y.bsdf)
            si = mi.SurfaceInteraction3f(y.si)
            if t:
                # The camera path, had it come to y
                z = ends.from_camera[t - 1]
                to = mi.Vector3f(si.p - z.si.p)
                distance2 = dr.squared_norm(to)
                d = to * dr.rsqrt(distance2)
                f, p, q = evaluate(RADIANCE, z.si, z.bsdf, z.si.to_local(d))
                end = mis.leave(z.vertex.end, cosine(z.si, d), p, q, mi.Bool(False))
                end = mis.arrive(end, cosine(si, d), distance2)
                good &= scatters_smoothly(z.bsdf) & (dr.max(f) > 0)
                good &= ~ends.scene.ray_test(z.si.spawn_ray_to(si.p))
            else:
                camera, e = ends.sensor.sample_direction(si, ends.lens)
                d, end = -camera.d, mis.begin_camera(e[0], cosine(si, camera.d))
                good &= camera.pdf > 0
            photon = Photon(si.p, si.n, -si.to_world(si.wi), mi.Spectrum(1))
            si.wi = si.to_local(-d)
            x = Vertex(si, mi.Spectrum(1), end, mi.UInt32(t + 1))
            C, others = merging.merged(x, y.bsdf, photon, y.vertex.end, True)
            path = ends.from_camera[:t] + ends.from_light[:s]
            # Merging comes behind all connections. More of these directions graze than of those seen to carry light.
            strategy = len(path) + 2 + t
            compare(others, ends.brute(t, s)[0], strategy, good & (dr.max(C) > 0), path, worst=0.03, least=30)


# ------------------------- The light of photons -------------------------


def test_the_light_of_photons_is_a_layer_of_its_own(renderer):
    """With the least radius there is hardly any; the image is the sum, and each part has a variance."""
    scene = load(renderer, SCENES["glass"], (24, 16))
    wide, least = (render_stack(scene, 8, 3, "vcm", radius=radius, unbiased=True) for radius in (2.0, 1e-5))
    assert wide.attributes[GATHERED] == 1 and {"caustic_var", "primal_var"} <= set(wide.names)
    share = [stack["caustic"].mean() / stack["primal"].mean() for stack in (wide, least)]
    assert share[0] > 0.02 and share[1] < 1e-3
    assert (wide["primal"] >= wide["caustic"] - 1e-4).all() and (wide["caustic_var"] > 0).any()
    assert GATHERED not in render_stack(scene, 2, 3, "bdpt", unbiased=True).attributes


def beam():
    """A spot that lights only a mirror, which lights a matt floor: all light has come by three edges."""
    import mitsuba as mi

    from data_gen.scenes.builtin import _camera, _diffuse, _rgb, _wall

    toward = mi.ScalarTransform4f().look_at(origin=[0, 1, 0], target=[1, 0.7, 0], up=[0, 1, 0])
    return {
        "type": "scene",
        "integrator": {"type": "path", "max_depth": 3},
        "sensor": _camera([-1.33, 2, 1.5], [-1.33, 0, 0], 50),
        "floor": _wall([0, 0, 0], [0, 1, 0], (8, 8), _diffuse(0.5, 0.5, 0.5)),
        "mirror": _wall([1, 0.7, 0], [-1, 0, 0], (1, 1), {"type": "conductor"}),
        "spot": {"type": "spot", "to_world": toward, "intensity": _rgb(9, 9, 9), "cutoff_angle": 10},
    }


def test_the_longest_paths_merge_too(renderer):
    """``max_depth`` edges: as bright as with room for longer paths, of which there are none."""
    longer = beam() | {"integrator": {"type": "path", "max_depth": 5}}
    light = [
        render_stack(load(renderer, scene, (24, 16)), 16, 3, "vcm", unbiased=True)["primal"].mean()
        for scene in (beam(), longer)
    ]
    assert light[1] > 1e-3 and light[0] == pytest.approx(light[1], rel=0.02)


# ------------------------- Where nothing merges -------------------------


def test_where_nothing_merges_it_is_bdpt(renderer):
    """With a radius of nearly nothing: the same paths from the same random numbers, one by one."""
    scene = load(renderer, SCENES["glass"], (24, 16))
    ours, theirs = (
        light_of_gradients(render_stack(scene, 8, 3, name, unbiased=True, **options).layers)
        for name, options in (("vcm", {"radius": 1e-5}), ("bdpt", {}))
    )
    # A ray that grazes an edge may go another way where its neighbours are others.
    assert np.isclose(ours, theirs, rtol=1e-3, atol=1e-4).mean() > 0.99 and abs(ours.mean() / theirs.mean() - 1) < 0.01
