"""What ``gpt`` is made of: its shift as a function, Jacobians, weights of pairs, classes of materials."""

import numpy as np
import pytest
from unbiased import FAR, load, render_ours


def test_far_shifts_leave_out_what_leaves_the_image(renderer):
    """The last eight columns have no pixel to differ from; before them there is no hole, and nothing else has moved."""
    from data_gen.film import SHIFTS
    from data_gen.render import render_stack

    scene, table = load(renderer, "diffuse", (20, 12)), dict(SHIFTS)
    near, far = render_ours(scene, "gpt", batches=1)[0], render_ours(scene, "gpt", batches=1, pixels=FAR)[0]
    assert not far["dx"][:, -FAR:].any() and not far["dy"][-FAR:].any()
    assert (far["dx"][:, :-FAR].any(axis=-1)).mean() > 0.95 and (far["dy"][:-FAR].any(axis=-1)).mean() > 0.95
    assert np.array_equal(near["direct"], far["direct"]) and np.array_equal(near["albedo"], far["albedo"])
    # The table is what it was, and so are the bits.
    assert table == SHIFTS and np.array_equal(near["dx"], render_stack(scene, 64, 0, "gpt")["dx"])


def escapes_from(reconnects, replay_inverts):
    """Steps (kind, base, base next, offset, offset next, offset kind) that the shift takes but does not take back.

    A step is taken as the sampler takes it. Its reverse begins with the offset path as the base, whose next vertex is
    the shared one after a reconnection and its own after a replay.
    """
    from itertools import product

    import drjit as dr
    import mitsuba as mi

    states = np.array(list(product(range(3), *[(False, True)] * 4, range(3))))
    kind, offset_kind = mi.UInt32(states[:, 0]), mi.UInt32(states[:, 5])
    base, base_next, offset, offset_next = (mi.Bool(states[:, i].astype(bool)) for i in range(1, 5))
    joins = reconnects(kind, base, base_next, offset)
    replays = ~joins & replay_inverts(offset_kind, offset, offset_next, base)
    # The reverse of a reconnection reconnects, having been sampled as a smooth event at the offset path's vertex.
    joins_back = reconnects(kind, offset, base_next, base)
    # The reverse of a replay replays, under the same rule.
    replays_back = ~reconnects(offset_kind, offset, offset_next, base)
    replays_back &= replay_inverts(kind, base, base_next, offset)
    return int(dr.count((joins & ~joins_back) | (replays & ~replays_back))[0])


def test_the_shift_of_the_shift_is_the_path(renderer):

    from data_gen.paths.shift import reconnects, replay_inverts

    assert escapes_from(reconnects, replay_inverts) == 0


def random_geometry(mi, n=4096):
    random = mi.PCG32(n)

    def point(height):
        return mi.Point3f(*(2 * mi.Float(random.next_float32()) - 1 for _ in range(2)), height)

    return point(1 + mi.Float(random.next_float32())), point(1 + mi.Float(random.next_float32())), point(0)


def test_jacobian_of_the_inverse_is_the_inverse(renderer):
    import drjit as dr

    from data_gen.paths.shift import reconnection_jacobian

    base, offset, target = random_geometry(renderer)
    normal = renderer.Normal3f(0, 0, 1)
    there = reconnection_jacobian(base, offset, target, normal)
    back = reconnection_jacobian(offset, base, target, normal)
    assert dr.all(dr.abs(there * back - 1) < 1e-5)
    assert dr.allclose(reconnection_jacobian(base, base, target, normal), 1)


def test_jacobian_is_that_of_the_shift(renderer):
    """Against finite differences: a little triangle about the target, as solid angles seen from either side."""
    import drjit as dr

    from data_gen.paths.shift import reconnection_jacobian

    base, offset, target = random_geometry(renderer)

    def solid_angle(point):
        a, b, c = (
            dr.normalize(target + 1e-2 * renderer.Vector3f(*edge) - point)
            for edge in ((1, 0, 0), (-0.5, 0.8, 0), (-0.5, -0.8, 0))
        )
        return dr.norm(dr.cross(b - a, c - a))

    expected = solid_angle(offset) / solid_angle(base)
    found = reconnection_jacobian(base, offset, target, renderer.Normal3f(0, 0, 1))
    assert dr.all(dr.abs(found / expected - 1) < 0.01)


def test_weights_of_a_pair_sum_to_one(renderer):
    import drjit as dr

    from data_gen.paths.mis import gradient_weight, mis_weight

    r = renderer.Float([1e-30, 1e-3, 1, 7, 1e30])
    assert dr.allclose(gradient_weight(r, True) + gradient_weight(1 / r, True), 2)
    assert dr.allclose(gradient_weight(r, False), 2)
    # Densities whose squares float32 cannot hold
    p, q = renderer.Float([1e-25, 1e25, 0, 1, 1]), renderer.Float([3e-25, 3e25, 1, 0, dr.inf])
    assert dr.allclose(mis_weight(p, q), [0.1, 0.1, 0, 1, 0])


def test_connectable_materials(renderer):
    from data_gen.paths.vertex import Materials, smallest_roughness

    rough = {"type": "roughconductor", "alpha": 0.3}
    smooth = {"type": "roughplastic", "alpha": 0.01}
    materials = {
        "diffuse": ({"type": "diffuse"}, 1, True),
        "rough": (rough, 0.3, True),
        "smooth": (smooth, 0.01, False),
        "streaked": ({"type": "roughconductor", "alpha_u": 0.3, "alpha_v": 0.02}, 0.02, False),
        "mirror": ({"type": "conductor"}, 1, False),
        "lacquer": ({"type": "plastic"}, 1, True),
        "nested": ({"type": "twosided", "nested": smooth}, 0.01, False),
        "blend": ({"type": "blendbsdf", "weight": 0.5, "a": rough, "b": smooth}, 0.01, False),
        "principled": ({"type": "principled", "roughness": 0.2}, 0.04, False),
        "hole": ({"type": "mask", "opacity": 0.5, "nested": {"type": "diffuse"}}, 1, True),
        "frosted": ({"type": "roughdielectric", "alpha": 0.4}, 0.4, True),
    }
    shapes = {name: {"type": "sphere", "bsdf": bsdf} for name, (bsdf, _, _) in materials.items()}
    scene = renderer.load_dict({"type": "scene", **shapes})
    classes = Materials(scene, 0.05)
    for shape in scene.shapes():
        _, roughness, connectable = materials[shape.id()]
        assert smallest_roughness(shape.bsdf()) == pytest.approx(roughness), shape.id()
        assert classes.connectable(renderer.BSDFPtr(shape.bsdf()))[0] == connectable, shape.id()
    assert not classes.connectable(renderer.BSDFPtr(None))[0]
    # Light comes out of media by it, which few paths find.
    with_media = Materials(scene, 0.05, media=True)
    frosted = renderer.BSDFPtr(scene.shapes()[list(materials).index("frosted")].bsdf())
    assert classes.connectable(frosted)[0] and not with_media.connectable(frosted)[0]
    assert with_media.connectable(renderer.BSDFPtr(scene.shapes()[1].bsdf()))[0]


def test_less_noise_than_replay_alone(renderer):
    from data_gen.render import render_stack

    scene = load(renderer, "diffuse", (64, 64))
    ours, theirs = (render_stack(scene, 16, 0, sampler) for sampler in ("gpt", "gpt-basic"))
    for name in ("dx_var", "dy_var"):
        assert ours[name].mean() < 0.75 * theirs[name].mean()
