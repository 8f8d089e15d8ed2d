"""Kernels that are recorded once: how often the Python that makes them runs, and that no bit depends on it."""

import gc
import logging

import numpy as np
import pytest
from bdpt_scenes import SCENES
from unbiased import load

FROM_THE_CAMERA = ("gpt", "primal", "gpt-basic", "gpt-simple", "split")


def textured_lamp():
    import mitsuba as mi

    from data_gen.scenes import builtin

    scene, texels = builtin.diffuse(), np.random.default_rng(1).random((4, 4, 3)).astype(np.float32)
    scene["lamp"]["emitter"]["radiance"] = {"type": "bitmap", "bitmap": mi.Bitmap(texels), "raw": True}
    return scene


def render(mi, scene, sampler, samples, others=(), **options):
    """The film of passes with so many samples; after each pass one of the ``others`` is loaded."""
    from data_gen.film import GradientFilm
    from data_gen.passes import recording
    from data_gen.paths.camera import CameraSamples
    from data_gen.samplers import SAMPLERS

    sensor, entry, loaded = scene.sensors()[0], SAMPLERS[sampler], []
    film, take = GradientFilm(*sensor.film().crop_size(), batches=bool(entry.batch)), entry.made(scene, **options)
    for i, n in enumerate(samples):
        with recording():
            take(CameraSamples(sensor, 7, n, sum(samples[:i]), 1 if entry.batch else 16), film)
            film.end_pass(1 if entry.batch else 16)
        if i < len(others):
            loaded.append(load(mi, others[i], (4, 4)))
    return film.develop()


@pytest.mark.parametrize("sampler", FROM_THE_CAMERA)
def test_passes_of_any_size_are_recorded_once(renderer, recordings, sampler):
    """Also with other scenes in the process, which have lamps with textures, and environments."""
    others = [load(renderer, other, (4, 4)) for other in (SCENES["areas"], SCENES["sky"])]
    render(renderer, load(renderer, "diffuse", (9, 7)), sampler, [16, 48, 16, 32])
    assert len(others) == 2 and recordings.of == {"samples": 1}


def spares():
    """A material, a texture and a medium that no shape has: calls go through them nevertheless."""
    import mitsuba as mi

    from data_gen.scenes import builtin

    texels = mi.Bitmap(np.random.default_rng(1).random((4, 4, 3)).astype(np.float32))
    return builtin.diffuse() | {
        "spare material": {
            "type": "roughconductor",
            "alpha": 0.3,
            "specular_reflectance": {"type": "rgb", "value": 0.2},
        },
        "spare texture": {"type": "bitmap", "bitmap": texels, "raw": True},
        "spare medium": {"type": "homogeneous", "albedo": 0.3, "phase": {"type": "hg", "g": 0.4}},
    }


@pytest.mark.parametrize("own", ["diffuse", spares])
def test_parts_that_no_shape_has_do_not_matter(renderer, recordings, caplog, own):
    others = [load(renderer, spares, (4, 4))]
    render(renderer, load(renderer, own, (9, 7)), "gpt", [16, 48, 16])
    assert len(others) == 1 and recordings.of == {"samples": 1} and not caplog.records


def test_steps_of_gpt_are_recorded_in_one_place(renderer, monkeypatch):
    """Recording goes through all materials of the scene at each step: unrolled and repeated steps made it long."""
    from data_gen.samplers.gpt import offset_path, trace

    recorded = []
    for module, name in ((trace, "base_step"), (offset_path, "step_apart"), (offset_path, "step_joined")):
        real = getattr(module, name)
        monkeypatch.setattr(module, name, lambda *args, f=real: (recorded.append(f.__name__), f(*args))[1])
    render(renderer, load(renderer, "glossy", (9, 7)), "gpt", [16])
    assert sorted(recorded) == ["base_step", "step_apart", "step_joined"]


@pytest.mark.parametrize("scene", [textured_lamp, "environment"])
def test_lamps_of_any_kind_are_recorded_once(renderer, recordings, scene):
    """A lamp with a texture makes the distribution that it is sampled by when it is first asked."""
    render(renderer, load(renderer, scene, (9, 7)), "gpt", [16, 48, 16])
    assert recordings.of == {"samples": 1}


@pytest.mark.parametrize("sampler", ["bdpt", "gbdpt"])
def test_paths_from_both_ends_are_recorded_once(renderer, recordings, sampler):
    others = [load(renderer, textured_lamp, (4, 4))]
    render(renderer, load(renderer, "diffuse", (16, 12)), sampler, [1] * 5)
    # Where two arrays happen to be of one width, a function is recorded again.
    assert len(others) == 1 and len(recordings.of) <= recordings.total() <= len(recordings.of) + 1


@pytest.mark.parametrize("options", [{"reuse": True}, {"shift": "manifold"}])
def test_options_of_gpt_are_recorded_once(renderer, recordings, options):
    render(renderer, load(renderer, "glossy", (9, 7)), "gpt", [16, 32, 16], **options)
    assert recordings.of == {"samples": 1}


def test_media_are_recorded_once(renderer, recordings):
    render(renderer, load(renderer, "haze", (9, 7)), "gpt", [16, 32, 16])
    assert recordings.of == {"samples": 1}


