"""Cameras: every sampler before every one of Mitsuba's, right or refused; and what samplers know of a camera."""

from functools import partial

import numpy as np
import pytest
from camera_cases import (
    CAMERAS,
    camera,
    card,
    compare,
    corner,
    described,
    film,
    orthographic,
    perspective,
    scene_with,
    stacks_of,
)
from references import references
from unbiased import load

from data_gen.samplers import SAMPLERS
from ngpt.errors import NgptError

pytest.importorskip("mitsuba")

from data_gen.frames.motion import motion_vectors, seen, snapshot
from data_gen.paths.camera import CameraSamples
from data_gen.paths.eye import Eye
from data_gen.paths.light_ends import LightEnds
from data_gen.render import render_stack
from data_gen.samplers.photons.map.fog import Fog
from data_gen.samplers.photons.map.radius import pixel_width
from data_gen.samplers.shared import unreachable_camera
from data_gen.scenes.facts import Facts
from data_gen.scenes.lamps import lamp_weights

# Where light paths end at the camera, and elsewhere
QUICK = [("bdpt", "principal point"), ("gpt", "principal point, crop")]
CORE = [name for name, entry in SAMPLERS.items() if entry.standing != "study"]
SLOW = [(name, view) for view in CAMERAS for name in CORE if (name, view) not in QUICK]
# Of a layer: a cell of the matrix fails by chance once in 3000 times.
LEVEL = 1e-4


def check(mi, sampler, view, batches, spp, media=False):
    """The sampler is right before that camera, or refuses it. Where it renders nothing but media, there are some."""
    entry = SAMPLERS[sampler]
    media = media or bool(entry.refuses(Facts("path", ())))
    scene, by_photons = scene_with(mi, view, media), "photons" in entry.options
    kind = view if view == "irradiancemeter" else CAMERAS[view]()["sensor"]["type"]
    if (
        view in ("batch", "radiancemeter, scaled")
        or (unreachable_camera in entry.refusals and kind not in ("perspective", "thinlens"))
        or (by_photons and kind not in ("perspective", "thinlens", "orthographic"))
    ):
        with pytest.raises(NgptError, match=rf"camera '{kind}'.*; (use --sampler gpt|remove <scale>|take its cameras)"):
            stacks_of(scene, sampler, 1, 1)
        return
    stacks = stacks_of(scene, sampler, batches, spp)
    expected = references(mi, partial(described, view, media))
    assert expected.mean() > 0.01
    for layer, result in compare(stacks, expected, LEVEL, slack=0.01 if by_photons else 0.0):
        assert result.passed, f"{layer}: {result}"


@pytest.mark.parametrize(("sampler", "view"), QUICK)
def test_right(renderer, sampler, view):
    check(renderer, sampler, view, batches=8, spp=16)


@pytest.mark.slow
@pytest.mark.parametrize(("sampler", "view"), SLOW)
def test_right_or_refused(renderer, sampler, view):
    check(renderer, sampler, view, batches=10, spp=8 if SAMPLERS[sampler].batch == 1 else 16)


@pytest.mark.parametrize("sampler", ["gpt", pytest.param("gpt-basic", marks=pytest.mark.slow)])
def test_fog_ends_at_the_far_plane(renderer, sampler):
    """Nothing scatters beyond it, and what does not scatter before it is gone."""
    check(renderer, sampler, "far plane", batches=10, spp=32, media=True)


def eye_of(mi, sensor, samples=64):
    """Camera samples and their rays, and the eye, of a sensor that a dictionary describes."""
    samples = CameraSamples(mi.load_dict(sensor), 0, samples)
    return samples, samples.rays()[0], Eye.of(samples)


def at(mi, p):
    import drjit as dr

    si = dr.zeros(mi.SurfaceInteraction3f, dr.width(p))
    si.p = p
    return si


