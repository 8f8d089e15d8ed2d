"""The file of a result: OpenEXR with the whole stack, PFM, or a picture."""

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

# Kinds of files that hold results
IMAGES = (".exr", ".pfm", *PICTURES)


@dataclass(frozen=True)
class Look:
    """How a picture shows light: its view transform (``ngpt.image.transforms``), and its exposure in stops, or
    "auto"."""

    transform: str = "standard"
    exposure: float | str = 0.0

    def of(self, image: np.ndarray) -> np.ndarray:
        """The pixels of a picture of an image (H, W, 3) in linear Rec. 709."""
        return shown(image, self.transform, self.stops(image))

    def stops(self, image: np.ndarray) -> float:
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
    """Writes images (H, W, 3), one for each of the ``views``, with their stacks. Only OpenEXR files hold several views.

    ``attributes`` say how they were made; ``into`` and ``reduce`` are as in ``ngpt.write``.
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
    """Raises an error for a file that cannot hold a result, or that this machine cannot make."""
    kind = target.suffix.lower()
    if kind not in IMAGES:
        raise WrongUse(f"{target}: results are OpenEXR, PFM or pictures; let the name end in {' '.join(IMAGES)}")
    if kind in PICTURES:
        check_kind(target, PICTURES)
        check_transform(transform)


def in_picture(image: np.ndarray, place: Place) -> np.ndarray:
    """The part of an image (H, W, 3) in the display window, without overscan. An image outside of it is shown whole.

    Pixels become as wide as they are high.
    """
    return squared(image[seen(place).within(place.data)], place.aspect)


def seen(place: Place) -> Window:
    return place.data.common(place.display) or place.data
