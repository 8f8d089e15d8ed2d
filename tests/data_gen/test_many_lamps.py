"""Hundreds of lamps in a scene file, which become few meshes, against the same file as it is."""

import numpy as np
import pytest
from ply_files import square
from unbiased import stacks_of

from data_gen.scenes.load import load_scene
from ngpt.testing import z_test

SIZE, COUNT = (48, 32), 300
CORNERS = ((-1, -1), (1, -1), (1, 1), (-1, 1))
RGB = '<emitter type="area"><rgb name="radiance" value="{}"/></emitter>'
# What may stand where a lamp's shape begins: 300 lamps of these kinds in turn face down, or to all sides (cubes)
KINDS = [
    ("rectangle", "", ""),
    ("rectangle", '<boolean name="flip_normals" value="true"/>', '<rotate x="1" angle="180"/>'),
    ("rectangle", "", '<scale z="-1"/>'),
    ("cube", "", ""),
    ("ply", '<string name="filename" value="plain.ply"/>', ""),
    ("ply", '<string name="filename" value="plain.ply"/><boolean name="flip_normals" value="true"/>', ""),
    ("ply", '<string name="filename" value="against.ply"/>', ""),
]


def write_squares(folder):
    """A square, and two with vertex normals: against the order of the corners, and bent."""
    corners = [(x, y, 0) for x, y in CORNERS]
    bent = [(0.8 * x, 0.8 * y, 1) for x, y in CORNERS]
    for name, normals in (("plain", ()), ("against", 4 * [(0, 0, -1)]), ("bent", bent)):
        (folder / f"{name}.ply").write_text(square(corners, normals))


def lamp(i, rng, kind=None, material="", emitter=None):
    shape, settings, first = KINDS[i % len(KINDS)] if kind is None else kind
    x, y, z = rng.uniform((-2, -2, 0.6), (2, 2, 1.4))
    place = f'{first}<scale value="0.05"/><rotate x="1" angle="{rng.uniform(100, 260):.1f}"/>'
    place += f'<translate x="{x:.3f}" y="{y:.3f}" z="{z:.3f}"/>'
    color = emitter or RGB.format(" ".join(f"{each:.3f}" for each in rng.uniform(0, 30, 3) ** 2 / 30))
    return f'<shape type="{shape}">{settings}<transform name="to_world">{place}</transform>{material}{color}</shape>'


def written(folder, lamps, more="", depth=3):
    write_squares(folder)
    path = folder / "scene.xml"
    path.write_text(
        f'<scene version="3.0.0"><integrator type="path"><integer name="max_depth" value="{depth}"/></integrator>'
        '<sensor type="perspective"><float name="fov" value="70"/><transform name="to_world">'
        '<lookat origin="0,-5,1.2" target="0,0,.4" up="0,0,1"/></transform><film type="hdrfilm">'
        '<integer name="width" value="48"/><integer name="height" value="32"/><rfilter type="box"/></film></sensor>'
        '<shape type="rectangle"><transform name="to_world"><scale value="4"/></transform></shape>'
        f"{more}{''.join(lamps)}</scene>"
    )
    return str(path)


@pytest.fixture(scope="module")
def many(tmp_path_factory):
    rng = np.random.default_rng(4)
    return written(tmp_path_factory.mktemp("lamps"), [lamp(i, rng) for i in range(COUNT)])


def emitters(path, **options):
    return len(load_scene(path, **options).emitters())


def test_many_become_64_meshes(renderer, many):
    assert emitters(many) == 64 and emitters(many, merged=False) == COUNT


def test_each_shines_to_its_own_side_with_its_own_light(renderer, many):
    """Where the camera sees them: the same rays meet the same lamps."""
    mi = renderer
    seen, direct = [], mi.load_dict({"type": "path", "max_depth": 1})
    for merged in (True, False):
        scene = load_scene(many, (192, 128), merged=merged)
        seen.append(np.array(mi.render(scene, integrator=direct, spp=16, seed=3)))
    assert (seen[1] > 0).mean() > 0.02
    assert np.isclose(*seen, rtol=1e-4, atol=1e-4).mean() > 0.9995


@pytest.fixture(scope="module")
def expected(renderer, many):
    return by_path(renderer, load_scene(many, SIZE, merged=False), 48, 100)


def by_path(mi, scene, spp, seed):
    return np.stack([np.array(mi.render(scene, spp=spp, seed=seed + i)) for i in range(8)])


@pytest.mark.parametrize(
    "sampler", ["path", "bdpt", *(pytest.param(s, marks=pytest.mark.slow) for s in ("primal", "gpt"))]
)
def test_their_light_is_that_of_the_file(renderer, many, expected, sampler):
    scene = load_scene(many, SIZE)
    if sampler == "path":
        images = by_path(renderer, scene, 32, 0)
    else:
        images = np.stack([stack["primal"] for stack in stacks_of(scene, sampler, 8, 16)])
    result = z_test(images, expected, block=8)
    assert result.passed, result
    assert images.mean() == pytest.approx(expected.mean(), rel=0.02)


