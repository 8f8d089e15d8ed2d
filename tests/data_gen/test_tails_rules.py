"""Rules of shared tails by themselves, without a render: where cells are found, who may end, and how many feed."""

import math
from types import SimpleNamespace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from data_gen.tails import feeding
from data_gen.tails.cache import NEAR, Trail
from data_gen.tails.table import CellPlace, in_table, key


def test_cells_that_share_a_place_find_others(renderer):
    """All 300 cells have the same first place in the table."""
    keys, names = dr.zeros(mi.UInt32, 1024), dr.arange(mi.UInt32, 300) + 1
    h = dr.full(mi.UInt32, 1000, 300)
    made, placed = in_table(keys, h, names, mi.Bool(True), fill=True)
    dr.eval(made, placed, keys)
    assert np.array(placed).all() and len({*np.array(made)}) == 300
    found, there = in_table(keys, h, names, mi.Bool(True))
    assert np.array(there).all() and np.array_equal(found, made)
    assert not np.array(in_table(keys, h, names + 300, mi.Bool(True))[1]).any()


def test_cells_of_other_sizes_are_other_cells(renderer):
    """Cells of two sizes with the same number along each axis lie in different places of the scene."""
    p, level = np.array([[0.3, 0.6], [0.7, 1.4], [-0.2, -0.4]]), np.array([-3, -2])
    first, name, _ = key(CellPlace(mi.Point3f(p), mi.UInt32(0), mi.Int32(level)))
    assert first[0] != first[1] and name[0] != name[1]


def vertex(t):
    x = dr.zeros(mi.SurfaceInteraction3f, 1)
    # Seen at 60 degrees, from inside the scene
    x.t, x.wi, x.shape = (
        mi.Float(t),
        mi.Vector3f(math.sqrt(0.75), 0, 0.5),
        mi.ShapePtr(mi.load_dict({"type": "sphere"})),
    )
    return x


def test_smooth_events_widen_a_path_and_sharp_ones_lengthen_it(renderer):
    """A step of length t behind a smooth event of density p adds t / sqrt(p cos θ) to the spread."""
    trail, there, outside = Trail.to(mi.Float(2)), mi.Bool(True), mi.Bool(False)
    sharp = trail.on(vertex(3.0), outside, mi.Bool(False), mi.Float(1.0), there)
    assert (sharp.reach[0], sharp.spread[0]) == (5, 0)
    once = sharp.on(vertex(4.0), outside, mi.Bool(True), mi.Float(0.5), there)
    assert (once.reach[0], once.spread[0]) == (5, pytest.approx(8))
    # What is sharp behind a rough surface neither widens nor lengthens it.
    again = once.on(vertex(7.0), outside, mi.Bool(False), mi.Float(1.0), there)
    assert (again.reach[0], again.spread[0]) == (5, pytest.approx(8))
    assert again.on(vertex(1.0), outside, mi.Bool(True), mi.Float(2.0), there).spread[0] == pytest.approx(9)


@pytest.fixture
def gpt_tails(renderer):
    from data_gen.samplers.gpt import tails

    return tails


PLAN = SimpleNamespace(
    limits=SimpleNamespace(max_depth=10),
    replays=False,
    matt=SimpleNamespace(
        at=lambda x, place, active: active,
        lambertian=lambda x, place, active: active,
        reflectance=lambda x, place, active: mi.Color3f(0.5),
    ),
)


class Light:
    """Knows 3 everywhere."""

    def place_of(self, x, inside, spread, late):
        return None

    def look(self, where, least, active):
        return [mi.Color3f(3)], [mi.Color3f(0)], active


def path_at(spread, reach=8.0):
    values = {"x": vertex(1.0), "depth": mi.UInt32(2), "trail": Trail(mi.Float(reach), mi.Float(spread))}
    return SimpleNamespace(place=None, walks=mi.Bool(True), late=mi.Bool(False), β=mi.Color3f(0.25), **values)


@pytest.mark.parametrize("share", [0.5, 0.99, 1.01, 4])
def test_a_path_goes_on_near_the_first_rough_surface(gpt_tails, share):
    """Where its spread is less than a part of its way to there."""
    _, able = gpt_tails.place(PLAN, Light(), path_at(share * NEAR * 8))
    assert able[0] == (share > 1)


def test_differences_get_what_offset_paths_would_find(gpt_tails):
    """Of a joined path that is three times as likely as its base path: 2 / (1 + 3) of the difference of throughputs."""
    joined, replayed = (
        SimpleNamespace(apart=mi.Bool(False), joined=mi.Bool(by), r=mi.Float(3), β=mi.Color3f(0.65), a=mi.Color3f(2))
        for by in (True, False)
    )
    joined.Δ = replayed.Δ = mi.Color3f(1)
    path, found, caustic, error = gpt_tails.end(PLAN, Light(), path_at(8.0), [joined, replayed])
    # ρ C is 1.5.
    assert np.allclose(found, 0.25 * 1.5) and np.allclose([caustic, error], 0) and not path.walks[0]
    assert np.allclose(joined.Δ, 1 + 0.5 * 0.4 * 1.5) and np.allclose(replayed.Δ, 1 + 2 * 1.5)


class Film:
    """A film with 4 samples per pixel: variances of the mean, and errors that pixels share."""

    moments = ("shared",)

    def __init__(self, own, common, size=(64, 64)):
        self.own, self.common, self.size = own, common, size
        self.samples_each = np.full(size, 4)

    def known(self, name):
        image = np.ones((*self.size, 3))
        return (image, self.own * image) if name == "primal" else (self.common * image, None)


@pytest.mark.parametrize(("ratio", "paths"), [(1 / 16, 1 / 4), (1 / 4, 1 / 2), (1e-9, 1 / 16), (100, 1)])
@pytest.mark.parametrize("size", [(64, 64), (20, 68)])
def test_paths_that_feed_are_as_the_root_of_both_variances(ratio, paths, size):
    """sqrt(S / V), for what one path of either kind would give; 16x16 pixels are a block, and fewer at borders."""
    fed, own = 2.0, 16**2 / 4
    assert feeding.share(Film(own, math.sqrt(ratio / fed), size), fed) == paths
