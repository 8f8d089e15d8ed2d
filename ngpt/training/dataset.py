"""Reads training sets: folders of shards with a manifest.

    data = Dataset("DIR")
    crop = data[0]
    crop.stack(0), crop.reference        # a GradientStack, (H, W, 3)
    for shot in data.shots:              # in sets of shots: the crops of a shot, frame by frame
        frames = [data[i] for i in shot]

``python -m data_gen`` makes them, ``ngpt info DIR`` verifies them, and ``ngpt.training.shards`` describes the files.
"""

import hashlib
import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from ngpt.errors import NgptError
from ngpt.layers import FEATURE_NOISE
from ngpt.stack import GradientStack
from ngpt.subpixels import FINE, SUBPIXELS, means, subpixels
from ngpt.system.records import Shape, check, read_json
from ngpt.training import shards
from ngpt.training.shards import Shard, tensor_names

FORMAT, VERSION = "ngpt-dataset", 1
MANIFEST = "manifest.json"
_CROP: Shape = {"spp": [int], "seconds": {str: (int, float)}}
_ENTRY: Shape = {"file": str, "sha256": str, "bytes": int, "scene": str, "crops": [_CROP], "failures": list}
_MANIFEST: Shape = {"config": dict, "planned": int, "shards": [_ENTRY]}


@dataclass(frozen=True)
class ShardCrop:
    """A crop. Its pixels are read only when they are used.

    ``spp`` holds the samples per pixel of the inputs. ``frame`` is the number of the crop in a shot (a frame sequence),
    from 0; None for a single image.
    """

    shard: Shard
    index: int
    scene: str
    spp: tuple[int, ...]
    frame: int | None = None

    @property
    def inputs(self) -> int:
        return len(self.spp)

    @property
    def paired(self) -> bool:
        """Whether the crop has no reference, but two independent inputs of equal spp, each the target of the other."""
        return shards.REFERENCES[0] not in self.shard.names

    def stack(self, k: int) -> GradientStack:
        """Input ``k`` with all layers of its rendered stack, with finite values.

        The stack has gradients if its sampler makes them. If the set has subpixels, the stack has them, too, and its
        pixels are the means of the subpixels, to the bit. Frames of shots have the layer ``motion``. It is NaN where
        the motion is unknown, and everywhere in a first frame.
        """
        if not 0 <= k < self.inputs:
            raise NgptError(f"{self.shard.path}: there is no input {k}; the crop has inputs 0 .. {self.inputs - 1}")
        layers, fine = self._pixels(k), self._subpixels(k)
        width = layers["primal"].shape[1]
        layers |= {name: means(layer, subpixels(fine, width)) for name, layer in fine.items()}
        for name in [name for name in layers if name.endswith("_se")]:
            layers[name.removesuffix("_se") + "_var"] = np.square(layers.pop(name))
        attributes: dict[str, Any] = {"ngpt:spp": self.spp[k], "ngpt:normalSpace": "camera"}
        if fine:
            attributes[SUBPIXELS] = subpixels(fine, width)
            if (noise := float(self.shard.input(shards.NOISE, self.index, k))) >= 0:
                attributes[FEATURE_NOISE] = noise
        if shards.MOTION in self.shard.names:
            motion = self.shard.crop(shards.MOTION, self.index)
            layers[shards.MOTION] = np.where(motion < shards.FAR, motion, np.float32(np.nan))
        if self.frame is not None:
            attributes |= {"ngpt:frame": self.frame, "ngpt:previousFrame": self.frame - 1}
        return GradientStack(layers, attributes, path=f"{self.shard.path}, crop {self.index}, input {k}", fine=fine)

    def _pixels(self, k: int) -> dict[str, np.ndarray]:
        """The layers of input ``k`` from the tensors of pixels, not subpixels; with standard errors, not variances."""
        names = [name for name in self.shard.names if name in shards.OF_INPUTS]
        layers = {name: self.shard.input(name, self.index, k) for name in names}
        layers["primal"] = layers.pop("indirect") + layers["direct"] + layers.get("caustic", 0)
        return layers

    def _subpixels(self, k: int) -> dict[str, np.ndarray]:
        names = {name: f"fine_{name}" for name in FINE}
        return {n: self.shard.input(tensor, self.index, k) for n, tensor in names.items() if tensor in self.shard.names}

    def strays(self, k: int) -> bool:
        """Whether the means of the subpixels of input ``k`` differ from its pixels by more than rounding."""
        pixels, fine = self._pixels(k), self._subpixels(k)
        for name, layer in fine.items():
            mean = means(layer, subpixels(fine, pixels[name].shape[1])).astype(np.float64)
            if np.abs(mean - pixels[name]).sum() > 2 * shards.MAX_LOSS * np.abs(mean).sum():
                return True
        return False

    @property
    def reference(self) -> np.ndarray:
        """(H, W, 3) float32: the converged image with directly visible emission. Raises NgptError for a pair."""
        if self.paired:
            raise NgptError(
                f"{self.shard.path}: crop {self.index} is a pair: no reference, its inputs are halves of the samples"
            )
        return self.shard.crop("reference_indirect", self.index) + self.reference_direct + self.reference_caustic

    @property
    def reference_direct(self) -> np.ndarray:
        """(H, W, 3) float32: the directly visible emission in the reference."""
        return self.shard.crop("reference_direct", self.index)

    @property
    def reference_caustic(self) -> np.ndarray:
        """(H, W, 3) float32: the light in the reference that the layer ``caustic`` of inputs estimates, or zeros."""
        if shards.REFERENCE_CAUSTIC in self.shard.names:
            return self.shard.crop(shards.REFERENCE_CAUSTIC, self.index)
        return np.zeros_like(self.reference_direct)

    @property
    def reference_halves(self) -> tuple[np.ndarray, ...]:
        """Two independent images (H, W, 3), each from half of the reference's samples; () if there are none.

        They exclude direct emission and ``reference_caustic``. Their noise cancels in products of errors.
        """
        if shards.REFERENCE_HALVES not in self.shard.names:
            return ()
        return tuple(self.shard.crop(shards.REFERENCE_HALVES, self.index))


