"""Results made smaller: colours are means, and what cannot be averaged stays what it is."""

import json

import numpy as np
import OpenEXR
import pytest

from ngpt.errors import NgptError, WrongUse
from ngpt.io.exr import read, read_image, write
from ngpt.io.openexr import ExrImage, ExrPart, read_exr, write_exr
from ngpt.stack import GradientStack
from ngpt.subpixels import means
from ngpt.windows import Window

ID = {name: np.array([bits], np.uint32).view(np.float32)[0] for name, bits in (("a", 0x41424344), ("b", 0x3F808182))}


def file_of(path, channels, data=None, display=None, **header):
    """A file with one part of these channels (H, W)."""
    height, width = next(iter(channels.values())).shape
    data = data or Window(0, 0, width, height)
    windows = {"dataWindow": data.box, "displayWindow": (display or data).box}
    own = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage} | windows | header
    return write_exr(path, ExrImage([ExrPart("", own, channels)]), overwrite=True)


def picture(rng, height=6, width=8, dtype=np.float32):
    return {c: rng.random((height, width)).astype(dtype) for c in "RGB"}


def blocks(values, k=2):
    """(h, w, K²) in rows, by loops: independent of what is tested."""
    h, w = values.shape[0] // k, values.shape[1] // k
    return np.array(
        [[[values[k * y + i, k * x + j] for i in range(k) for j in range(k)] for x in range(w)] for y in range(h)]
    )


def reduced_channels(path, k=2, image=None, **how):
    """The channels that a result of the file has when it is reduced."""
    stack = read(path)
    result = stack["primal"] if image is None else image
    target = write(path.with_name("small.exr"), result, like=stack, overwrite=True, reduce=k, **how)
    return read_exr(target).parts[0].channels


@pytest.mark.parametrize("k", [2, 3])
@pytest.mark.parametrize("dtype", [np.float32, np.float16])
def test_colours_alpha_and_unknown_channels_are_means(rng, tmp_path, k, dtype):
    channels = picture(rng, 6, 12, dtype)
    channels |= {"A": rng.random((6, 12)).astype(dtype), "mist.V": rng.random((6, 12)).astype(dtype)}
    path = file_of(tmp_path / "large.exr", channels)
    result = rng.random((6, 12, 3)).astype(np.float32)
    small = reduced_channels(path, k, result)
    tolerance = 1e-6 if dtype == np.float32 else 1e-3
    for i, c in enumerate("RGB"):
        assert np.allclose(small[c], blocks(result[..., i], k).mean(axis=-1), atol=tolerance)
        assert np.allclose(small[f"primal.{c}"], blocks(channels[c].astype(float), k).mean(axis=-1), atol=tolerance)
    for name in ("A", "mist.V"):
        assert small[name].dtype == dtype
        assert np.allclose(small[name], blocks(channels[name].astype(float), k).mean(axis=-1), atol=tolerance)


def test_depth_is_the_nearest_and_positions_are_there(rng, tmp_path):
    depth = 1 + rng.random((4, 4)).astype(np.float32)
    depth[0, 0], depth[2:, 2:], depth[0, 2] = 0, 0, np.inf
    channels = picture(rng, 4, 4) | {"Z": depth, "V.Position.X": rng.random((4, 4)).astype(np.float32)}
    small = reduced_channels(file_of(tmp_path / "large.exr", channels))
    of_depth, of_places = blocks(depth), blocks(channels["V.Position.X"])
    for y in range(2):
        for x in range(2):
            there = [(d, p) for d, p in zip(of_depth[y, x], of_places[y, x], strict=True) if 0 < d < np.inf]
            d, p = min(there) if there else (0, of_places[y, x][0])
            assert small["Z"][y, x] == np.float32(d) and small["V.Position.X"][y, x] == np.float32(p)


def test_ids_are_of_the_most_pixels(tmp_path):
    ids = np.array([[1, 1, 2, 3], [1, 7, 3, 3]], np.uint32)
    channels = {c: np.ones((2, 4), np.float32) for c in "RGB"}
    channels |= {"object.N": ids, "V.IndexOB.X": ids.astype(np.float32)}
    small = reduced_channels(file_of(tmp_path / "large.exr", channels))
    assert small["object.N"].dtype == np.uint32
    assert small["object.N"].tolist() == [[1, 3]] == small["V.IndexOB.X"].tolist()


