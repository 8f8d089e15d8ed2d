"""Intel Open Image Denoise as a method: it reads the primal and features, no gradients."""

from collections.abc import Mapping
from importlib.util import find_spec
from typing import Any

import numpy as np

from ngpt.coverage import mirrored
from ngpt.denoisers.clean import features_are_clean
from ngpt.denoisers.oidn_filters import filtered
from ngpt.errors import NgptError
from ngpt.options import Option
from ngpt.repair import Repaired
from ngpt.subpixels import means, spread, subpixels
from ngpt.system.install import package_command

AUXILIARY = ("prefiltered", "clean", "noisy", "none")
QUALITIES = {"high": "High", "balanced": "Balanced", "fast": "Fast"}
# The values of ``filter``: OIDN's own filter and its settings.
FILTERS: dict[str, dict[str, Any]] = {
    "image": {"hdr": True},
    "lightmap": {"kind": "RTLightmap"},
    "directional": {"kind": "RTLightmap", "directional": True},
}

OPTIONS = {
    "auxiliary": Option(
        "auto",
        "how OIDN uses albedo and normal; auto: clean for subpixels, else prefiltered",
        choices=("auto", *AUXILIARY),
    ),
    "filter": Option(
        "image", "for images, for lightmaps, or for lightmaps of coefficients in [-1, 1]", choices=tuple(FILTERS)
    ),
    "quality": Option("high", "quality of OIDN's network: a lower one is faster", choices=tuple(QUALITIES)),
}


def missing() -> str:
    return "" if find_spec("mitsuba_oidn") else f"OIDN is not installed: {package_command('mitsuba-oidn')}"


def oidn(data: Repaired, auxiliary: str, quality: str, filter: str = "image") -> np.ndarray:
    """The image that OIDN makes of the primal, albedo and normal: (H, W, 3) float32 without direct emission.

    OIDN takes no normals without albedo, so they are left out if there is no albedo.

    If the stack has subpixels (``ngpt.subpixels``), they are denoised, and their means are the image. "auto" does this
    only if features are clean. Noisy features, as behind a lens, would have to be prefiltered at four times the cost;
    without prefiltering, subpixels have more error than pixels (docs/lab/log).

    ``auxiliary``  how OIDN uses the features: "prefiltered" denoises them first with its own models and then marks
                   them as clean, which its documentation recommends for the best quality; "clean" marks them as clean
                   without denoising them; "noisy" does neither; "none" leaves them out; "auto" is "clean" for
                   subpixels, and else "prefiltered"
    ``quality``    "high", "balanced" or "fast", for the image and for features that are denoised first
    ``filter``     one of ``FILTERS``: "lightmap" and "directional" are OIDN's for lightmaps, which take no features

    Without features, OIDN reads mirror images of the covered pixels in place of empty ones. Otherwise it would darken
    the borders of the islands of a lightmap, and light would leak from one island to another. Empty pixels of the
    result are those of the primal.
    """
    require_oidn()
    features = {}
    # With light sources that are seen directly: OIDN was trained on such images.
    image, layers = data.image + data.direct, data.features
    k = subpixels(data.fine, image.shape[1]) if filter == "image" else 1
    if filter != "image":
        auxiliary = "none"
    elif auxiliary == "auto":
        auxiliary = "clean" if k > 1 and (not data.features or features_are_clean(data)) else "prefiltered"
        k = k if auxiliary == "clean" else 1
    if k > 1:
        image, layers = data.fine["primal"], data.fine
    image = np.ascontiguousarray(image, np.float32)
    if auxiliary == "prefiltered":
        features = prefiltered(layers, quality)
    elif auxiliary != "none":
        features = _in_range(layers)
    clean = bool(features) and auxiliary in ("prefiltered", "clean")
    settings = {**FILTERS[filter], "quality": QUALITIES[quality]} | ({"clean_aux": clean} if filter == "image" else {})
    empty = None if features or filter != "image" else data.empty
    if empty is None:
        denoised = filtered({"color": image, **features}, **settings)
        return (means(denoised, k) if k > 1 else denoised) - data.direct
    if k > 1:
        empty = spread(empty, k)
    image = np.where(empty[..., None], image, filtered({"color": mirrored(image, empty)}, **settings))
    return (means(image, k) if k > 1 else image) - data.direct


def prefiltered(features: Mapping[str, np.ndarray], quality: str) -> dict[str, np.ndarray]:
    """Albedo and normal (H, W, 3) denoised by OIDN's own models for them, whether they are noisy or not.

    With ``quality`` "high", this takes longer than denoising the image. With "balanced", it takes less than half of
    that, and images denoised with these features are as good (docs/lab/log).
    """
    require_oidn()
    return {name: _prefiltered(name, layer, quality) for name, layer in _in_range(features).items()}


def _in_range(features: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    if "albedo" not in features:
        return {}
    layers = {name: np.ascontiguousarray(features[name]) for name in ("albedo", "normal") if name in features}
    return layers | {"albedo": np.clip(layers["albedo"], 0, 1)}


def _prefiltered(name: str, layer: np.ndarray, quality: str) -> np.ndarray:
    return filtered({name: layer}, "cpu", quality=QUALITIES[quality]) if layer.any() else layer


def require_oidn() -> None:
    """Raises NgptError where OIDN is not installed."""
    if missing():
        raise NgptError(f"method 'oidn': {missing()}")
