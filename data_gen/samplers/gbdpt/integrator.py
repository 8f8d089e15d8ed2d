r"""Gradient-domain bidirectional path tracing: ``bdpt``, and each of its paths shifted to four neighbouring pixels.

Every path is found by one of many strategies, and shifted by one map that does not know which it was. So a path and
its copy share one weight over all strategies of both: see ``pairs``.

    x, y = T(x)       a path and its copy through the neighbouring pixel, with the same sub-pixel and lens samples
    b, b'             f(x) / p_s(x), and f(y) |J| / p_s(x): both with the density of the strategy that has found x
    r                 p_s(y) |J| / p_s(x)
    others            Σ p_j / p_s over all other strategies, of x or of y; of offset paths by the recursion of ``mis``
                      along y itself, as if y were a base path
    Δ                 gradient sample, the sum over all strategies and lengths

The map: mirrors, clear glass and holes in front of the camera are replayed; the first vertex behind them is the copy's
own, and from there it goes straight to the next vertex of the path, which both share with all further ones. It is
rejected, alike by all strategies, where one of these three vertices is not connectable, or where the copy is occluded
or black. What is completed by connecting the camera path's first vertices is
shifted in ``offset_path``; what ends by connecting a light path to the camera, in ``light_shift``.

Between that first vertex and the next one mirrors and glass may lie: then the copy walks through the same events to the
same next vertex. Camera paths do so in a second kernel (``chain_shift``), light paths that end at the first vertex in a
third and fourth (``light_shift``), each strategy with weights of its own.

[Manzi et al. 2015, "Gradient-Domain Bidirectional Path Tracing"; Hua et al. 2019, "A Survey on Gradient-Domain
Rendering", section 4.2; Sun et al. 2017, "Gradient-Domain Vertex Connection and Merging", eq. 14-15]
"""

from __future__ import annotations

from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np

from data_gen.film import SHIFTS, GradientFilm
from data_gen.passes import SamplePass
from data_gen.paths.camera import CameraSamples, in_packets
from data_gen.paths.features import features
from data_gen.paths.light_ends import LightEnds
from data_gen.paths.spectrum import to_rgb
from data_gen.paths.vertex import Materials
from data_gen.samplers.bdpt import mis
from data_gen.samplers.bdpt.choice import choose
from data_gen.samplers.bdpt.integrator import BDPT, refuse
from data_gen.samplers.bdpt.light_path import Visitor
from data_gen.samplers.bdpt.strategies import connection
from data_gen.samplers.bdpt.vertex import (
    Vertex,
    cosine,
    recall,
    scatters_smoothly,
)
from data_gen.samplers.common import like_path
from data_gen.samplers.gbdpt.base_path import Plan, base_step
from data_gen.samplers.gbdpt.chain_shift import along, completes, matters, no_chain, straight
from data_gen.samplers.gbdpt.light_again import Unseen, marked
from data_gen.samplers.gbdpt.light_shift import splat_differences
from data_gen.samplers.gbdpt.offset_path import brightest, connect, start, take_step, with_differences
from data_gen.samplers.gbdpt.pairs import difference, difference_of_one, weighted
from data_gen.samplers.gbdpt.roulette import Rater, survivors, thresholds


