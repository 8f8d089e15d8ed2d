r"""Progressive photon mapping: photons carry light to the surfaces that the camera sees, and are gathered there.

    x           a vertex of the camera path, at a material that scatters widely
    b, d, Φ     a photon within radius r of x, the direction in which it arrived, its power
    A           area of the surface from which photons are gathered: π r², and less along edges (map/radius.py)
    L(x)        Σ f(x; -d) Φ / (A N),    N: light paths of the pass
    β           throughput of the camera path

A camera path goes on at mirrors, glass, sharp gloss and holes. At a material that scatters widely, all smoothly (not
specularly) scattered light comes from photons, even light directly from lamps, and the camera path goes on only by a
specular event. Emission that the camera path meets on its way is added in full. So each path of light is found in only
one way.

[Hachisuka et al. 2008, "Progressive Photon Mapping"; Knaus and Zwicker 2011, radius.py]
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from data_gen.film import GradientFilm
from data_gen.paths.camera import CameraSamples
from data_gen.paths.light_ends import World
from data_gen.paths.spectrum import to_rgb
from data_gen.paths.vertex import SMOOTH, event_kind
from data_gen.paths.walk import Sky, roulette
from data_gen.samplers.bdpt.vertex import RADIANCE, context
from data_gen.samplers.photons.integrator import PhotonIntegrator, Traced
from data_gen.samplers.photons.map.grid import Grid
from data_gen.samplers.photons.map.radius import number_of, spread
from data_gen.samplers.photons.map.vertices import faces, light, on_surfaces, photon_of
from data_gen.samplers.photons.passes import Passes, Start, begun


@dataclass(init=False)
class Gathering:
    """The photons of a map, to be gathered on surfaces; for paths of at most ``max_depth`` edges."""

    world: World
    photons: Any
    grid: Grid
    radius2: mi.Float
    K: mi.Float  # 1 / (π r² N)
    number: mi.UInt32  # of the pass
    max_depth: mi.UInt32

    def __init__(self, world: World, traced: Traced, max_depth: int):
        self.world, self.photons, radius = world, traced.photons, traced.radius()
        self.grid = Grid(self.photons.p, on_surfaces(self.photons), radius)
        self.radius2 = dr.opaque(mi.Float, radius**2)
        self.K = dr.opaque(mi.Float, 1 / (np.pi * radius**2 * traced.paths))
        self.number, self.max_depth = number_of(traced.seed, traced.number), dr.opaque(mi.UInt32, max_depth)

    def light(self, si, bsdf: mi.BSDFPtr, depth: mi.UInt32, active: mi.Bool) -> mi.Spectrum:
        """Returns L(x) at the vertex ``si`` on a surface, ``depth`` edges from the camera. Photons that would make a
        path too long are left out.
        """
        longest = self.max_depth - depth

        def one(i, near):
            j = dr.gather(mi.UInt32, self.grid.index, i, near)
            photon, depth = photon_of(self.photons, j, near), dr.gather(mi.UInt32, self.photons.depth, j, near)
            return light(photon, si, bsdf, near & faces(photon, si) & (depth <= longest))

        zero = dr.zeros(mi.Spectrum, dr.width(depth))
        L = self.grid.gather(si.p, self.radius2, active, one, zero)
        return self.K * L * spread(self.world, si, self.radius2, self.number, active & (dr.max(L) > 0))


class PPM(PhotonIntegrator):
    """Progressive photon mapping on surfaces; no gradients.

    Plugin ``ppm``. Parameters, the first three as for Mitsuba's ``path``:

    ``max_depth``            default -1: no limit
    ``rr_depth``             5
    ``hide_emitters``        false
    ``radius``               3, the radius in the first pass, in pixels of median width at the surfaces that are seen
    ``photons``              1, the number of light paths in a pass for each pixel
    ``roughness_threshold``  0.05, the microfacet roughness above which photons are gathered at a material

    Biased, and consistent: the mean over passes converges to the image of ``path``, including light that ``path``
    cannot find. The radius shrinks from pass to pass, so the mean of several short renders is not the image of a long
    one.

    Not handled: media, polarised and spectral variants, the material ``hair``, cameras without adjacent pixels
    (meters), emitters other than areas, points, spots and those infinitely far away. Rendering a scene with any of
    these raises NgptError.
    """

    def sample_pass(self, passes: Passes, camera: CameraSamples, film: GradientFilm) -> None:
        """Traces the photon maps of a pass, and one camera path for each camera sample."""
        start, values = begun(passes, camera)
        near = (one for traced in self.maps(passes, camera) for one in self.near(passes, traced))
        wavelengths = start.ray.wavelengths
        # Emission that camera paths meet is added once: together with the first map, or alone if there is no map.
        L, Le = passes.frozen(self.light, passes.world, start, next(near, None), True)
        values |= {"primal": to_rgb(L + Le, wavelengths), "direct": to_rgb(Le, wavelengths)}
        dr.eval(values)
        for more in near:
            L, _ = passes.frozen(self.light, passes.world, start, more, False)
            values["primal"] += to_rgb(L, wavelengths)
            dr.eval(values["primal"])
        film.put_all(values)

    def near(self, passes: Passes, traced: Traced) -> Iterator[Any]:
        """Yields the parts of a photon map that are gathered, one after another."""
        yield Gathering(passes.world, traced, self.limits.max_depth)

    def light(self, *path) -> tuple[mi.Spectrum, mi.Spectrum]:
        """Returns L and Le of camera paths; the arguments are world, start, near and emission. L is the light gathered
        from ``near``, plus the emission that the paths meet if ``emission`` is true."""
        return by_vertices(self, *path)


@dr.syntax
def by_vertices(integrator: PhotonIntegrator, world: World, start: Start, near, emission: bool) -> tuple:
    """Returns L and Le of camera paths, which are traced vertex by vertex. L is the light gathered from ``near``, plus
    the emission that the paths meet if ``emission`` is true.

    ``near.light`` is called with (vertex, its material, depth, active). ``near`` may be None.
    """
    scene, limits, random = world.scene, integrator.limits, start.random.clone()
    ray, importance = mi.Ray3f(start.ray), start.importance
    connectable, gathered = world.materials.connectable, near.light if near is not None else None
    sky = Sky.from_camera(limits.hide_emitters)
    β, η = mi.Spectrum(importance), mi.Float(1)  # throughput and relative index of refraction up to the vertex
    depth = mi.UInt32(1)  # edges up to the vertex si
    # ------------------------- The first vertex --------------------------
    si = integrator.first_hit(scene, ray).compute_surface_interaction(ray)
    Le = importance * si.emitter(scene).eval(si, mi.Bool(limits.shows))
    L = dr.zeros(mi.Spectrum, dr.width(ray))
    active = si.is_valid() & (depth < limits.max_depth)
    while dr.hint(active, label="camera path"):
        # --------------------- Gather at the vertex -----------------------
        bsdf = si.bsdf()
        receives = active & connectable(bsdf)
        if dr.hint(gathered is not None, mode="scalar"):
            L += β * gathered(si, bsdf, depth, receives)

        # ------- The next direction; a path ends where it is gathered ------
        u_lobe, u_direction, u_survival = random.next_1d(), random.next_2d(), random.next_1d()
        sample, f_p = bsdf.sample(context(RADIANCE), si, u_lobe, u_direction, active)
        kind = event_kind(sample.sampled_type)
        found = active & (sample.pdf > 0) & ((kind != SMOOTH) | ~receives)
        sky = sky.behind(kind, found)
        η = dr.select(found, η * sample.eta, η)
        β *= f_p
        survival = roulette(dr.max(β), depth >= limits.rr_depth, η)
        active = found & (dr.max(β) > 0) & (u_survival < survival)
        β /= survival
        depth += 1

        # ------------------- The next vertex, its emission ----------------
        si = scene.ray_intersect(si.spawn_ray(si.to_world(sample.wo)), active)
        if dr.hint(emission, mode="scalar"):
            met = active & sky.meets(si)
            L += dr.select(met, β * si.emitter(scene).eval(si, met), 0)
        active &= si.is_valid() & (depth < limits.max_depth)
    return L, Le
