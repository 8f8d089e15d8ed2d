"""Kernels that are recorded once: how often the Python that makes them runs, and that no bit depends on it."""

import gc
import logging

import numpy as np
import pytest
from bdpt_scenes import SCENES
from stress_scenes import bitmap
from unbiased import load

pytest.importorskip("mitsuba")

from data_gen.adaptive import Adaptive
from data_gen.dataset.cameras import CameraView
from data_gen.film import GradientFilm
from data_gen.passes import recording
from data_gen.paths import frozen
from data_gen.paths.camera import CameraSamples
from data_gen.render import render_stack
from data_gen.samplers import FRAME_SAMPLERS, SAMPLERS
from data_gen.samplers.reused import Made
from data_gen.scenes import builtin
from data_gen.session import render_frames, render_scene


def textured_lamp():
    """It makes the distribution that it is sampled by when it is first asked."""
    scene = builtin.diffuse()
    scene["lamp"]["emitter"]["radiance"] = bitmap(4, 4, 1)
    return scene


def spares():
    """A material, a texture and a medium that no shape has: calls go through them nevertheless."""
    metal = {"type": "roughconductor", "alpha": 0.3, "specular_reflectance": {"type": "rgb", "value": 0.2}}
    medium = {"type": "homogeneous", "albedo": 0.3, "phase": {"type": "hg", "g": 0.4}}
    return builtin.diffuse() | {"spare material": metal, "spare texture": bitmap(4, 4, 1), "spare medium": medium}


def seen_by(camera, **more):
    """The diffuse room before a camera whose arrays Dr.Jit does not find."""

    def scene():
        sensor = builtin.diffuse()["sensor"]
        lens = {name: sensor[name] for name in ("to_world", "film")}
        return builtin.diffuse() | {"sensor": {"type": camera, **lens, **more}}

    return scene


def render(mi, scene, sampler, samples, others=(), **options):
    """The film of passes with so many samples; after each pass one of the ``others`` is loaded."""
    sensor, entry, loaded = scene.sensors()[0], SAMPLERS[sampler], []
    film, take = GradientFilm(*sensor.film().crop_size(), batches=bool(entry.batch)), entry.made(scene, **options)
    for i, n in enumerate(samples):
        with recording():
            take(CameraSamples(sensor, 7, n, sum(samples[:i]), 1 if entry.batch else 16), film)
            film.end_pass(1 if entry.batch else 16)
        if i < len(others):
            loaded.append(load(mi, others[i], (4, 4)))
    return film.develop()


# Sampler, scene, other scenes in the process, options
RECORDED = [
    ("gpt", "diffuse", (SCENES["areas"], SCENES["sky"]), {}),
    ("primal", "diffuse", (textured_lamp, spares), {}),
    ("gpt-basic", "diffuse", (textured_lamp, spares), {}),
    pytest.param("gpt-simple", "diffuse", (textured_lamp, spares), {}, marks=pytest.mark.slow),
    ("gpt", spares, (spares,), {}),
    *(pytest.param("gpt", scene, (), {}, marks=pytest.mark.slow) for scene in (textured_lamp, "environment")),
    ("gpt", "haze", (), {}),
    ("gpt", "glossy", (), {"reuse": True}),
    ("gpt", seen_by("thinlens", aperture_radius=0.05, focus_distance=4.0), (), {}),
    ("primal", seen_by("orthographic"), (), {}),
]


@pytest.mark.parametrize(("sampler", "scene", "others", "options"), RECORDED)
def test_passes_of_any_size_are_recorded_once(renderer, recordings, caplog, sampler, scene, others, options):
    others = [load(renderer, other, (4, 4)) for other in others]
    render(renderer, load(renderer, scene, (9, 7)), sampler, [16, 48, 16, 32], **options)
    assert recordings.of == {"samples": 1} and not caplog.records, others


