"""What references are kept: (variant, name, description, size, sampler of ours or None), for all tests together."""

from functools import partial
from itertools import product

import bdpt_scenes
import camera_cases
import data_gen_scenes as scenes
import hole_scenes
import lamps_scenes
import media_scenes
import split_scenes
import stress_scenes

RGB, SPECTRAL, MONO = "llvm_ad_rgb", "llvm_ad_spectral", "llvm_ad_mono"
LARGE, SMALL = (32, 32), (16, 16)
BUILTIN = ["diffuse", "glossy", "environment", "lens"]
PATHS = [*BUILTIN, "glass", "hidden_lamp", "plenty", "leaf", "fog", "within_fog", "caustics", "under_the_sky"]
PATHS += ["courtyard"]
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
    rooms = (scenes, bdpt_scenes, media_scenes, split_scenes, hole_scenes)
    return next(getattr(room, name) for room in rooms if hasattr(room, name))


def in_rgb():
    """(name, description, size), of Mitsuba's own integrators."""
    yield from ((name, of(name), LARGE) for name in (*PATHS, "everything", "without_gloss"))
    yield from ((f"gallery: {kind}", scene, LARGE) for kind, scene in lamps_scenes.GALLERIES.items())
    yield from ((name, scene, LARGE) for name, scene in bdpt_scenes.SCENES.items())
    yield from ((name, of(name), SMALL) for name in (*MEDIA, "fog", "within_fog", "lamp_alone", "seen_through"))
    yield from ((f"{name} by mis", media_scenes.by_mis(of(name)), SMALL) for name in ("colours", "coloured_smoke"))
    yield from ((f"courtyard to {depth}", scenes.limited(depth), SMALL) for depth in (2, 3))
    yield from ((f"moved {place}", at_place(*place), (24, 24)) for place in PLACES)
    yield "panels", scenes.panels, (24, 24)
    yield from (("curtains", of("curtains"), LARGE), ("few_edges", of("few_edges"), SMALL))
    yield from ((name, name, (12, 8)) for name in ("diffuse", "glossy"))
    yield from ((f"lit by all, fog {fog}", partial(lamps_scenes.lit_by, fog=fog), (48, 32)) for fog in (False, True))
    for view, media in product(camera_cases.RENDERED, (False, True)):
        yield f"{view}, media {media}", partial(camera_cases.described, view, media), None
    yield from ((scene.__name__, scene, (24, 16)) for scene in stress_scenes.SCENES)


def listed():
    yield from ((RGB, *row, None) for row in in_rgb())
    yield from ((RGB, name, of(name), LARGE, "bdpt") for name in BENT)
    yield SPECTRAL, "colours", media_scenes.colours, SMALL, None
    yield MONO, "coloured_smoke", media_scenes.coloured_smoke, SMALL, None
    yield SPECTRAL, "diffuse", "diffuse", (24, 24), None
    yield from ((variant, "lens", "lens", (24, 24), None) for variant in (SPECTRAL, MONO))


ALL = [*listed()]