def test_densities_are_those_of_the_samples(renderer, many):
    """The density that a direction sample has is the one that is given for where its ray leads."""
    import drjit as dr

    mi = renderer
    scene = load_scene(many, SIZE)
    random = mi.PCG32(1 << 14)
    x = dr.zeros(mi.SurfaceInteraction3f, 1 << 14)
    x.t, x.p = 0, mi.Point3f(4 * random.next_float32() - 2, 4 * random.next_float32() - 2, 0)
    x.n = mi.Normal3f(0, 0, 1)
    light, weight = scene.sample_emitter_direction(x, mi.Point2f(random.next_float32(), random.next_float32()), False)
    met = scene.ray_intersect(x.spawn_ray(light.d))
    same = (light.pdf > 0) & (dr.abs(met.t - light.dist) < 1e-4)
    p = scene.pdf_emitter_direction(x, mi.DirectionSample3f(scene, met, x), same)
    found, expected = np.array(p)[np.array(same)], np.array(light.pdf)[np.array(same)]
    # At grazing angles rounding counts.
    assert len(found) > 1000 and np.isclose(found, expected, rtol=1e-3).mean() > 0.99
    assert np.allclose(found, expected, rtol=0.05)
    Le = np.array(met.emitter(scene).eval(met, same))[:, np.array(same)]
    assert np.allclose(Le, (np.array(weight) * np.array(light.pdf))[:, np.array(same)], rtol=1e-3)


def test_dark_lamps_are_never_chosen(renderer, tmp_path):
    mi = renderer
    rng = np.random.default_rng(1)
    lamps = [lamp(i, rng, emitter=RGB.format("0" if i % 2 else "1 2 3")) for i in range(COUNT)]
    scene = load_scene(written(tmp_path, lamps), SIZE)
    random = mi.PCG32(1 << 14)
    place, _ = scene.emitters()[5].sample_position(0, mi.Point2f(random.next_float32(), random.next_float32()))
    radiance = scene.emitters()[5].table.radiance
    chosen = np.unique(np.array(place.uv.x).astype(int))
    assert 0 < len(chosen) == (radiance > 0).any(axis=1).sum() < len(radiance)
    assert (radiance[chosen] > 0).all()


CHECKERS = '<texture type="checkerboard" name="{}"/>'


@pytest.mark.parametrize(
    "kind, material, emitter",
    [
        (None, "", f'<emitter type="area">{CHECKERS.format("radiance")}</emitter>'),
        (None, "", '<emitter type="area"><spectrum name="radiance" value="400:1, 500:2"/></emitter>'),
        (None, "", RGB.format(1).replace("<rgb", '<float name="sampling_weight" value="2"/><rgb')),
        (None, f'<bsdf type="diffuse">{CHECKERS.format("reflectance")}</bsdf>', None),
        (None, '<medium type="homogeneous" name="interior"/>', None),
        (("sphere", "", ""), "", None),
        (("ply", '<string name="filename" value="bent.ply"/>', ""), "", None),
    ],
    ids=["texture", "spectrum", "weight", "textured material", "medium", "sphere", "vertex normals"],
)
def test_what_a_merged_lamp_could_not_keep_stays(renderer, tmp_path, kind, material, emitter):
    rng = np.random.default_rng(2)
    lamps = [lamp(i, rng, kind, material, emitter) for i in range(COUNT)]
    assert emitters(written(tmp_path, lamps)) == COUNT


def test_few_stay(renderer, tmp_path):
    rng = np.random.default_rng(2)
    assert emitters(written(tmp_path, [lamp(i, rng) for i in range(255)])) == 255


def test_each_material_has_its_own_meshes(renderer, tmp_path):
    rng = np.random.default_rng(2)
    white = '<bsdf type="twosided"><bsdf type="diffuse"/></bsdf>'
    lamps = [lamp(i, rng, material=white if i % 2 else "") for i in range(2 * COUNT)]
    scene = load_scene(written(tmp_path, lamps))
    assert len(scene.emitters()) == 128
    assert sorted({shape.bsdf().class_name() for shape in scene.shapes() if shape.is_emitter()}) == [
        "SmoothDiffuse",
        "TwoSidedBRDF",
    ]


def test_tiny_ones_behind_glass_are_still_announced(renderer, tmp_path):
    from data_gen.scenes.lost import behind_sharp

    rng = np.random.default_rng(2)
    far = '<shape type="sphere"><point name="center" x="400" y="0" z="0"/><bsdf type="dielectric"/></shape>'
    path = written(tmp_path, [lamp(i, rng) for i in range(COUNT)], more=far)
    assert behind_sharp(load_scene(path)) == behind_sharp(load_scene(path, merged=False)) == "tiny lamps"
