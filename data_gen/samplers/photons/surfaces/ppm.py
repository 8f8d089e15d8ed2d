r"""Progressive photon mapping: light is carried to where the camera looks, and gathered there from near by.

Light that goes through glass and then onto a rough surface, seen in a mirror or through glass itself, is found by no
connection: neither end can be joined to the other but by meeting it. Photons meet the surface, and are counted within
a radius of the point that the camera path meets. That blurs the light over the radius, which shrinks from pass to pass.

    x           a vertex of the camera path, at a material that scatters widely
    b, d, Φ     a photon within radius r of it, the direction it came along, its power
    L(x)        Σ f(x; -d) Φ / (π r² N),    N: light paths of the pass
    β           throughput of the camera path

A camera path goes on by mirrors, glass, sharp gloss and holes. It ends where light is scattered smoothly by a material
that scatters widely. All light that is scattered there comes from photons, that of lamps seen from there included;
emission that the camera path meets on its way counts as it is. So each path of light is found in one way alone.

[Hachisuka et al. 2008, "Progressive Photon Mapping"; Knaus and Zwicker 2011, radius.py]
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from data_gen.film import GradientFilm
from data_gen.passes import SamplePass
from data_gen.paths import media
from data_gen.paths.camera import CameraSamples
from data_gen.paths.light_ends import LightEnds
from data_gen.paths.segments import next_surface
from data_gen.paths.spectrum import to_rgb
from data_gen.paths.streams import sample_streams
from data_gen.paths.vertex import NULL, SMOOTH, Materials, event_kind
from data_gen.paths.world import World
from data_gen.samplers.bdpt.vertex import RADIANCE, context
from data_gen.samplers.common import GradientIntegrator, like_path
from data_gen.samplers.photons.map.fog import Fog
from data_gen.samplers.photons.map.grid import Grid
from data_gen.samplers.photons.map.photon import faces, light, photon_of
from data_gen.samplers.photons.map.radius import pixel_width, shrunk
from data_gen.samplers.photons.map.trace import MAP_BYTES, trace
from data_gen.samplers.photons.passes import Passes, begin, refuse_variants

# Of a camera sample and its features, beside the maps
CAMERA_BYTES = 256
# The streams of light paths are made from random numbers of the camera's samples and this.
_LIGHT_PATHS = 0x9807


@dataclass(init=False)
class Gathering:
    """The photons of a map, where they are gathered within ``radius``; ``paths`` light paths have brought them."""

    photons: Any
    grid: Grid
    radius2: mi.Float
    K: mi.Float
    max_depth: mi.UInt32

    def __init__(self, photons, radius: float, paths: int, max_depth: int):
        self.photons = photons
        on_surfaces = (photons.depth > 0) & (dr.squared_norm(photons.n) > 0)
        self.grid = Grid(photons.p, on_surfaces, radius)
        self.radius2 = dr.opaque(mi.Float, radius**2)
        self.K = dr.opaque(mi.Float, 1 / (np.pi * radius**2 * paths))
        self.max_depth = dr.opaque(mi.UInt32, max_depth)

    def light(self, si, place: None, bsdf: mi.BSDFPtr, depth: mi.UInt32, active: mi.Bool) -> mi.Spectrum:
        """L(x) at the vertex ``si``, on a surface, behind ``depth`` edges, of paths that are not too long."""
        photons, longest = self.photons, self.max_depth - depth

        def one(i, near):
            j = dr.gather(mi.UInt32, self.grid.index, i, near)
            photon = photon_of(photons, j, near)
            near = near & faces(photon, si) & (dr.gather(mi.UInt32, photons.depth, j, near) <= longest)
            return light(photon, si, bsdf, near)

        zero = dr.zeros(mi.Spectrum, dr.width(depth))
        return self.K * self.grid.gather(si.p, self.radius2, active, one, zero)


class PPM(GradientIntegrator):
    """Progressive photon mapping on surfaces; no gradients.

    Plugin ``ppm``. Parameters, the first three as for Mitsuba's ``path``:

    ``max_depth``            default -1: no limit
    ``rr_depth``             5
    ``hide_emitters``        false
    ``radius``               3, of the first pass, in pixels where the camera sees something (the median)
    ``photons``              1, light paths of a pass for each pixel
    ``roughness_threshold``  0.05, the microfacet roughness above which photons are gathered at a material

    Biased, and consistent: the mean over passes converges to the image of ``path``, light that ``path`` cannot find
    included. Passes differ: the first of one render is not one more of another.

    Not handled: media, polarised and spectral variants, emitters other than areas, points, spots and those infinitely
    far away. Rendering raises NgptError for them.
    """

    name = "ppm"
    camera_bytes, map_bytes = CAMERA_BYTES, MAP_BYTES
    fog: Fog | None = None
    edges = False  # whether photon maps have the edges of light paths, too

    def __init__(self, props: mi.Properties):
        super().__init__(props)
        max_depth = props.get("max_depth", -1)
        self.max_depth = max_depth if 0 <= max_depth < 0xFFFFFFFF else 0xFFFFFFFF
        self.rr_depth = props.get("rr_depth", 5)
        self.radius, self.photons = self.options["radius"], self.options["photons"]
        self.threshold = self.options["roughness_threshold"]

    @property
    def lane_bytes(self) -> int:
        """Of a camera sample, with all that its light paths may leave in a map."""
        return self.camera_bytes + self.photons * self.map_bytes

    def instead(self, lane_bytes: int) -> str:
        """What else than a smaller image would fit into so many bytes for each camera sample."""
        fits = (lane_bytes - self.camera_bytes) // self.map_bytes
        return f", or no more than -O photons={fits}" if fits > 0 else ""

    def prepare(self, scene) -> SamplePass:
        refuse_variants(self.name)
        world = World(scene, LightEnds(scene, self.name), Materials(scene, self.threshold))
        return Passes(self, world, pixel_width(scene))

    def sample_pass(self, passes: Passes, camera: CameraSamples, film: GradientFilm) -> None:
        """One photon map, and one camera path for each camera sample, of which a pixel has one."""
        ray, importance, random, keys, values = begin(passes, camera)
        near = self.gatherings(passes, keys, camera.first)
        # Emission that camera paths meet is counted with the first map, or without any.
        paths = passes.world.scene, passes.world.materials, random, ray, importance
        L, Le = passes.frozen(self.light, *paths, next(near, None), True, fixed=True)
        values |= {"primal": to_rgb(L + Le, ray.wavelengths), "direct": to_rgb(Le, ray.wavelengths)}
        dr.eval(values)
        for scattered in near:
            L, _ = passes.frozen(self.light, *paths, scattered, False, fixed=True)
            values["primal"] += to_rgb(L, ray.wavelengths)
            dr.eval(values["primal"])
        film.put_all(values)

    def gatherings(self, passes: Passes, keys, number: int):
        """What light is gathered from in each of the photon maps of pass ``number``."""
        if passes.world.lights.emitters is not None and self.max_depth > 1:
            _, maps = self.photon_maps(passes, keys)
            for photons in maps:
                yield self.gathering(photons, passes.width, number, self.photons * dr.width(keys[0]))

    def gathering(self, photons, width: float, number: int, paths: int):
        """The ``photons`` of pass ``number`` where they are gathered, of so many light paths."""
        return Gathering(photons, self.radius * width * shrunk(number), paths, self.max_depth)

    def photon_maps(self, passes: Passes, keys):
        """The light's ends and the maps of a pass: of ``photons`` light paths for each lane of the ``keys``."""
        n = dr.width(keys[0]) * self.photons
        lane = dr.arange(mi.UInt32, n)
        sample = lane // dr.opaque(mi.UInt32, self.photons)
        key, other = (dr.gather(mi.UInt32, k, sample) for k in keys)
        random = sample_streams(_LIGHT_PATHS, key, other ^ (lane % dr.opaque(mi.UInt32, self.photons)))
        receives, depths = passes.world.materials.connectable, (self.max_depth - 1, self.rr_depth)
        edges = self.edges and self.fog is not None
        return trace(passes.world.scene, passes.world.lights, random, receives, *depths, self.fog, passes.frozen, edges)

    def light(self, scene, materials, random, ray, importance, near, emission: bool):
        """L and Le of camera paths, with what is gathered from photons ``near``, and with ``emission`` or without."""
        scattered = near.light if near is not None else None
        return self.camera_path(scene, materials, random.clone(), ray, importance, scattered, emission)

    @dr.syntax
    def camera_path(self, scene, materials, random, ray, importance, scattered, emission: bool):
        """L of camera paths: where light is ``scattered``, and ``emission`` that they meet; and Le, seen directly.

        ``scattered`` is called with (vertex, its place, its material, depth, where), unless it is None.
        """
        ray, fog = mi.Ray3f(ray), self.fog
        # An environment that hides from the camera hides as well behind holes, where nothing has been scattered yet.
        sky_seen = mi.Bool(not self.hide_emitters)
        shown = mi.Bool(not self.hide_emitters and self.max_depth > 0)
        β, η, depth = mi.Spectrum(importance), mi.Float(1), mi.UInt32(1)
        if dr.hint(fog is not None, mode="scalar"):
            channel, first = media.choose_channel(random.next_1d()), partial(self.first_surface, scene)
            segment, si = fog.fly(first, ray, fog.within, channel, random, mi.Bool(True))
            place, Le = segment.place, importance * self.lamps_in_fog(scene, fog.media, ray, fog.within, channel)
            β *= fog.brought(segment, channel)
            L_first = β * self.behind_grids(scene, fog.media, segment)
        else:
            si, place, channel = self.first_hit(scene, ray).compute_surface_interaction(ray), None, None
            Le, L_first = importance * si.emitter(scene).eval(si, shown), 0
        L = dr.zeros(mi.Spectrum, dr.width(ray)) + (L_first if emission else 0)
        active = si.is_valid() & (depth < self.max_depth)
        while dr.hint(active, label="camera path"):
            bsdf = si.bsdf()
            receives = active & materials.connectable(bsdf)
            if dr.hint(fog is not None, mode="scalar"):
                receives |= active & place.scatters
            if dr.hint(scattered is not None, mode="scalar"):
                L += β * scattered(si, place, bsdf, depth, receives)
            u_lobe, u_direction, u_survival = random.next_1d(), random.next_2d(), random.next_1d()
            sample, f_p = bsdf.sample(context(RADIANCE), si, u_lobe, u_direction, active)
            kind = event_kind(sample.sampled_type)
            found = active & (sample.pdf > 0) & ((kind != SMOOTH) | ~receives)
            sky_seen |= found & (kind != NULL)
            η = dr.select(found, η * sample.eta, η)
            β *= f_p
            # As in ``path``: η² undoes what refraction does to radiance, and none survives for ever.
            survival = dr.select(depth < self.rr_depth, 1, dr.fmin(dr.max(β) * dr.square(η), 0.95))
            active = found & (dr.max(β) > 0) & (u_survival < survival)
            β /= survival
            depth += 1
            onward = si.spawn_ray(si.to_world(sample.wo))
            if dr.hint(fog is not None, mode="scalar"):
                medium = place.toward(si, onward.d)
                si, place, weight = fog.ahead(next_surface(scene), onward, medium, channel, random, active)
                β *= weight
            else:
                si = scene.ray_intersect(onward, active)
            if dr.hint(emission, mode="scalar"):
                met = active & (si.is_valid() | sky_seen)
                L += dr.select(met, β * si.emitter(scene).eval(si, met), 0)
            active &= si.is_valid() & (depth < self.max_depth)
        return L, Le


def make(scene: mi.Scene, **options) -> SamplePass:
    """The sampler ``ppm``, with the parameters of the scene's own ``path``."""
    return like_path(scene, "ppm", **options).prepare(scene)


mi.register_integrator("ppm", lambda props: PPM(props))
