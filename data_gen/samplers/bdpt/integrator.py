r"""Bidirectional path tracing: for each camera sample a path from the camera and one from a light, joined every way.

Light that a camera path finds by accident alone, from lamps behind shades or through glass onto a wall, a light path
finds at once. Every way to find a path is a strategy; all are weighted against each other (``mis``). A vertex of the
camera path is connected to a lamp and to one vertex of the light path, for all of them (``choice``).

    z                 vertices of the camera path
    y                 vertices of the light path, kept while the camera path is traced
    β                 throughput f / p of either
    p, q              density of a sampled direction, and of the same with both directions swapped
    others            Σ p_j / p_s over all other strategies
    L, Le             radiance of the camera path without, and of only, the emission that the camera sees directly

Both paths are made in one kernel. Light paths that reach the camera end on pixels of their own: they are splatted, so
samples are independent from pass to pass only. Paths of more than ``joined_depth`` edges are found from the camera
alone, by s = 0 and s = 1: that bounds what is kept of a light path, and paths may be as long as they like.

[Veach 1997, "Robust Monte Carlo Methods for Light Transport Simulation", chapter 10]
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import drjit as dr
import mitsuba as mi

from data_gen.film import GradientFilm
from data_gen.film.splats import Splats
from data_gen.passes import SamplePass
from data_gen.paths.camera import CameraSamples
from data_gen.paths.features import features
from data_gen.paths.light_ends import LightEnds
from data_gen.paths.spectrum import to_rgb
from data_gen.paths.vertex import NULL, event_kind
from data_gen.samplers.bdpt import mis
from data_gen.samplers.bdpt.choice import choose
from data_gen.samplers.bdpt.light_path import Seen, Visitor, light_path
from data_gen.samplers.bdpt.strategies import connected, emission_at, to_light
from data_gen.samplers.bdpt.vertex import (
    RADIANCE,
    Vertex,
    context,
    cosine,
    leave,
    recall,
    reverse_density,
    scatters_smoothly,
)
from data_gen.samplers.common import GradientIntegrator, like_path
from ngpt.errors import NgptError

_CAMERAS = ("PerspectiveCamera", "ThinLensCamera")


@dataclass
class Splatter:
    """Splats what light paths bring to the camera."""

    splats: Splats
    ray: mi.Ray3f
    importance: mi.Spectrum

    def start(self) -> None:
        return None

    def sees(self, state: None, seen: Seen) -> None:
        light = to_rgb(seen.C * self.importance / (1 + seen.others), self.ray.wavelengths)
        self.splats.add(seen.pixel, list(light), dr.max(seen.C) > 0)


class BDPT(GradientIntegrator):
    """Bidirectional path tracing, for surfaces; no gradients.

    Plugin ``bdpt``. Parameters, the first three as for Mitsuba's ``path``:

    ``max_depth``      default -1: no limit
    ``rr_depth``       5
    ``hide_emitters``  false
    ``joined_depth``   10, the number of edges up to which paths are found from both ends

    Not handled: media, polarised variants, cameras that are neither perspective nor thin lenses, emitters other than
    areas, points, spots and those infinitely far away. Rendering raises NgptError for them.
    """

    name = "bdpt"

    def __init__(self, props: mi.Properties):
        super().__init__(props)
        max_depth = props.get("max_depth", -1)
        self.max_depth = max_depth if 0 <= max_depth < 0xFFFFFFFF else 0xFFFFFFFF
        self.rr_depth = props.get("rr_depth", 5)
        self.joined_depth = self.options["joined_depth"]

    def prepare(self, scene) -> SamplePass:
        refuse(scene)
        lights = LightEnds(scene)
        return lambda camera, film: self.sample_pass(scene, lights, camera, film)

    def sample_pass(self, scene, lights: LightEnds, camera: CameraSamples, film: GradientFilm) -> None:
        """Takes one path from the camera and one from a light for each camera sample."""
        ray, importance, _ = camera.rays()
        random = camera.random.clone()
        longest = min(self.max_depth, self.joined_depth)
        kept, count = None, mi.UInt32(0)
        if longest > 1 and lights.emitters is not None:
            splatter = Splatter(film.splats("primal"), ray, importance)
            kept, count, random, _ = self.light_path(scene, lights, camera, random, ray, longest, splatter)
        L, Le = self.camera_path(scene, lights, camera, random, ray, importance, kept, count, longest)
        Le = self.emission_in_pixel(scene, camera, Le)
        values = {"primal": to_rgb(L + Le, ray.wavelengths), "direct": to_rgb(Le, ray.wavelengths)}
        values |= features(scene, camera.sensor, camera.random.clone(), ray)
        # One kernel for all of it: each value read on its own would trace the paths again.
        dr.eval(values)
        film.put_all(values)

    def light_path(self, scene, lights, camera, random, camera_ray, longest, visitor: Visitor, **more):
        """``light_path.light_path`` with these parameters."""
        occluded = partial(self.hidden_from_camera, scene)
        depths = longest, self.rr_depth
        return light_path(scene, lights, camera, random, camera_ray, *depths, occluded, visitor, **more)

    @dr.syntax
    def camera_path(self, scene, lights, camera, random, ray, importance, kept, count, longest, merging=None):
        """L and Le of a path from the camera, joined to the light path's vertices ``kept``.

        ``merging`` gathers photons too (``vcm.merging.Merging``), if it is not None.
        """
        ray = mi.Ray3f(ray)
        si = self.first_hit(scene, ray).compute_surface_interaction(ray)
        # An environment that hides from the camera hides as well behind holes, where nothing has been scattered yet.
        sky_seen = mi.Bool(not self.hide_emitters)
        shown = mi.Bool(not self.hide_emitters and self.max_depth > 0)
        Le = importance * si.emitter(scene).eval(si, shown)
        L = dr.zeros(mi.Spectrum, dr.width(ray))
        β, η, depth = mi.Spectrum(importance), mi.Float(1), mi.UInt32(1)
        active = si.is_valid() & (depth < self.max_depth)
        _, density = camera.sensor.sample_direction(si, camera.lens, active)
        end = mis.begin_camera(density[0], cosine(si, ray.d))
        while dr.hint(active, label="camera path"):
            z = Vertex(si, β, end, depth)
            bsdf = si.bsdf()
            smooth = active & scatters_smoothly(bsdf)
            joined = depth + 1 <= longest

            # --------------------- To a light ------------------------
            u_light, u_lobe, u_direction = random.next_2d(), random.next_1d(), random.next_2d()
            u_survival = random.next_1d()
            light, weight = scene.sample_emitter_direction(si, u_light, False, smooth)
            lit = smooth & (light.pdf > 0)
            wo = si.to_local(light.d)
            f, p, sample, f_p = bsdf.eval_pdf_sample(context(RADIANCE), si, wo, u_lobe, u_direction)
            f = dr.select(dr.isfinite(dr.sum(f)) & dr.isfinite(p), f, 0)
            lit &= dr.max(f * weight) > 0
            q = reverse_density(si, bsdf, wo, lit)
            z.end = mis.Partial(dr.select(joined, end.vcm, 0), dr.select(joined, end.vc, 0), end.waiting)
            C, others = to_light(lights, z, light, weight, f, p, q)
            lit &= ~scene.ray_test(si.spawn_ray_to(light.p), lit)
            L += dr.select(lit, C / (1 + others), 0)

            # ---------------- To the light path ----------------------
            if dr.hint(kept is not None, mode="scalar"):
                u_connection = random.next_1d()
                L += self.connection(scene, z, bsdf, smooth & joined, kept, count, longest, ray, u_connection)

            # ------------------- To photons near by -------------------
            if dr.hint(merging is not None, mode="scalar"):
                L += merging.light(z, bsdf, smooth & joined)

            # -------------------- Next vertex ------------------------
            found = active & (sample.pdf > 0)
            sky_seen |= found & (event_kind(sample.sampled_type) != NULL)
            η = dr.select(found, η * sample.eta, η)
            η_merged = mi.Float(0)
            if dr.hint(merging is not None, mode="scalar"):
                η_merged = merging.at(bsdf, joined)
            d, end = leave(z, bsdf, sample, found, η_merged)
            β *= f_p
            # As in ``path``: η² undoes what refraction does to radiance, and none survives for ever.
            survival = dr.select(depth < self.rr_depth, 1, dr.fmin(dr.max(β) * dr.square(η), 0.95))
            active = found & (dr.max(β) > 0) & (u_survival < survival)
            β /= survival
            depth += 1
            ray = si.spawn_ray(d)
            reached = scene.ray_intersect(ray, active)

            # ----------------- Emission met by chance ----------------
            met = active & (reached.is_valid() | sky_seen)
            Le_met, p, e = emission_at(scene, lights, reached, si, met)
            # Longer paths are not found by light paths.
            end.vc = dr.select(depth <= longest, end.vc, 0)
            L += dr.select(met, β * Le_met / (1 + mis.others_emitted(end, e, p)), 0)
            si = reached
            active &= si.is_valid() & (depth < self.max_depth)
            end = mis.arrive(end, cosine(si, d), dr.square(si.t))
        return L, Le

    def hidden_from_camera(self, scene, si, camera: mi.DirectionSample3f, active) -> mi.Bool:
        """Whether something is between ``si`` and the camera; lamps are not, if they are hidden."""
        if not self.hide_emitters:
            return scene.ray_test(si.spawn_ray_to(camera.p), active)
        on_lamp = si.emitter(scene) != None  # noqa: E711 - a comparison of arrays of pointers
        ray = si.spawn_ray_to(camera.p)
        hit = scene.ray_intersect_preliminary(ray, active=active & ~on_lamp)
        lamp = hit.is_valid() & (hit.shape.emitter() != None)  # noqa: E711
        behind = hit.compute_surface_interaction(ray, mi.RayFlags.Minimal, lamp).spawn_ray_to(camera.p)
        further = self.skip_area_emitters(scene, behind, False, lamp)
        blocked = dr.select(lamp, further.is_valid() & (further.t < behind.maxt), hit.is_valid())
        return on_lamp | blocked

    @dr.syntax
    def connection(self, scene, z, bsdf, active, kept, count, longest, ray, u):
        """The light of all paths that join vertex ``z`` to one of those ``kept``, by one of them that ``u`` chooses."""
        L = dr.zeros(mi.Spectrum, dr.width(z.depth))
        chosen, times = choose(z, active, kept, count, longest, u)
        if active & (times > 0):
            y = recall(kept.read(chosen), ray.time, ray.wavelengths)
            C, others = connected(scene, z, bsdf, y, mi.Bool(True))
            L = dr.select(dr.max(C) > 0, C * (times / (1 + others)), 0)
        return L


def refuse(scene, sampler: str = "bdpt") -> None:
    """Raises NgptError, in the name of the ``sampler``, for a variant or a camera that light paths cannot reach."""
    if mi.is_polarized:
        raise NgptError(
            f"sampler '{sampler}' does not follow polarised light (variant '{mi.variant()}'); "
            f"use variant '{mi.variant().removesuffix('_polarized')}', or sampler 'gpt-basic'"
        )
    camera = scene.sensors()[0]
    if camera.class_name() not in _CAMERAS:
        raise NgptError(
            f"sampler '{sampler}' cannot render this scene: light paths cannot reach a camera of type "
            f"{camera.class_name()}, but perspective and thin lens; use --sampler gpt, or primal"
        )


def make(scene: mi.Scene, **options) -> SamplePass:
    """The sampler ``bdpt``, with the parameters of the scene's own ``path``."""
    return like_path(scene, "bdpt", **options).prepare(scene)


mi.register_integrator("bdpt", lambda props: BDPT(props))
