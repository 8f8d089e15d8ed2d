"""What references are kept: (variant, name, description, size, sampler of ours or None), for all tests together."""

from functools import partial

import bdpt_scenes
import camera_cases
import data_gen_scenes as scenes
import lamps_scenes
import media_scenes
import split_scenes
import stress_scenes

RGB, LARGE, SMALL = "llvm_ad_rgb", (32, 32), (16, 16)
BUILTIN = ["diffuse", "glossy", "environment", "lens"]
PATHS = [*BUILTIN, "glass", "hidden_lamp", "plenty", "leaf", "fog", "within_fog", "caustics", "under_the_sky"]
PATHS += ["courtyard"]
QUICK = {*BUILTIN, "glass", "hidden_lamp", "plenty", "leaf", "within_fog", "caustics", "courtyard", "sky", "areas"}
QUICK |= {"panels", "everything", "gallery: flat", "haze", "colours", "colours by mis", "before_the_sky", "lamp_alone"}
QUICK |= {"coloured_smoke", "far plane, media True", "lit by all, fog False", "courtyard to 2", "courtyard to 3"}
QUICK |= {f"{view}, media False" for view in ("principal point", "near plane", "principal point, crop")}
# Of these ``path`` finds hardly any light, or none: references are by ``bdpt``.
BENT = ["by_a_point", "by_the_sun", "by_a_wall", "under_a_sky", "lacquered", "caustics", "glass", "glossy"]
MEDIA = ["haze", "forward", "colours", "dense", "milk", "nested", "smoke", "coloured_smoke", "before_the_sky"]
MEDIA += ["hiding", "hiding_outside", "hovering", "standing"]
# The same rooms smaller and larger, nearer and further away
PLACES = [(1e-3, 0), (1e4, 0), (1, 1e3), (1e4, 1e5)]


def at_place(scale, shift):
    return partial(scenes.moved, scale, shift)


def of(name):
    """A built-in scene by its name, or a function of one of our modules."""
    if name in BUILTIN:
        return name
    rooms = (scenes, bdpt_scenes, media_scenes, split_scenes)
    return next(getattr(room, name) for room in rooms if hasattr(room, name))


def listed():
    for name in PATHS:
        yield RGB, name, of(name), LARGE, None
    for kind, scene in lamps_scenes.GALLERIES.items():
        yield RGB, f"gallery: {kind}", scene, LARGE, None
    for name in ("diffuse", "glossy"):
        yield RGB, name, name, (12, 8), None
    for name in ("lamp_alone", "seen_through"):
        yield RGB, name, of(name), SMALL, None
    yield RGB, "without_gloss", split_scenes.without_gloss, LARGE, None
    yield RGB, "everything", split_scenes.everything, LARGE, None
    yield RGB, "panels", scenes.panels, (24, 24), None
    for depth in (2, 3):
        yield RGB, f"courtyard to {depth}", scenes.limited(depth), SMALL, None
    for place in PLACES:
        yield RGB, f"moved {place}", at_place(*place), (24, 24), None
    for name in (*MEDIA, "fog", "within_fog"):
        yield RGB, name, of(name), SMALL, None
    for name in ("colours", "coloured_smoke"):
        yield RGB, f"{name} by mis", media_scenes.by_mis(of(name)), SMALL, None
    for fog in (False, True):
        yield RGB, f"lit by all, fog {fog}", partial(lamps_scenes.lit_by, fog=fog), (48, 32), None
    for view in camera_cases.RENDERED:
        for media in (False, True):
            yield RGB, f"{view}, media {media}", partial(camera_cases.described, view, media), None, None
    yield "llvm_ad_spectral", "diffuse", "diffuse", (24, 24), None
    yield "llvm_ad_spectral", "colours", media_scenes.colours, SMALL, None
    yield "llvm_ad_mono", "coloured_smoke", media_scenes.coloured_smoke, SMALL, None
    for variant in ("llvm_ad_spectral", "llvm_ad_mono"):
        yield variant, "lens", "lens", (24, 24), None
    for name, scene in bdpt_scenes.SCENES.items():
        yield RGB, name, scene, LARGE, None
    for name in BENT:
        yield RGB, name, of(name), LARGE, "bdpt"
    for scene in stress_scenes.SCENES:
        yield RGB, scene.__name__, scene, (24, 16), None


def quick_first(row):
    """Those of `make test`, so that a run that is broken off has them."""
    return row[1] not in QUICK


ALL = sorted(listed(), key=quick_first)
