"""What the functions refuse: one line names the layer, the number and the remedy."""

import numpy as np
import pytest
from full_stack import full_layers

import ngpt
from ngpt.errors import NgptError

LAYERS = full_layers(18, 26)
IMAGE = LAYERS["primal"]
INTEGERS = "is of type {}; pass scene-linear floats"
UNANNOUNCED = "{} is given, but was not announced: Denoiser(size, {}=True)"


def torch(make):
    return lambda: make(pytest.importorskip("torch"))


# What ``ngpt.denoise`` is given -> what it says of it.
IMAGES = {
    "channels first": (IMAGE.transpose(2, 0, 1), "; channels come first there: pass image.transpose(1, 2, 0)"),
    "several images": (IMAGE[None], "one by one: image[0]"),
    "one channel": (IMAGE[..., :1], "an image of one channel is image.repeat(3, axis=-1)"),
    "two channels": (IMAGE[..., :2], "(18, 26, 2); it must be (height, width, 3) or (height, width, 4)"),
    "many channels": (np.tile(IMAGE, 9), "pass ngpt.GradientStack.from_aovs(image, scene.integrator().aov_names())"),
    "no pixels": (IMAGE[:0], "image is 26x0; it has no pixels"),
    "uint8": ((IMAGE * 50).astype("uint8"), INTEGERS.format("uint8")),
    "a name": ("stack.exr", "image is the name of a file; pass ngpt.read('stack.exr')"),
    "torch, channels first": (torch(lambda t: t.zeros(3, 18, 26)), "pass image.permute(1, 2, 0)"),
    "torch, meta": (torch(lambda t: t.zeros(18, 26, 3, device="meta")), "image is a Tensor that NumPy cannot read: "),
    "too large": (torch(lambda t: t.full((18, 26, 3), 1e39, dtype=t.float64)), "values that float32 cannot hold"),
}


@pytest.mark.parametrize("name", IMAGES)
def test_images(name):
    image, message = IMAGES[name]
    with pytest.raises(NgptError) as caught:
        ngpt.denoise(image() if callable(image) else image)
    assert message in str(caught.value) and "\n" not in str(caught.value)


def denoise(*method, **layers_and_options):
    return ngpt.denoise(IMAGE, *method, **layers_and_options)


def denoiser(call=(), size=(26, 18), **options):
    """Calls a Denoiser made with these options with the image and the layers of ``call``."""
    return ngpt.Denoiser(size, **options)(IMAGE, **dict(call))


CALLS = {
    "smaller albedo": (lambda: denoise(albedo=IMAGE[1:]), "albedo has shape (17, 26, 3); it must be (18, 26, 3)"),
    "normals": (lambda: denoise(normals=IMAGE), "has no option 'normals'; did you mean 'normal'"),
    "a misspelt option": (lambda: denoise(wieghts=""), "has no option 'wieghts'; did you mean 'weights'"),
    "another's option": (lambda: denoise("l2", weights=""), "'l2' has no option 'weights'; options: alpha; layers: "),
    "no method": (lambda: denoise("l3"), "unknown method 'l3'; choose one of: auto, primal"),
    "no gradients": (lambda: denoise("l2"), "denoise: method 'l2' needs dx, dy: pass dx=..., dy="),
    "unannounced": (lambda: denoiser({"albedo": IMAGE}), UNANNOUNCED.format("albedo", "albedo")),
    "unannounced flow": (lambda: denoiser({"flow": IMAGE}), UNANNOUNCED.format("flow", "temporal")),
    "no normals": (lambda: denoiser(normals=True), "normals=True announced normals, which is not given"),
    "flow of three": (lambda: denoiser({"flow": IMAGE}, temporal=True), "(18, 26, 3); it must be (18, 26, 2)"),
    "rows first": (lambda: denoiser(size=(18, 26)), "(18, 26, 3); it must be (26, 18, 3) or (26, 18, 4)"),
    "without its layers": (lambda: denoiser(method="l2"), "Denoiser: method 'l2' needs dx, dy: pass dx=..., dy="),
}


@pytest.mark.parametrize("name", CALLS)
def test_calls(name):
    call, message = CALLS[name]
    with pytest.raises(NgptError) as caught:
        call()
    assert message in str(caught.value) and "\n" not in str(caught.value)
