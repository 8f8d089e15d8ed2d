"""Files of compressed references (renders of many samples) without the noisy inputs of training.

Each time a reference is used, its inputs are rendered again, with new noise.

A file of references has the same name and the same record (scene, views, seeds, versions) as the shard in which the
references were made. It holds the reference images of each crop, compressed by lzma. A number x is stored as its sign
and the integer n nearest to 64 log2 |x|, with an error of at most 0.54 %. The numbers n of green, and the differences
of red and blue from green, are stored as differences from pixel to pixel, with high and low bytes separated.
"""

from __future__ import annotations

import json
import lzma
import zlib
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from data_gen.dataset.config import DatasetConfig, as_json
from ngpt.errors import NgptError
from ngpt.system.files import atomic_output
from ngpt.training.shards import REFERENCE_CAUSTIC, REFERENCES, Shard

STEPS = 64
# log2 of the least number that is kept; smaller ones become 0.
LEAST = -126
IMAGES = (*REFERENCES, REFERENCE_CAUSTIC)
# The entries of a configuration on which references do not depend
_OF_INPUTS = ("inputs", "spp", "adaptive", "subpixels")


@dataclass(frozen=True)
class Again:
    """A file of kept references, and the seed for the noise of their new inputs."""

    path: str
    seed: int


def home(config: DatasetConfig, folder: Path) -> Path:
    """The subfolder of ``folder`` for references of ``config``.

    Configurations that differ only in their inputs share a subfolder.
    """
    facts = {name: value for name, value in as_json(config).items() if name not in _OF_INPUTS}
    return folder / f"{zlib.crc32(json.dumps(facts, sort_keys=True).encode()):08x}"


def keep(shard: Shard, path: Path) -> None:
    """Writes the references of a shard to ``path``, and replaces an existing file."""
    from safetensors.numpy import save

    crops = range(len(shard.record["crops"]))
    names = [name for name in IMAGES if name in shard.names]
    tensors = {f"{name}/{crop}": packed(shard.crop(name, crop)) for name in names for crop in crops}
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic_output(path, overwrite=True) as temporary:
        temporary.write_bytes(save(tensors, {"ngpt": json.dumps(shard.record)}))


class Kept:
    """A file of kept references. Raises NgptError if it is missing or damaged."""

    def __init__(self, path: Path):
        self._shard = Shard(path)
        self.record = self._shard.record

    @property
    def places(self) -> dict[int, int]:
        """The place of each crop in the file, by the number of the crop in its scene."""
        return {facts["crop"]: place for place, facts in enumerate(self.record["crops"])}

    def images(self, place: int) -> tuple[np.ndarray, ...]:
        """The reference (H, W, 3) of all light, emission seen directly, and the layer ``caustic`` if there is one."""
        size = self.record["crops"][place]["view"]["size"]
        found = [f"{name}/{place}" for name in IMAGES if f"{name}/{place}" in self._shard.names]
        parts = [unpacked(self._shard.tensor(name), (size, size), str(self._shard.path)) for name in found]
        return (np.sum(parts, axis=0), *parts[1:])


def packed(image: np.ndarray) -> np.ndarray:
    """Compresses finite float32 (H, W, 3) to (n,) uint8."""
    size = np.abs(image)
    with np.errstate(divide="ignore"):
        steps = np.round((np.log2(size, dtype=np.float32) - LEAST) * STEPS)
    numbers = np.where(size >= 2.0**LEAST, np.sign(image) * (1 + np.maximum(steps, 0)), 0).astype(np.int16)
    numbers[..., ::2] -= numbers[..., 1:2]
    change = np.diff(numbers, axis=1, prepend=np.int16(0))
    planes = np.ascontiguousarray(change.astype("<i2").transpose(2, 0, 1)).view(np.uint8).reshape(-1, 2).T
    return np.frombuffer(lzma.compress(planes.tobytes()), np.uint8)


def unpacked(data: np.ndarray, size: tuple[int, int], where: str = "kept reference") -> np.ndarray:
    """Undoes ``packed``: (H, W, 3) float32, where ``size`` is (H, W). Raises NgptError for damaged bytes."""
    try:
        planes = np.frombuffer(lzma.decompress(data.tobytes()), np.uint8).reshape(2, -1)
        change = np.ascontiguousarray(planes.T).view("<i2").reshape(3, *size)
    except (lzma.LZMAError, EOFError, ValueError) as error:
        raise NgptError(f"{where}: is damaged: {error}; remove it, and it is made again") from error
    numbers = np.cumsum(change, axis=2, dtype=np.int16).transpose(1, 2, 0).copy()
    numbers[..., ::2] += numbers[..., 1:2]
    values = np.exp2((np.abs(numbers.astype(np.float32)) - 1) / STEPS + LEAST)
    return np.where(numbers == 0, 0, np.sign(numbers) * values).astype(np.float32)
