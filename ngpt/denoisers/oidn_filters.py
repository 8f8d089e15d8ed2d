"""Runs OIDN's filters. All threads of a process share its devices and filters, and only one thread uses them at a time.

If two threads set the images of one filter, they would get each other's pixels. Waiting costs no time, because OIDN
uses all cores, or as many as ``ngpt.limit_threads`` allows. Making a filter takes longer than running it on a small
image, so filters are kept.
"""

from collections.abc import Mapping
from threading import Lock
from typing import Any

import numpy as np

from ngpt.errors import NgptError
from ngpt.io.primaries import BEYOND, TO_WIDE, converted, negative_share
from ngpt.system.forks import hold_while_forking
from ngpt.system.limits import limited, processors

# Our name of a device -> its name in OIDN's Python package.
DEVICES = {"auto": "Default", "cpu": "CPU", "cuda": "CUDA", "hip": "HIP", "metal": "Metal", "sycl": "SYCL"}
# Negative light below this share of all light counts as rounding, and is not denoised separately.
_ROUNDING = 1e-6
# The number of filters that are kept. An image and its features with two qualities need five.
_MOST = 8

_lock = Lock()
# (name, threads) -> device
_devices: dict[tuple[str, int], Any] = {}
_filters: dict[tuple, Any] = {}


def filtered(
    images: Mapping[str, np.ndarray],
    device: str = "auto",
    weights: bytes | None = None,
    kind: str = "RT",
    **settings: Any,
) -> np.ndarray:
    """The result of OIDN's filter "RT", or of another ``kind``, (H, W, 3) float32.

    OIDN reads negative light as 0. So an image with many colours outside of its primaries is denoised in wider
    primaries, which leaves less error. All other negative light is denoised separately and then subtracted.

    ``images``    "color", "albedo" and "normal", or some of them: (H, W, 3) float32, C-contiguous, of one size
    ``device``    one of ``DEVICES``
    ``weights``   the contents of a .tza file, used in place of OIDN's own weights
    ``settings``  settings of the filter, by their names in ``mitsuba_oidn``; a quality by its name in
                  ``mitsuba_oidn.Quality``

    Raises NgptError with OIDN's message if the filter fails.
    """

    def run(colour: np.ndarray | None) -> np.ndarray:
        return _filtered(images if colour is None else {**images, "color": colour}, device, weights, kind, settings)

    def negative(colour: np.ndarray) -> np.ndarray | None:
        """The negative light of an image, if it is more than rounding."""
        light = np.maximum(-colour, 0)
        much = light.sum(dtype=np.float64) > _ROUNDING * np.abs(colour).sum(dtype=np.float64)
        return light if much else None

    def signs_apart(colour: np.ndarray) -> np.ndarray:
        light = negative(colour)
        return run(colour) if light is None else run(colour) - run(light)

    colour = images.get("color")
    if colour is None or settings.get("directional") or negative(colour) is None:
        return run(colour)
    wide = converted(colour, TO_WIDE)
    if negative_share(wide) <= BEYOND < negative_share(colour):
        return converted(signs_apart(wide), np.linalg.inv(TO_WIDE))
    return signs_apart(colour)


def _filtered(
    images: Mapping[str, np.ndarray], device: str, weights: bytes | None, kind: str, settings: Mapping[str, Any]
) -> np.ndarray:
    import mitsuba_oidn

    result = np.empty_like(next(iter(images.values())))
    # 0 threads: OIDN uses the pool of threads that it shares with Dr.Jit.
    where = device, processors() if limited() else 0
    key = (where, weights, kind, tuple(images), result.shape, tuple(settings.items()))
    try:
        with _lock:
            # A filter is put back only after it has worked, so that a failed one is not used again.
            made = _filters.pop(key, None) or _made(where, weights, kind, settings)
            _run(_devices[where], made, images, result)
            # Filters with a user's weights are not kept: there may be many, and each is as large as an image.
            if weights is None:
                _filters[key] = made
            while len(_filters) > _MOST:
                del _filters[next(iter(_filters))]
    except (mitsuba_oidn.Error, RuntimeError, TypeError, ValueError) as error:
        raise NgptError(f"OIDN cannot run on device '{device}': {' '.join(str(error).split())}") from error
    return result


def _made(where: tuple[str, int], weights: bytes | None, kind: str, settings: Mapping[str, Any]) -> Any:
    """A new filter on the device ``where`` = (name, threads). 0 threads stands for OIDN's own number on a CPU."""
    import mitsuba_oidn

    if where not in _devices:
        name, threads = where
        device = mitsuba_oidn.Device(getattr(mitsuba_oidn.DeviceType, DEVICES[name]))
        if threads and device.type == mitsuba_oidn.DeviceType.CPU:
            device.num_threads = threads
        _devices[where] = device
    made = _devices[where].new_filter(kind)
    if weights is not None:
        made.set_data("weights", weights)
    for name, value in settings.items():
        setattr(made, name, getattr(mitsuba_oidn.Quality, value) if name == "quality" else value)
    return made


def _run(device: Any, made: Any, images: Mapping[str, np.ndarray], result: np.ndarray) -> None:
    """Runs the filter ``made`` on ``images``, and writes ``result``. The filter keeps no reference to the arrays.

    If the device cannot read arrays in place, buffers are used.
    """
    height, width = result.shape[:2]
    buffers = {}
    for name, image in {**images, "output": result}.items():
        if device.can_share(image):
            made.set_image(name, image)
            continue
        import mitsuba_oidn

        buffers[name] = device.new_buffer(image.nbytes)
        if name != "output":
            buffers[name].write(image)
        made.set_image(name, buffers[name], format=mitsuba_oidn.Format.Float3, width=width, height=height)
    made.execute()
    if "output" in buffers:
        buffers["output"].read(result)
    for name in (*images, "output"):
        made.unset_image(name)


def _drop() -> None:
    _filters.clear()
    _devices.clear()


hold_while_forking(_lock, _drop)
