"""Shards of a training set: safetensors files with a few crops of one scene, written completely or not at all.

A shard has N crops with K inputs each. Tensors are scene-linear, and (N, K, H, W, C) unless another shape is given:

    indirect, direct            primal - direct - caustic, and direct. They are separate, because in a sum of half
                                floats weak light beside a lamp would be lost
    albedo, normal, depth
    primal_se                   standard errors, because variances of small numbers would underflow in half floats
    dx, dy, dx_se, dy_se        all or none: inputs of a sampler without gradients have none
    caustic, caustic_se         light that dx and dy exclude; all or none, with reference_caustic
    reference_caustic           (N, H, W, 3)
    reference_indirect, reference_direct    (N, H, W, 3)
    reference_halves            (N, 2, H, W, 3), optional: reference_indirect from each half of its samples
    samples                     optional: the number of samples of each pixel, if it varies within inputs
    diffuse, diffuse_se, specular, specular_se    all or none: parts of indirect, where the sampler splits it
    fine_primal, fine_albedo, fine_normal    (N, K, k H, k W, 3), all or none: k x k subpixels of each pixel, with all
                                light
    feature_noise               (N, K), only with subpixels: the variance ``ngpt:featureNoise``, -1 if unknown
    motion                      (N, H, W, 2), optional: the layer of that name, floats, ``FAR`` where it is unknown
    spp                         (N, K) samples per pixel, int32

The layer ``shared`` of inputs is left out, because no network reads it.

A crop may be a pair: it has K = 2 independent inputs, and no references.

The frames of a shot (a frame sequence) are successive crops. The record of each of these crops has the number of its
frame.

A tensor is stored in half floats if this changes at most the share ``MAX_LOSS`` of every crop, otherwise in floats.
With subpixels, ``fine_primal``, ``direct`` and ``caustic`` are always stored in floats. The reason is that a pixel is
the mean of its subpixels: in half floats, weak light beside a lamp would be lost in the difference of this mean to
``direct``. The record of the shard is in the metadata of the header, as JSON under "ngpt".
"""

import json
from collections.abc import Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path
from threading import Lock
from typing import Any

import numpy as np

from ngpt.errors import NgptError
from ngpt.layers import FEATURE_NOISE
from ngpt.stack import GradientStack
from ngpt.subpixels import FINE
from ngpt.system import files
from ngpt.system.install import install_command
from ngpt.system.records import check, parse_json
from ngpt.system.writing import write_bytes

# The tensors of inputs, with their numbers of channels.
GRADIENTS = {"dx": 3, "dy": 3, "dx_se": 3, "dy_se": 3}
INPUTS = {"indirect": 3, "direct": 3, "albedo": 3, "normal": 3, "depth": 1, "primal_se": 3}
CAUSTIC = {"caustic": 3, "caustic_se": 3}
SAMPLES = {"samples": 1}
SPLIT = {"diffuse": 3, "diffuse_se": 3, "specular": 3, "specular_se": 3}
SUBPIXELS = {f"fine_{name}": 3 for name in FINE}
NOISE = "feature_noise"
OF_INPUTS = INPUTS | GRADIENTS | CAUSTIC | SAMPLES | SPLIT
REFERENCES = ("reference_indirect", "reference_direct")
REFERENCE_CAUSTIC = "reference_caustic"
REFERENCE_HALVES = "reference_halves"
MOTION = "motion"

# The value, in pixels, that stands for unknown motion. It leads out of any image.
FAR = 1e6

# Name of a type in safetensors -> type of NumPy.
_TYPES = {"F16": np.float16, "F32": np.float32, "F64": np.float64, "U8": np.uint8, "I32": np.int32, "I64": np.int64}

# Share of the sum of absolute values that conversion to half floats may change; plain rounding changes about 1.8e-4.
MAX_LOSS = 1e-3


