"""Frames of shots, made without a renderer."""

import numpy as np

from ngpt.stack import GradientStack
from ngpt.windows import Place, Window

SIZE = (40, 56)
SIGMA = 0.2


def view(height=SIZE[0], width=SIZE[1], offset=0):
    """A smooth image with an edge, and its features; ``offset`` pixels further to the right."""
    y, x = np.mgrid[:height, :width].astype(float)
    x = x + offset
    image = np.stack([1.5 + np.sin(x / 9 + c) * np.cos(y / 7) for c in range(3)], axis=-1)
    image[x > 30] *= 0.5
    albedo = np.where((x > 30)[..., None], 0.3, [0.6, 0.7, 0.8])
    normal = np.broadcast_to([0.0, 0.0, 1.0], image.shape)
    return image, {"albedo": albedo, "normal": normal, "depth": 4 + 0.01 * y[..., None] + (x > 30)[..., None]}


def frame_of(image, features, rng, motion=(0, 0), sigma=SIGMA, **attributes):
    """A stack of an image with noise of that standard deviation; ``motion`` is that of all pixels, None: unknown."""
    layers = dict(features)
    if motion is not None:
        layers["motion"] = np.broadcast_to(motion, (*image.shape[:2], 2))
    layers |= {"primal": image + rng.normal(0, sigma, image.shape), "primal_var": np.full(image.shape, sigma**2)}
    return GradientStack({k: np.ascontiguousarray(v, np.float32) for k, v in layers.items()}, attributes)


def wall(rng, count, size=(16, 20, 3), growth=0.1):
    """A wall that grows brighter by so much a frame, with noise that no gradient tells from light, and ``dt``."""
    found = []
    for i in range(count):
        layers = {"primal": np.full(size, 1 + growth * i), "dx": np.zeros(size), "dy": np.zeros(size)}
        layers["dt"] = np.full(size, growth)
        noise = {"primal": SIGMA, "dx": SIGMA, "dy": SIGMA, "dt": 0.01}
        layers = {name: layer + rng.normal(0, noise[name], size) for name, layer in layers.items()}
        layers |= {f"{name}_var": np.full(size, sigma**2) for name, sigma in noise.items()}
        layers["motion"] = np.zeros((*size[:2], 2))
        found.append(GradientStack(layers, {"ngpt:frame": i, "ngpt:previousFrame": i - 1}))
    return found


def part_of(stack, left, top, width, height):
    """The pixels of a window, in place."""
    place, window = stack.place, Window(left, top, width, height)
    layers = {name: stack[name][window.within(place.data)] for name in stack.names}
    for name, border in (("dx", np.s_[:, -1]), ("dy", np.s_[-1])):
        if name in layers:  # as renders of a part have it
            for layer in (name, f"{name}_var"):
                layers[layer] = layers[layer].copy()
                layers[layer][border] = 0
    return GradientStack(layers, stack.attributes, path=stack.path, place=Place(window, place.display))


def without(stack, *names):
    return GradientStack({name: stack[name] for name in stack.names if name not in names}, stack.attributes)


def mse(image, truth):
    return float(np.mean(np.square(image - truth)))
