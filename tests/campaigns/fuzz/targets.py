"""What broken inputs are given to: a function of the input's number and a folder to work in, for each target.

A target returns where the input is accepted and handled, raises NgptError where it is refused, and anything else is a
failure. Number -1 is a whole input.
"""

import io
import random
import struct
import tempfile
import tomllib
import zlib
from collections.abc import Callable
from functools import cache
from hashlib import sha256
from pathlib import Path

import numpy as np
from data_mutations import bytes_changed, safetensors_changed, to_json, to_toml, value_changed
from exr_mutations import mutate, seeds
from full_stack import full_stack

import ngpt
from ngpt.io.exr import read, write
from ngpt.methods import reconstruct
from ngpt.network.shipped import WEIGHTS

CONFIGS = Path(__file__).resolve().parents[3] / "configs"


def exr(number: int, folder: Path) -> None:
    """What `ngpt denoise` does with a file: reads, reconstructs, writes; what is written can be read again."""
    path, result = folder / "stack.exr", folder / "result.exr"
    path.write_bytes(seeds()[0] if number < 0 else mutate(number))
    stack = read(path)
    method = "l2" if "dx" in stack and "dy" in stack else "primal"
    image = reconstruct(stack, method).image
    assert image.shape == stack["primal"].shape and np.isfinite(image).all()
    write(result, image, like=stack, overwrite=True)
    ngpt.read_image(result)


@cache
def _foreign() -> list[tuple[str, bytes]]:
    """Whole files of other formats than OpenEXR."""
    import tifffile
    from PIL import Image

    rng = np.random.default_rng(0)
    light, codes = rng.random((9, 12, 4)).astype(np.float32), rng.integers(0, 256, (9, 12, 4), np.uint8)
    hdr = b"#?RADIANCE\nEXPOSURE=2\nFORMAT=32-bit_rle_rgbe\n\n-Y 9 +X 12\n"
    runs = b"\2\2\0\x0c" + b"".join(b"\4" + bytes(4) + b"\x88" + bytes([130]) for _ in range(4))
    found = [("a.pfm", b"PF\n12 9\n-1.0\n" + light[..., :3].tobytes())]
    found += [("a.hdr", hdr + body) for body in (9 * runs, codes.tobytes(), 9 * (b"\1\2\3\x80" + b"\1\1\1\x0b"))]
    rgb = Image.fromarray(codes[..., :3])
    for kind, image, options in (
        ("png", Image.fromarray(codes), {}),
        ("png", Image.fromarray(codes[..., 0]), {}),
        ("png", rgb.quantize(7), {"transparency": b"\0\x80"}),
        ("jpeg", rgb, {}),
    ):
        image.save(file := io.BytesIO(), kind, **options)
        found.append((f"a.{kind}", file.getvalue()))
    for pixels, options in (
        (light[..., :3], {}),
        (codes, {"extrasamples": ["unassalpha"], "compression": "zlib", "predictor": True}),
        (codes[..., :3], {"tile": (16, 16), "compression": "zlib", "bigtiff": True}),
    ):
        tifffile.imwrite(file := io.BytesIO(), pixels, photometric="rgb", **options)
        found.append(("a.tif", file.getvalue()))
    return found


def _with_checksums(data: bytes) -> bytes:
    """A PNG with checksums that fit its chunks, so that damage gets past them."""
    place, out = 8, data[:8]
    while place + 12 <= len(data):
        length = min(struct.unpack_from(">I", data, place)[0], len(data) - place - 12)
        chunk = data[place + 4 : place + 8 + length]
        out += data[place : place + 4] + chunk + struct.pack(">I", zlib.crc32(chunk))
        place += 12 + length
    return out