@pytest.mark.parametrize(
    ("sampler", "scene"),
    [
        ("bdpt", "lens"),
        ("vcm", "diffuse"),
        *(pytest.param(*case, marks=pytest.mark.slow) for case in (("bdpt", "diffuse"), ("vcm", "lens"))),
    ],
)
def test_paths_from_both_ends_are_recorded_once(renderer, recordings, sampler, scene):
    assert_paths_are_recorded_once(renderer, recordings, sampler, scene)


def assert_paths_are_recorded_once(renderer, recordings, sampler, scene):
    others = [load(renderer, textured_lamp, (4, 4))]
    render(renderer, load(renderer, scene, (16, 12)), sampler, [1] * 5)
    # Where two arrays happen to be of one width, a function is recorded again.
    assert len(others) == 1 and len(recordings.of) <= recordings.total() <= len(recordings.of) + 1


def test_pixels_in_any_number_are_recorded_once(renderer, recordings):
    scene, passes = load(renderer, "diffuse", (12, 8)), []
    options = {"adaptive": Adaptive(None, "wcv"), "lamps": "uniform"}
    render_stack(scene, 160, 1, "gpt", progress=lambda *done: passes.append(done), unbiased=True, **options)
    assert len(passes) > 3 and recordings.of == {"samples": 1}


def test_scenes_that_come_meanwhile_change_no_bit(renderer, recordings, caplog):
    """Each costs one more recording: its objects are among those that a call might reach."""
    scene = load(renderer, "diffuse", (9, 7))
    alone = render(renderer, scene, "gpt", [16, 32, 16, 16, 16])
    recordings.of.clear()
    among = render(renderer, load(renderer, "diffuse", (9, 7)), "gpt", [16, 32, 16, 16, 16], [textured_lamp])
    # Once more, and again as the numbers that its objects share are found to be one.
    assert recordings.total() <= 3 and not caplog.records
    for name in alone:
        assert np.array_equal(alone[name], among[name], equal_nan=True), name


def loaded_and_gone(mi, sampler, size):
    """A scene is rendered, and nobody has it any more."""
    spp = 16 if size[0] > 9 else 2
    if sampler in FRAME_SAMPLERS:
        list(render_frames("glossy", range(2), 1, sampler=sampler, size=size))
    else:
        render_scene("glossy", spp, sampler=sampler, size=size)


@pytest.mark.parametrize("sampler", ["gpt", "primal", "ppm", pytest.param("vcm", marks=pytest.mark.slow)])
def test_a_scene_goes_with_its_last_render(renderer, sampler):
    assert_a_scene_goes_with_its_last_render(renderer, sampler)


def assert_a_scene_goes_with_its_last_render(renderer, sampler):
    """Python's collector of circles comes late: until then its objects would be in the kernels of other scenes."""
    import drjit as dr

    class Calls:
        count = 0

    def counted(x, calls=Calls):
        calls.count += 1
        return x + 1

    # Recorded again where other objects are in the process.
    kinds, x = frozen._of_each_kind(), dr.opaque(renderer.Float, 1, 4)
    probe = dr.freeze(lambda x: counted(x), state_fn=lambda *_: kinds, limit=1, auto_opaque=False)
    gc.collect()
    gc.disable()
    try:
        probe(x), probe(x)
        before = Calls.count
        loaded_and_gone(renderer, sampler, (64, 64) if sampler in ("gpt", "primal") else (9, 7))
        probe(x)
        assert Calls.count == before
        scene = load(renderer, "glossy", (4, 4))
        probe(x)
        assert Calls.count > before and scene
    finally:
        gc.enable()


