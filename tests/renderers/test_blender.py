"""Files that Blender wrote: their layers, what `auto` makes of them, and the add-on in Blender itself."""

import json

import numpy as np
import pytest
from pythons import ROOT, python_with, run

import ngpt
from ngpt.denoisers import oidn
from ngpt.measure.metrics import EPSILON, squared_error, trimmed_mean

pytestmark = pytest.mark.slow

SIZE = (256, 144)
# `auto` where OIDN is not installed, over OIDN's error. ngpt-colour is what sets it: tighten it with every new one.
WITHOUT_OIDN = 4.0


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


def test_auto_leaves_no_more_than_oidn_and_is_near_it_without(scene, monkeypatch):
    stack, error = scene
    theirs, noisy = error(ngpt.denoise(stack, method="oidn")), error(stack["primal"])
    assert error(ngpt.denoise(stack)) <= 1.001 * theirs < 0.25 * noisy
    monkeypatch.setattr(oidn, "find_spec", lambda name: None)
    result = ngpt.reconstruct(stack)
    assert result.method not in ("oidn", "primal")
    ours = error(result.image)
    print(f"{result.method} {ours:.5f}, OIDN {theirs:.5f}: {ours / theirs:.2f}; input {noisy:.5f}")
    assert ours <= WITHOUT_OIDN * theirs


# --- the add-on ------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def addon(tmp_path_factory):
    """A folder with what the add-on did, and its report."""
    folder = tmp_path_factory.mktemp("addon")
    python_with("onnxruntime")
    run("bpy", "blender_addon.py", ROOT / "export" / "hosts" / "blender" / "ngpt_denoise.py",
        ROOT / "ngpt" / "weights", folder, BLENDER_USER_RESOURCES=str(folder / "user"))  # fmt: skip
    said = json.loads((folder / "report.json").read_text())
    assert "failed" not in said, said["failed"]
    return folder, said


@pytest.mark.parametrize("name", ["passes", "tiles", "colour"])
def test_the_addons_pixels_are_ours(addon, name):
    folder, said = addon
    assert said.get(name, "") == ""
    stack = ngpt.read(folder / f"{'colour' if name == 'colour' else 'passes'}.exr")
    assert ("albedo" in stack) == (name != "colour")
    expected = ngpt.denoise(stack, method="ngpt-colour")
    image = np.load(folder / f"{name}.npy")
    assert image.shape[:2] == expected.shape[:2]
    assert np.abs(image[..., :3] - expected).max() <= 1e-4 * expected.max()
    if name == "colour":
        assert np.array_equal(image[..., 3:], stack["alpha"]) and stack["alpha"].min() == 0


def test_the_addon_leaves_the_scene_as_it_was(addon):
    _, said = addon
    assert "scripts" in said["installed"] and said["settings stay"] and said["removed"]
    assert said["image"] == [True, "Linear Rec.709", True]
    assert said["panel"] == ["network", "denoising_store_passes", "render.ngpt_denoise"]


@pytest.mark.parametrize(
    ("case", "message"),
    [
        ("no render", "there is no render yet"),
        ("no network", "there is no network at"),
        ("needs gradients", "ngpt-fast.onnx needs dx, dy, "),
        ("no onnxruntime", "-m pip install onnxruntime"),
    ],
)
def test_the_addon_says_what_is_missing(addon, case, message):
    said = addon[1][case]
    assert message in said and "Traceback" not in said and "\n" not in said