@pytest.mark.parametrize("k", [2, 3])
def test_variances_fall_and_motion_counts_the_new_pixels(rng, tmp_path, k):
    channels = picture(rng) | {f"primal_var.{c}": np.full((6, 8), 0.4, np.float32) for c in "RGB"}
    channels |= {f"motion.{c}": np.full((6, 8), 3.0, np.float32) for c in "XY"}
    channels["samples.N"] = np.full((6, 8), 16, np.float32)
    small = reduced_channels(file_of(tmp_path / "large.exr", channels, **{"ngpt:sampler": "primal"}), k)
    assert np.allclose(small["primal_var.G"], 0.4 / k**2) and np.allclose(small["motion.X"], 3 / k)
    assert np.allclose(small["samples.N"], 16 * k**2)


# ------------------------- Cryptomatte -------------------------


def cryptomatte(ids, coverages, name="V.CryptoObject", letters="rgba"):
    """Channels of ranks, two in each layer of four."""
    channels = {}
    for rank, (i, c) in enumerate(zip(ids, coverages, strict=True)):
        layer, first = f"{name}{rank // 2:02d}", 2 * (rank % 2)
        channels |= {f"{layer}.{letters[first]}": i, f"{layer}.{letters[first + 1]}": c}
    return channels


def matte(channels, wanted, name="V.CryptoObject"):
    """An artist's matte, as the specification has it: the coverage of all ranks of an id. Ids are compared as bits."""
    bits, total = np.float32(wanted).view(np.uint32), 0
    for channel in channels:
        layer, _, letter = channel.rpartition(".")
        if layer.startswith(name) and layer != name and letter in "rbRB":
            coverage = channels[f"{layer}.{chr(ord(letter) - 11) if letter in 'rR' else chr(ord(letter) - 1)}"]
            total = total + np.where(channels[channel].view(np.uint32) == bits, coverage, 0)
    return total


@pytest.mark.parametrize("listed", [True, False])
def test_mattes_of_a_cryptomatte_are_means_of_the_large_ones(rng, tmp_path, listed):
    shape = (6, 8)
    first = rng.random(shape) < 0.5
    ids = [np.where(first, ID["a"], ID["b"]).astype(np.float32), np.where(first, ID["b"], ID["a"]).astype(np.float32)]
    share = (0.5 + 0.5 * rng.random(shape)).astype(np.float32)
    none = np.zeros(shape, np.float32)
    channels = picture(rng) | cryptomatte([*ids, none, none], [share, 1 - share, none, none])
    channels |= {f"V.CryptoObject.{c}": none for c in "rgb"}  # a preview
    header = {
        "cryptomatte/1a2b3c4/name": "V.CryptoObject",
        "cryptomatte/1a2b3c4/manifest": json.dumps({"x": "41424344"}),
    }
    small = reduced_channels(file_of(tmp_path / "large.exr", channels, **(header if listed else {})))
    for name in "ab":
        expected = blocks(matte(channels, ID[name])).mean(axis=-1)
        assert np.allclose(matte(small, ID[name]), expected, atol=1e-6)
    # Ranks fall, and what is empty has no id.
    assert (small["V.CryptoObject00.g"] >= small["V.CryptoObject00.a"]).all()
    assert not small["V.CryptoObject01.r"].any() and not small["V.CryptoObject01.g"].any()
    there = {0, *(int(np.float32(i).view(np.uint32)) for i in ID.values())}
    assert set(np.unique(small["V.CryptoObject00.r"].view(np.uint32))) <= there


def test_ids_that_are_no_numbers_survive(tmp_path):
    """The bits of an id may be those of a NaN."""
    odd = np.full((2, 2), 0x7FC12345, np.uint32).view(np.float32)
    one, none = np.ones((2, 2), np.float32), np.zeros((2, 2), np.float32)
    channels = dict.fromkeys("RGB", one) | cryptomatte([odd, none], [one, none], "crypto", "RGBA")
    small = reduced_channels(file_of(tmp_path / "large.exr", channels, **{"cryptomatte/0/name": "crypto"}))
    assert small["crypto00.R"].view(np.uint32)[0, 0] == 0x7FC12345 and small["crypto00.G"][0, 0] == 1


def test_a_cryptomatte_of_half_floats_is_refused(rng, tmp_path):
    half = [np.ones((6, 8), np.float16)] * 2
    path = file_of(tmp_path / "large.exr", picture(rng) | cryptomatte(half, half))
    with pytest.raises(NgptError, match=r"large\.exr: Cryptomatte 'V\.CryptoObject' is not of 32-bit floats"):
        reduced_channels(path)


