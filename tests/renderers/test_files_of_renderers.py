"""Files that renderers wrote, 32x18 pixels, in ``files``: their layers, and what is made of them.

Cycles in Blender 5.0.1 wrote most of them, 4 samples per pixel, multi-layer with *Denoising Data* ticked: a room whose
left wall is red and whose right wall is green. In *interleaved* all passes are in one part; *denoised* has the denoised
image too; *stereo* has two eyes; *before* and *now* are two frames of a moving camera with the pass *Vector*. LuxCore
2.11.2, 16 samples per pixel, wrote a file for each buffer.
"""

import json
from pathlib import Path

import numpy as np
import pytest

import ngpt
from ngpt.cli import main
from ngpt.sequence.warp import warped

FILES = Path(__file__).parent / "files"


def blender(name):
    return ngpt.read(FILES / f"blender-{name}.exr")


@pytest.mark.parametrize(("name", "parts"), [("parts", 4), ("interleaved", 1)])
def test_the_passes_of_cycles_are_what_they_are_by_content(name, parts):
    stack = blender(name)
    assert stack.names == ("primal", "albedo", "normal", "depth", "alpha") and (stack.width, stack.height) == (32, 18)
    # The file holds other passes that a layer could be mistaken for.
    found = stack.source.resolution
    assert {layer: where.name.partition(".")[2] for layer, where in found.items()} == {
        "primal": "Combined",
        "albedo": "Denoising Albedo",
        "normal": "Denoising Normal",
        "depth": "Denoising Depth",
        "alpha": "Combined",
    }
    assert len({where.part for where in found.values()}) == parts
    assert np.median(np.linalg.norm(stack["normal"], axis=-1)) == pytest.approx(1, abs=1e-3)
    # Camera space, z away from the viewer: the back wall looks at the camera, the floor up.
    assert stack["normal"][6, 16] == pytest.approx([0, 0, -1], abs=0.15)
    assert stack["normal"][-2, 5] == pytest.approx([0, 1, 0], abs=0.15)
    red, green = stack["albedo"][7, 1], stack["albedo"][7, -2]
    assert red[0] > 5 * red[1] and green[1] > 3 * green[0]
    assert 3 < stack["depth"][9:].min() < stack["depth"].max() < 20
    assert np.all(stack["alpha"] == 1)
    other = blender("parts")
    for layer in other.names:
        # Sums of samples in another order: a pixel or two may differ by more.
        assert np.isclose(stack[layer], other[layer], rtol=1e-3, atol=1e-3).mean() > 0.99, layer


def test_what_cycles_denoised_is_not_denoised_again():
    both, noisy = blender("denoised"), blender("parts")
    assert both.source.resolution["primal"].name.endswith("Noisy Image")
    assert np.isclose(both["primal"], noisy["primal"], rtol=1e-3, atol=1e-3).mean() > 0.99
    chosen = ngpt.read(FILES / "blender-denoised.exr", layers={"primal": "ViewLayer.Combined"})["primal"]
    assert np.abs(chosen - noisy["primal"]).mean() > 0.01


def test_of_a_file_with_all_features_nothing_is_said_to_be_missing(command):
    assert json.loads(command(f"info {FILES / 'blender-parts.exr'} --json").out)["missing"] == []


def test_motion_leads_to_the_frame_before():
    before, now = blender("before"), blender("now")

    def distance(motion):
        seen, found = warped(before["albedo"], motion)
        return np.abs(seen - now["albedo"])[found].mean()

    motion = now["motion"]
    assert np.abs(np.median(motion, axis=(0, 1))).min() > 0.2
    others = [motion * sign for sign in ([0, 0], [-1, -1], [1, -1], [-1, 1])]
    assert distance(motion) < 0.8 * min(map(distance, others))
    temporal = ngpt.Temporal()
    for stack in (before, now):
        temporal.next(stack, ngpt.denoise(stack))
    assert temporal.share > 0.2 and not temporal.reason


@pytest.mark.parametrize("layout", ["stereo", "stereo-interleaved"])
def test_both_eyes_are_denoised_and_written_back(tmp_path, layout):
    stacks = ngpt.read_views(FILES / f"blender-{layout}.exr")
    assert [stack.names for stack in stacks] == [("primal", "albedo", "normal", "depth", "alpha")] * 2
    assert not np.array_equal(stacks[0]["depth"], stacks[1]["depth"])
    images = [ngpt.denoise(stack) for stack in stacks]
    ngpt.write(tmp_path / "clean.exr", images, like=stacks)
    for view, image, stack in zip(("left", "right"), images, stacks, strict=True):
        assert np.allclose(ngpt.read_image(tmp_path / "clean.exr", view=view), image, rtol=1e-3)
        again = ngpt.read(tmp_path / "clean.exr", view=view)
        assert all(np.array_equal(again[name], stack[name]) for name in stack.names)


def test_buffers_in_files_of_their_own_make_a_stack(tmp_path):
    files = {name: FILES / f"luxcore-{name}.exr" for name in ("albedo", "normal", "depth")}
    stack = ngpt.read(FILES / "luxcore-colour.exr", files=files)
    assert stack.names == ("primal", "albedo", "normal", "depth")
    height, width = stack.height, stack.width
    assert np.array_equal(stack["normal"][height // 3, width // 2], [0, -1, 0])  # world space
    assert np.abs(stack["normal"][-2, width // 2]) == pytest.approx([0, 0, 1], abs=0.01)
    red, green = stack["albedo"][height // 2, 1], stack["albedo"][height // 2, -2]
    assert red[0] > 5 * red[1] and green[1] > 3 * green[0]
    # LuxCore writes infinity where a ray meets nothing.
    assert 3 < stack["depth"].min() < stack["depth"][np.isfinite(stack["depth"])].max() < 20
    layers = [argument for name, path in files.items() for argument in (f"--{name}", str(path))]
    assert main(["denoise", str(FILES / "luxcore-colour.exr"), *layers, "-o", str(tmp_path / "clean.exr"), "-q"]) == 0
    assert np.allclose(ngpt.read_image(tmp_path / "clean.exr"), ngpt.denoise(stack), rtol=1e-2, atol=1e-3)
