"""The gradient-domain path tracer is unbiased, and the tests that say so would notice if it were not.

The budget is fixed: 16 stacks of 64 spp against 24 references of 128 spp at 32x32 pixels, a level of 1 % for a scene as
a whole. Mutants are built by replacing one of the functions that the sampler is made of.
"""

from functools import partial

import numpy as np
import pytest
from data_gen_scenes import fog, furnace, glass, hidden_lamp, one_sided, plenty, polished
from unbiased import DISTANCES, FAR, gradient_tests, load, render_ours, render_references

from ngpt.errors import NgptError
from ngpt.testing import z_test

SCENES = ["diffuse", "glossy", "environment", "lens", glass, hidden_lamp, plenty]


def verdicts(stacks, references, pixels=1):
    return {name: result.passed for name, result in gradient_tests(stacks, references, pixels=pixels)}


@pytest.mark.parametrize("scene", SCENES[3:6])  # the first is the one of all samplers' law
def test_unbiased(renderer, scene):
    scene = load(renderer, scene, (32, 32))
    references = render_references(renderer, scene, spp=256)
    assert references.mean() > 0.01  # black images agree all too well
    for pixels in DISTANCES:
        for name, result in gradient_tests(render_ours(scene, "gpt", pixels=pixels), references, pixels=pixels):
            assert result.passed, f"{name} over {pixels} pixels: {result}"


@pytest.mark.slow
@pytest.mark.parametrize("scene", SCENES)
def test_unbiased_with_a_large_budget(renderer, scene):
    scene = load(renderer, scene, (64, 64))
    stacks = render_ours(scene, "gpt", spp=512)
    for name, result in gradient_tests(stacks, render_references(renderer, scene, batches=32, spp=1024)):
        assert result.passed, f"{name}: {result}"


@pytest.mark.parametrize("threshold", [0.0, pytest.param(10.0, marks=pytest.mark.slow)])
def test_unbiased_whatever_is_connectable(renderer, threshold):
    """All that is not a mirror, and nothing at all, which leaves random sequence replay."""
    scene = load(renderer, plenty, (32, 32))
    references = render_references(renderer, scene, spp=128)
    for name, result in gradient_tests(render_ours(scene, "gpt", roughness_threshold=threshold), references):
        assert result.passed, f"{name}: {result}"


@pytest.mark.slow
def test_agrees_with_the_teaching_sampler(renderer):
    scene = load(renderer, plenty, (32, 32))
    ours, theirs = render_ours(scene, "gpt"), render_ours(scene, "gpt-basic")
    for name in ("primal", "direct", "dx", "dy", "albedo", "normal"):
        result = z_test(np.stack([stack[name] for stack in ours]), np.stack([stack[name] for stack in theirs]))
        assert result.passed, f"{name}: {result}"


@pytest.mark.slow
@pytest.mark.parametrize(
    ("function", "mutant"),
    [
        ("reconnection_jacobian", lambda mi, dr, *geometry: mi.Float(1)),
        ("gradient_weight", lambda mi, dr, r, good: dr.select(good, 2 / (1 + r), 1)),
        pytest.param("gradient_weight", lambda mi, dr, r, good: mi.Float(1), marks=pytest.mark.slow),
        ("SHIFTS", {"dx+": (2, 0), "dx-": (-1, 0), "dy+": (0, 1), "dy-": (0, -1)}),
        pytest.param("SHIFTS", {"dx+": (1, 0), "dx-": (-1, 0), "dy+": (0, -1), "dy-": (0, 1)}, marks=pytest.mark.slow),
    ],
    ids=[
        "no Jacobian",
        "failed shifts count half",
        "all weights equal",
        "off by one",
        "down is up",
    ],
)
def test_mutants_fail_the_z_test(renderer, function, mutant, monkeypatch):
    import drjit as dr

    from data_gen.paths import shift
    from data_gen.samplers.gpt import integrator as gpt

    module = gpt if function == "SHIFTS" else shift
    scene = load(renderer, "diffuse", (32, 32))
    references = render_references(renderer, scene, spp=128)
    monkeypatch.setattr(module, function, partial(mutant, renderer, dr) if callable(mutant) else mutant)
    passed = verdicts(render_ours(scene, "gpt"), references)
    assert passed["primal"] and not (passed["dx"] and passed["dy"])