@pytest.mark.parametrize("view", ["perspective", "thin lens", "mirrored", "principal point", "principal point, crop"])
def test_the_importance_of_a_camera_is_the_density_of_its_rays(renderer, view):
    """On all of the film: Mitsuba's own is 0 in the part that an offset of the principal point adds."""
    mi = renderer
    samples, ray, eye = eye_of(mi, CAMERAS[view]()["sensor"])
    to, importance = eye.toward(at(mi, ray(1.7)), samples.lens)
    assert np.allclose(np.array(to.uv), np.array(samples.position), atol=1e-4) and np.all(np.array(to.pdf) == 1)
    assert np.allclose(np.array(to.d), -np.array(ray.d), atol=1e-5)
    # Points on two neighbouring rays lie a pixel apart across the ray: that many square metres are a pixel.
    width, height = samples.size
    beside = [np.array(d, np.float64) for d in (ray.d, ray.d_x, ray.d_y)]
    n = np.array(eye.sensor.world_transform() @ mi.Vector3f(0, 0, 1), np.float64).reshape(3, 1)
    plane = [d / (d * n).sum(axis=0) for d in beside]
    pixel = np.linalg.norm(np.cross(plane[1] - plane[0], plane[2] - plane[0], axis=0), axis=0)
    cos, distance = (beside[0] * n).sum(axis=0), np.array(to.dist, np.float64)
    assert np.allclose(np.array(importance), 1 / (pixel * width * height * cos**3 * distance**2), rtol=2e-3)


def test_our_rays_of_a_thin_lens_are_those_of_mitsuba(renderer):
    samples, _, eye = eye_of(renderer, CAMERAS["thin lens"]()["sensor"])
    ours = eye.ray(samples.position, samples.lens)
    theirs, _ = eye.sensor.sample_ray(samples.time, samples.wavelength, samples.position * samples.steps, samples.lens)
    for name in ("o", "d", "maxt", "time"):
        assert np.allclose(getattr(ours, name), getattr(theirs, name), rtol=1e-4, atol=1e-5), name


@pytest.mark.parametrize("kind", ["perspective", "thinlens"])
def test_what_the_near_plane_cuts_away_hides_nothing(renderer, kind):
    mi = renderer
    lens = {"aperture_radius": 0.1} if kind == "thinlens" else {}
    sensor = camera(kind, fov=40, near_clip=1.6, far_clip=4.0, **lens)
    samples, ray, eye = eye_of(mi, sensor)
    scene = mi.load_dict({"type": "scene", **card()})
    si = at(mi, ray(1.0))
    to, _ = eye.toward(si, samples.lens)
    begins = np.array(ray.o)
    assert np.allclose(np.array(to.p), begins, atol=1e-5)
    assert not np.array(scene.ray_test(si.spawn_ray_to(to.p))).any()
    lens_point = mi.Point3f(to.p + to.d * (to.dist - 1.0))
    assert np.array(scene.ray_test(si.spawn_ray_to(lens_point))).mean() > 0.05
    # Beyond the far plane and before the near one there is nothing to see.
    for t, density in ((-0.2, 0), (0.01, 1), (2.2, 1), (3.0, 0)):
        assert np.all(np.array(eye.toward(at(mi, ray(t)), samples.lens)[0].pdf) == density)


def rendered(mi, sensor):
    to_world = mi.ScalarTransform4f().look_at([0, 0, -1], [0.5, 0.3, 0], [0, 1, 0]).scale(20)
    wall = {"type": "rectangle", "to_world": to_world}
    scene = {"type": "scene", "sensor": sensor, "light": {"type": "constant"}, "wall": wall}
    return render_stack(load(mi, scene), 4, sampler="primal", unbiased=True)


@pytest.mark.parametrize("kind", ["perspective", "thinlens", "orthographic"])
def test_depth_is_from_the_camera_and_not_from_its_near_plane(renderer, kind):
    more = {"perspective": {"fov": 40}, "thinlens": {"fov": 40, "aperture_radius": 0.01}}.get(kind, {})
    near, far = (rendered(renderer, camera(kind, near_clip=clip, **more)) for clip in (0.01, 2.0))
    assert near["depth"].min() > 3 and np.allclose(near["depth"], far["depth"], rtol=1e-4)


def test_features_do_not_depend_on_how_an_orthographic_camera_is_scaled(renderer):
    scales = (1.0, [1.5, 0.7, 1.0], [1.5, 0.7, 3.0])
    even, flat, deep = (rendered(renderer, orthographic(scale, near_clip=1.0)["sensor"]) for scale in scales)
    assert np.allclose(flat["depth"], deep["depth"], rtol=1e-4) and flat["depth"].min() > 3
    assert all(np.allclose(stack["normal"], even["normal"][0, 0], atol=1e-4) for stack in (even, deep))


def test_a_mirrored_camera_has_mirrored_features(renderer):
    """As the image that it sees: x of normals to the right of that."""
    mirror = renderer.ScalarTransform4f().scale([-1, 1, 1])
    straight, mirrored = (rendered(renderer, perspective(turned)["sensor"]) for turned in (None, mirror))
    assert np.allclose(mirrored["depth"], straight["depth"][:, ::-1], rtol=0.02)
    assert np.allclose(mirrored["normal"] * [-1, 1, 1], straight["normal"], atol=1e-4)


