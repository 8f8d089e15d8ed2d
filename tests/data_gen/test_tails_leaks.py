"""How far light leaks in the cache of ``tails="shared"``: through walls, under boards, round edges."""

from functools import partial

import mitsuba as mi
import numpy as np
import pytest
from shared_tails import SIZE, Bias, blocks, images, whole_paths
from tails_scenes import (
    contact,
    door,
    foggy_sheet,
    half_fog,
    shade,
    shelf,
    slit,
    thin_wall,
    two_rooms,
    varnish,
)
from unbiased import load

from data_gen.samplers.gpt import rounds
from data_gen.tails import cache, schedule
from data_gen.tails.schedule import FINENESS, fineness

pytestmark = pytest.mark.usefixtures("small_images_share")

# Scenes, and of 64 samples per pixel, 8 seeds: the largest rms of blocks, and the largest error of the image. Beside
# them what was measured; the noise of the estimate makes some of it imaginary (-). The dark room behind the thin wall
# has a hundredth of the light of the bright one, and gets about a third as much again through the cells of the floor,
# ceiling and back that are on both sides. In the last room light is rare, and 8 seeds know its mean within 5 %.
MOST = {
    shelf: (0.012, 0.004),  # 0.0055, -0.0013
    thin_wall: (0.600, 0.004),  # 0.305, -0.0007
    door: (0.060, 0.020),  # 0.020, -0.002
    shade: (0.060, 0.030),  # -, -0.006
    contact: (0.006, 0.006),  # 0.0023, -0.0028
    slit: (0.150, 0.150),  # 0.075, -0.073
    foggy_sheet: (0.020, 0.008),  # -, 0.0012
    # Squares of four times 8 seeds: .0006, -.0017, .0017, .0013. So .020, the bound until now, was within the noise.
    half_fog: (0.060, 0.014),  # 0.02, 0.002
}
# Edges, walls and light that is found by luck are tested in other ways below and in test_tails.py, too.
QUICK = (contact, foggy_sheet)


def grey_bias(shared, whole):
    return Bias(*(x.mean(axis=-1, keepdims=True) for x in (blocks(shared), whole)), dark=1e-3)


@pytest.mark.parametrize("scene", [s if s in QUICK else pytest.param(s, marks=pytest.mark.slow) for s in MOST])
def test_little_light_leaks(renderer, scene):
    most, most_total = MOST[scene]
    found = grey_bias(images(load(renderer, scene, SIZE), "shared", 64, range(8)), whole_paths(scene))
    assert found.square < most**2
    assert abs(found.total) < most_total
    # What leaks in one place is little, apart from its noise.
    assert (np.abs(found.each) - 3 * found.noise).max() < 2 * most


def bias_of_cells(scene, size, spp, seeds):
    """The mean square of the bias in a small image, with cells of this fineness."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(rounds, "fineness", lambda paths: float(size))
        shared = images(load(mi, scene, (16, 12)), "shared", spp, range(seeds))
    return grey_bias(shared, whole_paths(scene, (16, 12), 3072)).square


@pytest.mark.parametrize("scene", [shelf, varnish])
def test_coarse_cells_have_little_bias(renderer, scene):
    """Cells of twice the usual side, at edges and beside gloss, which is followed. Measured: .001 and below."""
    assert abs(bias_of_cells(scene, FINENESS / 2, 256, 6)) < 0.006**2


@pytest.mark.slow
def test_bias_vanishes_with_the_size_of_cells(renderer, monkeypatch):
    """Light that passes a wall without thickness, where no cell is torn, at three sizes of cells."""
    monkeypatch.setattr(cache, "TORN", 1e9)
    found = np.sqrt([bias_of_cells(thin_wall, size, 256, 6) for size in (4, 8, 16)])
    assert found[0] > 0.2 and found[1] < 0.7 * found[0] and found[2] < 0.7 * found[1], found


def test_cells_shrink_with_paths():
    """By the fourth root, so that bias, which falls with their area, falls as fast as noise."""
    assert fineness(1) == fineness(1 << 20) == FINENESS and fineness(1 << 24) == pytest.approx(2 * FINENESS)


# Walls between a bright and a dark room, 70 : 1: how thick, where, the unit of the scene, and how far from its origin
WALLS = [(0.0, 0.0, 1, 0), (0.0005, 0.05, 1, 0), (0.02, 0.0, 1, 0), (0.1, 0.03, 1e3, 0), (0.02, 0.02, 1e-3, 10)]
# The thinnest that has two sides, and one that is far from the origin
QUICK_WALLS = (WALLS[1], WALLS[4])


@pytest.mark.parametrize("wall", [w if w in QUICK_WALLS else pytest.param(w, marks=pytest.mark.slow) for w in WALLS])
def test_dark_rooms_stay_dark(renderer, monkeypatch, wall):
    """Light of the dark room over the truth. Measured: 1.01 to 1.05; without torn cells, 1.1 to 1.2."""
    monkeypatch.setattr(schedule, "FIRST", 1 << 16)
    rooms, size = partial(two_rooms, *wall), (64, 36)
    whole = whole_paths(rooms, size, 512)
    shared = blocks(images(load(renderer, rooms, size), "shared", 64, range(4)))
    dark, bright = np.s_[:, :, 10:], np.s_[:, :, :6]
    assert whole[dark].mean() < 0.05 * whole[bright].mean()
    assert shared[dark].mean() / whole[dark].mean() < 1.08
    assert shared.mean() / whole.mean() == pytest.approx(1, abs=0.01)


def test_cells_lie_about_the_camera(renderer):
    """Floats are fine there, however large the scene is. Each seed has another grid."""
    sensor = mi.load_dict({"type": "perspective", "to_world": mi.ScalarTransform4f().translate([1e5, 2.0, -3.0])})
    one, other = (rounds.grid(sensor, seed) for seed in (1, 2))
    for grid in (one, other):
        assert np.allclose(np.array(grid.origin).ravel(), [1e5, 2, -3])
    shifts = np.array([np.array(grid.shift).ravel() for grid in (one, other)])
    assert (np.abs(shifts[0] - shifts[1]) > 1e-3).all() and (shifts >= 0).all() and (shifts < 1).all()


def test_odd_images(renderer):
    """Images of one pixel, of part of a picture, and without light."""

    def room(lit=True, **film):
        scene = contact()
        scene["sensor"]["film"].update(width=16, height=12, **film)
        return load(renderer, scene if lit else {name: part for name, part in scene.items() if name != "lamp"})

    part = room(crop_offset_x=3, crop_offset_y=2, crop_width=7, crop_height=5)
    one = room(crop_offset_x=8, crop_offset_y=6, crop_width=1, crop_height=1)
    for scene in (part, one):
        shared, paths = (images(scene, tails, 64, [0]).mean() for tails in ("shared", "paths"))
        assert shared == pytest.approx(paths, rel=0.1)
    assert images(room(lit=False), "shared", 16, [0]).max() == 0
