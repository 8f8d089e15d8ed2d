"""Training sets of random numbers, with all that a set may hold."""

import hashlib
import json

import numpy as np

from ngpt.layers import FEATURE_NOISE
from ngpt.stack import GradientStack
from ngpt.subpixels import FINE, means, spread, stored
from ngpt.training.dataset import FORMAT, VERSION, Dataset
from ngpt.training.shards import CropData, write_shard

SIZE = 8


def crop_data(rng, caustic=False, halves=False, motion=None, k=1):
    def image(channels=3):
        return rng.random((SIZE, SIZE, channels), np.float32)

    def layers():
        varying = ["primal", "dx", "dy", *(["caustic"] if caustic else [])]
        made = {name: image() for name in (*varying, "direct", "albedo", "normal")} | {"depth": image(1)}
        made["primal"] += made["direct"] + made.get("caustic", 0)
        return made | {f"{name}_var": image() for name in varying}

    def stack():
        pixels = layers()
        if k == 1:
            return GradientStack(pixels)
        # About the pixels
        fine = {
            name: stored(name, spread(pixels[name], k) + rng.normal(0, 0.1, (k * SIZE, k * SIZE, 3))) for name in FINE
        }
        pixels |= {name: means(layer, k) for name, layer in fine.items()}
        return GradientStack(pixels, {FEATURE_NOISE: 1e-9}, fine=fine)

    direct, light = image(), image() if caustic else None
    reference = direct + 1 + (light if caustic else 0)
    apart = tuple(direct + image() for _ in range(2 * halves))
    return CropData([stack() for _ in range(2)], [2, 9], reference, direct, light, apart, motion)


def write_set(folder, shards, frames=None, **config):
    """A training set of ``shards``, crops by the name of their scene; ``frames`` are the crops' own, in that order."""
    entries, frames = [], iter(frames or ())
    (folder / "shards").mkdir(parents=True, exist_ok=True)
    for scene, crops in shards.items():
        path, told = folder / f"shards/{scene}.safetensors", []
        for crop in crops:
            frame = next(frames, None)
            told.append({"spp": list(crop.spp), "seconds": {}} | ({} if frame is None else {"frame": frame}))
        record = {"scene": scene, "crops": told, "failures": []}
        write_shard(path, crops, record)
        sealed = {"file": f"shards/{path.name}", "sha256": hashlib.sha256(path.read_bytes()).hexdigest()}
        entries.append(sealed | {"bytes": path.stat().st_size} | record)
    manifest = {"format": FORMAT, "version": VERSION, "config": config, "planned": 3, "shards": entries}
    (folder / "manifest.json").write_text(json.dumps(manifest))
    return Dataset(folder)