@dataclass(frozen=True)
class CropData:
    """A rendered crop.

    ``stacks``             K inputs with finite values, with ``spp`` samples per pixel
    ``reference``          the converged image (H, W, 3); None for a pair
    ``reference_direct``   the directly visible emission in the reference; None for a pair
    ``reference_caustic``  the light in the reference that the layer ``caustic`` of inputs estimates; None if there is
                           no such layer
    ``halves``             two independent images, each from half of the reference's samples, without
                           ``reference_caustic``; () if the reference is not made of halves
    ``motion``             (H, W, 2), the motion of a frame of a shot, NaN where it is unknown; None for single images
    """

    stacks: Sequence[GradientStack]
    spp: Sequence[int]
    reference: np.ndarray | None = None
    reference_direct: np.ndarray | None = None
    reference_caustic: np.ndarray | None = None
    halves: tuple[np.ndarray, ...] = ()
    motion: np.ndarray | None = None

    def tensors(self) -> dict[str, np.ndarray]:
        inputs = [_input_tensors(stack) for stack in self.stacks]
        tensors = {name: np.stack([i[name] for i in inputs]) for name in inputs[0]}
        tensors["spp"] = np.array(self.spp, np.int32)
        if self.reference is None or self.reference_direct is None:
            return tensors
        tensors["reference_indirect"] = self.reference - self.reference_direct
        tensors["reference_direct"] = self.reference_direct
        if self.reference_caustic is not None:
            tensors["reference_indirect"] = tensors["reference_indirect"] - self.reference_caustic
            tensors[REFERENCE_CAUSTIC] = self.reference_caustic
        if self.halves:
            tensors[REFERENCE_HALVES] = np.stack(self.halves) - self.reference_direct
        if self.motion is not None:
            tensors[MOTION] = np.where(np.abs(self.motion) < FAR, self.motion, FAR).astype(np.float32)
        return tensors


def tensor_names(
    gradients: bool, caustic: bool = False, further: Sequence[str] = (), *, pairs: bool = False
) -> tuple[str, ...]:
    """The names of the tensors of a shard.

    ``gradients``, ``caustic``  whether its inputs have these layers
    ``further``                 the names of its optional tensors
    ``pairs``                   whether its crops are pairs, which have no references
    """
    references = () if pairs else (*((REFERENCE_CAUSTIC,) if caustic else ()), *REFERENCES)
    return (*INPUTS, *(GRADIENTS if gradients else ()), *(CAUSTIC if caustic else ()), *further, *references, "spp")


def _input_tensors(stack: GradientStack) -> dict[str, np.ndarray]:
    caustic = "caustic" in stack
    tensors = {"indirect": stack["primal"] - stack["direct"] - (stack["caustic"] if caustic else 0)}
    optional = {"dx": GRADIENTS, "caustic": CAUSTIC, "samples": SAMPLES, "diffuse": SPLIT}
    for name in (*INPUTS, *(name for layer, names in optional.items() if layer in stack for name in names)):
        if name.endswith("_se"):
            tensors[name] = np.sqrt(stack[name.removesuffix("_se") + "_var"])
        elif name != "indirect":
            tensors[name] = stack[name]
    if stack.fine:
        tensors |= {f"fine_{name}": layer for name, layer in stack.fine.items()}
        noise = stack.number(FEATURE_NOISE)
        tensors[NOISE] = np.float32(-1 if noise is None else noise)
    return tensors


def smallest_float(tensor: np.ndarray) -> np.ndarray:
    """``tensor`` (N, ...) in half floats if that is accurate enough for each of its N entries, else in floats."""
    if tensor.dtype.kind != "f":
        return tensor
    with np.errstate(over="ignore"):
        half = tensor.astype(np.float16)
    for exact, rounded in zip(tensor.astype(np.float64), half, strict=True):
        if not np.isfinite(rounded).all() or np.abs(exact - rounded).sum() > MAX_LOSS * np.abs(exact).sum():
            return tensor.astype(np.float32)
    return half


