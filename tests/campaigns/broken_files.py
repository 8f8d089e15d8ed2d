"""What broken files are given to: a function of a ``random.Random`` and a folder to work in, for each target.

A target returns where the file is accepted and handled, raises NgptError where it is refused, and anything else is a
failure. With None in place of the random numbers the file is whole.
"""

import io
import struct
import tempfile
import tomllib
import zlib
from collections.abc import Callable
from functools import cache
from hashlib import sha256
from pathlib import Path
from random import Random

import numpy as np
from broken_data import bytes_changed, safetensors_changed, to_json, value_changed
from broken_exr import exr_changed, seeds
from full_stack import full_stack

import ngpt
from ngpt.io.exr import read, write
from ngpt.methods import reconstruct
from ngpt.network.shipped import WEIGHTS

CONFIGS = Path(__file__).parents[2] / "configs"


def exr(rng: Random | None, folder: Path) -> None:
    """What `ngpt denoise` does with a file: reads, reconstructs, writes; what is written can be read again."""
    path, result = folder / "stack.exr", folder / "result.exr"
    path.write_bytes(exr_changed(rng) if rng else seeds()[0])
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


def foreign(rng: Random | None, folder: Path) -> None:
    """PFM, Radiance HDR, PNG, TIFF and JPEG: read as a stack and as a picture."""
    name, data = rng.choice(_foreign()) if rng else _foreign()[0]
    if rng:
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


def manifest(rng: Random | None, folder: Path) -> None:
    value, shard = _dataset()
    data = to_json(value)
    if rng:
        data = to_json(value_changed(rng, value)) if rng.random() < 0.8 else bytes_changed(rng, data)
    _read_dataset(folder, data, shard)


def shard(rng: Random | None, folder: Path) -> None:
    """The manifest has the checksum of the broken shard. Otherwise each would be refused for its checksum."""
    value, data = _dataset()
    data = safetensors_changed(rng, data) if rng else data
    entry = value["shards"][0] | {"sha256": sha256(data).hexdigest(), "bytes": len(data)}
    _read_dataset(folder, to_json(value | {"shards": [entry]}), data)


@cache
def _weights() -> bytes:
    """Weights of a tiny network."""
    from networks import ALL, dense, untrained

    from ngpt.network.safetensors import save_weights

    with tempfile.TemporaryDirectory() as folder:
        save_weights(Path(folder) / "weights.safetensors", untrained(dense(ALL)), {})
        return (Path(folder) / "weights.safetensors").read_bytes()


def weights(rng: Random | None, folder: Path) -> None:
    path, data = folder / "weights.safetensors", _weights()
    path.write_bytes(safetensors_changed(rng, data) if rng else data)
    image = ngpt.denoise(full_stack(9, 7), "ngpt", weights=str(path))
    assert np.isfinite(image).all()


def settings(rng: Random | None, folder: Path) -> None:
    """Configurations of training and of data generation: other values, or other bytes."""
    from data_gen.dataset.config import DatasetConfig, read_config
    from ngpt.system.records import from_table
    from ngpt.training.settings import from_dict, read_settings

    name = rng.choice(("fast.toml", "data-cpu.toml", "paper.toml")) if rng else "fast.toml"
    path, data = folder / name, (CONFIGS / name).read_bytes()
    if rng and rng.random() < 0.8:
        value = tomllib.loads(data.decode())
        if name == "data-cpu.toml":
            value["files"] = [{"pattern": str(folder / "*.xml"), "crops": 2, "boxes": {"a": [[0, 0, 0], [1, 1, 1]]}}]
        changed = value_changed(rng, value)
        changed = changed if isinstance(changed, dict) else {"x": changed}
        from_table(DatasetConfig, changed, str(path)) if name == "data-cpu.toml" else from_dict(changed, str(path))
        return
    path.write_bytes(bytes_changed(rng, data) if rng else data)
    if name == "data-cpu.toml":
        read_config(path)
    else:
        read_settings(path)


def network(rng: Random | None, folder: Path) -> None:
    """ONNX files that users pass as weights."""
    path, data = folder / "network.onnx", (WEIGHTS / "ngpt-fast.onnx").read_bytes()
    path.write_bytes(_onnx_changed(rng, data) if rng else data)
    image = ngpt.denoise(full_stack(9, 7), "ngpt-fast", weights=str(path))
    assert np.isfinite(image).all()


def _onnx_changed(rng: Random, data: bytes) -> bytes:
    """Its metadata, nodes, inputs and initializers, or its bytes. ``hostile_networks`` has networks that lie."""
    import onnx

    if rng.random() < 0.5:
        # The graph's own bytes stand before and after the numbers.
        return bytes_changed(rng, data[:40_000]) + data[40_000:] if rng.random() < 0.7 else bytes_changed(rng, data)
    model = onnx.load_from_string(data)
    graph = model.graph
    match rng.randrange(5):
        case 0:
            rng.choice(model.metadata_props).value = rng.choice(("", "0", "-1", "x", "1e9", str(2**70), "primal, base"))
        case 1:
            rng.choice(graph.input).name = rng.choice(("x", "", "base"))
        case 2:
            rng.choice(graph.node).op_type = rng.choice(("Loop", "Sub", "Conv", "Nothing", "Sin"))
        case 3:
            tensor = rng.choice([tensor for tensor in graph.initializer if tensor.dims])
            tensor.dims[rng.randrange(len(tensor.dims))] = rng.choice((0, 1, -1, 2**31, 2**62))
        case 4:
            part = rng.choice((graph.node, graph.input))
            del part[rng.randrange(len(part))]
    return model.SerializeToString()


TARGETS: dict[str, Callable[[Random | None, Path], None]] = {
    target.__name__: target for target in (exr, foreign, manifest, shard, weights, settings, network)
}