# ------------------------- windows and refusals -------------------------


def test_pixels_of_windows_stay_where_they_were(rng, tmp_path, command):
    channels = picture(rng, 5, 9)
    path = file_of(tmp_path / "large.exr", channels, Window(3, -2, 9, 5), Window(0, 0, 20, 11))
    told = command("denoise large.exr -o small.exr -m primal --reduce 2")
    assert "data window 9x5 at (3, -2) is no multiple of 2: 8x4 at (4, -2) of it is taken" in told.err
    assert "display window 20x11 at (0, 0) is no multiple of 2: 20x10 at (0, 0)" in told.err
    small = read(tmp_path / "small.exr")
    assert small.place.data == Window(2, -1, 4, 2) and small.place.display == Window(0, 0, 10, 5)
    assert np.allclose(small["primal"][0, 0, 0], channels["R"][0:2, 1:3].mean(), atol=1e-6)
    assert read_exr(path).parts[0].header["dataWindow"][0].tolist() == [3, -2]


def test_gradients_and_motion_of_unknown_unit_are_refused(rng, tmp_path):
    zeros = np.zeros((4, 4, 3), np.float32)
    with pytest.raises(NgptError, match=r"has dx, dy, differences between its pixels.*--subpixels"):
        write(tmp_path / "a.exr", zeros, like=GradientStack({"primal": zeros, "dx": zeros, "dy": zeros}), reduce=2)
    path = file_of(tmp_path / "large.exr", picture(rng) | {"velocity.R": np.ones((6, 8), np.float32)})
    with pytest.raises(NgptError, match=r"channel 'velocity.R' looks like motion vectors.*--layer motion="):
        reduced_channels(path)
    with pytest.raises(WrongUse, match="by 2 or more, not by 0"):
        write(tmp_path / "a.exr", zeros, like=GradientStack({"primal": zeros}), reduce=0)


def test_pixels_that_are_not_finite_do_not_count(rng, tmp_path):
    channels = picture(rng, 4, 4) | {"mask.V": np.ones((4, 4), np.float32)}
    channels["mask.V"][0, 1], channels["mask.V"][2:, 2:] = np.nan, np.nan
    small = reduced_channels(file_of(tmp_path / "large.exr", channels))
    assert small["mask.V"][0, 0] == 1 and np.isnan(small["mask.V"][1, 1])


# ------------------------- the command -------------------------


def test_the_command_writes_exr_pictures_and_pfm_of_one_size(rng, tmp_path, command):
    file_of(tmp_path / "large.exr", picture(rng))
    for name in ("small.exr", "small.pfm", "small.png"):
        told = command(f"denoise large.exr -o {name} -m primal --reduce 2 --ref large.exr", 0, 1)
        assert read_image(tmp_path / name).shape == (3, 4, 3) if (tmp_path / name).exists() else told.err
    command("denoise large.exr -o small.exr -m primal --reduce 2 --force")
    assert read(tmp_path / "small.exr").attributes["ngpt:reduced"] == 2
    assert "skipped" in command("denoise large.exr -o small.exr -m primal --reduce 2 --skip-existing").err
    told = command("denoise large.exr -o small.exr -m primal --skip-existing", 1)
    assert "reduced 2, not none" in told.err


def test_errors_are_of_the_small_image(rng, tmp_path, command):
    channels = picture(rng)
    file_of(tmp_path / "large.exr", channels)
    file_of(tmp_path / "ref.exr", {c: blocks(v).mean(axis=-1).astype(np.float32) for c, v in channels.items()})
    report = json.loads(command("denoise large.exr -o small.exr -m primal --reduce 2 --ref ref.exr --json").out)
    assert report["files"][0]["metrics"]["relMSE"] < 1e-10 and report["files"][0]["width"] == 4


def test_results_of_subpixels_are_reduced_without_them(rng, tmp_path):
    primal = rng.random((8, 8, 3)).astype(np.float32)
    stack = GradientStack({"primal": means(primal, 2)}, fine={"primal": primal})
    small = read(write(tmp_path / "small.exr", stack["primal"], like=stack, reduce=2))
    assert not small.fine and small["primal"].shape == (2, 2, 3) and "ngpt:subpixels" not in small.attributes
