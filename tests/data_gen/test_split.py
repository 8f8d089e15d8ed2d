"""The sampler ``split`` shares light out as its layers say, whatever materials are made of.

The budget of z-tests is fixed: 16 stacks against 16 references, a level of 1 % for a scene as a whole.
"""

import numpy as np
import pytest
from data_gen_scenes import fog, hidden_lamp
from unbiased import load, render_ours, render_references

import ngpt
from ngpt.cli import main
from ngpt.errors import NgptError
from ngpt.layers import LAYERS
from ngpt.testing import z_test

PARTS = ("diffuse", "specular")


def coats(specular=1.0):
    """Materials with diffuse lobes and others; with ``specular`` 0 the others are black, the diffuse ones the same."""
    from data_gen.scenes.builtin import _diffuse, _rgb

    satin = {"type": "roughplastic", "alpha": 0.2, "diffuse_reflectance": _rgb(0.6, 0.3, 0.1), "nonlinear": True}
    satin |= {"specular_reflectance": specular}
    gloss = {"type": "plastic", "diffuse_reflectance": _rgb(0.2, 0.5, 0.3), "specular_reflectance": specular}
    metal = {"type": "roughconductor", "material": "Cu", "alpha": 0.3} if specular else _diffuse(0, 0, 0)
    return {
        "satin": satin,
        "gloss": {"type": "twosided", "nested": gloss},
        "hole": {"type": "mask", "opacity": 0.6, "nested": satin},
        "blend": {"type": "blendbsdf", "weight": 0.4, "one": _diffuse(0.5, 0.4, 0.6), "two": metal},
    }


def shelf(materials, max_depth=5, more=None):
    """Balls of these materials on a floor under a large lamp."""
    from data_gen.scenes.builtin import _camera, _diffuse, _light, _sphere, _wall

    def scene():
        places = zip((-1.05, -0.35, 0.35, 1.05), materials.items(), strict=False)
        return {
            "type": "scene",
            "integrator": {"type": "path", "max_depth": max_depth, "rr_depth": 3},
            "sensor": _camera([0, 0.9, 3.2], [0, 0.35, 0], 45),
            "floor": _wall([0, 0, 0], [0, 1, 0], (6, 6), _diffuse(0.5, 0.5, 0.5)),
            "lamp": _light([0, 2.2, 0.8], [0, -1, 0], (2, 2), (3, 3, 3)),
            **{name: _sphere([x, 0.33, 0], 0.33, bsdf) for x, (name, bsdf) in places},
            **(more or {}),
        }

    return scene


def principled(**values):
    base = {"type": "rgb", "value": [0.7, 0.4, 0.2]}
    return {"type": "twosided", "nested": {"type": "principled", "base_color": base, "roughness": 0.4, **values}}


def everything():
    """All that light may meet first: coats, mirrors, glass, metal, principled materials, bumps."""
    import mitsuba as mi

    from data_gen.scenes.builtin import _sphere

    relief = mi.Bitmap(np.random.default_rng(3).random((8, 8), np.float32))
    bump = {"type": "bitmap", "raw": True, "bitmap": relief}
    first = {**coats(), "paint": principled(metallic=0.2, clearcoat=0.5)}
    behind = {
        "mirror": {"type": "conductor"},
        "glass": {"type": "dielectric"},
        "frosted": {"type": "roughdielectric", "alpha": 0.2},
        "relief": {"type": "bumpmap", "texture": bump, "scale": 0.05, "nested": principled(metallic=0.5)["nested"]},
    }
    places = zip((-1, -0.3, 0.4, 1.1), behind.items(), strict=True)
    more = {name: _sphere([x, 1.0, -0.4], 0.33, bsdf) for x, (name, bsdf) in places}
    more["paint"] = _sphere([0, 0.2, 1.2], 0.2, first.pop("paint"))
    # Without it ``path`` loses light behind holes.
    more["sky"] = {"type": "constant", "radiance": 0.2}
    return shelf(first, more=more)()


def test_all_of_it_is_the_light_of_path(renderer):
    scene = load(renderer, everything, (32, 32))
    stacks = render_ours(scene, "split", spp=32)
    references = render_references(renderer, scene, batches=16, spp=64)
    for stack in stacks:
        parts = stack["direct"] + stack["diffuse"] + stack["specular"]
        np.testing.assert_allclose(stack["primal"], parts, rtol=1e-5, atol=1e-6)
        assert min(stack[name].min() for name in PARTS) >= 0
    result = z_test(np.stack([stack["primal"] for stack in stacks]), references)
    assert references.mean() > 0.1 and result.passed, result


@pytest.mark.slow
@pytest.mark.parametrize("scene", ["glossy", "environment", "lens", everything])
def test_all_of_it_is_the_light_of_path_with_a_large_budget(renderer, scene):
    scene = load(renderer, scene, (48, 48))
    ours = np.stack([stack["primal"] for stack in render_ours(scene, "split", spp=512)])
    assert z_test(ours, render_references(renderer, scene, batches=16, spp=512)).passed


