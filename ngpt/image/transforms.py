"""View transforms from scene-linear Rec. 709 to 8-bit sRGB, for pictures to look at.

standard  the sRGB curve (IEC 61966-2-1); values above 1 are clipped
filmic    AgX: highlights roll off and lose their colour, as on film
aces      ACES 1.3, "ACES 1.0 - SDR Video", by the built-in configuration of OpenColorIO, which must be installed
"""

from collections.abc import Callable
from functools import lru_cache
from importlib.util import find_spec
from typing import Any

import numpy as np

from ngpt.errors import NgptError
from ngpt.image.display import encoded_srgb, to_display8
from ngpt.system.install import package_command

# AgX (Troy Sobotka) in the form of B. Wrensch, "Minimal AgX implementation" (iolite-engine.com, 2023): primaries are
# moved toward grey, light from 2^-12.47393 to 2^4.026069 is mapped by a polynomial, and primaries are moved back.
_INSET = np.array(
    [
        [0.842479062253094, 0.0784335999999992, 0.0792237451477643],
        [0.0423282422610123, 0.878468636469772, 0.0791661274605434],
        [0.0423756549057051, 0.0784336, 0.879142973793104],
    ]
)
_DARKEST, _BRIGHTEST = -12.47393, 4.026069
_CURVE = (-17.86, 78.01, -126.7, 92.06, -28.72, 4.361, -0.1718, 0.002857)  # highest power first
_CONFIGURATION = "ocio://cg-config-v2.1.0_aces-v1.3_ocio-v2.3"


def filmic(light: np.ndarray) -> np.ndarray:
    """Light (H, W, 3) of 0 or more as display values of sRGB, by AgX."""
    stops = np.log2(np.maximum(light @ _INSET.T, 2.0**_DARKEST))
    place = np.clip((stops - _DARKEST) / (_BRIGHTEST - _DARKEST), 0.0, 1.0)
    return np.polyval(_CURVE, place) @ np.linalg.inv(_INSET).T


def aces(light: np.ndarray) -> np.ndarray:
    """Light (H, W, 3) of 0 or more as display values of sRGB, by OpenColorIO."""
    image = np.ascontiguousarray(light, np.float32)
    _aces().applyRGB(image)
    return image


def check_transform(name: str) -> None:
    """Raises NgptError if the package of a transform is missing."""
    if name == "aces":
        _aces()


@lru_cache(maxsize=1)
def _aces() -> Any:
    if find_spec("PyOpenColorIO") is None:
        raise NgptError(f"--transform aces needs OpenColorIO: {package_command('opencolorio>=2.3')}")
    import PyOpenColorIO as ocio

    try:
        config = ocio.Config.CreateFromFile(_CONFIGURATION)
    except ocio.Exception as error:
        version = ocio.__version__
        raise NgptError(f"--transform aces: OpenColorIO {version} has no ACES 1.3; install 2.3 or newer") from error
    view = ("Linear Rec.709 (sRGB)", "sRGB - Display", "ACES 1.0 - SDR Video", ocio.TRANSFORM_DIR_FORWARD)
    return config.getProcessor(*view).getDefaultCPUProcessor()


TRANSFORMS: dict[str, Callable[[np.ndarray], np.ndarray]] = {"standard": encoded_srgb, "filmic": filmic, "aces": aces}


def shown(image: np.ndarray, transform: str = "standard", stops: float = 0.0) -> np.ndarray:
    """Scene-linear Rec. 709 (H, W, 3) as uint8 sRGB, after multiplication by 2**stops.

    Negative values show as 0, a pixel with +Inf as white, a pixel with NaN as magenta. Raises NgptError if the package
    of the transform is missing.
    """
    return to_display8(image, TRANSFORMS[transform], stops)
