"""What some varied scenes have and others have not: as often as is said, from the seed alone, beside the same scene."""

import subprocess
import sys
import zlib
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree as xml

import numpy as np
import pytest
from unbiased import load

pytest.importorskip("mitsuba")

from data_gen.dataset import crops, jobs
from data_gen.dataset.cameras import Surroundings, find_view
from data_gen.dataset.config import DatasetConfig, made_name
from data_gen.scenes.builtin import _box, _camera, _diffuse, _sphere, _volume, _wall
from data_gen.scenes.procedural import hard_light, media, things, variety
from data_gen.scenes.procedural.materials import ROLES
from data_gen.scenes.procedural.scenes import _surface, make_scene
from data_gen.scenes.procedural.stage import Stage
from ngpt.errors import NgptError
from ngpt.system.writing import write_json
from ngpt.training.dataset import MANIFEST, read_manifest
from ngpt.training.shards import Shard

RENDERED = """
import sys, mitsuba as mi, numpy as np
mi.set_variant("scalar_rgb")
for path in sys.argv[1:]:
    scene = mi.load_file(path)
    film = mi.traverse(scene.sensors()[0])
    film["film.size"] = [16, 9]
    film.update()
    mi.set_log_level(mi.LogLevel.Error)
    image = np.array(mi.render(scene, spp=4))
    # Bump maps give Mitsuba some samples that are not finite, with and without media; our films leave them out.
    print(path, bool(np.isfinite(image).mean() > 0.9 and np.nanmedian(image) > 0))
"""


def made(tmp_path: Path, name: str, seed, varied: bool = True) -> dict[str, bytes]:
    (tmp_path / name).mkdir()
    make_scene(seed, tmp_path / name, variety.SHARES if varied else None)
    return {path.name: path.read_bytes() for path in (tmp_path / name).iterdir()}


def only(monkeypatch, *sights: str, kind: str = "") -> None:
    monkeypatch.setattr(variety, "SHARES", {name: float(name in sights) for name in variety.SHARES})
    if kind:
        # As often as before by number, so that the same random numbers are left for what comes after.
        monkeypatch.setattr(media, "KINDS", dict.fromkeys(media.KINDS, media.KINDS[kind]))


def test_each_sight_comes_as_often_as_is_said():
    found = [variety.further_sights((11, i))[0] for i in range(3000)]
    for name, share in variety.SHARES.items():
        count = sum(name in sights for sights in found)
        assert abs(count - share * 3000) <= 4 * np.sqrt(3000 * share * (1 - share)), name
    assert 0.1 <= variety.SHARES["media"] <= 0.2
    # Each for itself: both together as often as chance has it.
    both = sum({"hair", "fine"} <= sights for sights in found) / 3000
    assert both == pytest.approx(variety.SHARES["hair"] * variety.SHARES["fine"], abs=0.02)


def test_scenes_are_those_of_before(tmp_path):
    """Training sets are made of names and seeds: a changed scene would be another set under the same name."""
    text = made(tmp_path, "a", 7, varied=False)["scene.xml"]
    assert zlib.crc32(text) == 0x77A5293


def test_a_varied_scene_that_nothing_falls_to_is_the_plain_one(tmp_path):
    seed = next(i for i in range(100) if not variety.further_sights(i)[0])
    assert made(tmp_path, "a", seed) == made(tmp_path, "b", seed, varied=False)


def test_sights_come_on_top_of_the_same_scene(tmp_path, monkeypatch):
    plain = made(tmp_path, "plain", 3, varied=False)
    only(monkeypatch, "hair", "bulbs", "caustic", "media")
    full, again = made(tmp_path, "full", 3), made(tmp_path, "again", 3)
    assert full == again
    assert all(full[name] == data for name, data in plain.items() if name.endswith((".png", ".pfm")))
    assert {f"bulb{i}.ply" for i in range(variety.EMITTERS)} <= full.keys() - plain.keys()
    cameras = [xml.fromstring(scene["scene.xml"]).find("sensor/transform/lookat").attrib for scene in (plain, full)]
    assert cameras[0] == cameras[1]


@pytest.mark.parametrize("seed", range(5))
def test_small_lamps_are_10_to_50_and_small(seed, monkeypatch):
    stage = Stage(np.random.default_rng(seed))
    lamps = variety.bulbs(stage, [])
    assert len(lamps) == variety.EMITTERS and all((lamp.radiance > 0).all() for lamp in lamps)
    spheres = sum(len(lamp.mesh.vertices) for lamp in lamps) / len(variety.sphere(0.01, 8).vertices)
    assert 10 <= spheres <= 50
    other = variety.caustic(stage)
    assert len(variety.bulbs(stage, other)) == variety.EMITTERS


