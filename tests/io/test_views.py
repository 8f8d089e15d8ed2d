"""Views of stereo files: found in every layout, read one by one, and written back in the layout they had."""

import numpy as np
import pytest
from exr_files import read_raw, same_bits, write_raw

from ngpt.errors import NgptError
from ngpt.io.exr import read, read_image, read_views, write
from ngpt.io.views import Part, views_of

SIZE = (4, 6)
LAYERS = {"Combined": "RGBA", "Denoising Albedo": "RGB", "Depth": "Z", "Vector": "XYZW"}


def value(view, layer, suffix):
    """An image whose values say which channel it is."""
    start = 100 * (view == "right") + 10 * list(LAYERS).index(layer) + "RGBAXYZW".index(suffix)
    return np.full(SIZE, start / 256, np.float16 if layer == "Combined" else np.float32)


def channels(name, views=("left", "right"), layers=LAYERS):
    """``name`` makes a channel's name of a view, a layer and a suffix."""
    return {name(v, k, c): value(v, k, c) for v in views for k, suffixes in layers.items() for c in suffixes}


def held_in(path):
    return {(name, c): pixels for name, _, parts in read_raw(path) for c, pixels in parts.items()}


def bare(layer, suffix):
    return suffix if layer == "Combined" else f"{layer}.{suffix}"


BOTH = {"multiView": ["left", "right"]}
# Layout -> the parts of a file: as in OpenEXR's documentation, as Blender 5.0 writes one part or many, and others.
LAYOUTS = {
    "one part, the first view without a name": [
        (channels(lambda v, k, c: bare(k, c) if v == "left" else
                  (f"right.{c}" if k == "Combined" else f"{k}.right.{c}")), BOTH),
    ],
    "the name in front": [(channels(lambda v, k, c: f"{v}.{bare(k, c)}" if v == "right" else bare(k, c)), BOTH)],
    "Blender, one part": [(channels(lambda v, k, c: f"ViewLayer.{k}.{v}.{c}"), BOTH)],
    "no attribute": [(channels(lambda v, k, c: f"ViewLayer.{k}.{v}.{c}"), {})],
    "a part for each view": [(channels(lambda v, k, c: bare(k, c), [v]), {"view": v}, v) for v in ("left", "right")],
    "Nuke": [
        (channels(lambda v, k, c: c, [v], {k: LAYERS[k]}), {"view": v}, f"{'rgba' if k == 'Combined' else k}.{v}")
        for v in ("left", "right") for k in LAYERS
    ],
    "named parts": [(channels(lambda v, k, c: bare(k, c), [v]), {}, v) for v in ("left", "right")],
    "Blender, many parts": [
        (channels(lambda v, k, c: f"ViewLayer.{k}.{c}", [v], {k: LAYERS[k]}), {"view": v}, f"ViewLayer.{k}-{v}")
        for k in LAYERS for v in ("left", "right")
    ],
}  # fmt: skip


@pytest.fixture(params=LAYOUTS)
def source(request, tmp_path):
    return write_raw(tmp_path / "stereo.exr", *LAYOUTS[request.param])


def held(stack):
    return {name: tuple(stack[name][0, 0]) for name in stack.names}


def expected(view):
    layers = {"primal": "Combined.RGB", "albedo": "Denoising Albedo.RGB", "depth": "Depth.Z", "motion": "Vector.XY"}
    pixels = {}
    for name, (layer, suffixes) in {
        name: of.split(".") for name, of in (layers | {"alpha": "Combined.A"}).items()
    }.items():
        pixels[name] = tuple(float(value(view, layer, c)[0, 0]) for c in suffixes)
    x, y = pixels["motion"]
    return pixels | {"motion": (x, -y)}


def test_every_view_is_read(source):
    stacks = read_views(source)
    assert [held(stack) for stack in stacks] == [expected("left"), expected("right")]
    assert held(read(source)) == expected("left") and held(read(source, view="right")) == expected("right")
    assert [held(stack) for stack in read_views(source, view="right")] == [expected("right")]
    assert tuple(read_image(source, view="right")[0, 0]) == expected("right")["primal"]
    for name in ("right.Denoising Albedo", "Denoising Albedo.right", "Denoising Albedo"):
        assert held(read(source, {"albedo": name}, view="right"))["albedo"] == expected("right")["albedo"]
    with pytest.raises(NgptError, match=r"has no view 'top'; it has left, right"):
        read(source, view="top")


def test_results_keep_the_layout_and_the_inputs(source, tmp_path):
    before, images = read_views(source), [np.full((*SIZE, 3), 3 + i, np.float32) for i in range(2)]
    once = write(tmp_path / "once.exr", images, like=before)
    twice = write(tmp_path / "twice.exr", [image + 4 for image in images], like=read_views(once))
    for path, first in ((once, 3), (twice, 7)):
        after = read_views(path)
        assert [held(stack) for stack in after] == [expected("left"), expected("right")]
        assert (read_image(path) == first).all()
        assert (read_image(path, view="right") == first + 1).all() and (read_image(path, view="left") == first).all()
        found = held_in(path)
        assert set(held_in(source)) <= set(found) and {"R", "primal.R"} <= {c for _, c in found}
        # Nothing shows noise any more but what is called primal, in the type it had.
        noisy = {float(value(v, "Combined", c)[0, 0]) for v in ("left", "right") for c in "RGB"}
        kept = [c for (_, c), pixels in found.items() if float(pixels[0, 0]) in noisy]
        assert len(kept) == 6 and all(c.startswith("primal.") for c in kept)
        assert all(found[key].dtype == np.float16 for key in found if key[1] in kept)
        right = [float(found[key][0, 0]) for key in found if float(found[key][0, 0]) == first + 1]
        assert len(right) >= 3
        views = {header.get("view") for _, header, _ in read_raw(path)} | {None}
        assert views == {header.get("view") for _, header, _ in read_raw(source)} | {None}


def test_one_view_is_written_and_the_other_stays(source, tmp_path):
    right = read(source, view="right")
    path = write(tmp_path / "right.exr", np.full((*SIZE, 3), 5, np.float32), like=right)
    before, after = held_in(source), held_in(path)
    changed = {key for key in before if not same_bits(before[key], after[key])}
    assert held(read(path)) == expected("left") and held(read(path, view="right")) == expected("right")
    assert len(changed) == 3 and all((after[key] == 5).all() for key in changed)


@pytest.mark.parametrize(
    ("parts", "names"),
    [
        ([Part("", ["R", "G", "B"])], [""]),
        ([Part("", ["R", "G", "B", "left.Z"], views=["left", "right"])], ["left"]),  # the right eye has no colour
        ([Part("", ["C_left.R", "C_right.R", "R", "G", "B"])], [""]),  # light groups
        ([Part("", ["R", "G", "B", "left.R", "left.G", "left.B"])], [""]),
        ([Part("", ["a.mid.R", "a.mid.G", "a.mid.B", "R", "G", "B"], views=["wide", "mid"])], ["wide", "mid"]),
    ],
)
def test_what_counts_as_views(parts, names):
    assert [view.name for view in views_of(parts)] == names