def write_shard(path: Path, crops: Sequence[CropData], record: Mapping[str, Any]) -> None:
    """Writes a shard with the record of its rendering. It has no crops if all of them have failed.

    An existing file is kept: another worker has made it, and its checksum may already be in the manifest. The two files
    differ only in the times of their records.

    Raises NgptError for values that are not finite, and if the file cannot be written.
    """
    from safetensors.numpy import save

    each = [crop.tensors() for crop in crops]
    tensors = {name: np.stack([t[name] for t in each]) for name in each[0]} if each else {}
    # Half floats would change motion by hundredths of a pixel, and cannot hold FAR.
    whole = {MOTION, NOISE, *(("fine_primal", "direct", "caustic") if "fine_primal" in tensors else ())}
    tensors = {name: tensor if name in whole else smallest_float(tensor) for name, tensor in tensors.items()}
    for name, tensor in tensors.items():
        if not np.isfinite(tensor).all():
            raise NgptError(f"{path}: tensor '{name}' has {np.sum(~np.isfinite(tensor))} values that are not finite")
    # safetensors writes bytes in the order of memory, so arrays must be contiguous in C order.
    tensors = {name: np.ascontiguousarray(tensor) for name, tensor in tensors.items()}
    data = save(tensors, {"ngpt": json.dumps(record)})
    files.save(path, lambda path, overwrite: write_bytes(path, data, overwrite), alike=True)


class Shard:
    """Reads parts of the tensors in a shard.

    The file is not mapped into memory, because if a mapped file is truncated, the process dies without a message.

    ``keep_open``  whether the file stays open, so that it can be read after it has been removed
    """

    def __init__(self, path: Path, keep_open: bool = False):
        try:
            from safetensors import SafetensorError, safe_open
        except ModuleNotFoundError as error:
            raise NgptError(f"training sets need safetensors; `{install_command('train')}`") from error
        self.path = path
        if not path.is_file():
            raise NgptError(f"{path}: no such shard; make it again: ngpt dataset")
        try:
            # safetensors checks the header. Tensors are read by this class.
            with safe_open(path, framework="np") as checked:
                metadata = checked.metadata() or {}
                self.names = tuple(checked.keys())
            with open(path, "rb") as file:
                length = int.from_bytes(file.read(8), "little")
                header = json.loads(file.read(length))
            self._kept = open(path, "rb", buffering=0) if keep_open else None  # noqa: SIM115 (closed with the shard)
        except (OSError, SafetensorError, ValueError) as error:
            raise NgptError(f"{path}: cannot be read as a shard: {error}; make it again or remove it") from error
        self._one_reader = Lock()
        self._tensors = {name: header[name] for name in self.names}
        self._first = 8 + length
        if "ngpt" not in metadata:
            raise NgptError(f"{path}: is no shard of a training set (its header has no 'ngpt' record)")
        self.record: dict[str, Any] = parse_json(metadata["ngpt"], f"{path}: its record")
        check(self.record, dict, f"{path}: its record")

    def shape(self, name: str) -> tuple[int, ...]:
        return tuple(self._tensors[name]["shape"])

    def type(self, name: str) -> str:
        """The type's name in safetensors, such as "F16"."""
        return self._tensors[name]["dtype"]

    def tensor(self, name: str) -> np.ndarray:
        return self._part(name)

    def crop(self, name: str, crop: int) -> np.ndarray:
        """Tensor ``name`` of one crop, float32 (integers as they are)."""
        return _single(self._part(name, crop))

    def input(self, name: str, crop: int, k: int) -> np.ndarray:
        """Tensor ``name`` of one input of one crop, float32."""
        return _single(self._part(name, crop, k))

    def _part(self, name: str, *index: int) -> np.ndarray:
        """The part of a tensor at these first indices. Raises NgptError if the file is now too short."""
        shape = self.shape(name)
        array = np.empty(shape[len(index) :], _TYPES[self.type(name)])
        place = int(np.ravel_multi_index(index, shape[: len(index)])) if index else 0
        begin = self._first + self._tensors[name]["data_offsets"][0] + place * array.nbytes
        room = array.reshape(-1).view(np.uint8)
        try:
            with (
                nullcontext(self._kept) if self._kept else open(self.path, "rb", buffering=0) as file,
                self._one_reader,
            ):
                file.seek(begin)
                done = 0
                while done < len(room) and (read := file.readinto(room[done:].data)):
                    done += read
        except OSError as error:
            raise NgptError(f"{self.path}: cannot be read any more: {error.strerror}; copy it again") from error
        if done < len(room):
            raise NgptError(
                f"{self.path}: ends amid tensor '{name}', after {begin + done} bytes: it was cut while it was in use; "
                "copy it again, or make it again: python -m data_gen"
            )
        return array


def _single(array: np.ndarray) -> np.ndarray:
    return array.astype(np.float32) if array.dtype.kind == "f" else array