@pytest.mark.recorded_anew
def test_what_cannot_be_recorded_says_so_once(renderer, recordings, caplog, monkeypatch):
    import drjit as dr

    mi, kept = renderer, frozen.Frozen(load(renderer, "diffuse", (4, 4)))
    monkeypatch.setattr(frozen, "_SAID", set())
    caplog.set_level(logging.WARNING, "ngpt")

    class Box:
        """Dr.Jit does not know of what is in it."""

        secret = dr.opaque(mi.Float, 0.25, 4)

    def secretive(x):
        return x + Box.secret

    for _ in range(3):
        assert np.array_equal(np.array(kept(secretive, dr.opaque(mi.Float, 1, 4))), np.full(4, 1.25, np.float32))
    (line,) = caplog.messages
    assert "secretive is recorded again in each pass" in line and "\n" not in line
    assert recordings.total() > 3


def test_what_is_recorded_once_has_the_width_of_each_call(renderer, recordings):
    """Constants too, such as the emission of a scene without lamps: Dr.Jit would keep the width of the first."""
    import drjit as dr

    mi = renderer
    kept, time = frozen.Frozen(load(mi, "diffuse", (4, 4))), dr.full(mi.Float, 0.5, 20)

    def taken(time, lanes):
        return dr.gather(mi.Float, time, lanes), lanes + 1

    def constant(time, lanes):
        return dr.full(mi.Float, 1, dr.width(lanes)), lanes + 1

    for n in (5, 11, 8, 13):
        lanes = dr.arange(mi.UInt32, n)
        dr.eval(lanes)
        for f in (taken, constant):
            assert [dr.width(x) for x in kept(f, time, lanes)] == [n, n]
    assert set(recordings.of) == {"taken", "constant"} and recordings.total() <= 4


def test_an_interrupt_while_kernels_are_recorded_is_one(renderer):
    """Dr.Jit wraps it in a RuntimeError, as it does what keeps a function from being recorded."""
    import drjit as dr

    mi, calls = renderer, []

    def interrupted(*_):
        calls.append(1)
        raise KeyboardInterrupt

    kept, lanes = frozen.Frozen(load(mi, "diffuse", (4, 4))), dr.opaque(mi.UInt32, 3, 4)
    for f in (interrupted, lambda n: dr.while_loop((n,), lambda n: n > 0, interrupted)):
        # The next call is another try.
        for _ in range(2):
            with recording(), pytest.raises(KeyboardInterrupt):
                kept(f, lanes)
        assert len(calls) == 2
        calls.clear()


def test_renders_of_one_scene_share_what_is_recorded(renderer, recordings):
    """With another camera as well; whatever else changes is seen."""
    mi, made = renderer, Made()
    lens = {"type": "thinlens", "aperture_radius": 0.02, "focus_distance": 4.0}
    scene = load(mi, lambda: builtin.diffuse() | {"sensor": builtin.diffuse()["sensor"] | lens}, (16, 16))

    def rendered(i, made=None, **options):
        origin, up, window = (0.2 * i, 1.2, 3.5 - 0.3 * i), (0.1 * i, 1, 0), (10 + i, 12)
        CameraView(origin, (0, 1, 0), up, 50 - 5 * i, 0.02 * (i + 1), 4 - i, (64 + 8 * i, 48), window, 16).apply(scene)
        return render_stack(scene, 4, i, "gpt", made=made, unbiased=True, **options)

    anew = [rendered(i) for i in range(3)]
    recordings.of.clear()
    shared = [rendered(i, made) for i in range(3)]
    # The second render may find numbers of the camera that are one.
    assert recordings.total() <= 2
    for one, other in zip(anew, shared, strict=True):
        assert all(np.array_equal(one[name], other[name], equal_nan=True) for name in one.names)
    recordings.of.clear()
    rendered(2, made)
    assert not recordings.of
    rendered(2, made, caustic=False)
    assert recordings.of
    params = mi.traverse(scene)
    params["lamp.emitter.radiance.value"] = mi.Color3f(1, 2, 3)
    params.update()
    bright, again = rendered(2), rendered(2, made)
    assert np.array_equal(bright["primal"], again["primal"]) and not np.array_equal(bright["primal"], anew[2]["primal"])