def foreign(number: int, folder: Path) -> None:
    """PFM, Radiance HDR, PNG, TIFF and JPEG: read as a stack and as a picture."""
    seeds = _foreign()
    name, data = seeds[max(number, 0) % len(seeds)]
    if number >= 0:
        rng = random.Random(number)
        data = bytes_changed(rng, data)
        data = _with_checksums(data) if name.endswith("png") and rng.random() < 0.8 else data
    path = folder / name
    path.write_bytes(data)
    stack = read(path)
    image = ngpt.read_image(path)
    assert image.shape == stack["primal"].shape and image.dtype == np.float32
    if np.isfinite(image).all(axis=-1).any():
        reconstruct(stack, "primal")


@cache
def _dataset() -> tuple[dict, bytes]:
    """A manifest and the shard it lists."""
    from ngpt.training.dataset import FORMAT, VERSION
    from ngpt.training.shards import CropData, write_shard

    stack = full_stack(8, 8)
    stack = stack.replace(direct=np.zeros_like(stack["primal"]))
    crop = CropData([stack, stack], [2, 9], stack["primal"], stack["direct"])
    told = {"scene": "a", "crops": [{"spp": [2, 9], "seconds": {"inputs": 1.0}}] * 2, "failures": []}
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "shard"
        write_shard(path, [crop, crop], told)
        data = path.read_bytes()
    entry = {"file": "shards/a-000.safetensors", "sha256": sha256(data).hexdigest(), "bytes": len(data)} | told
    return {"format": FORMAT, "version": VERSION, "config": {}, "planned": 2, "shards": [entry]}, data


def _read_dataset(folder: Path, manifest: bytes, shard: bytes) -> None:
    """What training and `ngpt info` do with a dataset."""
    from ngpt.training.dataset import Dataset, problems, summary

    (folder / "shards").mkdir(exist_ok=True)
    (folder / "shards" / "a-000.safetensors").write_bytes(shard)
    (folder / "manifest.json").write_bytes(manifest)
    for crop in Dataset(folder):
        for k in range(crop.inputs):
            assert reconstruct(crop.stack(k), "primal").image.shape == crop.reference.shape
    assert problems(folder) == summary(folder)["problems"]


def manifest(number: int, folder: Path) -> None:
    (value, shard), rng = _dataset(), random.Random(number)
    data = to_json(value)
    if number >= 0:
        data = to_json(value_changed(rng, value)) if rng.random() < 0.8 else bytes_changed(rng, data)
    _read_dataset(folder, data, shard)


def shard(number: int, folder: Path) -> None:
    """With the checksum of the broken shard in the manifest, so that it is not refused for that alone."""
    value, data = _dataset()
    data = data if number < 0 else safetensors_changed(random.Random(number), data)
    entry = value["shards"][0] | {"sha256": sha256(data).hexdigest(), "bytes": len(data)}
    _read_dataset(folder, to_json(value | {"shards": [entry]}), data)


@cache
def _weights() -> tuple[bytes, bytes]:
    """Weights of a tiny network, and the checkpoint of its training after one step."""
    with tempfile.TemporaryDirectory() as folder:
        run = _trainer(Path(folder))
        run.run()
        return (Path(folder) / "weights.safetensors").read_bytes(), run.checkpoint.read_bytes()


SETTINGS = {
    "model": {"network": "dense", "channels": [2, 3], "units": [1, 1], "inputs": ["primal", "dx", "dy", "albedo"]},
    "data": {"crop": 16},
    "run": {"steps": 1, "batch": 1, "log": 1, "save": 1, "validate": 1},
}  # fmt: skip


class _Crop:
    scene, inputs, spp, paired, reference_halves = "a", 1, (4,), False, ()
    reference = full_stack(16, 16)["primal"]
    reference_direct = reference_caustic = np.zeros_like(reference)

    def stack(self, k: int) -> ngpt.GradientStack:
        return full_stack(16, 16)


def _trainer(folder: Path):
    import torch

    from ngpt.training.images import Images
    from ngpt.training.settings import from_dict
    from ngpt.training.trainer import Trainer

    torch.set_num_threads(1)

    def loss(prediction, target, generator):
        value = (prediction - target).abs().mean()
        return value, {"l1": value}

    settings = from_dict(SETTINGS, "test")
    return Trainer(settings, Images(settings, [_Crop()], [], loss), folder, say=lambda text: None)


