"""What ``gpt`` is made of: Jacobians, weights of pairs, classes of materials. Its shifts have a file of their own."""

import drjit as dr
import mitsuba as mi
import pytest
from unbiased import load

from data_gen.paths.mis import gradient_weight, mis_weight
from data_gen.paths.shift import reconnection_jacobian
from data_gen.paths.vertex import Materials, smallest_roughness
from data_gen.render import render_stack


def test_jacobian_is_that_of_the_shift(renderer):
    """Against finite differences: a little triangle about the target, as solid angles seen from either side."""
    random = mi.PCG32(4096)

    def point(height):
        return mi.Point3f(*(2 * mi.Float(random.next_float32()) - 1 for _ in range(2)), height)

    base, offset, target = (point(h) for h in (1 + random.next_float32(), 1 + random.next_float32(), 0))

    def solid_angle(point):
        a, b, c = (
            dr.normalize(target + 1e-2 * mi.Vector3f(*edge) - point)
            for edge in ((1, 0, 0), (-0.5, 0.8, 0), (-0.5, -0.8, 0))
        )
        return dr.norm(dr.cross(b - a, c - a))

    found = reconnection_jacobian(base, offset, target, mi.Normal3f(0, 0, 1))
    assert dr.all(dr.abs(found * solid_angle(base) / solid_angle(offset) - 1) < 0.01)


def test_weights_of_a_pair_sum_to_one(renderer):
    r = mi.Float([1e-30, 1e-3, 1, 7, 1e30])
    assert dr.allclose(gradient_weight(r, True) + gradient_weight(1 / r, True), 2)
    assert dr.allclose(gradient_weight(r, False), 2)
    # Densities whose squares float32 cannot hold
    p, q = mi.Float([1e-25, 1e25, 0, 1, 1]), mi.Float([3e-25, 3e25, 1, 0, dr.inf])
    assert dr.allclose(mis_weight(p, q), [0.1, 0.1, 0, 1, 0])


ROUGH = {"type": "roughconductor", "alpha": 0.3}
SMOOTH = {"type": "roughplastic", "alpha": 0.01}
# A material, its smallest roughness, whether it is connectable, and whether it is in scenes with media, where light
# comes out by frosted glass, which few paths find
MATERIALS = {
    "diffuse": ({"type": "diffuse"}, 1, True, True),
    "rough": (ROUGH, 0.3, True, True),
    "smooth": (SMOOTH, 0.01, False, False),
    "streaked": ({"type": "roughconductor", "alpha_u": 0.3, "alpha_v": 0.02}, 0.02, False, False),
    "mirror": ({"type": "conductor"}, 1, False, False),
    "lacquer": ({"type": "plastic"}, 1, True, True),
    "nested": ({"type": "twosided", "nested": SMOOTH}, 0.01, False, False),
    "blend": ({"type": "blendbsdf", "weight": 0.5, "a": ROUGH, "b": SMOOTH}, 0.01, False, False),
    "principled": ({"type": "principled", "roughness": 0.2}, 0.04, False, False),
    "hole": ({"type": "mask", "opacity": 0.5, "nested": {"type": "diffuse"}}, 1, True, True),
    "frosted": ({"type": "roughdielectric", "alpha": 0.4}, 0.4, True, False),
}


@pytest.mark.parametrize("name", MATERIALS)
def test_connectable_materials(renderer, name):
    material, roughness, *connectable = MATERIALS[name]
    scene = mi.load_dict({"type": "scene", "ball": {"type": "sphere", "bsdf": material}})
    bsdf = scene.shapes()[0].bsdf()
    assert smallest_roughness(bsdf) == pytest.approx(roughness)
    for media in (False, True):
        classes = Materials(scene, 0.05, media=media)
        assert classes.connectable(mi.BSDFPtr(bsdf))[0] == connectable[media]
        assert not classes.connectable(mi.BSDFPtr(None))[0]


def test_less_noise_than_replay_alone(renderer):
    scene = load(renderer, "diffuse", (64, 64))
    ours, theirs = (render_stack(scene, 16, 0, sampler, unbiased=True) for sampler in ("gpt", "gpt-basic"))
    for name in ("dx_var", "dy_var"):
        assert ours[name].mean() < 0.75 * theirs[name].mean()
