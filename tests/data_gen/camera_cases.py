"""Every camera of Mitsuba, in scenes that tell when one is wrong: name -> what it changes of a scene.

The scenes have no symmetry. A card stands before some near planes, and something lies beyond the far planes.
"""

import numpy as np
from data_gen_scenes import _scale
from renders import mi
from unbiased import differences, light_apart, load, render_ours

from data_gen.samplers import SAMPLERS
from data_gen.scenes.builtin import _diffuse, _light, _sphere, _wall
from ngpt.testing import z_test

# Pixels, and those of blocks whose means are compared
SIZE, BLOCK = (24, 16), 8
EYE, TARGET = [0.2, 0.6, 3.6], [0, 0.5, 0]
OFFSET = {"principal_point_offset_x": 0.12, "principal_point_offset_y": -0.08}
CROP = {"crop_offset_x": 8, "crop_offset_y": 4, "crop_width": 24, "crop_height": 16}


def film(width=SIZE[0], height=SIZE[1], **crop):
    return {"type": "hdrfilm", "width": width, "height": height, "rfilter": {"type": "box"}, **crop}


def camera(kind="perspective", turned=None, film=None, **parameters):
    """A camera before the scene; ``turned`` is put behind its view, ``film`` in place of its own."""
    view = mi.ScalarTransform4f().look_at(origin=EYE, target=TARGET, up=[0, 1, 0])
    to_world = view if turned is None else view @ turned
    return {"type": kind, "to_world": to_world, "film": film or globals()["film"](), **parameters}


def perspective(turned=None, film=None, **parameters):
    return {"sensor": camera("perspective", turned, film, fov=40, **parameters)}


def thin_lens(**parameters):
    return {"sensor": camera("thinlens", fov=40, aperture_radius=0.15, focus_distance=3.0, **parameters)}


def orthographic(scale, **parameters):
    return {"sensor": camera("orthographic", _scale(scale), **parameters)}


def card():
    """Between the camera and a near plane at 1.6, before the middle of the picture; the side that is seen is lit."""
    grey = {"type": "twosided", "bsdf": _diffuse(0.5, 0.5, 0.5)}
    return {"card": _wall([0.2, 0.45, 2.3], [0, 0.95, 0.3], (0.4, 0.5), grey)}


def meter(kind):
    """A sensor of one pixel; looks at the floor, the ball and the wall."""
    return {"sensor": camera(kind, film=film(1, 1))}


def irradiance():
    """A sensor of what falls on a small card above the floor, from the side of the lamp."""
    shape = _wall([-0.5, 0.2, 0.9], [0.3, 1, 0.1], (0.4, 0.4), _diffuse(0.3, 0.3, 0.3))
    return {"sensor": shape | {"sensor": {"type": "irradiancemeter", "film": film(16, 16)}}}


def distant():
    """What leaves the ball and the floor along one direction."""
    target = {key: value for key, value in _wall([0, 0.3, 0], [0, 1, 0], (1.6, 1.2), {}).items() if key != "bsdf"}
    return {"sensor": {"type": "distant", "direction": [-0.3, -1, -0.4], "target": target, "film": film(1, 1)}}


def two_cameras():
    """The first is rendered; the second is another kind, elsewhere."""
    view = mi.ScalarTransform4f().look_at(origin=[2, 2, 2], target=[0, 0, 0], up=[0, 1, 0])
    return perspective() | {"second": {"type": "orthographic", "to_world": view, "film": film(8, 8)}}


def batch():
    inner = {"a": camera(film=film(12, 16)), "b": camera(film=film(12, 16))}
    return {"sensor": {"type": "batch", "film": film(), **inner}}


CAMERAS = {
    "perspective": perspective,
    "thin lens": thin_lens,
    "orthographic": lambda: orthographic(1.4),
    "orthographic, wide pixels": lambda: orthographic([1.6, 1.1, 0.5], near_clip=2.0) | card(),
    "mirrored": lambda: perspective(_scale([-1, 1, 1]), **OFFSET),
    "principal point": lambda: perspective(**OFFSET),
    "crop": lambda: perspective(film=film(40, 32, **CROP)),
    "principal point, crop": lambda: perspective(film=film(40, 32, **CROP), **OFFSET),
    "near plane": lambda: perspective(near_clip=1.6) | card(),
    "near plane, thin lens": lambda: thin_lens(near_clip=1.6) | card(),
    "far plane": lambda: perspective(far_clip=3.9),
    "two cameras": two_cameras,
    "radiancemeter": lambda: meter("radiancemeter"),
    "irradiancemeter": irradiance,
    "distant": distant,
    "radiancemeter, scaled": lambda: {"sensor": camera("radiancemeter", _scale(2), film(1, 1))},
    "batch": batch,
}