class GBDPT(BDPT):
    """Gradient-domain bidirectional path tracing, for surfaces.

    Plugin ``gbdpt``. Parameters are those of ``bdpt``, and

    ``roughness_threshold``  0.05, the microfacet roughness above which materials are connectable

    Not handled: what ``bdpt`` does not handle.
    """

    name = "gbdpt"

    def __init__(self, props: mi.Properties):
        super().__init__(props)
        self.roughness_threshold = self.options["roughness_threshold"]

    def prepare(self, scene) -> SamplePass:
        refuse(scene, "gbdpt")
        materials = Materials(scene, self.roughness_threshold)
        longest = min(self.max_depth, self.joined_depth)
        lights = LightEnds(scene, "gbdpt")
        plan = Plan(lights, materials, self.max_depth, self.rr_depth, longest, pair=difference)
        return lambda camera, film: self.gradient_pass(scene, plan, camera, film)

    def gradient_pass(self, scene, plan: Plan, camera: CameraSamples, film: GradientFilm) -> None:
        """Takes one path from the camera and one from a light, and all their shifts, for each camera sample."""
        ray, importance, _ = camera.rays()
        inside = [camera.rays(shift)[2] for shift in SHIFTS.values()]
        splats = {name: film.splats(name) for name in ("primal", *SHIFTS)} if plan.joins else {}
        rater = None
        if plan.joins:
            rater = Rater.of(splats["primal"], ray, importance, dr.width(camera.pixel), plan.longest)
        L, Le, Δ, marks, bent = self.both_paths(scene, plan, camera, rater)
        Le = self.emission_in_pixel(scene, camera, Le)
        values = {"primal": to_rgb(L + Le, ray.wavelengths), "direct": to_rgb(Le, ray.wavelengths)}
        values |= features(scene, camera.sensor, camera.random.clone(), ray)
        # One kernel for all of it: each value read on its own would trace the paths again.
        dr.eval(values, Δ, inside, marks, bent)
        if rater is not None:
            light = values["primal"] - values["direct"]
            self.shift_splats(scene, plan, camera, splats, rater, marks, light)
        if not plan.materials.all_connectable:
            self.shift_bent(scene, plan, camera, bent, Δ)
        film.put_all(values)
        for name, value, active in zip(SHIFTS, Δ, inside, strict=True):
            film.put(name, value, active)

    def both_paths(
        self, scene, plan: Plan, camera: CameraSamples, visitor: Visitor | None, alone: mi.Bool | None = None
    ):
        """L, Le, and for each of SHIFTS Δ, as colours, of the path from the camera, joined to one from a light; the
        state of the light path's ``visitor``, and whether the camera path is bent.

        In Δ are all paths but bent ones, or, with ``alone``, bent ones alone, of the lanes where that is true.
        """
        ray, importance, _ = camera.rays()
        shifted = [camera.rays(shift) for shift in SHIFTS.values()]
        random, kept, count, state = camera.random.clone(), None, mi.UInt32(0), mi.UInt64(0)
        if plan.joins:
            kept, count, random, state = self.light_path(scene, plan.lights, camera, random, ray, plan.longest, visitor)
        course, chain = (straight(), None) if alone is None else (straight(alone), no_chain(dr.width(alone)))
        paths = camera, random, ray, importance, shifted, kept, count, course, chain
        L, Le, Δ, course = self.shifted_camera_path(scene, plan, *paths)
        return L, Le, [to_rgb(one, ray.wavelengths) for one in Δ], state, course.bent

    def shift_bent(self, scene, plan: Plan, camera: CameraSamples, bent: mi.Bool, Δ: list[mi.Color3f]) -> None:
        """Adds to Δ the differences of ``bent`` camera paths, which are traced anew: see ``chain_shift``."""
        # Copies: kernels tell arrays by how their memory is aligned, and NumPy's is so or so.
        lanes, exists = (dr.opaque(mi.UInt32(part)) for part in in_packets(np.array(dr.compress(bent)), camera))
        if not dr.width(lanes):
            return
        alone = exists != 0
        plan = replace(plan, pair=difference_of_one)
        _, _, few, _, _ = self.both_paths(scene, plan, camera.at(lanes), Unseen(), alone)
        dr.eval(few)
        for total, added in zip(Δ, few, strict=True):
            for channel, value in zip(total, added, strict=True):
                dr.scatter_add(channel, value, lanes, alone)

    def shift_splats(
        self, scene, plan: Plan, camera: CameraSamples, splats, rater: Rater, marks: mi.UInt64, light: mi.Color3f
    ) -> None:
        """Splats the differences of light paths that end at ``marked`` vertices, of those that survive ``roulette``;
        ``light`` is that of camera paths.

        Those behind mirrors or glass are few, and their walks long: in the kernel of all most lanes would wait.
        """
        lanes, depths = marked(marks, plan.longest)
        if not dr.width(lanes):
            return
        threshold = thresholds(camera, light, splats["primal"])
        lanes, depths, times = survivors(camera, rater, lanes, depths, threshold)
        if not dr.width(lanes):
            return
        bent = splat_differences(scene, plan, camera.at(lanes), depths, self.first_hit, splats, times=times)
        dr.eval(bent)
        if plan.materials.all_connectable or not dr.width(few := dr.compress(bent)):
            return
        lanes, depths, times = (dr.gather(type(value), value, few) for value in (lanes, depths, times))
        dr.eval(splat_differences(scene, plan, camera.at(lanes), depths, self.first_hit, splats, True, times))

    @dr.syntax
    def shifted_camera_path(
        self,
        scene,
        plan,
        camera,
        random,
        ray,
        importance,
        shifted,
        kept,
        count,
        course=None,
        chain=None,
        merging=None,
    ):
        """``BDPT.camera_path``, Δ of its four offset paths, and where its ``course`` has led.

        Bent paths are rejected; where there is a ``course``, they are left out of Δ; where there is a ``chain`` as
        well, all others are, and bent ones are followed.
        """
        ray = mi.Ray3f(ray)
        si = self.first_hit(scene, ray).compute_surface_interaction(ray)
        offsets = []
        for offset_ray, offset_importance, inside in shifted:
            hit = self.first_hit(scene, offset_ray)
            offsets.append(start(camera.sensor, camera.lens, si, offset_ray, hit, offset_importance, inside))
        # An environment that hides from the camera hides as well behind holes, where nothing has been scattered yet.
        sky_seen = mi.Bool(not self.hide_emitters)
        shown = mi.Bool(not self.hide_emitters and self.max_depth > 0)
        Le = importance * si.emitter(scene).eval(si, shown)
        L = dr.zeros(mi.Spectrum, dr.width(ray))
        β, η, depth = mi.Spectrum(importance), mi.Float(1), mi.UInt32(1)
        active = si.is_valid() & (depth < plan.max_depth) & matters(course, chain)
        _, density = camera.sensor.sample_direction(si, camera.lens, active)
        end = mis.begin_camera(density[0], cosine(si, ray.d))
        while dr.hint(active, label="camera path"):
            z = Vertex(si, β, end, depth)
            wanted = completes(course, chain)
            step, η, sky_seen = base_step(scene, plan, random, z, active, η, sky_seen, brightest(offsets), wanted)
            L += weighted(step.C_light, step.others_light) + weighted(step.C_met, step.others_met)
            came, (step, course, chain) = course, along(scene, plan, step, course, chain)
            if dr.hint(kept is not None, mode="scalar"):
                joins = active & wanted & scatters_smoothly(si.bsdf()) & step.joins
                u = random.next_1d()
                L, Δ = self.shifted_connection(scene, plan, step, joins, kept, count, ray, u, L, offsets)
                offsets = with_differences(offsets, Δ)
            if dr.hint(merging is not None, mode="scalar"):
                gathers = active & scatters_smoothly(si.bsdf()) & step.joins
                light, Δ = merging.differences(z, si.bsdf(), gathers, offsets)
                L, offsets = L + light, with_differences(offsets, Δ)
            offsets = take_step(scene, plan, step, offsets, came, chain)
            si, β, end = step.x1, step.β1, step.end1
            depth += 1
            active = step.goes_on & si.is_valid() & (depth < plan.max_depth) & matters(course, chain)
        return L, Le, [offset.Δ for offset in offsets], course

    @dr.syntax
    def shifted_connection(self, scene, plan, step, active, kept, count, ray, u, L, offsets):
        """``L`` and Δ, and with them the paths that join the vertex of ``step`` to one of those ``kept``, by ``u``.

        It is chosen by the base path alone, so that it stands for all of them in differences as well.
        """
        z, Δ = step.z, [offset.Δ for offset in offsets]
        chosen, times = choose(z, active, kept, count, plan.longest, u)
        if active & (times > 0):
            y = recall(kept.read(chosen), ray.time, ray.wavelengths)
            found = connection(scene, z, z.si.bsdf(), y, mi.Bool(True))
            shares = dr.select(step.shared, times, 0)
            C, others, Δ = connect(scene, plan, z, step.connectable, y, found, shares, offsets, Δ)
            L += weighted(C, others) * times
        return L, Δ


def make(scene: mi.Scene, **options) -> SamplePass:
    """The sampler ``gbdpt``, with the parameters of the scene's own ``path``."""
    return like_path(scene, "gbdpt", **options).prepare(scene)


mi.register_integrator("gbdpt", lambda props: GBDPT(props))
