"""Renders with subpixels: each sample counts in the one that it lies in, whatever the passes."""

import numpy as np
import pytest
from unbiased import load, same

import ngpt
from ngpt.errors import WrongUse
from ngpt.subpixels import FEWEST, FINE, means

pytest.importorskip("mitsuba")

from data_gen import passes
from data_gen.adaptive import Adaptive, UnevenRender
from data_gen.film import GradientFilm
from data_gen.paths.camera import CameraSamples
from data_gen.render import render_stack
from data_gen.samplers import find
from data_gen.session import render_frames

SIZE = (13, 9)


def same_fine(one, other):
    assert one.fine.keys() == other.fine.keys()
    for name in one.fine:
        assert np.array_equal(one.fine[name], other.fine[name], equal_nan=True), name


@pytest.mark.parametrize("k", [2, 4])
@pytest.mark.parametrize("first", [0, 16])
def test_each_subpixel_has_as_many_points(renderer, k, first):
    sensor = load(renderer, "diffuse", SIZE).sensors()[0]
    camera = CameraSamples(sensor, 3, 16, first, net=16)
    cells = np.array(camera.cells(k)).reshape(-1, 16)
    assert (np.sort(cells, axis=1) == np.repeat(np.arange(k * k), 16 // (k * k))).all()
    # As far as positions can tell, they are where the rays go.
    x, y = (np.array(c).reshape(-1, 16) % 1 for c in (camera.position.x, camera.position.y))
    there = np.floor(k * y) * k + np.floor(k * x)
    assert (cells == there).mean() > 0.999


@pytest.mark.parametrize("k", [1, 2, 4])
@pytest.mark.parametrize("sampler", ["primal", "gpt"])
def test_pixels_are_the_means_of_their_subpixels(renderer, sampler, k):
    scene = load(renderer, "glossy", SIZE)
    plain, stack = (render_stack(scene, 16, 3, sampler, subpixels=n) for n in (1, k))
    if k == 1:
        assert not stack.fine and "ngpt:subpixels" not in stack.attributes
        same(stack, plain)
        return
    assert stack.attributes["ngpt:subpixels"] == k and set(stack.fine) == set(FINE)
    for name in FINE:
        assert stack.fine[name].shape == (9 * k, 13 * k, 3)
        assert np.array_equal(means(stack.fine[name], k), stack[name])
        # Features are rounded to half floats; light only differs by the order of sums.
        scale = np.abs(plain[name]).max()
        assert np.abs(stack[name] - plain[name]).max() < (1e-6 if name == "primal" else 5e-4) * scale
    for name in set(plain.names) - set(FINE):
        assert np.array_equal(stack[name], plain[name], equal_nan=True), name


def test_subpixels_are_the_pixels_of_a_larger_image(renderer):
    """Means over many samples, against an image of twice the size: nothing is mirrored or swapped."""
    scene, large = load(renderer, "diffuse", SIZE), load(renderer, "diffuse", (26, 18))
    fine = render_stack(scene, 256, 1, "primal", subpixels=2).fine
    other = render_stack(large, 64, 2, "primal")
    for name in ("albedo", "normal"):
        assert np.abs(fine[name] - other[name]).mean() < 0.02
        assert np.abs(fine[name][:, ::-1] - other[name]).mean() > 0.04


@pytest.mark.parametrize("spp", [1, 3, 6, 16])
@pytest.mark.parametrize("points", ["sobol", "independent"])
def test_any_number_of_samples_fills_all_subpixels(renderer, spp, points):
    stack = render_stack(load(renderer, "diffuse", SIZE), spp, 3, "primal", points=points, subpixels=4)
    for name in FINE:
        assert np.isfinite(stack.fine[name]).all() and np.array_equal(means(stack.fine[name], 4), stack[name])


def test_the_bits_do_not_depend_on_passes(renderer, monkeypatch):
    scene = load(renderer, "glossy", SIZE)
    whole = render_stack(scene, 40, 3, "primal", subpixels=2)
    monkeypatch.setattr(passes, "FIRST_LANES", 1)
    monkeypatch.setattr(passes, "PASS_SECONDS", 0)
    same_fine(render_stack(scene, 40, 3, "primal", subpixels=2), whole)


def test_adaptive_samples_count_in_their_subpixels(renderer, rng):
    scene, blocks = load(renderer, "glossy", SIZE), rng.integers(0, 3, SIZE[0] * SIZE[1])
    work = UnevenRender(find("primal").made(scene), scene.sensors()[0], 3, points="sobol", subpixels=2)
    work.add(np.ones(len(blocks), int), whole=True)
    work.add(blocks)
    stack, counts = work.film.stack(), 16 * (1 + blocks.reshape(SIZE[::-1]))
    assert np.array_equal(stack["samples"][..., 0], counts)
    for n in np.unique(counts):
        here = (counts == n).repeat(2, axis=0).repeat(2, axis=1)
        even = render_stack(scene, int(n), 3, "primal", points="rounds", subpixels=2)
        assert np.array_equal(stack.fine["primal"][here], even.fine["primal"][here])
    whole = render_stack(scene, 48, 3, "primal", adaptive=Adaptive(method="primal"), subpixels=2)
    assert np.array_equal(means(whole.fine["primal"], 2), whole["primal"])


def test_crops_are_a_part_of_the_whole(renderer):
    from data_gen.scenes.builtin import SCENES

    description = SCENES["diffuse"]()
    film = description["sensor"]["film"]
    film |= {"width": 13, "height": 9, "crop_offset_x": 3, "crop_offset_y": 2, "crop_width": 7, "crop_height": 5}
    stack = render_stack(load(renderer, description), 16, 3, "primal", subpixels=2)
    assert stack.fine["primal"].shape == (10, 14, 3) and stack.place.data.corner == (3, 2)
    whole = render_stack(load(renderer, "diffuse", SIZE), 256, 1, "primal", subpixels=2)
    part = whole.fine["albedo"][4:14, 6:20]
    assert np.abs(stack.fine["albedo"] - part).mean() < 0.05


def test_samples_that_are_not_finite_are_left_out(renderer, rng):
    mi = renderer
    film = GradientFilm(2, 1, subpixels=2)
    camera = CameraSamples(load(mi, "diffuse", (2, 1)).sensors()[0], 3, 8, net=8)
    values = rng.random((2, 8, 3)).astype(np.float32)
    cells = np.array(camera.cells(2)).reshape(2, 8)
    values[0, cells[0] == 1] = np.nan  # a subpixel
    values[1] = np.inf  # a pixel
    film.begin_pass(camera)
    film.put("primal", mi.Color3f(*values.reshape(-1, 3).T))
    film.end_pass(8)
    fine = film.stack().fine["primal"]
    for cell, (y, x) in {0: (0, 0), 2: (1, 0), 3: (1, 1)}.items():
        assert np.allclose(fine[y, x], values[0, cells[0] == cell].mean(axis=0))
    assert np.allclose(fine[0, 1], np.mean([fine[0, 0], fine[1, 0], fine[1, 1]], axis=0))
    assert np.isnan(fine[:, 2:]).all()


def test_subpixels_that_do_not_fit_become_fewer_and_a_line_says_so(renderer, caplog):
    sensor = load(renderer, "diffuse", (256, 128)).sensors()[0]
    one, two = (GradientFilm(256, 128, net=16, subpixels=k).bytes // 2**20 + 129 for k in (1, 2))
    film, _, _ = passes.film_within(two, sensor, 16, subpixels=4, net=16)
    assert film.subpixels == 2 and "4x4 subpixels of 256x128 pixels do not fit" in caplog.text
    assert "2x2 are kept" in caplog.text
    film, _, _ = passes.film_within(one, sensor, 16, subpixels=4, net=16)
    assert film.subpixels == 1 and "none are kept" in caplog.text


def test_what_auto_keeps(renderer):
    scene = load(renderer, "diffuse", SIZE)
    many = render_stack(scene, FEWEST, 3, "primal", subpixels="auto")
    assert many.attributes["ngpt:subpixels"] == 2
    assert not render_stack(scene, FEWEST - 1, 3, "primal", subpixels="auto").fine
    early = render_stack(scene, None, 3, "primal", subpixels="auto", seconds=60, stop=lambda: True)
    if early.attributes["ngpt:spp"] < FEWEST:
        assert not early.fine and "ngpt:subpixels" not in early.attributes
    assert not render_stack(scene, 32, 3, "gpt", subpixels="auto").fine
    assert not render_stack(scene, 4, 3, "bdpt", subpixels="auto").fine


def test_what_cannot_be_kept_is_refused(renderer):
    scene = load(renderer, "diffuse", SIZE)
    with pytest.raises(WrongUse, match=r"sampler 'bdpt' puts light on any pixel.*one of: .*primal"):
        render_stack(scene, 4, 3, "bdpt", subpixels=2)
    with pytest.raises(WrongUse, match="'3' subpixels cannot be kept; write 1, 2, 4, or auto"):
        render_stack(scene, 4, 3, "primal", subpixels=3)


def test_a_render_goes_on_with_its_subpixels(command, tmp_path, renderer):
    line = "render diffuse --size 16x12 --sampler primal --seed 3 -O tails=paths -o a.exr"
    command(f"{line} --spp 16 --subpixels 2")
    command(f"{line} --spp 32 --skip-existing --subpixels 2")
    joined = ngpt.read(tmp_path / "a.exr")
    assert joined.attributes["ngpt:spp"] == 32 and joined.attributes["ngpt:subpixels"] == 2
    assert np.array_equal(means(joined.fine["primal"], 2), joined["primal"])
    assert "subpixels 2, not 4" in command(f"{line} --spp 48 --skip-existing --subpixels 4", 1)
    # One that was begun with few samples, and so without them, goes on without.
    command(f"{line.replace('a.exr', 'b.exr')} --spp 16 --subpixels 1")
    command(f"{line.replace('a.exr', 'b.exr')} --spp 32 --skip-existing --subpixels 1")
    command(f"{line.replace('a.exr', 'c.exr')} --spp 2")
    assert not ngpt.read(tmp_path / "c.exr").fine
    command(f"{line.replace('a.exr', 'c.exr')} --spp 64 --skip-existing")
    assert not ngpt.read(tmp_path / "b.exr").fine and not ngpt.read(tmp_path / "c.exr").fine


def test_shots_have_subpixels(renderer):
    frames = render_frames("diffuse", [0, 1], 16, sampler="primal", size=(8, 6), subpixels=2)
    for _, stack in frames:
        assert "motion" in stack and np.array_equal(means(stack.fine["primal"], 2), stack["primal"])