def test_hair_is_as_thin_as_hair():
    rng = np.random.default_rng(2)
    for parts in (things.wires(rng, (4, 4), 2.4), things.tuft(rng), things.net(rng)):
        mesh = parts[0][1]
        corners = mesh.vertices[mesh.faces]
        edges = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=-1)
        assert np.isfinite(mesh.normals).all() and len(mesh.faces) < 60_000
        assert np.median(edges.min(axis=1)) < 0.004  # metres round the tube


def room_of(seed: int) -> Stage:
    """A room of 6 x 4 x 3 metres with a camera in it."""
    stage = Stage(np.random.default_rng(seed))
    stage.area, stage.height, stage.closed = (6.0, 4.0), 3.0, True
    stage.standing.append((1.0, -0.5, 0.6))
    return stage


@pytest.mark.parametrize("seed", range(12))
def test_a_partition_leaves_one_opening_beside_the_camera(seed):
    stage = room_of(seed)
    hard_light.partition(stage)
    slots = [slot for slot in ROLES["wall"] if slot in stage.meshes]
    faces = [mesh for slot in slots for mesh in stage.meshes[slot]]
    assert len(faces) == 2
    low, high = (np.min([m.vertices.min(0) for m in faces], 0), np.max([m.vertices.max(0) for m in faces], 0))
    thick, wide = sorted((high - low)[[0, 2]])
    assert thick == pytest.approx(0.1) and wide in (pytest.approx(4), pytest.approx(6))
    areas = [_surface(mesh) for mesh in faces]
    assert areas[0] == pytest.approx(areas[1]) and 0.4 * 3 * wide < areas[0] < 3 * wide - 0.01 * 1.5
    across = 0 if wide == pytest.approx(4) else 2
    assert abs((low + high)[across] / 2 - (1.0, 0, -0.5)[across]) > hard_light.CLEAR


def test_lamps_differ_by_up_to_100_and_all_is_in_the_room():
    ratios = []
    for seed in range(40):
        stage = room_of(seed)
        lamps = hard_light.lamps(stage, variety.EMITTERS)
        assert len(lamps) == variety.EMITTERS
        power = [light.mean() * _surface(mesh) for mesh, light in lamps]
        ratios.append(max(power) / min(power))
        hard_light.mirrors(stage)
        for mesh in [*(mesh for mesh, _ in lamps), *(mesh for meshes in stage.meshes.values() for mesh in meshes)]:
            # Shades and ledges may reach into walls.
            assert (np.abs(mesh.vertices) <= [3.5, 4.0, 2.5]).all()
    assert 8 < np.median(ratios) < 50 and max(ratios) < 100 * (1 / 0.6)


def test_fine_pictures_repeat_more_often():
    stage = Stage(np.random.default_rng(0))
    stage.add([("floor", variety.box([4, 0.1, 4]))])
    before = {slot: np.ptp(meshes[0].uvs) for slot, meshes in stage.meshes.items()}
    variety.fine_pictures(stage)
    assert all(np.ptp(stage.meshes[slot][0].uvs) >= 3 * size for slot, size in before.items())


def test_fog_dims_light_across_the_place_by_what_is_said(tmp_path):
    depths = []
    for seed in range(40):
        stage = Stage(np.random.default_rng(seed))
        stage.area, stage.closed = (6.0, 4.0), True
        air = media.fog(stage, np.random.default_rng(seed), tmp_path).elements[0]
        scale = float(air.find("float[@name='scale']").get("value"))
        depths.append(6 * scale * np.mean([float(x) for x in air.find("rgb[@name='sigma_t']").get("value").split()]))
    assert 0.15 < min(depths) < 0.4 and 1.2 < max(depths) < 2.5


# A kind of media, or none, and the other sights of a scene
TOGETHER = {
    "": ("hair", "bulbs", "fine"),
    "fog": ("media", "caustic", "mirrors"),
    "beams": ("media", "partition", "lamps"),
    "smoke": ("media",),
    "liquid": ("media",),
}


def test_each_kind_renders(tmp_path, monkeypatch):
    """In Mitsuba's scalar variant, which compiles no kernel."""
    assert {*TOGETHER} == {"", *media.KINDS} and {*variety.SHARES} == {*sum(TOGETHER.values(), ())}
    paths = []
    for number, (kind, sights) in enumerate(TOGETHER.items()):
        folder = tmp_path / str(number)
        folder.mkdir()
        with monkeypatch.context() as patch:
            only(patch, *sights, kind=kind)
            paths.append(str(make_scene((4, number), folder, variety.SHARES)))
        text = (folder / "scene.xml").read_text()
        assert ('"volpath"' in text) == ("<medium" in text) == ("media" in sights)
    command = [sys.executable, "-c", RENDERED, *paths]
    told = subprocess.run(command, capture_output=True, text=True, check=True).stdout.splitlines()
    assert [line for line in told if line.startswith(str(tmp_path))] == [f"{path} True" for path in paths]


