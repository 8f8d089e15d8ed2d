"""Writes a training set in the layout of Open Image Denoise's own training: an OpenEXR file for each image and feature.

    FOLDER/train/SCENE/crop0003_0016spp.hdr.exr     an input of 16 samples per pixel: light,
                        crop0003_0016spp.alb.exr    albedo, 0 to 1,
                        crop0003_0016spp.nrm.exr    normal, -1 to 1
                        crop0003_ref.hdr.exr        and the same for the reference
    FOLDER/valid/...                                the same for the scenes that are kept for validation

Source of the layout: "Datasets" in the README of Open Image Denoise 2.4, and training/dataset.py there.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

from ngpt.errors import NgptError
from ngpt.io.openexr import ExrImage, ExrPart, write_exr
from ngpt.training.dataset import Dataset, ShardCrop

# One in VALIDATION scenes is for validation, and at least one scene if there are two.
VALIDATION = 10


def write_layout(data: Dataset, folder: Path, progress: Callable[[int, int], None] = lambda done, total: None) -> int:
    """Writes the crops of ``data`` into ``folder``, except existing files, and returns how many inputs were left out.

    An input is left out if another input of its crop has as many samples, since both would have the same name.
    Raises NgptError for sets of shots or without references, and if a file cannot be written.
    """
    if data.shots:
        raise NgptError(f"{data.folder}: is a set of shots, and Open Image Denoise trains on single images")
    held = set(data.scenes[::-VALIDATION][: len(data.scenes) // 2])
    digits = max([4, *(len(str(n)) for crop in data for n in crop.spp)])
    left_out = 0
    progress(0, len(data))
    for done, (name, crop) in enumerate(_named(data), 1):
        place = folder / ("valid" if crop.scene in held else "train") / crop.scene
        place.mkdir(parents=True, exist_ok=True)
        for label, images in _images(crop, digits):
            for feature, image in images.items():
                path = place / f"{name}_{label}.{feature}.exr"
                if not path.exists():
                    write_exr(path, _file(image, half=feature != "hdr"))
        left_out += crop.inputs - len(set(crop.spp))
        progress(done, len(data))
    return left_out


def _named(data: Dataset) -> Iterator[tuple[str, ShardCrop]]:
    counts: dict[str, int] = {}
    for crop in data:
        number = counts.get(crop.scene, 0)
        counts[crop.scene] = number + 1
        yield f"crop{number:04d}", crop


def _images(crop: ShardCrop, digits: int) -> Iterator[tuple[str, dict[str, np.ndarray]]]:
    """(end of the name, images) of each input and of the reference. The features of the reference are means over all
    inputs, weighted by their samples."""
    if "reference_indirect" not in crop.shard.names:
        raise NgptError(f"{crop.shard.path}: has no references, without which Open Image Denoise does not train")
    stacks = [crop.stack(k) for k in range(crop.inputs)]
    for k in sorted({n: k for k, n in reversed(list(enumerate(crop.spp)))}.values()):
        label = f"{crop.spp[k]:0{digits}d}spp"
        yield label, {"hdr": stacks[k]["primal"], "alb": stacks[k]["albedo"], "nrm": stacks[k]["normal"]}
    means = {
        short: np.average([stack[layer] for stack in stacks], axis=0, weights=crop.spp)
        for short, layer in (("alb", "albedo"), ("nrm", "normal"))
    }
    yield "ref", {"hdr": crop.reference, **means}


def _file(image: np.ndarray, half: bool) -> ExrImage:
    kind = np.float16 if half else np.float32
    channels = {name: np.ascontiguousarray(image[..., i], kind) for i, name in enumerate("RGB")}
    return ExrImage([ExrPart("", {}, channels)])