@pytest.mark.parametrize("camera", ["thinlens", "orthographic"])
@pytest.mark.parametrize("sampler", ["gpt", "primal"])
def test_all_cameras_are_recorded_once(renderer, recordings, caplog, camera, sampler):
    """Dr.Jit finds the arrays of none but the perspective camera."""
    from data_gen.scenes import builtin

    to_world = renderer.ScalarTransform4f().look_at([0, 1.2, 3.9], [0, 1.1, 0], [0, 1, 0])
    more = {"aperture_radius": 0.05, "focus_distance": 4.0} if camera == "thinlens" else {}
    sensor = {"type": camera, "to_world": to_world, "film": builtin.diffuse()["sensor"]["film"], **more}
    render(renderer, load(renderer, lambda: builtin.diffuse() | {"sensor": sensor}, (9, 7)), sampler, [16, 32, 16])
    assert recordings.of == {"samples": 1} and not caplog.records


def test_pixels_in_any_number_are_recorded_once(renderer, recordings):
    from data_gen.adaptive import Adaptive
    from data_gen.render import render_stack

    passes = []
    scene = load(renderer, "diffuse", (12, 8))
    render_stack(
        scene,
        160,
        1,
        "gpt",
        adaptive=Adaptive(None, "wcv"),
        progress=lambda *done: passes.append(done),
        lamps="uniform",
    )
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
    from data_gen.samplers import FRAME_SAMPLERS
    from data_gen.session import render_frames, render_scene

    spp = 16 if size[0] > 9 else 2
    if sampler in FRAME_SAMPLERS:
        list(render_frames("glossy", range(2), 1, sampler=sampler, size=size))
    else:
        render_scene("glossy", spp, sampler=sampler, size=size)


@pytest.mark.parametrize("sampler", ["gpt", "primal", "gpm", "vcm", "gbdpt", "restir"])
def test_a_scene_goes_with_its_last_render(renderer, sampler):
    """Python's collector of circles comes late: until then its objects would be in the kernels of other scenes."""
    import drjit as dr

    from data_gen.paths.frozen import _of_each_kind

    class Calls:
        count = 0

    def counted(x, calls=Calls):
        calls.count += 1
        return x + 1

    # Recorded again where other objects are in the process.
    kinds, x = _of_each_kind(), dr.opaque(renderer.Float, 1, 4)
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

    from data_gen.paths import frozen

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
    assert "secretive is recorded anew in each pass" in line and "\n" not in line
    assert recordings.total() > 3


def test_what_is_recorded_once_has_the_width_of_each_call(renderer, recordings):
    """Constants too, such as the emission of a scene without lamps: Dr.Jit would keep the width of the first."""
    import drjit as dr

    from data_gen.paths.frozen import Frozen

    mi = renderer
    frozen, time = Frozen(load(mi, "diffuse", (4, 4))), dr.full(mi.Float, 0.5, 20)

    def taken(time, lanes):
        return dr.gather(mi.Float, time, lanes), lanes + 1

    def constant(time, lanes):
        return dr.full(mi.Float, 1, dr.width(lanes)), lanes + 1

    for n in (5, 11, 8, 13):
        lanes = dr.arange(mi.UInt32, n)
        dr.eval(lanes)
        for f in (taken, constant):
            assert [dr.width(x) for x in frozen(f, time, lanes)] == [n, n]
    assert set(recordings.of) == {"taken", "constant"} and recordings.total() <= 4


def test_an_interrupt_while_kernels_are_recorded_is_one(renderer):
    """Dr.Jit wraps it in a RuntimeError, as it does what keeps a function from being recorded."""
    import drjit as dr

    from data_gen.passes import recording
    from data_gen.paths.frozen import Frozen

    mi, calls = renderer, []

    def interrupted(*_):
        calls.append(1)
        raise KeyboardInterrupt

    frozen, lanes = Frozen(load(mi, "diffuse", (4, 4))), dr.opaque(mi.UInt32, 3, 4)
    for f in (interrupted, lambda n: dr.while_loop((n,), lambda n: n > 0, interrupted)):
        with recording(), pytest.raises(KeyboardInterrupt):
            frozen(f, lanes)
        assert len(calls) == 1
        # The next call is another try.
        with recording(), pytest.raises(KeyboardInterrupt):
            frozen(f, lanes)
        assert len(calls) == 2
        calls.clear()


def test_renders_of_one_scene_share_what_is_recorded(renderer, recordings):
    """With another camera as well; whatever else changes is seen."""
    from data_gen.dataset.cameras import View
    from data_gen.made import Made
    from data_gen.render import render_stack
    from data_gen.scenes import builtin

    mi, made = renderer, Made()
    lens = {"type": "thinlens", "aperture_radius": 0.02, "focus_distance": 4.0}
    scene = load(mi, lambda: builtin.diffuse() | {"sensor": builtin.diffuse()["sensor"] | lens}, (16, 16))

    def rendered(i, made=None, **options):
        origin, up, window = (0.2 * i, 1.2, 3.5 - 0.3 * i), (0.1 * i, 1, 0), (10 + i, 12)
        View(origin, (0, 1, 0), up, 50 - 5 * i, 0.02 * (i + 1), 4 - i, (64 + 8 * i, 48), window, 16).apply(scene)
        return render_stack(scene, 4, i, "gpt", made=made, **options)

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