@pytest.mark.slow
@pytest.mark.parametrize(
    "mutant", ["emission at the joint", pytest.param("light at the joint", marks=pytest.mark.slow)]
)
def test_mutants_that_only_far_shifts_see(renderer, mutant, monkeypatch):
    """Weights that are nearly right between neighbours: the z-test passes over one pixel, and fails over eight."""
    from data_gen.paths import shift
    from data_gen.samplers.gpt import offset_path

    weight, emission = shift.gradient_weight, offset_path.shared_emission
    scene = load(renderer, "glossy", (32, 32))
    references = render_references(renderer, scene, spp=128)
    if mutant == "emission at the joint":
        # What is found at the shared vertex has the density of emitter sampling that the base path knows.
        def of_the_base(scene, lights, x1, Le, p, **geometry):
            return emission(scene, lights, x1, Le, p, **geometry)[0], p

        monkeypatch.setattr(offset_path, "shared_emission", of_the_base)
    else:
        # What is sampled there has the weight 1/2, whatever the densities of the paths that came.
        half = renderer.Float(1)
        monkeypatch.setattr(shift, "gradient_weight", lambda r, good: half if good is True else weight(r, good))
    near, far = (verdicts(render_ours(scene, "gpt", pixels=n), references, n) for n in DISTANCES)
    assert near == {"primal": True, "dx": True, "dy": True}
    assert far["primal"] and not (far["dx"] and far["dy"])


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


def one_direction(film, layer):
    """Differences sampled from one of the two pixels only."""
    gradient, variance = type(film).true_gradient(film, layer)
    ahead = np.s_[:, :-1] if layer == "dx" else np.s_[:-1]
    gradient[ahead] = film._image(film._statistics(f"{layer}+")[1])[ahead]
    return gradient, variance


def wrapped(film, layer):
    """The last column's difference taken to the first."""
    gradient, variance = type(film).true_gradient(film, layer)
    image = film._image(film._statistics("primal")[1])
    return np.where(gradient == 0, np.roll(image, -1, axis=1 if layer == "dx" else 0) - image, gradient), variance


@pytest.mark.slow
@pytest.mark.parametrize("mutant", [one_direction, wrapped])
def test_mutants_of_the_borders_fail_the_z_test(renderer, mutant, monkeypatch):
    from data_gen.film import GradientFilm

    monkeypatch.setattr(GradientFilm, "true_gradient", GradientFilm._gradient, raising=False)
    monkeypatch.setattr(GradientFilm, "_gradient", mutant)
    scene = load(renderer, "diffuse", (32, 32))
    passed = verdicts(render_ours(scene, "gpt"), render_references(renderer, scene, spp=128))
    assert passed["primal"] and not passed["dx"]


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
    import mitsuba as mi

    from data_gen.paths.shift import reconnects, replay_inverts

    assert escapes_from(reconnects, replay_inverts) == 0
    # Without the test of the reverse shift; without the kind of event in it; with a rule that is not symmetric
    assert escapes_from(reconnects, lambda *_: mi.Bool(True))
    assert escapes_from(reconnects, lambda kind, offset, after, base: ~(offset & after & base) | (kind == 2))
    assert escapes_from(lambda kind, base, after, offset: (kind == 0) & base & after, replay_inverts)


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

    from data_gen.paths.shift import gradient_weight, mis_weight

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


def test_mean_gradients_have_no_curl(renderer):
    stacks = render_ours(load(renderer, "glossy", (32, 32)), "gpt")

    def curl(stack):
        dx, dy = stack["dx"], stack["dy"]
        return (dx[:-1, :-1] + dy[:-1, 1:] - dx[1:, :-1] - dy[:-1, :-1])[:28, :28]

    curls = np.stack([curl(stack) for stack in stacks])
    assert np.abs(curls).max() > 0  # single renders do have it
    result = z_test(curls, np.zeros_like(curls), block=4)
    assert result.passed, result


def test_furnace(renderer):
    stacks = render_ours(load(renderer, furnace, (16, 16)), "gpt", batches=16, spp=64)
    for name, expected in (("primal", 1.0), ("dx", 0.0), ("dy", 0.0)):
        ours = np.stack([stack[name] for stack in stacks])
        result = z_test(ours, np.full_like(ours, expected))
        assert result.passed, f"{name}: {result}"


