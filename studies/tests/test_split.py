"""The sampler ``split`` shares light out as its layers say, whatever materials are made of.

The budget of z-tests is fixed: 16 stacks against 16 references, a level of 1 % for a scene as a whole.
"""

import drjit as dr
import numpy as np
import pytest
from references import references
from split_scenes import coats, everything, principled, shelf, without_gloss
from unbiased import assert_unbiased, load, render_ours

import ngpt
from data_gen.render import render_stack
from ngpt.cli import main
from ngpt.merging import merge
from ngpt.testing import z_test

PARTS = ("diffuse", "specular")


def test_all_of_it_is_the_light_of_path(renderer):
    stacks = render_ours(load(renderer, everything, (32, 32)), "split", batches=12, spp=32)
    for stack in stacks:
        parts = stack["direct"] + stack["diffuse"] + stack["specular"]
        np.testing.assert_allclose(stack["primal"], parts, rtol=1e-5, atol=1e-6)
        assert min(stack[name].min() for name in PARTS) >= 0
    assert_unbiased(stacks, references(renderer, everything, (32, 32)))


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
    scene = shelf(bare)()
    scene["floor"]["bsdf"] = {"type": "roughconductor", "alpha": 0.3}
    (stack,) = render_ours(load(renderer, scene, (24, 24)), "split", batches=1, spp=16)
    assert stack["specular"].any() and not stack["diffuse"].any() and not stack["diffuse_var"].any()


@pytest.mark.slow
def test_diffuse_light_is_that_of_the_same_materials_without_gloss(renderer):
    """The mean of light that lamps send to what the camera sees; Mitsuba renders the materials whose gloss is black."""
    stacks = render_ours(load(renderer, shelf(coats(), 2), (32, 32)), "split", spp=32)
    expected = references(renderer, without_gloss, (32, 32))
    result = z_test(np.stack([stack["diffuse"] for stack in stacks]), expected)
    assert result.passed, result
    # With the gloss it is another image.
    assert not z_test(np.stack([stack["diffuse"] + stack["specular"] for stack in stacks]), expected).passed


def shares(mi, description, n=2000):
    """The share of diffuse lobes at random pairs of directions, f of all lobes, and the cosines of the directions."""
    from ngpt_studies.split import Lobes

    scene = mi.load_dict({"type": "scene", "shape": {"type": "rectangle", "bsdf": description}})
    rng = np.random.default_rng(0)
    ray = mi.Ray3f(mi.Point3f(0.1, 0.2, 1), dr.normalize(mi.Vector3f(rng.uniform(-0.1, 0.1, (3, n))) - [0, 0, 1]))
    si = scene.ray_intersect(ray)
    wi, wo = rng.normal(size=(2, 3, n))
    si.wi = dr.normalize(mi.Vector3f(wi[0], wi[1], abs(wi[2])))
    wo = dr.normalize(mi.Vector3f(wo))
    f = np.nan_to_num(np.array(si.bsdf().eval(mi.BSDFContext(), si, wo)))
    return np.array(Lobes(scene).diffuse(si, wo, mi.Bool(True))), f, np.array(wo.z), np.array(si.wi.z)


@pytest.mark.parametrize(("metallic", "spec_trans"), [(0.3, 0.0), (0.0, 0.0), (1.0, 0.0), (0.2, 0.5)])
def test_the_diffuse_part_of_principled_materials_is_lamberts(renderer, metallic, spec_trans):
    bare = principled(metallic=metallic, spec_trans=spec_trans)["nested"]
    for description in (bare, principled(metallic=metallic)) if not spec_trans else (bare,):
        share, f, out, into = shares(renderer, description)
        lambert = (1 - metallic) * (1 - spec_trans) * np.array([[0.7], [0.4], [0.2]]) * np.abs(out) / np.pi
        expected = np.where(out * into > 0, np.minimum(lambert, f), 0)
        np.testing.assert_allclose(share * f, expected, rtol=1e-3, atol=1e-6)


def test_files_and_merged_stacks_hold_the_parts(renderer, tmp_path, capsys):
    stacks = [render_stack(load(renderer, "glossy", (12, 8)), 8, seed, "split", unbiased=True) for seed in (1, 2)]
    path = tmp_path / "stack.exr"
    ngpt.write(path, stacks[0])
    read, merged = ngpt.read(path), merge(stacks)
    assert main(["info", str(path)]) == 0
    told = capsys.readouterr().out
    assert read.names == stacks[0].names
    for name in PARTS:
        one, other = (stack[name] for stack in stacks)
        np.testing.assert_allclose(read[name], one, rtol=1e-3, atol=1e-4)
        np.testing.assert_allclose(merged[name], (one + other) / 2, rtol=1e-5, atol=1e-6)
        assert name in told and f"{name}_var" in read.names
