"""What the functions refuse: one line names the layer, the number and the remedy."""

import numpy as np
import pytest
from full_stack import full_layers

import ngpt
from ngpt.errors import NgptError

LAYERS = full_layers(18, 26)
IMAGE = LAYERS["primal"]
RGBA = np.concatenate([IMAGE, IMAGE[..., :1]], axis=-1)


def denoiser(*arguments, call=(), size=(26, 18), **options):
    """Calls a Denoiser made with these options with the image and the layers named in ``call``."""
    layers = {"albedo": LAYERS["albedo"], "normals": LAYERS["normal"], "dx": LAYERS["dx"], "dy": LAYERS["dy"]}
    given = {name: layers[name] for name in call if name in layers} | (call if isinstance(call, dict) else {})
    return ngpt.Denoiser(size, *arguments, **options)(IMAGE, **given)


def torch(make):
    return lambda: ngpt.denoise(make(pytest.importorskip("torch")))


ROWS = {
    # Shapes, each with what makes the right one of it
    "channels first": (
        lambda: ngpt.denoise(IMAGE.transpose(2, 0, 1)),
        "shape (3, 18, 26); it must be (height, width, 3) or (height, width, 4); channels come first there: "
        "pass image.transpose(1, 2, 0)",
    ),
    "several images": (lambda: ngpt.denoise(IMAGE[None]), "one by one: image[0]"),
    "flat": (
        lambda: ngpt.denoise(IMAGE[..., 0]),
        "an image of one channel is image[..., None].repeat(3, axis=-1)",
    ),
    "one channel": (lambda: ngpt.denoise(IMAGE[..., :1]), "an image of one channel is image.repeat(3, axis=-1)"),
    "five channels": (lambda: ngpt.denoise(IMAGE[..., [0, 1, 2, 0, 1]]), "pass image[..., :4]"),
    "many channels": (
        lambda: ngpt.denoise(np.tile(IMAGE, 9)),
        "pass ngpt.GradientStack.from_aovs(image, scene.integrator().aov_names()), and for its",
    ),
    "no pixels": (lambda: ngpt.denoise(IMAGE[:0]), "image is 26x0; it has no pixels"),
    "two channels": (lambda: ngpt.denoise(IMAGE[..., :2]), "(18, 26, 2); it must be"),
    "nothing": (lambda: ngpt.denoise(None), "image has shape ()"),
    "smaller albedo": (
        lambda: ngpt.denoise(IMAGE, albedo=IMAGE[1:]),
        "albedo has shape (17, 26, 3); it must be (18, 26, 3)",
    ),
    "albedo with alpha": (lambda: ngpt.denoise(IMAGE, albedo=RGBA), "pass albedo[..., :3]"),
    "torch, channels first": (torch(lambda t: t.zeros(3, 18, 26)), "pass image.permute(1, 2, 0)"),
    # Kinds of numbers
    **{
        kind: (
            lambda kind=kind: ngpt.denoise((IMAGE * 50).astype(kind)),
            f"image is of type {kind}: integers hold what displays show; pass",
        )
        for kind in ("uint8", "uint16", "int32")
    },
    "complex": (lambda: ngpt.denoise(IMAGE.astype("complex64")), "of type complex64"),
    "a name": (lambda: ngpt.denoise("stack.exr"), "image is the name of a file; pass ngpt.read('stack.exr')"),
    "torch, integers": (torch(lambda t: t.zeros(18, 26, 3, dtype=t.uint8)), "image is of type uint8"),
    "torch, meta": (torch(lambda t: t.zeros(18, 26, 3, device="meta")), "image is a Tensor that NumPy cannot read: "),
    "too large": (torch(lambda t: t.full((18, 26, 3), 1e39, dtype=t.float64)), "values that float32 cannot hold"),
    # Names
    **{
        wrong: (
            lambda wrong=wrong: ngpt.denoise(IMAGE, **{wrong: IMAGE}),
            f"has no option '{wrong}'; did you mean '{meant}'",
        )
        for wrong, meant in (("normals", "normal"), ("albdo", "albedo"), ("wieghts", "weights"))
    },
    "another's option": (
        lambda: ngpt.denoise(IMAGE, "l2", weights="mine.onnx"),
        "method 'l2' has no option 'weights'; options: alpha; layers: ",
    ),
    "of shots": (lambda: ngpt.denoise(IMAGE, dt=IMAGE), "no option 'dt'; options: "),
    "no method": (lambda: ngpt.denoise(IMAGE, "l3"), "unknown method 'l3'; choose one of: auto, primal"),
    "no gradients": (lambda: ngpt.denoise(IMAGE, "l2"), "denoise: method 'l2' needs dx, dy: pass dx=..., dy="),
    # Denoiser
    "unannounced": (
        lambda: denoiser(normals=True, call=("albedo", "normals")),
        "albedo is given, but was not announced: Denoiser(size, albedo=True)",
    ),
    "not given": (lambda: denoiser(normals=True), "normals=True announced normals, which is not given"),
    "width and height": (
        lambda: denoiser(size=(18, 26)),
        "noisy has shape (18, 26, 3); it must be (26, 18, 3) or (26, 18, 4)",
    ),
    "smaller dx": (lambda: denoiser(call={"dx": IMAGE[1:], "dy": IMAGE}), "dx has shape (17, 26, 3)"),
    **{
        f"layer {name}": (
            lambda name=name: denoiser(call={name: IMAGE}),
            f"no layer is called '{name}'; there are: depth, dx",
        )
        for name in ("dz", "dt", "diffuse")
    },
    "misspelt option": (
        lambda: denoiser(method="l2", alhpa=0.1),
        "method 'l2' has no option 'alhpa'; did you mean 'alpha'",
    ),
    "no such method": (lambda: denoiser(method="l3"), "unknown method 'l3'"),
    "a method without its layers": (
        lambda: denoiser(method="l2"),
        "Denoiser: method 'l2' needs dx, dy: pass dx=..., dy=",
    ),
    **{
        name: (
            lambda name=name: denoiser(call={name: IMAGE}),
            f"{name} is given, but was not announced: Denoiser(size, temporal=True)",
        )
        for name in ("flow", "previous_denoised")
    },
    "no flow": (lambda: denoiser(temporal=True), "temporal=True announced flow, which is not given"),
    "flow of three": (
        lambda: denoiser(temporal=True, call={"flow": IMAGE}),
        "flow has shape (18, 26, 3); it must be (18, 26, 2)",
    ),
}


@pytest.mark.parametrize("name", ROWS)
def test_refused(name):
    call, message = ROWS[name]
    with pytest.raises(NgptError) as caught:
        call()
    assert message in str(caught.value) and "\n" not in str(caught.value)
