"""Stacks and results in OpenEXR files: what is written is read again, and what is not ours passes through."""

import numpy as np
import OpenEXR
import pytest
from exr_files import comparable, noise, read_raw, same_bits, window, write_raw
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import ngpt
from ngpt.errors import NgptError
from ngpt.io.exr import layers_of_light, read, replace_layers_of_light, write
from ngpt.layers import LAYERS
from ngpt.stack import GradientStack

LOSSLESS = ("NO", "RLE", "ZIPS", "ZIP", "PIZ")
quick = settings(max_examples=20, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])


@st.composite
def layer_arrays(draw):
    rng = np.random.default_rng(draw(st.integers(0, 2**32)))
    height, width = draw(st.integers(1, 9)), draw(st.integers(1, 9))
    names = ["primal", *draw(st.lists(st.sampled_from(list(LAYERS)[1:]), unique=True))]
    arrays = {}
    for name in names:
        dtype = draw(st.sampled_from([np.float16, np.float32]))
        arrays[name] = noise(rng, (height, width, len(LAYERS[name].channels)), dtype)
    return arrays


@quick
@given(arrays=layer_arrays())
def test_a_stack_is_read_as_it_was_written(tmp_path, arrays):
    attributes = {"ngpt:spp": 16, "ngpt:seed": str(2**63), "ngpt:seconds": 1.5, "ngpt:normalSpace": "camera"}
    stack = GradientStack.from_arrays(attributes=attributes, **arrays)
    path = write(tmp_path / "a.exr", stack, overwrite=True)
    ((_, header, channels),) = read_raw(path)
    for name, array in arrays.items():
        for index, suffix in enumerate(LAYERS[name].channels):
            stored = channels[suffix if name in ("primal", "alpha") else f"{name}.{suffix}"]
            assert same_bits(stored, array[..., index].astype(np.float32)), (name, suffix)
    assert header["type"] == OpenEXR.scanlineimage and header["compression"] == OpenEXR.ZIP_COMPRESSION
    again = read(path)
    expected = dict(arrays)
    if not {"dx", "dy"} & arrays.keys():
        expected.pop("direct", None)
        if "caustic_var" not in arrays:
            expected.pop("caustic", None)
    for name, beside in (("diffuse", "diffuse_var"), ("specular", "specular_var"), ("shared", "primal_var")):
        if beside not in arrays:
            expected.pop(name, None)
    assert set(again.names) == set(expected)
    for name, array in expected.items():
        assert same_bits(again[name], array.astype(np.float32)) and again[name].flags.c_contiguous
    assert again.attributes == {**attributes, "ngpt:version": ngpt.__version__}


