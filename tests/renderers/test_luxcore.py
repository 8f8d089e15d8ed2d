"""Files that LuxCore wrote, one for each buffer: taken together, and what `auto` makes of them."""

import numpy as np
import pytest
from pythons import run

import ngpt
from ngpt.cli import main
from ngpt.denoisers import oidn
from ngpt.measure.metrics import relmse_trimmed

pytestmark = pytest.mark.slow

# As in test_blender.py.
WITHOUT_OIDN = 3.6


@pytest.fixture(scope="module")
def folders(tmp_path_factory):
    """Folders with the files of a render: at 16 spp, and of two halves of a reference."""
    made = {name: tmp_path_factory.mktemp(name) for name in ("noisy", "a", "b")}
    for seed, (name, spp) in enumerate((("noisy", 16), ("a", 400), ("b", 400)), 1):
        run("pyluxcore", "luxcore_scene.py", made[name], spp, seed)
    return made


@pytest.fixture(scope="module")
def errors(folders):
    halves = [ngpt.read_image(folders[name] / "colour.exr") for name in "ab"]
    return lambda image: relmse_trimmed(image, *halves)


def files(folder):
    return {name: folder / f"{name}.exr" for name in ("albedo", "normal", "depth")}


def test_buffers_in_files_of_their_own_make_a_stack(folders):
    stack = ngpt.read(folders["noisy"] / "colour.exr", files=files(folders["noisy"]))
    assert stack.names == ("primal", "albedo", "normal", "depth")
    height, width = stack.height, stack.width
    assert np.array_equal(stack["normal"][height // 3, width // 2], [0, -1, 0])  # world space
    assert np.abs(stack["normal"][-3, width // 2]) == pytest.approx([0, 0, 1], abs=0.01)
    red, green = stack["albedo"][height // 2, 4], stack["albedo"][height // 2, -4]
    assert red[0] > 5 * red[1] and green[1] > 3 * green[0]
    # LuxCore writes infinity where a ray meets nothing.
    assert 3 < stack["depth"].min() < stack["depth"][np.isfinite(stack["depth"])].max() < 20


@pytest.mark.parametrize("peer", [True, False], ids=["oidn", "no-oidn"])
def test_auto_denoises_them(folders, errors, tmp_path, monkeypatch, peer):
    pytest.importorskip("mitsuba_oidn")
    folder = folders["noisy"]
    stack = ngpt.read(folder / "colour.exr", files=files(folder))
    theirs, most = errors(ngpt.denoise(stack, method="oidn")), 1.001 if peer else WITHOUT_OIDN
    if not peer:
        monkeypatch.setattr(oidn, "find_spec", lambda name: None)
    result = tmp_path / "clean.exr"
    layers = [argument for name, path in files(folder).items() for argument in (f"--{name}", str(path))]
    assert main(["denoise", str(folder / "colour.exr"), *layers, "-o", str(result), "-q"]) == 0
    ours, noisy = errors(ngpt.read_image(result)), errors(stack["primal"])
    print(f"{ngpt.read(result).attributes['ngpt:method']} {ours:.5f}, OIDN {theirs:.5f}, input {noisy:.5f}")
    assert ours <= most * theirs and ours < 0.5 * noisy
