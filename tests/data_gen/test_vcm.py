"""What is particular to ``vcm``: weights with merging, the map of light paths, its image, refusals.

That it repeats its bits, says how noisy it is and stays within its memory is among the laws of all samplers.
"""

import numpy as np
import pytest
from bdpt_ends import Ends, check_weights, compare, plan_of, without_hole
from bdpt_scenes import SCENES
from unbiased import REFERENCES, light_of_gradients, load

from ngpt.errors import NgptError

ETA = 0.05


@pytest.fixture(scope="module")
def ends(renderer):
    from data_gen.paths.vertex import Materials

    scene = load(renderer, without_hole, (24, 24))
    return Ends(renderer, scene, ETA, Materials(scene, 0.05).connectable, spp=64)


def test_weights_count_merging_too(ends):
    """Of all connections, brute force in float64."""
    check_weights(ends)


def test_weights_of_merging_are_those_of_all_densities(ends):
    """So the weights of all ways to find a path sum to 1, merging at each of its vertices among them."""
    import drjit as dr

    from data_gen.samplers.bdpt import mis
    from data_gen.samplers.bdpt.vertex import RADIANCE, Vertex, cosine, evaluate, scatters_smoothly
    from data_gen.samplers.photons.map.photon import Photon
    from data_gen.samplers.vcm.merging import Merging

    class Gathered:
        η = ends.mi.Float(ETA)

    merging = Merging(Gathered, plan_of(ends.scene, 10))
    for t in range(3):
        for s in range(2, 4):
            (y, _, y_bsdf, _), (*_, delta) = ends.from_light[s - 1], ends.from_light[s - 2]
            good = delta & scatters_smoothly(y_bsdf) & ends.connectable(y_bsdf)
            si = ends.mi.SurfaceInteraction3f(y.si)
            if t:
                # The camera path, had it come to y
                z, _, z_bsdf, _ = ends.from_camera[t - 1]
                to = ends.mi.Vector3f(y.si.p - z.si.p)
                distance2 = dr.squared_norm(to)
                d = to * dr.rsqrt(distance2)
                f, p, q = evaluate(RADIANCE, z.si, z_bsdf, z.si.to_local(d))
                end = mis.leave(z.end, cosine(z.si, d), p, q, ends.mi.Bool(False))
                end = mis.arrive(end, cosine(y.si, d), distance2)
                good &= scatters_smoothly(z_bsdf) & (dr.max(f) > 0)
                good &= ~ends.scene.ray_test(z.si.spawn_ray_to(y.si.p))
            else:
                camera, e = ends.sensor.sample_direction(y.si, ends.lens)
                d, end = -camera.d, mis.begin_camera(e[0], cosine(y.si, camera.d))
                good &= camera.pdf > 0
            si.wi = si.to_local(-d)
            x = Vertex(si, ends.mi.Spectrum(1), end, ends.mi.UInt32(t + 1))
            photon = Photon(y.si.p, y.si.n, -y.si.to_world(y.si.wi), ends.mi.Spectrum(1))
            C, others = merging.merged(x, y_bsdf, photon, y.end, True)
            vertices = ends.from_camera[:t] + ends.from_light[:s]
            # Merging at the first vertex that the camera sees comes behind all connections.
            densities = ends.densities(t, s)
            connections = len(vertices) + 2
            # More of these directions graze than of connections that were seen to carry light.
            compare(others, densities, connections + t, good & (dr.max(C) > 0), vertices, worst=0.03, least=30)


def test_where_nothing_merges_it_is_bdpt(renderer):
    """With a radius of nearly nothing: the same paths from the same random numbers, one by one."""
    from data_gen.render import render_stack

    scene = load(renderer, SCENES["glass"], (24, 16))
    ours = light_of_gradients(render_stack(scene, 8, 3, "vcm", radius=1e-5).layers)
    theirs = light_of_gradients(render_stack(scene, 8, 3, "bdpt").layers)
    close = np.isclose(ours, theirs, rtol=1e-3, atol=1e-4)
    # A ray that grazes an edge may go another way where its neighbours are others.
    assert close.mean() > 0.99 and abs(ours.mean() / theirs.mean() - 1) < 0.01


def images(scene, sampler, n, spp=1, **options):
    """Independent images of one pass each, without emission seen directly: (n, H, W, 3); kernels recorded once."""
    from data_gen.film import GradientFilm
    from data_gen.passes import recording
    from data_gen.paths.camera import CameraSamples
    from data_gen.samplers import find

    passes, sensor, found = find(sampler).made(scene, **options), scene.sensors()[0], []
    width, height = (int(size) for size in sensor.film().crop_size())
    for i in range(n):
        film = GradientFilm(width, height, batches=True)
        with recording():
            passes(CameraSamples(sensor, i if sampler == "vcm" else REFERENCES + i, spp), film)
            film.end_pass(spp)
        found.append(light_of_gradients(film.develop()))
    return np.stack(found)


