"""Writes results: as OpenEXR with the whole stack, as PFM, or as pictures."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ngpt.errors import WrongUse
from ngpt.image.display import auto_exposure, squared
from ngpt.image.pictures import PICTURES, check_kind, write_picture
from ngpt.image.transforms import check_transform, shown
from ngpt.io.exr import write
from ngpt.io.foreign.pfm import write_pfm
from ngpt.io.primaries import converted, to_rec709
from ngpt.io.reduced import smaller
from ngpt.stack import GradientStack
from ngpt.windows import Place, Window

# The endings of files that can hold results
IMAGES = (".exr", ".pfm", *PICTURES)


@dataclass(frozen=True)
class Look:
    """How pictures show light.

    ``transform``  the view transform, a name in ``ngpt.image.transforms``
    ``exposure``   in stops, or "auto"
    """

    transform: str = "standard"
    exposure: float | str = 0.0

    def of(self, image: np.ndarray) -> np.ndarray:
        """The picture (H, W, 3) uint8 sRGB of an image (H, W, 3) in linear Rec. 709."""
        return shown(image, self.transform, self.stops(image))

    def stops(self, image: np.ndarray) -> float:
        """The exposure of an image in stops."""
        return auto_exposure(image) if isinstance(self.exposure, str) else self.exposure


def write_result(
    target: Path,
    views: Sequence[tuple[np.ndarray, GradientStack]],
    attributes: Mapping[str, Any],
    look: Look,
    overwrite: bool,
    *,
    into: str | None = None,
    reduce: int = 1,
) -> None:
    """Writes the results (H, W, 3) of ``views`` with their stacks as OpenEXR, or only the first in another format.

    ``attributes``, ``into`` and ``reduce`` are as for ``ngpt.write``; ``look`` is for pictures.
    """
    if target.suffix.lower() == ".exr":
        images, stacks = (list(each) for each in zip(*views, strict=True))
        write(target, images, stacks, overwrite, attributes, into, reduce=reduce)
        return
    image, place = smaller(views[0][0], views[0][1].place, reduce)
    light = converted(image, to_rec709(views[0][1].attributes))
    if target.suffix.lower() == ".pfm":
        write_pfm(target, light, overwrite)
    else:
        write_picture(target, look.of(in_picture(light, place)), overwrite)


def check_image(target: Path, transform: str) -> None:
    """Raises an error if a file cannot hold a result, or if its kind or the transform needs a missing package."""
    kind = target.suffix.lower()
    if kind not in IMAGES:
        raise WrongUse(f"{target}: results are OpenEXR, PFM or pictures; let the name end in {' '.join(IMAGES)}")
    if kind in PICTURES:
        check_kind(target, PICTURES)
        check_transform(transform)


def in_picture(image: np.ndarray, place: Place) -> np.ndarray:
    """The part of an image (H, W, 3) in the display window, with square pixels.

    An image outside of the display window is returned whole.
    """
    return squared(image[seen(place).within(place.data)], place.aspect)


def seen(place: Place) -> Window:
    """The part of the data window in the display window; the whole data window if there is none."""
    return place.data.common(place.display) or place.data