class Dataset:
    """The crops of a training set, in the order of its manifest.

    Opening a set reads only its manifest. Each process checks a shard when it first reads one of the shard's crops, and
    raises NgptError if the shard is missing, differs from the manifest, or holds other tensors than it should.
    """

    def __init__(self, folder: str | Path):
        self.folder = Path(folder)
        self.manifest = read_manifest(self.folder)
        self._places: list[tuple[dict, int]] = []
        for entry in self.manifest["shards"]:
            self._places += [(entry, i) for i in range(len(entry["crops"]))]
        self._open: dict[str, Shard] = {}

    @property
    def scenes(self) -> tuple[str, ...]:
        """The names of the scenes that have crops."""
        return tuple(dict.fromkeys(entry["scene"] for entry, _ in self._places))

    @property
    def shots(self) -> tuple[range, ...]:
        """The indices of the crops of each shot, frame by frame; () for a set of single images."""
        frames = [(entry["file"], entry["crops"][place].get("frame")) for entry, place in self._places]
        first = [i for i, (_, frame) in enumerate(frames) if frame == 0]
        shots = []
        for begin in first:
            file, end = frames[begin][0], begin + 1
            while end < len(frames) and frames[end] == (file, end - begin):
                end += 1
            shots.append(range(begin, end))
        return tuple(shots)

    def __len__(self) -> int:
        return len(self._places)

    def __getitem__(self, index: int) -> ShardCrop:
        if not -len(self) <= index < len(self):
            raise IndexError(f"{self.folder}: crop {index} of {len(self)}")
        entry, place = self._places[index]
        if entry["file"] not in self._open:
            self._open[entry["file"]] = _checked(self.folder / entry["file"], entry)
        crop = entry["crops"][place]
        return ShardCrop(self._open[entry["file"]], place, entry["scene"], tuple(crop["spp"]), crop.get("frame"))

    def __iter__(self) -> Iterator[ShardCrop]:
        return (self[i] for i in range(len(self)))

    def __getstate__(self) -> dict[str, Any]:
        return self.__dict__ | {"_open": {}}


def read_manifest(folder: Path) -> dict[str, Any]:
    """The manifest of the training set in ``folder``. Raises NgptError if it is missing or invalid."""
    path = folder / MANIFEST
    if not path.is_file():
        raise NgptError(f"{folder}: no training set there ({MANIFEST} is missing); make one by `ngpt dataset`")
    manifest = read_json(path)
    if not isinstance(manifest, dict) or manifest.get("format") != FORMAT:
        raise NgptError(f"{path}: is not the manifest of a training set")
    if manifest.get("version") != VERSION:
        raise NgptError(f"{path}: is of version {manifest.get('version')}, this ngpt reads version {VERSION}")
    check(manifest, _MANIFEST, str(path))
    for entry in manifest["shards"]:
        for crop in entry["crops"]:
            if "frame" in crop:
                check(crop["frame"], int, f"{path}: 'frame' of a crop of {entry['file']!r}")
        name = PurePosixPath(entry["file"])
        if name.is_absolute() or ".." in name.parts or "\0" in entry["file"]:
            raise NgptError(f"{path}: lists {entry['file']!r}, which is outside its folder; do not trust this manifest")
    return manifest