def test_what_is_diffuse_has_no_specular_light(renderer):
    (stack,) = render_ours(load(renderer, "diffuse", (16, 16)), "split", batches=1, spp=4)
    assert stack["diffuse"].any() and not stack["specular"].any() and not stack["specular_var"].any()


def test_what_is_not_has_no_diffuse_light(renderer):
    """Gloss, glass, mirrors, and a principled metal."""
    bare = {
        "metal": {"type": "roughconductor", "alpha": 0.2},
        "glass": {"type": "dielectric"},
        "frosted": {"type": "roughdielectric", "alpha": 0.2},
        "gold": principled(metallic=1.0),
    }

    def without_floor():
        scene = shelf(bare)()
        return scene | {"floor": scene["floor"] | {"bsdf": {"type": "roughconductor", "alpha": 0.3}}}

    (stack,) = render_ours(load(renderer, without_floor, (24, 24)), "split", batches=1, spp=16)
    assert stack["specular"].any() and not stack["diffuse"].any() and not stack["diffuse_var"].any()


@pytest.mark.slow
def test_diffuse_light_is_that_of_the_same_materials_without_gloss(renderer):
    """Of light that lamps send to what the camera sees; Mitsuba renders the materials whose gloss is black."""
    stacks = render_ours(load(renderer, shelf(coats(), 2), (32, 32)), "split", spp=32)
    black = load(renderer, shelf(coats(0.0), 2, {"sky": {"type": "constant", "radiance": 1e-9}}), (32, 32))
    references = render_references(renderer, black, batches=16, spp=128)
    result = z_test(np.stack([stack["diffuse"] for stack in stacks]), references)
    assert result.passed, result
    # With the gloss it is another image.
    assert not z_test(np.stack([stack["diffuse"] + stack["specular"] for stack in stacks]), references).passed


def by_lobe(mi, scene, seed, spp):
    """Diffuse light by sampling that lobe alone at the first vertex, and Mitsuba's ``path`` from there on."""
    import drjit as dr

    from data_gen.paths.camera import CameraSamples

    camera = CameraSamples(scene.sensors()[0], seed, spp)
    ray, _, _ = camera.rays()
    si = scene.ray_intersect(mi.Ray3f(ray))
    only = mi.BSDFContext()
    only.type_mask = int(mi.BSDFFlags.Diffuse)
    diffuse = si.is_valid() & mi.has_flag(si.bsdf().flags(), mi.BSDFFlags.Diffuse)
    u = camera.random.next_1d(), camera.random.next_2d()
    sample, weight = si.bsdf().sample(only, si, *u, diffuse)
    found = diffuse & (sample.pdf > 0)
    path = mi.load_dict({"type": "path", "max_depth": 4, "rr_depth": 3})
    L = weight * path.sample(scene, camera.random, si.spawn_ray(si.to_world(sample.wo)), None, found)[0]
    light = np.array(dr.select(found, mi.Color3f(L), 0)).T.reshape(-1, spp, 3).mean(axis=1)
    width, height = (int(n) for n in camera.size)
    return light.reshape(height, width, 3)


@pytest.mark.slow
def test_diffuse_light_is_that_of_diffuse_lobes(renderer):
    """Light that comes over further surfaces too."""
    coated = {name: bsdf for name, bsdf in coats().items() if name != "hole"}
    scene = load(renderer, shelf(coated), (24, 24))
    stacks = render_ours(scene, "split", spp=64)
    lobes = np.stack([by_lobe(renderer, scene, 500 + i, 256) for i in range(16)])
    result = z_test(np.stack([stack["diffuse"] for stack in stacks]), lobes)
    assert result.passed, result
    # All light is another image by far.
    assert not z_test(np.stack([stack["primal"] - stack["direct"] for stack in stacks]), lobes).passed


def shares(mi, description, n=2000):
    """The share of diffuse lobes at random pairs of directions, f of them alone, of the others alone, of all."""
    import drjit as dr

    from data_gen.paths.lobes import Lobes

    scene = mi.load_dict({"type": "scene", "shape": {"type": "rectangle", "bsdf": description}})
    rng = np.random.default_rng(0)
    ray = mi.Ray3f(mi.Point3f(0.1, 0.2, 1), dr.normalize(mi.Vector3f(rng.uniform(-0.1, 0.1, (3, n))) - [0, 0, 1]))
    si = scene.ray_intersect(ray)
    wi, wo = rng.normal(size=(2, 3, n))
    si.wi = dr.normalize(mi.Vector3f(wi[0], wi[1], abs(wi[2])))
    wo = dr.normalize(mi.Vector3f(wo))
    masks = int(mi.BSDFFlags.Diffuse), ~int(mi.BSDFFlags.Diffuse) & 0xFFFFFFFF, 0xFFFFFFFF
    evaluated = []
    for mask in masks:
        context = mi.BSDFContext()
        context.type_mask = mask
        evaluated.append(np.nan_to_num(np.array(si.bsdf().eval(context, si, wo))))
    share = Lobes(scene).diffuse(si, wo, mi.Bool(True))
    cosines = np.array(wo.z), np.array(si.wi.z)
    return np.array(share), *evaluated, cosines