@pytest.mark.parametrize("kind", [pytest.param("fog", marks=pytest.mark.slow), "smoke"])
def test_cameras_are_found_beside_media_and_see_through_their_boundaries(renderer, kind):
    """A camera's medium is said once: those in fog stay in it, those outside of smoke stay outside."""
    low, high = ([-3, -0.5, -3], [3, 3, 3]) if kind == "fog" else ([-0.5, 0, -0.5], [0.5, 2, 0.5])
    air = {"type": "homogeneous", "sigma_t": 0.3, "albedo": 0.8}
    lens, grey = {"type": "thinlens", "aperture_radius": 0.01, "focus_distance": 2.0}, _diffuse(0.5, 0.5, 0.5)
    scene = {
        "type": "scene",
        "sensor": _camera([0.2, 1, 2.6], [0, 0.5, 0], 60) | lens,
        "floor": _wall([0, 0, 0], [0, 1, 0], (20, 20), grey),
        "block": _box([0.2, 0.6, 0], [0.3, 1.2, 0.3], 10, grey),
        "medium": _volume((low, high), air),
        **{f"ball{i}": _sphere([1.8 * np.sin(i), 0.3, 1.8 * np.cos(i)], 0.3, grey) for i in range(7)},
    }
    around, rng = Surroundings(load(renderer, scene)), np.random.default_rng(0)
    for _ in range(2):
        origin = np.array(find_view(around, rng, 32, 20, 0.005).origin)
        assert np.all((origin > low) & (origin < high)) == (kind == "fog")
    start, towards = np.array([[0.2, 0.6, -9.0]]), np.array([[0.0, 0.0, 1.0]])
    assert around.cast(start, towards, boundaries=True)[0] == pytest.approx(9 + low[2], abs=1e-3)
    distance, normal, _ = around.cast(start, towards)
    # The block, turned by 10 degrees, or a ball before it.
    assert 9 + low[2] + 0.2 < distance[0] < 9 and normal[0, 2] < -0.5
    up = np.array([[0.0, 1.0, 0.0]])
    assert np.isinf(around.cast(start, up)[0])


@pytest.mark.slow
@pytest.mark.parametrize("kind", list(media.KINDS))
def test_crops_of_scenes_with_media(renderer, tmp_path, monkeypatch, kind):
    """By the sampler that `auto` takes; every layer is finite."""
    only(monkeypatch, "media", kind=kind)
    small = {"size": 16, "inputs": 1, "spp": (2, 4), "scenes": 1, "crops": 1, "reference_spp": 8}
    config = DatasetConfig(sampler="auto", varied=True, **small)
    (tmp_path / "shards").mkdir()
    crops.make_shard(config, config.plan()[0], str(tmp_path), "llvm_ad_rgb")
    shard = Shard(tmp_path / config.plan()[0].file)
    assert not shard.record["failures"] and "dx" in shard.names


def test_a_set_begun_before_there_was_an_entry_goes_on(tmp_path):
    config = DatasetConfig(scenes=2)
    jobs.start(config, tmp_path, 8)
    manifest = read_manifest(tmp_path)
    del manifest["config"]["varied"]
    write_json(tmp_path / MANIFEST, manifest)
    jobs.start(config, tmp_path, 8)
    with pytest.raises(NgptError, match="varied differ"):
        jobs.start(replace(config, varied=True), tmp_path, 8)


def test_a_configuration_sets_shares(tmp_path):
    config = DatasetConfig(scenes=40, varied=True, sights={"media": 1.0, "hair": 0.0})
    for number in range(40):
        seed = crops.scene_seed(config, made_name(number))
        sights = variety.further_sights(seed, variety.SHARES | config.sights)[0]
        assert "media" in sights and "hair" not in sights
        # The other sights fall to the scenes that they fell to.
        assert sights - {"media", "hair"} == variety.further_sights(seed)[0] - {"media", "hair"}
    for share in (0.0, 1.0):
        (tmp_path / str(share)).mkdir()
        scene = crops.made_scene(replace(config, sights={"media": share}), made_name(0), tmp_path / str(share))
        assert ("<medium" in scene.read_text()) == bool(share)