def weights(number: int, folder: Path) -> None:
    path, data = folder / "weights.safetensors", _weights()[0]
    path.write_bytes(data if number < 0 else safetensors_changed(random.Random(number), data))
    image = ngpt.denoise(full_stack(9, 7), "ngpt", weights=str(path))
    assert np.isfinite(image).all()


def checkpoint(number: int, folder: Path) -> None:
    data = _weights()[1]
    run = _trainer(folder)
    run.checkpoint.write_bytes(data if number < 0 else safetensors_changed(random.Random(number), data))
    run.resume()


def settings(number: int, folder: Path) -> None:
    """Configurations of training and of data generation."""
    from data_gen.dataset.config import read_config
    from ngpt.training.settings import read_settings

    rng = random.Random(number)
    name = rng.choice(("fast.toml", "data-cpu.toml", "paper.toml"))
    data = (CONFIGS / name).read_bytes()
    if number >= 0:
        value = tomllib.loads(data.decode())
        if name == "data-cpu.toml":
            value["files"] = [{"pattern": str(folder / "*.xml"), "crops": 2, "boxes": {"a": [[0, 0, 0], [1, 1, 1]]}}]
        changed = value_changed(rng, value)
        data = (
            to_toml(changed if isinstance(changed, dict) else {"x": changed})
            if rng.random() < 0.8
            else bytes_changed(rng, data)
        )
    path = folder / "settings.toml"
    path.write_bytes(data)
    if name == "data-cpu.toml":
        read_config(path)
    else:
        read_settings(path)


def network(number: int, folder: Path) -> None:
    """ONNX files that users pass as weights."""
    path, data = folder / "network.onnx", (WEIGHTS / "ngpt-fast.onnx").read_bytes()
    path.write_bytes(data if number < 0 else _onnx_changed(random.Random(number), data))
    image = ngpt.denoise(full_stack(9, 7), "ngpt-fast", weights=str(path))
    assert np.isfinite(image).all()


def _onnx_changed(rng: random.Random, data: bytes) -> bytes:
    """Its metadata, nodes, inputs and initializers, or its bytes."""
    import onnx

    if rng.random() < 0.4:
        # The graph's own bytes stand before and after the numbers.
        return bytes_changed(rng, data[:40_000]) + data[40_000:] if rng.random() < 0.7 else bytes_changed(rng, data)
    model = onnx.load_from_string(data)
    graph = model.graph
    match rng.randrange(7):
        case 0:
            entry = rng.choice(model.metadata_props)
            entry.value = rng.choice(
                ("", "0", "-1", "x", "1e9", str(2**70), "primal", "primal, primal", "l3", "primal, base")
            )
        case 1:
            rng.choice(graph.input).name = rng.choice(("x", "", "base"))
        case 2:
            del graph.node[rng.randrange(len(graph.node))]
        case 3:
            rng.choice(graph.node).op_type = rng.choice(("Loop", "Sub", "Conv", "Nothing", "Sin"))
        case 4:
            tensor = rng.choice(graph.initializer)
            tensor.data_location = onnx.TensorProto.EXTERNAL
            for key, value in (("location", rng.choice(("/etc/passwd", "../x", "network.onnx"))), ("offset", "0")):
                tensor.external_data.add(key=key, value=value)
            tensor.ClearField("raw_data")
        case 5:
            tensor = rng.choice(graph.initializer)
            if tensor.dims:
                tensor.dims[rng.randrange(len(tensor.dims))] = rng.choice((0, 1, -1, 2**31, 2**62))
        case 6:
            del graph.input[rng.randrange(len(graph.input))]
    return model.SerializeToString()


TARGETS: dict[str, Callable[[int, Path], None]] = {
    target.__name__: target for target in (exr, foreign, manifest, shard, weights, checkpoint, settings, network)
}