@pytest.mark.slow
def test_materials_hear_the_mask_but_for_those_that_are_known_not_to(renderer):
    """The day a principled material fails this, it may go from ``lobes.DEAF``."""
    coated = {"type": "roughplastic", "alpha": 0.2}
    flat = renderer.Bitmap(np.full((4, 4), 0.5, np.float32))
    up = renderer.Bitmap(np.full((4, 4, 3), (0.5, 0.5, 1), np.float32))
    up = {"type": "bitmap", "bitmap": up, "raw": True}
    hearing = {
        **coats(),
        "bump": {"type": "bumpmap", "t": {"type": "bitmap", "bitmap": flat, "raw": True}, "nested": coated},
        "normals": {"type": "normalmap", "normalmap": up, "nested": coated},
        "pplastic": {"type": "pplastic", "alpha": 0.2},
        "metal": {"type": "roughconductor", "alpha": 0.3},
        "frosted": {"type": "roughdielectric", "alpha": 0.3},
        "both": {"type": "blendbsdf", "weight": 0.3, "one": {"type": "twosided", "n": coated}, "two": coated},
    }
    for name, description in hearing.items():
        share, diffuse, others, all_of_it, _ = shares(renderer, description)
        np.testing.assert_allclose(diffuse + others, all_of_it, rtol=1e-4, atol=1e-6, err_msg=name)
        np.testing.assert_allclose(share * all_of_it, diffuse, rtol=1e-4, atol=1e-6, err_msg=name)
    for description in (principled(metallic=0.3), {"type": "principledthin", "roughness": 0.4}):
        _, diffuse, others, all_of_it, _ = shares(renderer, description)
        assert (diffuse + others).mean() > 1.9 * all_of_it.mean()


@pytest.mark.parametrize(("metallic", "spec_trans"), [(0.3, 0.0), (0.0, 0.0), (1.0, 0.0), (0.2, 0.5)])
def test_the_diffuse_part_of_principled_materials_is_lamberts(renderer, metallic, spec_trans):
    bare = principled(metallic=metallic, spec_trans=spec_trans)["nested"]
    for description in (bare, principled(metallic=metallic)) if not spec_trans else (bare,):
        share, _, _, f, (out, into) = shares(renderer, description)
        lambert = (1 - metallic) * (1 - spec_trans) * np.array([[0.7], [0.4], [0.2]]) * np.abs(out) / np.pi
        expected = np.where(out * into > 0, np.minimum(lambert, f), 0)
        np.testing.assert_allclose(share * f, expected, rtol=1e-3, atol=1e-6)


@pytest.mark.parametrize(
    ("scene", "reason"), [(fog, "'split' knows only 'path'"), (hidden_lamp, "hides emitters; use --sampler gpt")]
)
def test_refuses_what_it_cannot_render(renderer, scene, reason):
    from data_gen.render import render_stack

    with pytest.raises(NgptError, match=reason):
        render_stack(load(renderer, scene, (8, 8)), 1, sampler="split")


@pytest.mark.slow
@pytest.mark.parametrize("max_depth", [0, 1])
def test_depth_limits(renderer, max_depth):
    (stack,) = render_ours(load(renderer, shelf(coats(), max_depth), (16, 16)), "split", batches=1, spp=2)
    assert not stack["diffuse"].any() and not stack["specular"].any()
    assert np.array_equal(stack["primal"], stack["direct"])


@pytest.fixture
def stacks(renderer):
    from data_gen.render import render_stack

    return [render_stack(load(renderer, "glossy", (12, 8)), 8, seed, "split") for seed in (1, 2)]


def test_files_hold_the_parts(stacks, tmp_path, capsys):
    path = tmp_path / "stack.exr"
    ngpt.write(path, stacks[0])
    read = ngpt.read(path)
    assert read.names == stacks[0].names and set(PARTS) < set(read.names)
    for name in (*PARTS, *(f"{name}_var" for name in PARTS)):
        np.testing.assert_allclose(read[name], stacks[0][name], rtol=1e-3, atol=1e-4)
        assert read[name].dtype == np.float32 and LAYERS[name].float_on_disk == name.endswith("_var")
    assert main(["info", str(path)]) == 0
    told = capsys.readouterr().out
    assert all(name in told for name in ("diffuse", "specular", "diffuse_var"))


def test_merged_stacks_have_merged_parts(stacks):
    from ngpt.merging import merge

    merged = merge(stacks)
    for name in PARTS:
        np.testing.assert_allclose(merged[name], (stacks[0][name] + stacks[1][name]) / 2, rtol=1e-5, atol=1e-6)
        # About half of that of either
        assert 0.3 < merged[f"{name}_var"].mean() / np.mean([stack[f"{name}_var"] for stack in stacks]) < 0.7
