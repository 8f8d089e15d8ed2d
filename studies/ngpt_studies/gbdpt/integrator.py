r"""Gradient-domain bidirectional path tracing: ``bdpt``, and each of its paths shifted to four neighbouring pixels.

Many strategies find a path, and one map shifts it, which does not depend on the strategy. So a path and its copy share
one weight over all strategies of both: see ``pairs``.

    x, y = T(x)       a path and its copy through the neighbouring pixel, with the same sub-pixel and lens samples
    b, b'             f(x) / p_s(x), and f(y) |J| / p_s(x), where s is the strategy that has found x
    r                 p_s(y) |J| / p_s(x)
    others            Σ p_j / p_s over all other strategies, of x or of y; for offset paths by the recursion of ``mis``
                      along y itself, as if y were a base path
    Δ                 gradient sample, the sum over all strategies and lengths

The map: The copy replays events at mirrors and clear glass in front of the camera. The first vertex behind them is its
own. From there it goes straight to the next vertex of the path, and shares that and all further vertices. All
strategies reject the shift if one of these three vertices is not connectable, or if the copy is occluded or black.
Paths that are traced from the camera are shifted in ``offset_path``, light paths that are connected to the camera in
``light_shift``.

Holes are no vertices (``paths.holes``). On each edge the copy must go through the same number of holes as the path, or
it is rejected. The copy is weakened by their transmittance, even if the path has passed its holes by chance.

If mirrors or glass lie between that first vertex and the next one, the copy walks through the same events to the same
next vertex. A second kernel does this for camera paths (``chain_shift``). Light paths that end at the first vertex have
a third kernel, and a fourth for walks (``light_shift``). For walks each strategy has separate weights.

[Manzi et al. 2015, "Gradient-Domain Bidirectional Path Tracing"; Hua et al. 2019, "A Survey on Gradient-Domain
Rendering", section 4.2; Sun et al. 2017, "Gradient-Domain Vertex Connection and Merging", eq. 14-15]
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from data_gen.film import SHIFTS, GradientFilm
from data_gen.film.splats import Splats
from data_gen.passes import PACKET, SamplePass
from data_gen.paths.camera import QUARTERS, CameraSamples
from data_gen.paths.eye import Eye, Sight
from data_gen.paths.features import features
from data_gen.paths.frozen import Frozen
from data_gen.paths.holes import Holes
from data_gen.paths.light_ends import LightEnds, World
from data_gen.paths.spectrum import to_rgb
from data_gen.paths.vertex import Materials
from data_gen.samplers.bdpt.integrator import BDPT
from data_gen.samplers.bdpt.light_path import Visitor, light_path
from ngpt_studies.gbdpt.base_path import Plan
from ngpt_studies.gbdpt.camera_path import shifted_camera_path
from ngpt_studies.gbdpt.chain_shift import no_chain, straight
from ngpt_studies.gbdpt.light_again import Unseen, marked
from ngpt_studies.gbdpt.light_shift import splat_differences
from ngpt_studies.gbdpt.pairs import difference, difference_of_one
from ngpt_studies.gbdpt.roulette import Rater, Worth, survivors, thresholds


class GBDPT(BDPT):
    """Gradient-domain bidirectional path tracing, for surfaces.

    Plugin ``gbdpt``, with the parameters of ``bdpt`` and ``roughness_threshold``. It has the same limits as ``bdpt``.
    """

    plan_class = Plan

    def begin(self, scene: mi.Scene, sensor: mi.Sensor) -> SamplePass:
        materials = Materials(scene, self.options["roughness_threshold"])
        world = World(scene, LightEnds(scene, self.name), materials, holes=Holes.of(scene))
        plan = self.plan(world, pair=difference)
        return partial(self.gradient_pass, Frozen(scene, plan), plan)

    def gradient_pass(self, frozen: Frozen, plan: Plan, camera: CameraSamples, film: GradientFilm) -> None:
        """Takes one path from the camera and one from a light, and all their shifts, for each camera sample."""
        splats = {name: film.splats(name) for name in ("primal", *SHIFTS)} if plan.joins else {}
        n, sums = dr.width(camera.pixel), None
        if plan.joins:
            sums = lambda: (splats["primal"].zeros(), Worth.nothing(n, plan.longest))  # noqa: E731
        camera.look((0, 0), *SHIFTS.values(), *QUARTERS)
        values, Δ, inside, marks, bent, sums = frozen(self.samples, plan, camera, sums=sums)
        if plan.joins:
            splats["primal"].take(sums[0])
            threshold = thresholds(camera, values["primal"] - values["direct"], splats["primal"])
            shift_splats(frozen, plan, camera, splats, sums[1], marks=marks, threshold=threshold)
        if not plan.materials.all_connectable:
            shift_bent(frozen, plan, camera, bent, Δ)
        film.put_all(values | dict(zip(SHIFTS, zip(Δ, inside, strict=True), strict=True)))

    def samples(self, plan: Plan, camera: CameraSamples, sums: Any = None) -> tuple:
        """Returns the layers, Δ in the order of SHIFTS and where it is on the film, the marked vertices, which paths
        are bent, and the ``sums`` (splats and ``Worth`` of light paths) with this pass added."""
        ray, importance, _ = camera.rays()
        inside = [camera.rays(shift)[2] for shift in SHIFTS.values()]
        rater = None
        if sums is not None:
            rater = Rater(Splats.on(Eye.of(camera).pixels, 3, sums[0]), ray, importance, sums[1])
        L, Le, Δ, marks, bent = both_paths(plan, camera, rater)
        Le = self.emission_in_pixel(plan.scene, camera, Le)
        values = {"primal": to_rgb(L + Le, ray.wavelengths), "direct": to_rgb(Le, ray.wavelengths)}
        values |= features(plan.scene, camera.sensor, camera.random.clone(), ray)
        return values, Δ, inside, marks, bent, sums


def both_paths(plan: Plan, camera: CameraSamples, visitor: Visitor | None, alone: mi.Bool | None = None) -> tuple:
    """L, Le and Δ (a colour for each of SHIFTS) of camera paths that are joined to light paths, the state of the light
    path's ``visitor``, and whether the camera path is bent.

    Δ contains all paths except bent ones. With ``alone`` it contains only bent ones, in the lanes where ``alone`` is
    true.
    """
    sight, light, state = Sight.of(camera), None, mi.UInt64(0)
    shifted = [camera.rays(shift) for shift in SHIFTS.values()]
    if plan.joins:
        light, random, state = light_path(plan, sight, visitor)
        sight = replace(sight, random=random)
    bends = (straight(), None) if alone is None else (straight(alone), no_chain(dr.width(alone)))
    L, Le, Δ, course = shifted_camera_path(plan, sight, shifted, light, bends=bends)
    return L, Le, [to_rgb(one, sight.ray.wavelengths) for one in Δ], state, course.bent


def shift_bent(frozen: Frozen, plan: Plan, camera: CameraSamples, bent: mi.Bool, Δ: list[mi.Color3f]) -> None:
    """Adds to Δ the differences of ``bent`` camera paths, which are traced again: see ``chain_shift``."""
    # Copied, since kernels depend on the alignment of arrays, which varies for arrays of NumPy.
    lanes, exists = (dr.opaque(mi.UInt32(part)) for part in in_packets(np.array(dr.compress(bent)), camera))
    if not dr.width(lanes):
        return
    alone = exists != 0
    few = frozen(bent_differences, replace(plan, pair=difference_of_one), camera.at(lanes), alone)
    for total, added in zip(Δ, few, strict=True):
        for channel, value in zip(total, added, strict=True):
            dr.scatter_add(channel, value, lanes, alone)


def bent_differences(plan: Plan, camera: CameraSamples, alone: mi.Bool) -> list[mi.Color3f]:
    """Δ in the order of SHIFTS of bent camera paths only, in the lanes where ``alone`` is true."""
    return both_paths(plan, camera, Unseen(), alone)[2]


def shift_splats(
    frozen: Frozen,
    plan: Plan,
    camera: CameraSamples,
    splats: dict[str, Splats],
    worth: Worth,
    *,
    marks: mi.UInt64,
    threshold: mi.Float,
) -> None:
    """Splats the differences of light paths that end at ``marked`` vertices and survive ``roulette``, whose
    probabilities depend on the ``threshold`` of each pixel.

    Paths behind mirrors or glass have a kernel of their own: they are few, and other lanes would wait for their long
    walks.
    """
    lanes, depths = marked(marks, plan.longest)
    if not dr.width(lanes):
        return
    lanes, depths, times = survivors(camera, worth, lanes, depths, threshold)
    for bent in (False, True):
        if not dr.width(lanes):
            return
        sums, is_bent = frozen(
            splatted_differences,
            plan,
            camera.at(lanes),
            depths,
            times,
            bent,
            sums=lambda: {name: splats[name].zeros() for name in SHIFTS},
        )
        for name, added in sums.items():
            splats[name].take(added)
        if plan.materials.all_connectable:
            return
        few = dr.compress(is_bent)
        lanes, depths, times = (dr.gather(type(value), value, few) for value in (lanes, depths, times))


def splatted_differences(
    plan: Plan, camera: CameraSamples, depths: mi.UInt32, times: mi.Float, bent: bool, sums: dict[str, tuple]
) -> tuple[dict[str, tuple], mi.Bool]:
    """Adds the differences of light paths to ``sums``. Also returns which are bent, see ``light_shift``."""
    sight = Sight.of(camera)
    splats = {name: Splats.on(sight.eye.pixels, 3, one) for name, one in sums.items()}
    return sums, splat_differences(plan, sight, depths, splats, bent, times)


def in_packets(lanes: np.ndarray, camera: CameraSamples) -> tuple[np.ndarray, np.ndarray]:
    """The ``lanes``, with gaps so that no two blocks of samples share a packet, and which of them exist.

    The last bits of a ray's result depend on the rays traced with it, and a block must not depend on its pass.
    """
    _, counts = np.unique(lanes // (camera.pixels * camera.block), return_counts=True)
    padded = -(-counts // PACKET) * PACKET
    place = np.arange(len(lanes)) + np.repeat(np.cumsum(padded - counts) - (padded - counts), counts)
    spread, exists = np.zeros(padded.sum(), np.uint32), np.zeros(padded.sum(), bool)
    spread[place], exists[place] = lanes, True
    return spread, exists
