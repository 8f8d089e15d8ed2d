"""Intel Open Image Denoise as a method. It reads the primal and features, but no gradients."""

from collections.abc import Mapping
from dataclasses import replace
from importlib.util import find_spec
from typing import Any

import numpy as np

from ngpt.coverage import mirrored
from ngpt.denoisers.oidn_filters import filtered
from ngpt.errors import NgptError
from ngpt.options import Option
from ngpt.repair import Repaired
from ngpt.subpixels import means, spread, subpixels
from ngpt.system.install import package_command

AUXILIARY = ("prefiltered", "clean", "noisy", "none")
QUALITIES = {"high": "High", "balanced": "Balanced", "fast": "Fast"}
# The values of the option ``filter``, and the settings of OIDN that they stand for.
FILTERS: dict[str, dict[str, Any]] = {
    "image": {"hdr": True},
    "lightmap": {"kind": "RTLightmap"},
    "directional": {"kind": "RTLightmap", "directional": True},
}

OPTIONS = {
    "auxiliary": Option(
        "auto",
        "how albedo and normal are used; auto: prefiltered, and with subpixels the mean of that and of noisy subpixels",
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

    OIDN takes no normals without albedo, so without albedo they are left out. If the stack has subpixels
    (``ngpt.subpixels``), OIDN denoises them, and the image is their means; with "auto", the image is ``of_both``.

    ``auxiliary``  how OIDN uses the features: "prefiltered" first denoises them with OIDN's own models and then marks
                   them as clean, as its documentation recommends for the best quality; "clean" marks them as clean
                   without denoising them; "noisy" does neither; "none" leaves them out; "auto" is "prefiltered" without
                   subpixels
    ``quality``    "high", "balanced" or "fast": the quality for the image, and for prefiltering
    ``filter``     one of ``FILTERS``: "lightmap" and "directional" are for lightmaps, and read no features

    Without features, mirror images of the covered pixels take the place of empty pixels. Otherwise OIDN would darken
    the borders of the islands of a lightmap, and light would leak from one island to another. Empty pixels of the
    result are those of the primal.
    """
    require_oidn()
    features = {}
    # With directly visible light sources, because OIDN was trained on such images.
    image, layers = data.image + data.direct, data.features
    k = subpixels(data.fine, image.shape[1]) if filter == "image" else 1
    if filter != "image":
        auxiliary = "none"
    elif auxiliary == "auto" and k > 1:
        return of_both(with_clean_features(data), quality)
    elif auxiliary == "auto":
        auxiliary = "prefiltered"
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


def of_both(data: Repaired, quality: str) -> np.ndarray:
    """The mean of OIDN's images of pixels and of K x K, K / 2 x K / 2, ... subpixels; (H, W, 3) float32.

    Without subpixels, it is the image of the pixels. Features of pixels are marked as clean, and features of subpixels
    as noisy: marked as clean, they would leave noise behind a lens, and prefiltering would take four times as long
    (docs/lab/log).

    Images of small pixels keep edges, and those of large pixels have smooth areas. Their errors differ so much that the
    mean has less error than each of the images in nearly every scene.
    """
    images = [oidn(replace(data, fine={}), "clean", quality)]
    k, fine = subpixels(data.fine, data.image.shape[1]), data.fine
    while k > 1:
        images.append(oidn(replace(data, fine=fine), "noisy", quality))
        k, odd = divmod(k, 2)
        if odd:
            break
        fine = {name: means(layer, 2) for name, layer in fine.items()}
    return np.asarray(np.mean(images, axis=0, dtype=np.float32))


def with_clean_features(data: Repaired) -> Repaired:
    """The data with prefiltered albedo and normal of pixels, for ``of_both`` and for networks.

    The quality is "balanced". "high" takes more than twice as long, and improves neither of them (docs/lab/log).
    """
    return replace(data, features=data.features | prefiltered(data.features, "balanced"))


def prefiltered(features: Mapping[str, np.ndarray], quality: str) -> dict[str, np.ndarray]:
    """Albedo and normal (H, W, 3), denoised by OIDN's models for them."""
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
    """Raises NgptError if OIDN is not installed."""
    if missing():
        raise NgptError(f"method 'oidn': {missing()}")
