"""A reconstruction called the way Mitsuba's denoisers are, on the arrays a renderer has in its hands.

denoiser = ngpt.Denoiser(size, albedo=True, normals=True)       # as mi.OptixDenoiser(size, albedo=True, ...)
clean = denoiser(noisy, albedo=a, normals=n, dx=dx, dy=dy)      # noisy, a, n, ... of NumPy, PyTorch or Dr.Jit
"""

from __future__ import annotations

from typing import Any

import numpy as np

from ngpt.errors import NgptError
from ngpt.methods import METHODS, reconstruct
from ngpt.stack import GradientStack


class Denoiser:
    """Reconstructs images of one size.

    ``size``     (width, height) in pixels
    ``albedo``, ``normals``  whether they will be given, as mi.OptixDenoiser asks; what is not announced is refused
    ``method``   as of ``ngpt.denoise``: "auto", the default, takes the best method for the layers each call gives
    ``options``  of the method

    Raises NgptError for an unknown method.
    """

    def __init__(self, size: Any, albedo: bool = False, normals: bool = False, method: str = "auto", **options: Any):
        try:
            self.width, self.height = (int(n) for n in np.ravel(_to_numpy(size)))
        except (TypeError, ValueError):
            raise NgptError(f"Denoiser: size is {size!r}; it must be (width, height)") from None
        if method not in ("auto", *METHODS):
            raise NgptError(f"unknown method '{method}'; choose one of: auto, {', '.join(METHODS)}")
        self.announced = {"albedo": albedo, "normals": normals}
        self.method, self.options = method, options

    def __call__(
        self,
        noisy: Any,
        *,
        dx: Any = None,
        dy: Any = None,
        albedo: Any = None,
        normals: Any = None,
        depth: Any = None,
        direct: Any = None,
        primal_var: Any = None,
        dx_var: Any = None,
        dy_var: Any = None,
        to_sensor: Any = None,
    ) -> Any:
        """The reconstruction of ``noisy``, of its kind (array, tensor on its device) and shape.

        All (H, W, C), scene-linear, with the meaning of the layers of ``GradientStack``; ``depth`` may be (H, W).
        ``noisy`` has 3 channels, or 4: alpha comes back as it is. ``normals`` are in camera space, or in world space if
        ``to_sensor`` is given: the rotation to the camera's axes (+x right, +y up, +z toward the viewer), (3, 3) or
        (4, 4), an array or a transform with a ``matrix``.

        Raises NgptError for arrays of another size, for albedo or normals that were not announced or are missing though
        they were, and as ``ngpt.denoise`` does.
        """
        given = {"dx": dx, "dy": dy, "albedo": albedo, "normal": normals, "depth": depth, "direct": direct}
        given |= {"primal_var": primal_var, "dx_var": dx_var, "dy_var": dy_var}
        for name, announced in self.announced.items():
            is_given = given[name.removesuffix("s")] is not None
            if is_given and not announced:
                raise NgptError(f"Denoiser: {name} is given, but was not announced: Denoiser(size, {name}=True)")
            if announced and not is_given:
                raise NgptError(
                    f"Denoiser: {name} was announced, but is not given: pass {name}=..., or leave it out there"
                )
        image = self._layer("noisy", noisy, (3, 4))
        layers = {"primal": image[..., :3]}
        for name, value in given.items():
            if value is not None:
                layers[name] = self._layer(name, value, (1,) if name == "depth" else (3,))
        stack = GradientStack(layers, path="Denoiser")
        if normals is not None and to_sensor is not None:
            stack = stack.replace(normal=stack["normal"] @ _rotation(to_sensor).T)
        result = reconstruct(stack, self.method, **self.options).image
        return _like(np.concatenate([result, image[..., 3:].astype(np.float32)], axis=-1), noisy)

    def _layer(self, name: str, value: Any, channels: tuple[int, ...]) -> np.ndarray:
        layer = _to_numpy(value)
        layer = layer[..., None] if layer.ndim == 2 else layer
        if layer.ndim != 3 or layer.shape[:2] != (self.height, self.width) or layer.shape[2] not in channels:
            shape = " or ".join(f"({self.height}, {self.width}, {n})" for n in channels)
            raise NgptError(f"Denoiser: {name} has shape {tuple(layer.shape)}; it must be {shape}")
        return layer


def _rotation(to_sensor: Any) -> np.ndarray:
    """The upper left (3, 3) float32 of a matrix, or of a transform that has one."""
    matrix = _to_numpy(getattr(to_sensor, "matrix", to_sensor))
    if matrix.size not in (9, 16) or matrix.dtype.kind not in "fiu":
        raise NgptError(f"Denoiser: to_sensor is {matrix.shape} of {matrix.dtype}; it must be (3, 3) or (4, 4) numbers")
    side = 3 if matrix.size == 9 else 4
    return matrix.reshape(side, side)[:3, :3].astype(np.float32)


def _to_numpy(value: Any) -> np.ndarray:
    """Arrays of any library, from any device, as NumPy's; shared where that is possible."""
    if isinstance(value, np.ndarray):
        return value
    if hasattr(value, "detach"):  # PyTorch
        value = value.detach().cpu()
        value = value.float() if value.is_floating_point() else value
    if hasattr(value, "numpy"):  # PyTorch, Dr.Jit
        return value.numpy()
    return np.from_dlpack(value) if hasattr(value, "__dlpack__") else np.asarray(value)


def _like(image: np.ndarray, example: Any) -> Any:
    """The image as whatever ``example`` is."""
    if isinstance(example, np.ndarray):
        return image.astype(example.dtype) if example.dtype.kind == "f" else image
    if hasattr(example, "new_tensor"):  # PyTorch
        return example.new_tensor(image)
    return type(example)(image)