# But for those that no sampler renders
RENDERED = [view for view in CAMERAS if view not in ("batch", "radiancemeter, scaled")]


def corner(media=False):
    """A corner with a ball and a lamp beside the view; with ``media`` the air scatters light."""
    scene = {
        "type": "scene",
        "integrator": {"type": "path", "max_depth": 4, "rr_depth": 100},
        "floor": _wall([0, 0, 0], [0, 1, 0], (5, 5), _diffuse(0.6, 0.5, 0.4)),
        "wall": _wall([1.1, 1, 0], [-1, 0, 0], (5, 3), _diffuse(0.7, 0.3, 0.2)),
        "back": _wall([0, 1, -1], [0, 0, 1], (5, 3), _diffuse(0.3, 0.5, 0.6)),
        "ball": _sphere([-0.3, 0.45, 0.1], 0.45, {"type": "roughconductor", "material": "Al", "alpha": 0.5}),
        "lamp": _light([-0.4, 1.9, 0.7], [0.2, -1, -0.2], (0.9, 0.7), (9, 8, 7)),
    }
    if not media:
        return scene
    scene["integrator"] = {"type": "volpath", "max_depth": 4, "rr_depth": 100}
    return {"type": "scene", "air": {"type": "homogeneous", "id": "air", "albedo": 0.8, "sigma_t": 0.15}, **scene}


def described(view, media=False):
    """The scene before the camera of that name."""
    changes = CAMERAS[view]()
    if media:
        # Of meters on shapes, too: their rays start in the air.
        sensor = changes["sensor"].get("sensor", changes["sensor"])
        sensor["medium"] = {"type": "ref", "id": "air"}
    return corner(media) | changes


def scene_with(mi, view, media=False):
    return load(mi, described(view, media))


def compare(stacks, references, level, slack=0.0):
    """(layer, z-test): of the primal, and of differences over a pixel where there are any.

    ``slack`` is how far block means may be off, in means of the image: of samplers that are biased.
    """
    edge = min(BLOCK, *references.shape[1:3])
    mean = references.mean()
    for name, axis in (("primal", None), ("dx", 0), ("dy", 1)):
        if name not in stacks[0] or (axis is not None and references.shape[2 - axis] < 2):
            continue
        if axis is None:
            ours, theirs = np.stack([stack[name] for stack in stacks]), references
        else:
            ours = np.stack([stack[name] + differences(light_apart(stack))[axis] for stack in stacks])
            theirs = np.stack([differences(reference)[axis] for reference in references])
        off = block_means(ours.mean(axis=0) - theirs.mean(axis=0), edge)
        # The mean of differences in a block is that of its two edges over its width.
        most = slack * mean * (1 if axis is None else 2 / edge)
        allowed = np.clip(off, -most, most)
        rows, columns = (edge * n for n in allowed.shape[:2])
        theirs = theirs[:, :rows, :columns] + allowed.repeat(edge, 0).repeat(edge, 1)
        yield name, z_test(ours[:, :rows, :columns], theirs, edge, level)


def block_means(image, edge):
    rows, columns = image.shape[0] // edge, image.shape[1] // edge
    return image[: rows * edge, : columns * edge].reshape(rows, edge, columns, edge, -1).mean(axis=(1, 3))


def stacks_of(scene, sampler, batches, spp):
    """Layers of independent stacks by any sampler; those by photons with a radius that hardly blurs."""
    options = {}
    if "photons" in SAMPLERS[sampler].options:
        # Beams and planes are all tried for each camera ray: fewer do.
        options = {"photons": 1 if sampler.endswith(("beams", "planes")) else 8, "radius": 0.6}
    if np.prod(scene.sensors()[0].film().crop_size()) == 1:
        spp *= 8 if SAMPLERS[sampler].batch else 128
    return render_ours(scene, sampler, batches, spp, **options)