def checksum(path: Path) -> str:
    """The sha256 of a file, as hexadecimal digits."""
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def problems(folder: Path) -> list[str]:
    """A line for each fault of a training set: files, checksums, shapes, counts and values."""
    found = []
    manifest = read_manifest(folder)
    for entry in manifest["shards"]:
        try:
            shard = _checked(folder / entry["file"], entry)
        except NgptError as error:
            found.append(str(error))
            continue
        for name in shard.names if entry["crops"] else ():
            bad = int(np.sum(~np.isfinite(shard.tensor(name))))
            if bad:
                found.append(f"{shard.path}: tensor '{name}' has {bad} values that are not finite")
        for i, crop_entry in enumerate(entry["crops"]):
            read = ShardCrop(shard, i, entry["scene"], tuple(crop_entry["spp"]))
            for k in filter(read.strays, range(read.inputs)):
                found.append(
                    f"{shard.path}: the subpixels of crop {i}, input {k} do not match its pixels; make this shard again"
                )
        if entry["crops"] and shards.REFERENCES[0] not in shard.names:
            one, other = shard.tensor("indirect").swapaxes(0, 1)
            for crop in np.flatnonzero((one == other).all(axis=(1, 2, 3))):
                found.append(f"{shard.path}: both halves of crop {crop} are the same: nothing is learnt from them")
    listed = {entry["file"] for entry in manifest["shards"]}
    on_disk = {path.relative_to(folder).as_posix() for path in (folder / "shards").glob("[!.]*.safetensors")}
    found += [f"{folder / name}: is not in the manifest; run `ngpt dataset` again" for name in sorted(on_disk - listed)]
    return found


def _checked(path: Path, entry: dict[str, Any]) -> Shard:
    """The shard of an entry of the manifest. Raises NgptError if its checksum or one of its tensors is wrong."""
    # Not Path.is_file, which raises for names that are too long.
    if not os.path.isfile(path):
        raise NgptError(f"{path}: is missing; remove it from the manifest by running `ngpt dataset` again")
    if (digest := checksum(path)) != entry["sha256"]:
        known = entry["sha256"][:12]
        raise NgptError(
            f"{path}: its sha256 is {digest[:12]}..., the manifest says {known}...; copy it again or remove it"
        )
    shard, crops = Shard(path), entry["crops"]
    if not crops:
        return shard
    gradients, caustic = (not tensors.keys().isdisjoint(shard.names) for tensors in (shards.GRADIENTS, shards.CAUSTIC))
    fine = () if shards.SUBPIXELS.keys().isdisjoint(shard.names) else (*shards.SUBPIXELS, shards.NOISE)
    optional = (shards.REFERENCE_HALVES, shards.MOTION, *shards.SAMPLES, *shards.SPLIT)
    pairs = set(shards.REFERENCES).isdisjoint(shard.names)
    further = [*(name for name in optional if name in shard.names), *fine]
    names = tensor_names(gradients, caustic, further, pairs=pairs)
    missing = [name for name in names if name not in shard.names]
    if missing:
        raise NgptError(f"{path}: tensors {', '.join(missing)} are missing")
    shape = shard.shape("indirect")
    if len(shape) != 5 or 0 in shape or any(len(crop["spp"]) != shape[1] for crop in crops):
        raise NgptError(
            f"{path}: tensor 'indirect' is {shape}; it must have 5 axes, with {len(crops[0]['spp'])} inputs"
        )
    inputs, height, width = shape[1:4]
    if pairs and not (inputs == 2 and gradients):
        raise NgptError(f"{path}: has no references, so its crops must be pairs: 2 inputs with gradients, not {inputs}")
    shapes: dict[str, tuple[int, ...]] = {name: (inputs, height, width, c) for name, c in shards.OF_INPUTS.items()}
    shapes |= {"spp": (inputs,), shards.REFERENCE_HALVES: (2, height, width, 3), shards.MOTION: (height, width, 2)}
    if fine:
        wide = shard.shape("fine_primal")
        k = max(wide[3] // width if len(wide) == 5 else 0, 2)
        shapes |= {shards.NOISE: (inputs,)} | dict.fromkeys(shards.SUBPIXELS, (inputs, k * height, k * width, 3))
    for name in names:
        expected = (len(crops), *shapes.get(name, (height, width, 3)))
        if shard.shape(name) != expected:
            raise NgptError(f"{path}: tensor '{name}' is {shard.shape(name)}, it must be {expected}")
        types = ("I32",) if name == "spp" else ("F16", "F32")
        if shard.type(name) not in types:
            raise NgptError(f"{path}: tensor '{name}' is of type {shard.type(name)}, it must be {' or '.join(types)}")
    return shard


def summary(folder: Path) -> dict[str, Any]:
    """The facts of a training set that ``ngpt info`` prints. The entry ``problems`` lists its faults."""
    data = Dataset(folder)
    entries = data.manifest["shards"]
    crops = [crop for entry in entries for crop in entry["crops"]]
    seconds: dict[str, float] = {}
    for crop in crops:
        for part, value in crop["seconds"].items():
            seconds[part] = seconds.get(part, 0.0) + value
    return {
        "training set": str(folder),
        **({"shots": len(data.shots)} if data.shots else {}),
        "crops": len(data),
        **({"subpixels": k} if (k := data.manifest["config"].get("subpixels", 1)) != 1 else {}),
        **({"pairs": len(data)} if data.manifest["config"].get("reference_spp") == 0 else {}),
        "planned": data.manifest["planned"],
        "failed": sum(len(entry["failures"]) for entry in entries),
        "scenes": len(data.scenes),
        "shards": len(entries),
        "megabytes": round(sum(entry["bytes"] for entry in entries) / 1e6, 1),
        "seconds": {part: round(value, 1) for part, value in seconds.items()},
        "problems": problems(folder),
    }