def test_mirror_image(renderer):
    def render(side):
        return render_ours(load(renderer, lambda: one_sided(side), (32, 24)), "gpt")

    right, left = render(1), render(-1)
    assert not verdicts(left, np.stack([stack["primal"] for stack in right]))["primal"]
    mirrored = np.stack([-stack["dx"][:, -2::-1] for stack in left])
    assert z_test(np.stack([stack["dx"][:, :-1] for stack in right]), mirrored).passed
    mirrored = np.stack([stack["dy"][:, ::-1] for stack in left])
    assert z_test(np.stack([stack["dy"] for stack in right]), mirrored).passed


def test_less_noise_than_replay_alone(renderer):
    from data_gen.render import render_stack

    scene = load(renderer, "diffuse", (64, 64))
    ours, theirs = (render_stack(scene, 16, 0, sampler) for sampler in ("gpt", "gpt-basic"))
    for name in ("dx_var", "dy_var"):
        assert ours[name].mean() < 0.75 * theirs[name].mean()


def test_same_seed_same_bits(renderer):
    from data_gen.render import render_stack

    scene = load(renderer, "glossy", (16, 12))
    a, b, c = (render_stack(scene, 8, seed) for seed in (7, 7, 8))
    for name in a.names:
        assert np.array_equal(a[name], b[name]), name
    assert not np.array_equal(a["dx"], c["dx"])


@pytest.mark.parametrize(("max_depth", "lit"), [(0, False), (1, False), (2, True), (-1, True)])
def test_depth_limits(renderer, max_depth, lit):
    from data_gen.render import render_stack

    def scene():
        description = polished(0.3)
        description["integrator"]["max_depth"] = max_depth
        return description

    scene = load(renderer, scene, (12, 12))
    stack = render_stack(scene, 64)
    assert stack.attributes["ngpt:sampler"] == "gpt"
    assert stack["dx"].any() == lit
    assert stack["primal"].mean() == pytest.approx(np.array(renderer.render(scene, spp=256)).mean(), rel=0.05)


def test_works_as_a_mitsuba_integrator(renderer):
    scene = load(renderer, "diffuse", (20, 10))
    integrator = renderer.load_dict({"type": "gpt", "max_depth": 3})
    image = renderer.render(scene, integrator=integrator, spp=4)
    names = integrator.aov_names()
    assert image.shape == (10, 20, len(names))
    assert names[:3] == ["primal.R", "primal.G", "primal.B"] and {"dx.B", "normal.Z", "depth.Z"} < set(names)


def test_the_choice_of_a_sampler(renderer):
    from data_gen.inspect import inspect_scene
    from data_gen.render import render_stack
    from data_gen.samplers import choose
    from data_gen.scenes.facts import scene_facts

    assert choose(scene_facts(load(renderer, "diffuse", (4, 4))))[0] == "gpt"
    assert inspect_scene("diffuse")["plan"][1] == "because the integrator is 'path' and there are no media"
    foggy = load(renderer, fog, (4, 4))
    assert choose(scene_facts(foggy)) == ("gpt", "the integrator is 'volpath' and there are media")

    def unseen_fog():
        return fog() | {"integrator": {"type": "path"}}

    unseen = load(renderer, unseen_fog, (4, 4))
    assert "media" in choose(scene_facts(unseen))[1]
    with pytest.raises(NgptError, match=r"'gpt' cannot render this scene: there are media.*--sampler gpt-basic"):
        render_stack(unseen, 1, sampler="gpt")


def test_polarised_light_is_declined(renderer):
    from data_gen.backend import use_variant

    use_variant("llvm_ad_spectral_polarized")
    try:
        import mitsuba as mi

        from data_gen.render import render_stack

        scene = load(mi, "diffuse", (4, 4))
        with pytest.raises(NgptError, match="polarised"):
            render_stack(scene, 1, sampler="gpt")
        with pytest.raises(NgptError, match="is polarised, which 'gpt' does not follow; use --sampler gpt-basic"):
            mi.load_dict({"type": "gpt"}).render(scene, spp=1)
    finally:
        use_variant("llvm_ad_rgb")