def blocks(images, block=6):
    """Means of blocks of pixels over images, and the variances of those."""
    n, height, width, _ = images.shape
    x = images.reshape(n, height // block, block, width // block, block, 3).mean(axis=(2, 4))
    return x.mean(axis=0), x.var(axis=0, ddof=1) / n


def assert_same_image(ours, theirs, share=0.02):
    """Means of blocks differ by no more than 4 standard errors and a share of the image, which may be bias."""
    (a, a_var), (b, b_var) = blocks(ours), blocks(theirs)
    off = np.abs(a - b) - 4 * np.sqrt(a_var + b_var)
    assert b.mean() > 0.01 and off.max() < share * b.mean(), (off.max(), b.mean())


@pytest.mark.parametrize(
    "name", [*(pytest.param(name, marks=pytest.mark.slow) for name in ("areas", "sky")), "glass", "points"]
)
def test_small_radii_have_the_image_of_bdpt(renderer, name):
    """All lights, mirrors, glass, holes: whatever merging finds is found less by connections."""
    scene = load(renderer, SCENES[name], (24, 24))
    assert_same_image(images(scene, "vcm", 64, radius=0.5), images(scene, "bdpt", 8, 32))


def seen_through_glass():
    """A floor under a pane of thick glass, lit through it by a point: no connection finds that light."""
    floor = {
        key: value for key, value in SCENES["points"]().items() if key in ("type", "integrator", "sensor", "floor")
    }
    pane = {"type": "cube", "bsdf": {"type": "dielectric"}}
    import mitsuba as mi

    pane["to_world"] = mi.ScalarTransform4f().translate([0, 0.3, 0]).scale([5, 0.1, 5])
    return floor | {"pane": pane, "point": {"type": "point", "position": [0, 2, 0], "intensity": 5.0}}


def test_light_that_merging_alone_finds(renderer):
    """As much as ``ppm`` does, where ``bdpt`` is black."""
    scene = load(renderer, seen_through_glass, (24, 24))
    photons = images(scene, "ppm", 32, radius=2.0)
    assert_same_image(images(scene, "vcm", 32, radius=2.0), photons)
    assert images(scene, "bdpt", 1, 8).mean() < 0.01 * photons.mean()


@pytest.mark.slow
def test_vcm_converges_where_only_merging_finds_the_light(renderer):
    """The error of the mean over n passes falls about like n^(-2/3)."""
    from data_gen.render import render_stack

    scene = load(renderer, seen_through_glass, (24, 24))
    reference = render_stack(scene, 768, REFERENCES, "ppm", photons=4, radius=1.0)["primal"]

    def error(n):
        x = render_stack(scene, n, 0, "vcm", radius=2.0)["primal"]
        return np.mean((x - reference) ** 2 / (reference**2 + 0.01))

    counts = 4, 16, 64, 256
    slope, _ = np.polyfit(np.log(counts), np.log([error(n) for n in counts]), 1)
    assert slope < -0.55


def test_kernels_of_vcm_are_recorded_once(renderer, recordings):
    """But for widths that happen to be equal; other passes launch them again."""
    from data_gen.film import GradientFilm
    from data_gen.passes import recording
    from data_gen.paths.camera import CameraSamples
    from data_gen.samplers import find

    scene = load(renderer, "diffuse", (16, 12))
    passes, film = find("vcm").made(scene), GradientFilm(16, 12, batches=True)
    for i in range(4):
        with recording():
            passes(CameraSamples(scene.sensors()[0], 3, 1, i), film)
            film.end_pass(1)
    assert len(recordings.of) == 3 and recordings.total() <= 4


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            {"sensor": {"type": "orthographic"}},
            "'vcm' cannot .* light paths cannot reach a camera .orthographic",
        ),
        ({"lamp": {"type": "projector", "irradiance": 1.0}}, r"'vcm' cannot .* from emitter 'lamp' \(Projector\)"),
    ],
)
def test_what_vcm_cannot_render(renderer, change, message):
    from data_gen.render import render_stack

    scene = load(renderer, lambda: SCENES["points"]() | change, (8, 8))
    with pytest.raises(NgptError, match=message):
        render_stack(scene, 1, 0, "vcm")


def test_maps_of_vcm_larger_than_memory_are_refused_with_what_fits(renderer):
    from data_gen.render import render_stack

    scene = load(renderer, "diffuse", (128, 128))
    with pytest.raises(NgptError, match=r"pass --memory \d+, or .* or no more than -O joined_depth=\d+") as caught:
        render_stack(scene, 1, 0, "vcm", memory=50, joined_depth=64)
    fits = int(str(caught.value).rsplit("=", 1)[1])
    assert 1 < fits < 64
    render_stack(scene, 1, 0, "vcm", memory=50, joined_depth=fits)
    with pytest.raises(NgptError, match=r"render a smaller image$"):
        render_stack(scene, 1, 0, "vcm", memory=20)


def test_spectra_are_refused_by_vcm(renderer):
    from data_gen.backend import use_variant
    from data_gen.render import render_stack

    try:
        use_variant("llvm_ad_spectral")
        with pytest.raises(NgptError, match="'llvm_ad_spectral' each path has wavelengths of its own, and 'vcm'"):
            render_stack(load(renderer, "diffuse", (8, 8)), 1, 0, "vcm")
    finally:
        use_variant()


def test_scenes_without_lights_are_black_for_vcm(renderer):
    from data_gen.render import render_stack

    def dark():
        return {key: value for key, value in SCENES["points"]().items() if key not in ("point", "spot", "sun")}

    stack = render_stack(load(renderer, dark, (8, 8)), 2, 0, "vcm")
    assert not stack["primal"].any() and stack["albedo"].any()


def test_media_are_refused_by_vcm():
    from data_gen.samplers import find
    from data_gen.scenes.facts import Facts

    with pytest.raises(NgptError, match=r"there are media .*, which 'vcm' does not see"):
        find("vcm", Facts("path", ("air",)))
