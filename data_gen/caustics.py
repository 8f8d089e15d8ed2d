"""Measures which share of a scene's light is caustics of lamps that are tiny or have no size.

Light paths are connected to the camera at each of their vertices. A path counts as a caustic if it starts at such a
lamp and meets a mirror or clear glass before any other surface. Paths from the camera hardly find such caustics: no
connection leads through the mirror or glass to the lamp, and few paths hit the lamp by chance. Light that the camera
sees only in mirrors or through glass is not measured.
"""

from __future__ import annotations

from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np

from data_gen.paths.camera import CameraSamples
from data_gen.paths.eye import Sight
from data_gen.paths.holes import Holes
from data_gen.paths.light_ends import LightEnds, World
from data_gen.paths.vertex import DELTA, event_kind
from data_gen.samplers import SAMPLERS
from data_gen.samplers.bdpt.light_path import begin, go_on
from data_gen.samplers.bdpt.plan import Plan
from data_gen.samplers.bdpt.strategies import to_camera
from data_gen.samplers.bdpt.vertex import scatters_smoothly
from data_gen.scenes.facts import scene_facts
from data_gen.scenes.load import at_most
from data_gen.scenes.lost import behind_sharp, hard_to_meet

# The number of light paths, and the most edges of each
_PIXELS, _SPP, _LONGEST = 1 << 14, 4, 8


def share_of_caustics(scene: mi.Scene) -> float | None:
    """The share of caustics in the light on the surfaces that the camera sees, 0 to 1; None if ``bdpt`` cannot render
    the scene.

    The share is 0 in scenes that have no tiny lamps, or neither mirrors nor clear glass. The measurement always uses
    the same random numbers.
    """
    if not behind_sharp(scene):
        return 0.0
    if SAMPLERS["bdpt"].refuses(scene_facts(scene)):
        return None
    integrator = SAMPLERS["bdpt"].integrator(scene)
    plan = integrator.plan(World(scene, LightEnds(scene, "bdpt"), holes=Holes.of(scene)))
    plan = replace(plan, longest=min(plan.longest, _LONGEST))
    if not plan.joins:
        return 0.0
    table = mi.Bool([hard_to_meet(scene, emitter) for emitter in scene.emitters()])
    with at_most(scene, _PIXELS):
        found, whole = _light(plan, Sight.of(CameraSamples(scene.sensors()[0], 0, _SPP)), table)
        found, whole = (float(np.array(light, np.float64).sum()) for light in (found, whole))
    return found / whole if whole > 0 else 0.0


@dr.syntax
def _light(plan: Plan, sight: Sight, table: mi.Bool) -> tuple[mi.Float, mi.Float]:
    """Returns two values for each light path: the caustic light that it brings to the camera, and all light that it
    brings.

    ``table`` says for each emitter of the scene whether it is tiny or has no size.
    """
    eye, random = sight.eye, sight.random.clone()
    start, end, active = begin(plan, random, sight.ray)
    hard = dr.gather(mi.Bool, table, start.index)
    found, whole = mi.Float(0), mi.Float(0)
    first, caustic = mi.Bool(True), mi.Bool(False)  # the path has met only holes so far; it is a caustic
    while dr.hint(active, label="light to the camera"):
        y, bsdf = end.y, end.y.si.bsdf()
        C, _, _ = to_camera(
            eye, eye.place_on_lens(random), y, bsdf, active & scatters_smoothly(bsdf), plan.seen_by_camera
        )
        light = dr.mean(C)
        light = dr.select(dr.isfinite(light), light, 0)
        whole += light
        found += dr.select(caustic, light, 0)
        end, active, sample, _ = go_on(plan, random, start, y, bsdf, active & (y.depth + 1 < plan.longest))
        kind = event_kind(sample.sampled_type)
        passed = mi.Bool(False) if plan.holes is None else plan.holes.passed(bsdf, kind)
        caustic |= first & hard & (kind == DELTA)
        first &= passed
    return found, whole
