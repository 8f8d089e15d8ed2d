"""Light goes straight on through masks and panes, toward lamps of every kind, and is found once."""

import numpy as np
import pytest
from hole_scenes import curtains, curtains_in_fog
from unbiased import load, render_ours

pytest.importorskip("mitsuba")

from ngpt.testing import z_test


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


@pytest.mark.slow
def test_in_fog(renderer):
    """Rays go on through masks, panes and the boundaries of media, in the medium that is behind each."""
    scene = load(renderer, curtains_in_fog, (16, 16))
    theirs = np.stack([np.array(renderer.render(scene, spp=256, seed=1000 + i)) for i in range(12)])
    ours = np.stack([stack["primal"] for stack in render_ours(scene, "gpt", 12, 64)])
    assert z_test(ours, theirs).passed
