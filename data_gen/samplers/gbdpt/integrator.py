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
rejected, alike by all strategies, where one of these three vertices is not connectable, where a mirror leaves one of
them, or where the copy is occluded or black. What is completed by connecting the camera path's first vertices is
shifted in ``offset_path``; what ends by connecting a light path to the camera, in ``light_shift``.

What reaches the first vertex through mirrors or glass is rejected, but for light paths that end there: of those the
copies go through the same events to the vertex before them, in a kernel of their own.

[Manzi et al. 2015, "Gradient-Domain Bidirectional Path Tracing"; Hua et al. 2019, "A Survey on Gradient-Domain
Rendering", section 4.2; Sun et al. 2017, "Gradient-Domain Vertex Connection and Merging", eq. 14-15]
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from data_gen.film import SHIFTS, GradientFilm
from data_gen.passes import SamplePass
from data_gen.paths.camera import CameraSamples
from data_gen.paths.features import features
from data_gen.paths.spectrum import to_rgb
from data_gen.paths.vertex import ROUGHNESS_THRESHOLD, Materials
from data_gen.samplers.bdpt import mis
from data_gen.samplers.bdpt.choice import choose
from data_gen.samplers.bdpt.integrator import BDPT, refuse
from data_gen.samplers.bdpt.lights import LightEnds
from data_gen.samplers.bdpt.strategies import connection
from data_gen.samplers.bdpt.vertex import (
    Vertex,
    cosine,
    recall,
    scatters_smoothly,
)
from data_gen.samplers.common import like_path
from data_gen.samplers.gbdpt.base_path import Plan, base_step
from data_gen.samplers.gbdpt.light_again import Marker, marked
from data_gen.samplers.gbdpt.light_shift import splat_differences
from data_gen.samplers.gbdpt.offset_path import brightest, connect, start, take_step, with_differences
from data_gen.samplers.gbdpt.pairs import weighted


class GBDPT(BDPT):
    """Gradient-domain bidirectional path tracing, for surfaces.

    Plugin ``gbdpt``. Parameters are those of ``bdpt``, and

    ``roughness_threshold``  0.05, the microfacet roughness above which materials are connectable

    Not handled: what ``bdpt`` does not handle.
    """

    def __init__(self, props: mi.Properties):
        super().__init__(props)
        self.roughness_threshold = props.get("roughness_threshold", ROUGHNESS_THRESHOLD)

    def prepare(self, scene) -> SamplePass:
        refuse(scene, "gbdpt")
        materials = Materials(scene, self.roughness_threshold)
        longest = min(self.max_depth, self.joined_depth)
        plan = Plan(LightEnds(scene, "gbdpt"), materials, self.max_depth, self.rr_depth, longest)
        return lambda camera, film: self.gradient_pass(scene, plan, camera, film)

    def gradient_pass(self, scene, plan: Plan, camera: CameraSamples, film: GradientFilm) -> None:
        """Takes one path from the camera and one from a light, and all their shifts, for each camera sample."""
        ray, importance, _ = camera.rays()
        shifted = [camera.rays(shift) for shift in SHIFTS.values()]
        random = camera.random.clone()
        kept, count, marks = None, mi.UInt32(0), mi.UInt64(0)
        if plan.longest > 1 and plan.lights.emitters is not None:
            splats = {name: film.splats(name) for name in ("primal", *SHIFTS)}
            marker = Marker(splats["primal"], ray, importance)
            kept, count, random, marks = self.light_path(scene, plan.lights, camera, random, ray, plan.longest, marker)
        L, Le, Δ = self.shifted_camera_path(scene, plan, camera, random, ray, importance, shifted, kept, count)
        Le = self.emission_in_pixel(scene, camera, Le)
        values = {"primal": to_rgb(L + Le, ray.wavelengths), "direct": to_rgb(Le, ray.wavelengths)}
        values |= features(scene, camera.sensor, camera.random.clone(), ray)
        Δ, inside = [to_rgb(one, ray.wavelengths) for one in Δ], [inside for _, _, inside in shifted]
        # One kernel for all of it: each value read on its own would trace the paths again.
        dr.eval(values, Δ, inside, marks)
        if kept is not None:
            self.shift_splats(scene, plan, camera, splats, marks)
        film.put_all(values)
        for name, value, active in zip(SHIFTS, Δ, inside, strict=True):
            film.put(name, value, active)

    def shift_splats(self, scene, plan: Plan, camera: CameraSamples, splats, marks: mi.UInt64) -> None:
        """Splats the differences of light paths that end at ``marked`` vertices.

        Those behind mirrors or glass are few, and their walks long: in the kernel of all most lanes would wait.
        """
        lanes, depths = marked(marks, plan.longest)
        if not dr.width(lanes):
            return
        bent = splat_differences(scene, plan, camera.at(lanes), depths, self.first_hit, splats)
        dr.eval(bent)
        if plan.materials.all_connectable or not dr.width(few := dr.compress(bent)):
            return
        lanes, depths = dr.gather(mi.UInt32, lanes, few), dr.gather(mi.UInt32, depths, few)
        dr.eval(splat_differences(scene, plan, camera.at(lanes), depths, self.first_hit, splats, bent=True))

    @dr.syntax
    def shifted_camera_path(self, scene, plan, camera, random, ray, importance, shifted, kept, count, merging=None):
        """``BDPT.camera_path``, and Δ of its four offset paths."""
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
        active = si.is_valid() & (depth < plan.max_depth)
        _, density = camera.sensor.sample_direction(si, camera.lens, active)
        end = mis.begin_camera(density[0], cosine(si, ray.d))
        while dr.hint(active, label="camera path"):
            z = Vertex(si, β, end, depth)
            step, η, sky_seen = base_step(scene, plan, random, z, active, η, sky_seen, brightest(offsets))
            L += weighted(step.C_light, step.others_light) + weighted(step.C_met, step.others_met)
            if dr.hint(kept is not None, mode="scalar"):
                joins = active & scatters_smoothly(si.bsdf()) & step.joins
                u = random.next_1d()
                L, Δ = self.shifted_connection(scene, plan, step, joins, kept, count, ray, u, L, offsets)
                offsets = with_differences(offsets, Δ)
            if dr.hint(merging is not None, mode="scalar"):
                gathers = active & scatters_smoothly(si.bsdf()) & step.joins
                light, Δ = merging.differences(z, si.bsdf(), gathers, offsets)
                L, offsets = L + light, with_differences(offsets, Δ)
            offsets = take_step(scene, plan, step, offsets)
            si, β, end = step.x1, step.β1, step.end1
            depth += 1
            active = step.goes_on & si.is_valid() & (depth < plan.max_depth)
        return L, Le, [offset.Δ for offset in offsets]

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
            C, others, Δ = connect(scene, plan, z, step.connectable, y, found, times, offsets, Δ)
            L += weighted(C, others) * times
        return L, Δ


def make(scene: mi.Scene, **options) -> SamplePass:
    """The sampler ``gbdpt``, with the parameters of the scene's own ``path``."""
    return like_path(scene, "gbdpt", **options).prepare(scene)


mi.register_integrator("gbdpt", lambda props: GBDPT(props))