def test_photons_are_gathered_in_pixels_wherever_the_near_plane_is(renderer):
    wall = {"type": "rectangle", "to_world": renderer.ScalarTransform4f().scale(20)}
    for near in (0.01, 2.5):
        scene = renderer.load_dict({"type": "scene", "sensor": camera(fov=40, near_clip=near), "wall": wall})
        expected = 2 * np.tan(np.radians(20)) / 24 * 3.6
        assert pixel_width(scene, scene.sensors()[0]) == pytest.approx(expected, rel=0.05)


@pytest.mark.parametrize("view", ["perspective", "irradiancemeter"])
def test_lamps_are_weighed_by_what_any_camera_sees(renderer, view):
    """Mitsuba's meters on shapes have rays with differentials alone."""
    dim = {"type": "sphere", "center": [0.5, 0.2, 0.5], "radius": 0.1, "emitter": {"type": "area"}}
    weights = lamp_weights(load(renderer, corner() | CAMERAS[view]() | {"zz": dim}))
    assert len(weights) == 2 and 0.1 <= weights.min() < 0.4


@pytest.mark.parametrize("kind", ["distant", "irradiancemeter"])
def test_lamps_know_their_medium_wherever_the_camera_is(renderer, kind):
    """It is looked for on the way to the camera: not to the middle of the world, where meters say they are."""
    mi = renderer
    meter = {"type": kind, "film": film(1, 1)}
    if kind == "irradiancemeter":
        meter = {"type": "sphere", "center": [0, 0, 5], "radius": 0.5, "meter": meter}
    fog = {"type": "homogeneous", "albedo": 0.8, "sigma_t": 0.5}
    ball = {"type": "sphere", "bsdf": {"type": "null"}, "interior": fog}
    lamp = {"type": "sphere", "radius": 0.1, "center": [0, 0.5, 0], "emitter": {"type": "area"}}
    scene = mi.load_dict({"type": "scene", "meter": meter, "ball": ball, "lamp": lamp})
    ways = Fog(scene, scene.sensors()[0], LightEnds(scene), "bre")
    inside, outside = (ways.around(scene, mi.Point3f([0.0], [y], [0.0])) for y in (0.7, 1.3))
    assert (inside != None)[0] and not (outside != None)[0]  # noqa: E711 - arrays of pointers


@pytest.mark.parametrize("view", ["principal point", "principal point, crop", "crop", "mirrored", "near plane"])
def test_a_still_camera_sees_nothing_move_and_knows_where_its_pixels_look(renderer, view):
    scene = scene_with(renderer, view)
    now, what = snapshot(scene), seen(scene)
    assert np.array_equal(motion_vectors(scene, now, snapshot(scene)), np.zeros((16, 24, 2)))
    x, y, _, w = now.film @ what.points.T
    rows, columns = np.mgrid[:16, :24].reshape(2, -1) + 0.5
    assert np.allclose(x / w, columns, atol=2e-3) and np.allclose(y / w, rows, atol=2e-3)


@pytest.mark.parametrize("view", ["batch", "radiancemeter, scaled"])
def test_cameras_that_no_sampler_renders(renderer, view):
    for sampler in CORE:
        check(renderer, sampler, view, 1, 1)
    integrator = renderer.load_dict({"type": "gpt"})
    with pytest.raises(NgptError, match="camera '"):
        integrator.render(scene_with(renderer, view))


@pytest.mark.parametrize("sampler", ["gpt", "bdpt", pytest.param("ppm", marks=pytest.mark.slow)])
def test_plugins_render_from_any_camera_of_a_scene(renderer, sampler):
    """``sensor`` of ``mi.render`` may be another one than the first, of a kind that the sampler refuses."""
    mi = renderer
    one, other = perspective()["sensor"], orthographic(1.5)["sensor"]
    integrator = mi.load_dict({"type": sampler, "max_depth": 3, "lamps": "uniform"})
    first = load(mi, {**corner(), "a": one, "b": other})
    second = load(mi, {**corner(), "b": other, "c": one})
    assert [s.class_name() for s in second.sensors()] == ["OrthographicCamera", "PerspectiveCamera"]
    images = [np.array(integrator.render(s, sensor=i, seed=3, spp=4)) for s, i in ((first, 0), (second, 1))]
    assert np.array_equal(*images) and images[0][..., :3].mean() > 0.01
    if sampler == "bdpt":
        with pytest.raises(NgptError, match="light paths cannot reach a camera 'orthographic'"):
            integrator.render(second, sensor=0, spp=4)
