"""Light goes straight on through masks and panes, toward lamps of every kind, and is found once."""

import numpy as np
import pytest
from hole_scenes import curtains, curtains_in_fog, leaves
from unbiased import FAR, assert_unbiased, load, render_ours

pytest.importorskip("mitsuba")

from ngpt.testing import z_test


@pytest.mark.slow
def test_it_is_the_light_of_volpath(renderer):
    """Of all lamps together, which Mitsuba's ``path`` does not find: it loses a twelfth."""
    import straight_on

    scene = load(renderer, curtains, (16, 16))
    kinds = {"volpath": None, "path": None, "by hand": straight_on.integrator(renderer)}
    images = {}
    for name, integrator in kinds.items():
        integrator = integrator or renderer.load_dict({"type": name, "max_depth": -1})
        renders = (renderer.render(scene, integrator=integrator, spp=256, seed=1000 + i) for i in range(8))
        images[name] = np.stack([np.array(image) for image in renders])
    assert images["path"].mean() < 0.95 * images["volpath"].mean()
    assert z_test(images["by hand"], images["volpath"]).passed
    ours = np.stack([stack["primal"] for stack in render_ours(scene, "primal", 12, 64)])
    assert z_test(ours, images["volpath"]).passed


def test_what_does_not_know_its_share_is_no_hole(renderer):
    from data_gen.paths.holes import Holes, knows

    mask = {"type": "mask", "opacity": 0.5, "nested": {"type": "diffuse"}}
    flat = {"type": "rgb", "value": [0.5, 0.5, 1.0]}
    known = [mask, {"type": "null"}, {"type": "thindielectric"}, mask | {"nested": {"type": "dielectric"}}]
    known += [{"type": "blendbsdf", "weight": 0.5, "a": mask, "b": {"type": "diffuse"}}, {"type": "diffuse"}]
    unknown = [{"type": "normalmap", "normalmap": flat, "bsdf": mask}]
    unknown += [{"type": "blendbsdf", "weight": 0.5, "a": unknown[0], "b": {"type": "diffuse"}}]
    assert [knows(renderer.load_dict(bsdf)) for bsdf in (*known, *unknown)] == [True] * len(known) + [False, False]

    def holes(bsdf):
        scene = load(renderer, {"type": "scene", "a": {"type": "sphere", "bsdf": bsdf}})
        return Holes.of(scene, passed=lambda shape: False)

    # Where there are none, nothing of them is compiled.
    assert holes(mask) and holes({"type": "diffuse"}) is None and holes(unknown[0]) is None


@pytest.mark.parametrize("sampler", ["bdpt", pytest.param("vcm", marks=pytest.mark.slow)])
def test_connections_go_on_through_many_holes(renderer, sampler):
    assert_connections_go_on_through_many_holes(renderer, sampler)


def assert_connections_go_on_through_many_holes(renderer, sampler):
    """Light through holes of some leaves is seen through holes of others; no path is counted twice.

    Differences over eight pixels are right, too, where copies see other numbers of leaves.
    """
    import straight_on

    scene = load(renderer, leaves, (16, 16))
    integrator = straight_on.integrator(renderer)
    theirs = np.stack(
        [np.array(renderer.render(scene, integrator=integrator, spp=256, seed=1000 + i)) for i in range(8)]
    )
    stacks = render_ours(scene, sampler, 8, 64, FAR)
    assert_unbiased(stacks, theirs, pixels=FAR)
    assert abs(np.mean([stack["primal"] for stack in stacks]) / theirs.mean() - 1) < 0.005


@pytest.mark.parametrize("hides", [False, True])
def test_lamps_hide_from_the_camera_only_in_front_of_holes(renderer, hides):
    """From the floor, below a lamp that is below or above a mask: what comes to the camera above both."""
    from data_gen.paths.holes import Holes

    def at(height, **more):
        to_world = renderer.ScalarTransform4f().translate([0, 0, height])
        return {"type": "rectangle", "to_world": to_world, **more}

    lamp = {"emitter": {"type": "area"}}
    mask = {"type": "mask", "opacity": 0.75, "nested": {"type": "diffuse"}}
    for lamp_at, mask_at, seen in ((2, 1, 0.25 if hides else 0), (1, 2, 0)):
        parts = {"floor": at(0), "lamp": at(lamp_at, **lamp), "mask": at(mask_at, bsdf=mask)}
        scene = load(renderer, {"type": "scene", **parts})
        holes, ray = Holes.of(scene), renderer.Ray3f([0.1, 0.1, 0.5], [0, 0, -1])
        floor = scene.ray_intersect(ray)
        way = scene, floor, renderer.Point3f(0.1, 0.1, 3), renderer.UInt32(3), renderer.Bool(True)
        if hides:
            T, _ = holes.toward_camera(*way)
        else:
            T, _ = holes.transmittance(scene, floor.spawn_ray_to(way[2]), *way[2:])
        assert np.allclose(T, seen)


@pytest.mark.slow
def test_in_fog(renderer):
    """Rays go on through masks, panes and the boundaries of media, in the medium that is behind each."""
    scene = load(renderer, curtains_in_fog, (16, 16))
    theirs = np.stack([np.array(renderer.render(scene, spp=256, seed=1000 + i)) for i in range(12)])
    ours = np.stack([stack["primal"] for stack in render_ours(scene, "gpt", 12, 64)])
    assert z_test(ours, theirs).passed
