"""Prepares the contents of one file for the report: light as pictures, other layers in colours of their own."""

import numpy as np

from ngpt.io.exr import channels_alone, layers_of_light
from ngpt.io.primaries import converted, to_rec709
from ngpt.report.content import ReportEntry
from ngpt.stack import GradientStack

# Layers of the contract that hold light
_LIGHT = ("primal", "direct", "caustic", "diffuse", "specular")


def of_stack(stack: GradientStack, shown: np.ndarray, name: str) -> tuple[list[ReportEntry], dict[str, np.ndarray]]:
    """The entries of a ``Scene`` for one file, (H, W, 3) scene-linear, and its layers, (H, W, 1) or (H, W, 3).

    ``shown`` (H, W, 3) is the picture that a viewer shows. It is the first entry, called ``name``. In a result, the
    input follows as "primal". Channels that belong to no colour and no layer of the contract are layers of their own.
    """
    light = {layer: stack[layer] for layer in _LIGHT if layer in stack}
    light |= {layer: image for layer, image in layers_of_light(stack).items() if layer not in light}
    matrix = to_rec709(stack.attributes)
    light = {layer: converted(image, matrix) for layer, image in light.items()}
    entries = [ReportEntry(name, shown)]
    for layer, image in light.items():
        # A file may hold the root a second time, under its renderer's name.
        if not np.array_equal(image, shown, equal_nan=True):
            entries.append(ReportEntry(layer if layer != name else f"{layer} (layer)", image))
    taken = {entry.name for entry in entries}
    layers = {layer: stack[layer] for layer in stack.names if layer not in light}
    # The page shows one or three channels, so layers of two get a third one of zeros.
    layers = {layer: np.pad(v, ((0, 0), (0, 0), (0, int(v.shape[2] == 2)))) for layer, v in layers.items()}
    for channel, values in channels_alone(stack).items():
        if channel not in "RGB":  # the root, which is shown already
            layers[channel] = np.asarray(values, np.float32)[..., None]
    return entries, {layer: values for layer, values in layers.items() if layer not in taken}
