"""Files that Blender wrote: their layers, and what `auto` makes of them."""

import numpy as np
import pytest
from pythons import run

import ngpt
from ngpt.denoisers import oidn
from ngpt.measure.metrics import EPSILON, squared_error, trimmed_mean
from ngpt.sequence.warp import warped

pytestmark = pytest.mark.slow

SIZE = (256, 144)


def render(folder, *options, size=SIZE):
    run("bpy", "blender_scene.py", "--size", "{}x{}".format(*size), *options[:-1], folder, *options[-1])


@pytest.fixture(scope="module")
def noisy(tmp_path_factory):
    """A file of 16 spp, the lens closed."""
    folder = tmp_path_factory.mktemp("noisy")
    render(folder, ["noisy=16:1"])
    return folder / "noisy.exr"


@pytest.fixture(scope="module", params=["sharp", "blurred"])
def scene(request, tmp_path_factory):
    """The stack at 16 spp, lens closed or open; and the trimmed relMSE of an image of it.

    The reference is noisy itself. With two halves, squares have no part of that; what they are relative to would have,
    and is OIDN's image of both halves for that reason: relative to their mean, OIDN's error came out twice as large.
    """
    pytest.importorskip("mitsuba_oidn")
    folder = tmp_path_factory.mktemp(request.param)
    lens = ["--blur"] if request.param == "blurred" else []
    render(folder, *lens, ["noisy=16:1", "a=112:2", "b=112:3"])
    noisy, a, b = (ngpt.read(folder / f"{name}.exr") for name in ("noisy", "a", "b"))
    clean = ngpt.denoise(a.replace(primal=(a["primal"] + b["primal"]) / 2), method="oidn")
    size = clean**2 + EPSILON

    def error(image):
        squares = squared_error(image, a["primal"], b["primal"]) / size
        return trimmed_mean(squares, (image - clean) ** 2 / size, 0.001)

    return noisy, error


def check_layers(stack):
    """What each pass is in Cycles, found by content: not by its name alone."""
    assert stack.names == ("primal", "albedo", "normal", "depth", "alpha")
    assert (stack.width, stack.height) == SIZE
    lengths = np.linalg.norm(stack["normal"], axis=-1)
    assert np.median(lengths) == pytest.approx(1, abs=1e-3)
    # Camera space, z away from the viewer: the back wall looks at the camera, the floor up.
    assert stack["normal"][SIZE[1] // 3, SIZE[0] // 2] == pytest.approx([0, 0, -1], abs=0.15)
    assert stack["normal"][-3, 40] == pytest.approx([0, 1, 0], abs=0.15)
    red, green = stack["albedo"][60, 8], stack["albedo"][60, -8]
    assert red[0] > 5 * red[1] and green[1] > 3 * green[0]
    assert 3 < stack["depth"][SIZE[1] // 2 :].min() < stack["depth"].max() < 20
    assert np.all(stack["alpha"] == 1)


def test_the_parts_of_a_file_are_found(noisy):
    stack = ngpt.read(noisy)
    check_layers(stack)
    # The file holds other passes that a layer could be mistaken for.
    found = stack.source.resolution
    assert {name: where.name.partition(".")[2] for name, where in found.items()} == {
        "primal": "Combined",
        "albedo": "Denoising Albedo",
        "normal": "Denoising Normal",
        "depth": "Denoising Depth",
        "alpha": "Combined",
    }
    if len(stack.source.image.parts) > 1:  # Blender before 5.0 writes one
        assert len({where.part for where in found.values()}) == 4


def test_one_part_holds_the_same(noisy, tmp_path):
    render(tmp_path, "--interleaved", ["noisy=16:1"])
    one, other = ngpt.read(tmp_path / "noisy.exr"), ngpt.read(noisy)
    assert len(one.source.image.parts) == 1
    check_layers(one)
    for name in other.names:
        # Sums of samples in another order: a pixel or two may differ by more.
        assert np.isclose(one[name], other[name], rtol=1e-3, atol=1e-3).mean() > 0.999, name


def test_what_cycles_denoised_is_not_denoised_again(tmp_path):
    render(tmp_path, "--denoised", ["both=4:1"], size=(64, 36))
    render(tmp_path, ["noisy=4:1"], size=(64, 36))
    both, noisy = (ngpt.read(tmp_path / f"{name}.exr") for name in ("both", "noisy"))
    assert both.source.resolution["primal"].name.endswith("Noisy Image")
    assert np.isclose(both["primal"], noisy["primal"], rtol=1e-3, atol=1e-3).mean() > 0.999
    denoised = ngpt.read(tmp_path / "both.exr", layers={"primal": "ViewLayer.Combined"})["primal"]
    assert np.abs(denoised - noisy["primal"]).mean() > 0.01


def test_auto_leaves_no_more_than_oidn_and_denoises_without(scene, monkeypatch):
    stack, error = scene
    theirs, noisy = error(ngpt.denoise(stack, method="oidn")), error(stack["primal"])
    assert error(ngpt.denoise(stack)) <= 1.001 * theirs < 0.25 * noisy
    monkeypatch.setattr(oidn, "find_spec", lambda name: None)
    result = ngpt.reconstruct(stack)
    assert result.method == "nfor" and error(result.image) < 0.5 * noisy


def test_motion_leads_to_the_frame_before(tmp_path):
    render(tmp_path, "--moving", ["before=4:1:3", "now=4:1:4"])
    before, now = (ngpt.read(tmp_path / f"{name}.exr") for name in ("before", "now"))

    def distance(motion):
        seen, found = warped(before["albedo"], motion)
        return np.abs(seen - now["albedo"])[found].mean()

    motion = now["motion"]
    assert np.abs(np.median(motion, axis=(0, 1))).min() > 1
    others = [motion * sign for sign in ([0, 0], [-1, -1], [1, -1], [-1, 1])]
    assert distance(motion) < 0.4 * min(map(distance, others))
    temporal = ngpt.Temporal()
    for stack in (before, now):
        temporal.next(stack, ngpt.denoise(stack))
    assert temporal.share > 0.2 and not temporal.reason


@pytest.mark.parametrize("layout", [[], ["--interleaved"]], ids=["many parts", "one part"])
def test_both_eyes_are_denoised_and_written_back(tmp_path, layout):
    render(tmp_path, "--stereo", *layout, ["both=4:1"], size=(96, 54))
    stacks = ngpt.read_views(tmp_path / "both.exr")
    assert [stack.names for stack in stacks] == [("primal", "albedo", "normal", "depth", "alpha")] * 2
    assert not np.array_equal(stacks[0]["depth"], stacks[1]["depth"])
    images = [ngpt.denoise(stack) for stack in stacks]
    ngpt.write(tmp_path / "clean.exr", images, like=stacks)
    for view, image, stack in zip(("left", "right"), images, stacks, strict=True):
        assert np.allclose(ngpt.read_image(tmp_path / "clean.exr", view=view), image, rtol=1e-3)
        again = ngpt.read(tmp_path / "clean.exr", view=view)
        assert all(np.array_equal(again[name], stack[name]) for name in stack.names)