@st.composite
def files(draw):
    """Parts for write_raw: a stack among layers, types, windows and attributes that ngpt knows nothing of."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32)))
    height, width = draw(st.integers(1, 40)), draw(st.integers(1, 40))
    header = {
        "dataWindow": window(draw(st.integers(-50, 50)), draw(st.integers(-50, 50)), width, height),
        "displayWindow": window(-3, -7, 64, 32),
        "compression": getattr(OpenEXR, f"{draw(st.sampled_from(LOSSLESS))}_COMPRESSION"),
        "lineOrder": draw(st.sampled_from([OpenEXR.INCREASING_Y, OpenEXR.DECREASING_Y])),
        "pixelAspectRatio": 2.0,
    }
    if draw(st.booleans()):
        header |= {"type": OpenEXR.tiledimage, "tiles": OpenEXR.TileDescription()}
    types = {kind: draw(st.sampled_from([np.float16, np.float32])) for kind in ("root", "dx", "albedo", "unknown")}
    channels = {name: noise(rng, (height, width), types["root"]) for name in "RGBA"}
    channels |= {f"dx.{name}": noise(rng, (height, width), types["dx"]) for name in "RGB"}
    channels |= {f"View.Denoising Albedo.{name}": noise(rng, (height, width), types["albedo"]) for name in "RGB"}
    channels |= {
        "id.ID": noise(rng, (height, width), np.uint32),
        "fog.Q": noise(rng, (height, width), types["unknown"]),
    }
    attributes = {"owner": "me", "x:list": ["a", "b"], "ngpt:spp": 3, "worldToCamera": np.eye(4, dtype=np.float32)}
    parts = [(channels, {**header, **attributes}, "beauty")]
    if draw(st.booleans()):
        other = {"displayWindow": header["displayWindow"], "pixelAspectRatio": 2.0, "dataWindow": window(5, 6, 4, 3)}
        parts.append(({"mask": noise(rng, (3, 4), np.uint32)}, {**other, "comments": "second"}, "other"))
    return parts


@quick
@given(parts=files())
def test_all_else_passes_through_a_copy_and_a_result(tmp_path, parts):
    source = write_raw(tmp_path / "source.exr", *parts)
    stack = read(source)
    result = np.full((stack.height, stack.width, 3), 0.1, np.float32)
    olds = read_raw(source)
    copy, written = (
        read_raw(write(tmp_path / "result.exr", *what, overwrite=True)) for what in ((stack,), (result, stack))
    )
    assert len(copy) == len(written) == len(parts)
    for (_, _, channels), (_, _, old) in zip(copy, olds, strict=True):
        assert set(channels) == set(old) and all(same_bits(channels[name], old[name]) for name in old)
    root_type = parts[0][0]["R"].dtype
    for index, ((name, header, channels), (_, old_header, old)) in enumerate(zip(written, olds, strict=True)):
        assert name == parts[index][2]
        expected = dict(old)
        if index == 0:
            expected |= {f"primal.{suffix}": old[suffix] for suffix in "RGB"}
            expected |= dict.fromkeys("RGB", np.full((stack.height, stack.width), 0.1, root_type))
        assert set(channels) == set(expected)
        for channel, pixels in expected.items():
            assert same_bits(channels[channel], pixels), (name, channel)
        assert header.pop("ngpt:version", None) == (ngpt.__version__ if index == 0 else None)
        for derived in ("channels", "chunkCount"):
            header.pop(derived, None), old_header.pop(derived, None)
        assert {key: comparable(value) for key, value in header.items()} == {
            key: comparable(value) for key, value in old_header.items()
        }


def small(*names: str, dtype=np.float32, start: float = 0.0) -> dict[str, np.ndarray]:
    """2x3 channels, all different."""
    return {name: np.arange(6).reshape(2, 3).astype(dtype) + dtype(start + 10 * i) for i, name in enumerate(names)}


RESULT = np.linspace(0.5, 2.0, 18, dtype=np.float32).reshape(2, 3, 3)
ROOT = ("R", "G", "B")
PRIMAL = ("primal.R", "primal.G", "primal.B")


@pytest.mark.parametrize(
    ("peak", "expected"),
    [(65504.0, np.float16), (65505.0, np.float32), (1e-6, np.float32), (0.0, np.float16)],
)
def test_half_becomes_float_where_half_cannot_hold_the_result(tmp_path, peak, expected):
    stack = read(write_raw(tmp_path / "a.exr", (small(*ROOT, dtype=np.float16),)))
    image = np.zeros((2, 3, 3), np.float32)
    image[0, 0, 0], image[1, 1] = -peak, np.nan
    ((_, _, channels),) = read_raw(write(tmp_path / "b.exr", image, like=stack))
    for index, name in enumerate(ROOT):
        assert same_bits(channels[name], image[..., index].astype(expected))
    assert all(channels[name].dtype == np.float16 for name in PRIMAL)


@pytest.mark.parametrize(
    ("into", "replaced"),
    [("Combined", "View.Combined"), ("View.Noisy Image", "View.Noisy Image"), ("root", ""), (None, "")],
)
def test_into_chooses_the_layer_that_is_replaced(tmp_path, into, replaced, command):
    layers = {f"View.{name}": [f"View.{name}.{c}" for c in "RGB"] for name in ("Noisy Image", "Combined", "DiffDir")}
    before = small(*(channel for channels in layers.values() for channel in channels))
    write_raw(tmp_path / "a.exr", (before,))
    told = command("denoise a.exr -m primal -o b.exr" + (f" --into '{into}'" if into else "")).err
    ((_, header, after),) = read_raw(tmp_path / "b.exr")
    stack = read(tmp_path / "a.exr")
    write(tmp_path / "c.exr", RESULT, like=stack, into=into)
    ((_, _, changed),) = read_raw(tmp_path / "c.exr")
    for name, channels in layers.items():
        expected = [RESULT[..., i] if name == replaced else before[channel] for i, channel in enumerate(channels)]
        assert all(same_bits(changed[channel], pixels) for channel, pixels in zip(channels, expected, strict=True))
    assert header.get("ngpt:pass", "") == replaced and same_bits(after["R"], before["View.Noisy Image.R"])
    stays = "View.Combined stays as it was (--into Combined replaces it)"
    assert (stays in told) == (replaced != "View.Combined")
    assert (f"layers root and {replaced}" in told) == bool(replaced)


def test_into_a_layer_that_is_not_there_names_those_that_are(tmp_path):
    stack = read(write_raw(tmp_path / "a.exr", (small(*ROOT, *(f"a.Combined.{c}" for c in "RGB")),)))
    with pytest.raises(NgptError, match="'Combine' is no layer of colour; there are: root"):
        write(tmp_path / "b.exr", RESULT, like=stack, into="Combine")


def test_a_primal_in_a_later_part_puts_the_result_in_a_new_first_part(tmp_path):
    parts = [
        (small("Z"), {"compression": OpenEXR.PIZ_COMPRESSION}, "depth"),
        (small(*"RGBA", start=100.0), {"owner": "me", "lineOrder": OpenEXR.DECREASING_Y}, "Combined"),
    ]
    stack = read(write_raw(tmp_path / "a.exr", *parts))
    assert stack.attributes == {"owner": "me"} and stack["depth"][0, 1, 0] == 1.0
    path = write(tmp_path / "b.exr", RESULT, like=stack)
    after = read_raw(path)
    assert [name for name, _, _ in after] == ["ngpt", "depth", "Combined"]
    assert set(after[0][2]) == {*ROOT, "A", *PRIMAL}
    assert same_bits(after[0][2]["B"], RESULT[..., 2])
    for (channels, header, _), (_, new_header, new) in zip(parts, after[1:], strict=True):
        assert set(new) == set(channels) and all(same_bits(new[name], channels[name]) for name in new)
        assert {key: new_header[key] for key in header} == header
    again = read(path)
    assert all(same_bits(again[name], stack[name]) for name in stack.names) and again.names == stack.names
    assert again.attributes == {"owner": "me", "ngpt:version": ngpt.__version__}


@pytest.mark.parametrize(("name", "part"), [("ViewLayer.Combined", ""), ("C", "beauty"), ("beauty", "beauty")])
def test_a_result_replaces_the_layer_that_its_input_came_from(tmp_path, name, part):
    """Who loads that layer in a compositor wants the image; the input is kept to the bit, and is denoised again."""
    before = small(*(f"{name}.{c}" for c in "RGBA"), "albedo.R", "albedo.G", "albedo.B", dtype=np.float16)
    path, stack = None, read(write_raw(tmp_path / "0.exr", (before, {}, part)))
    for number in (1, 2, 3):
        path = write(tmp_path / f"{number}.exr", RESULT * number, like=stack)
        ((_, header, channels),) = read_raw(path)
        assert header["ngpt:pass"] == name
        for i, (root, kept) in enumerate(zip(ROOT, PRIMAL, strict=True)):
            expected = (RESULT[..., i] * number).astype(np.float16)
            assert same_bits(channels[root], expected) and same_bits(channels[f"{name}.{root}"], expected)
            assert same_bits(channels[kept], before[f"{name}.{root}"])
        assert same_bits(channels[f"{name}.A"], before[f"{name}.A"])
        again = read(path)
        assert again.names == stack.names and all(same_bits(again[layer], stack[layer]) for layer in stack.names)
        # Asked for by name, it is still the input that is meant.
        stack = read(path, {"primal": name})
        assert same_bits(stack["primal"], again["primal"])


def test_channels_in_the_units_of_others_stay_as_they_are(tmp_path):
    before = small(*ROOT, "V.Vector.X", "V.Vector.Y", "V.Vector.Z", "V.Vector.W")
    stack = read(write_raw(tmp_path / "a.exr", (before,)))
    assert same_bits(stack["motion"][..., 1], -before["V.Vector.Y"])
    write(tmp_path / "b.exr", stack)
    write(tmp_path / "c.exr", RESULT, like=stack)
    write(tmp_path / "d.exr", RESULT, like=stack.replace(motion=stack["motion"] + 1))
    for name in "bcd":
        ((_, _, channels),) = read_raw(tmp_path / f"{name}.exr")
        assert all(same_bits(channels[key], before[key]) for key in before if "Vector" in key)
        assert ("motion.X" in channels) == (name == "d")
    assert same_bits(read(tmp_path / "c.exr")["motion"], stack["motion"])
    assert same_bits(read(tmp_path / "d.exr")["motion"], stack["motion"] + 1)


def test_a_root_that_is_not_the_primal_is_not_lost(tmp_path):
    before = small(*ROOT, "noisy.R", "noisy.G", "noisy.B")
    stack = read(write_raw(tmp_path / "a.exr", (before,)), {"primal": "noisy"})
    after = read_raw(write(tmp_path / "b.exr", RESULT, like=stack))
    assert [name for name, _, _ in after] == ["ngpt", "source"]
    assert same_bits(after[0][2]["R"], RESULT[..., 0]) and same_bits(after[0][2]["primal.R"], before["noisy.R"])
    assert set(after[1][2]) == set(before) and all(same_bits(after[1][2][name], before[name]) for name in before)


def test_changed_and_added_layers_go_where_they_belong(tmp_path):
    albedo = [f"View.Denoising Albedo.{suffix}" for suffix in "RGB"]
    half = small(*ROOT, *albedo, "dx.R", "dx.G", "dx.B", "N.X", "N.Y", "N.Z", dtype=np.float16)
    stack = read(write_raw(tmp_path / "a.exr", (half, {"ngpt:spp": 1, "owner": "me"})))
    stack = stack.replace(albedo=stack["albedo"] / 64, dx=stack["dx"] + 1, dy=RESULT, alpha=RESULT[..., 0])
    stack.attributes["ngpt:spp"] = 2
    ((_, header, channels),) = read_raw(write(tmp_path / "b.exr", stack))
    assert set(channels) == {*half, "dy.R", "dy.G", "dy.B", "A"}
    assert same_bits(channels[albedo[1]], half[albedo[1]] / np.float16(64)), "colour keeps its type"
    assert same_bits(channels["dx.B"], half["dx.B"].astype(np.float32) + 1), "gradients are float"
    assert same_bits(channels["N.Y"], half["N.Y"])
    assert same_bits(channels["dy.G"], RESULT[..., 1]) and same_bits(channels["A"], RESULT[..., 0])
    assert header["ngpt:spp"] == 2 and header["owner"] == "me"


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (lambda stack: ("out.png", RESULT), "out.png: ngpt writes OpenEXR; let the name end in .exr"),
        (lambda stack: ("out.exr", RESULT[:1], stack), "the result is 3x1 but the stack"),
        (lambda stack: ("out.exr", RESULT[..., :2], stack), "out.exr: layer 'primal' has shape (2, 3, 2)"),
        (lambda stack: ("out.exr", RESULT * 1j, stack), "is of type complex64"),
        (lambda stack: ("out.exr", RESULT.astype(np.float64) * 1e300), "values that float32 cannot hold"),
        (lambda stack: ("out.exr", stack, stack), "`like` goes with an image"),
        (lambda stack: ("no/out.exr", RESULT, stack), "does not exist"),
        (lambda stack: ("out.exr", GradientStack.from_arrays(dx=RESULT)), "out.exr needs layer 'primal'"),
        (lambda stack: ("out.exr", stack.replace(primal=RESULT[:1])), "the stack is 3x1 but"),
    ],
)
def test_what_cannot_be_written_leaves_no_file(tmp_path, arguments, expected):
    stack = read(write_raw(tmp_path / "a.exr", (small(*ROOT),)))
    name, *rest = arguments(stack)
    with pytest.raises(NgptError) as caught:
        write(tmp_path / name, *rest)
    assert expected in str(caught.value) and "\n" not in str(caught.value)
    assert [path.name for path in tmp_path.iterdir()] == ["a.exr"]


def test_a_layer_without_a_pixel_of_the_picture_is_refused(tmp_path):
    parts = (small(*ROOT), {}, "rgb"), (small("X", "Y", "Z"), {"dataWindow": window(5, 0, 3, 2)}, "N")
    with pytest.raises(NgptError, match=r"a.exr: layer 'normal' is 3x2 at \(5, 0\) but 'primal' 3x2 at \(0, 0\)"):
        read(write_raw(tmp_path / "a.exr", *parts))


def test_parts_with_windows_of_their_own_are_filled_up_with_zeros(tmp_path, rng):
    """As compositors and Arnold cut them: to where there is anything, and to overscan."""
    display = {"displayWindow": window(0, 0, 8, 6)}
    image, normal, albedo = (
        {name: rng.random(size).astype(np.float32) for name in names}
        for size, names in (((6, 8), ROOT), ((3, 2), "XYZ"), ((8, 10), ROOT))
    )
    path = write_raw(
        tmp_path / "a.exr",
        (image, display, "rgb"),
        (normal, display | {"dataWindow": window(3, 1, 2, 3)}, "N"),
        (albedo, display | {"dataWindow": window(-1, -1, 10, 8)}, "albedo"),
    )
    stack, expected = read(path), np.zeros((6, 8, 3), np.float32)
    expected[1:4, 3:5] = np.stack(list(normal.values()), axis=-1)
    assert np.array_equal(stack["normal"], expected)
    assert np.array_equal(stack["albedo"], np.stack(list(albedo.values()), axis=-1)[1:7, 1:9])
    # Parts stay as they are in results; layers that are changed go beside them.
    result = write(tmp_path / "b.exr", stack["primal"], like=stack.replace(normal=-expected))
    ((_, _, held),) = [part for part in read_raw(result) if part[0] == "N"]
    assert all(same_bits(held[name], normal[name]) for name in "XYZ")
    assert np.array_equal(read(result)["normal"], -expected)


def test_layers_of_light_lie_where_their_windows_say(tmp_path, rng):
    """Here the layer is as large as the image, but three pixels further to the right and two further down."""
    image, fog = ({c: rng.random((6, 8)).astype(np.float32) for c in ROOT} for _ in range(2))
    display = {"displayWindow": window(0, 0, 8, 6)}
    moved = display | {"dataWindow": window(3, 2, 8, 6)}
    stack = read(write_raw(tmp_path / "a.exr", (image, display, "rgb"), (fog, moved, "fog")))
    held, expected = np.stack([fog[c] for c in ROOT], axis=-1), np.zeros((6, 8, 3), np.float32)
    expected[2:, 3:] = held[:4, :5]
    assert np.array_equal(layers_of_light(stack)["fog"], expected)
    again = replace_layers_of_light(stack, {"fog": 2 * expected})
    assert np.array_equal(layers_of_light(again)["fog"], 2 * expected)
    ((_, _, after),) = [part for part in read_raw(write(tmp_path / "b.exr", again)) if part[0] == "fog"]
    assert np.array_equal(after["G"][:4, :5], 2 * fog["G"][:4, :5])


# What Mitsuba's films write with the pixel formats `luminance` and `xyz`.
@pytest.mark.parametrize(("names", "header"), [("Y", {}), ("XYZ", {"generatedBy": "Mitsuba version 3.9.1"})])
def test_images_of_other_channels_are_written_as_they_came(tmp_path, rng, names, header):
    channels = {name: rng.uniform(0.2, 1, (6, 8)).astype(np.float16) for name in names}
    path = write_raw(tmp_path / "a.exr", (channels | {"A": np.ones((6, 8), np.float16)}, header))
    stack = read(path)
    assert (
        np.array_equal(stack["primal"], np.stack([channels[n] for n in (names * 3)[:3]], axis=-1)) and "alpha" in stack
    )
    result = write(tmp_path / "b.exr", 2 * stack["primal"], like=stack)
    ((_, _, held),) = read_raw(result)
    assert held.keys() == {*names, "A", *(f"primal.{name}" for name in names)}
    assert all(same_bits(held[f"primal.{n}"], channels[n]) and same_bits(held[n], 2 * channels[n]) for n in names)
    np.testing.assert_allclose(ngpt.read_image(result), 2 * ngpt.read_image(path), rtol=2e-3)
    if names == "XYZ":
        white = {"X": np.full((1, 1), 0.9505, "f4"), "Y": np.ones((1, 1), "f4"), "Z": np.full((1, 1), 1.0891, "f4")}
        seen = ngpt.read_image(write_raw(tmp_path / "white.exr", (white, header)))
        np.testing.assert_allclose(seen, 1, atol=1e-3)
    else:
        with pytest.raises(NgptError, match="channel 'Y' is luminance, and the image has colours"):
            write(tmp_path / "d.exr", stack["primal"] * [1, 2, 3], like=stack)


def test_uint_channels_are_read_as_numbers(tmp_path):
    channels = {name: np.array([[0, 7, 2**24]], np.uint32) for name in ROOT}
    stack = read(write_raw(tmp_path / "a.exr", (channels,)))
    assert np.array_equal(stack["primal"][0, :, 1], [0, 7, 2**24])
    written = read_raw(write(tmp_path / "b.exr", stack["primal"], like=stack))[0][2]
    assert written["R"].dtype == np.float32 and written["primal.R"].dtype == np.uint32
