"""The materials and media at which a path may end in the cache, and the share of light that they scatter evenly.

The cache knows the light that *arrives* at a surface, weighted by the cosine: its irradiance over π. Every material
with a diffuse part scatters some of that light as a matt surface of reflectance ρ would,

    f cos θ = ρ cos θ / π + rest.

For the first term the path ends, and the cache supplies the light. For the rest the path goes on: gloss, metal,
mirrors, transmission, and what bumps and Fresnel's law change about the diffuse part. Any ρ gives the right mean, and a
ρ that fits the material well makes the rest small. Nothing is divided by ρ, so ρ may be 0.

In a medium the cache knows the mean radiance over all directions. A phase function is split in the same way,

    f = ρ / 4π + rest,

where ρ is 4π times the least value of the phase function f, so that the rest is nowhere negative. The throughput of a
path already includes the albedo. So a cell needs neither the extinction nor the albedo: thin and dense parts of a grid
may share a cell, and so may both sides of an index-matched boundary.
"""

from __future__ import annotations

import re
from collections.abc import Sequence

import drjit as dr
import mitsuba as mi
import numpy as np

from data_gen.paths import media
from data_gen.paths.media import Place
from data_gen.paths.vertex import SMOOTH, ByMaterial, dr_number, event_kind, materials_of

# ρ is computed from the value of a material for one outgoing direction. _TILT is the tangent of the angle between that
# direction and the normal. The direction is far from the horizon, and also far from the mirror direction, which is on
# the other side of the normal.
_TILT = 1.0
# The flags of all lobes except the diffuse reflection
_ELSE = ("Delta", "Delta1D", "Null", "Glossy", "DiffuseTransmission")
# The least ρ of a medium in which paths may end. With a smaller ρ, nearly all paths would go on at each vertex anyway.
_LEAST_EVEN = 0.1
# The class names of materials that tilt the normal of a nested material
_BUMPS = re.compile("(Bump|Normal)Map")


class Matt:
    """The facts that the cache needs about a scene's materials, and about its media ``fogs``."""

    def __init__(self, scene: mi.Scene, fogs: Sequence[mi.Medium] = ()):
        bsdfs = materials_of(scene)
        evens = {dr_number(mi.MediumPtr(fog)): even_part(fog.phase_function()) for fog in fogs}
        of_media = np.zeros(max(evens, default=0) + 1, np.float32)
        of_media[list(evens)] = list(evens.values())
        self.evens = ByMaterial(mi.Float(of_media))
        table = np.zeros(max(bsdfs, default=0) + 1, bool)
        table[[number for number, bsdf in bsdfs.items() if is_lambertian(bsdf)]] = True
        # Materials inside shape groups are not in ``bsdfs``, so some of them may be matt.
        groups = any(shape.class_name() == "Instance" for shape in scene.shapes())
        matt = any(mi.has_flag(bsdf.flags(), mi.BSDFFlags.DiffuseReflection) for bsdf in bsdfs.values())
        self.any = groups or matt or bool(of_media.any())
        self.nothing_else = ByMaterial(mi.Bool(table))
        tilted = np.zeros(len(table), bool)
        tilted[[number for number, bsdf in bsdfs.items() if _BUMPS.search(str(bsdf))]] = True
        # Materials inside shape groups may tilt their normals too.
        self.any_tilted = groups or bool(tilted.any())
        self.tilts = ByMaterial(mi.Bool(tilted))
        self.plain = MattTable(bsdfs)

    def at(self, x: mi.SurfaceInteraction3f, place: Place | None, active: mi.Bool) -> mi.Bool:
        """Whether a path may end at ``x``: for the diffuse part of a material, or the even part of a phase function."""
        matt = mi.has_flag(x.bsdf().flags(), mi.BSDFFlags.DiffuseReflection)
        return active & (matt if place is None else matt | (self._even(place, active) > 0))

    def lambertian(self, x: mi.SurfaceInteraction3f, place: Place | None, active: mi.Bool) -> mi.Bool:
        """Whether the vertex scatters only like a matt surface, or evenly in a medium.

        A path that ends at such a vertex has no rest to follow.
        """
        listed, lambertian = self.nothing_else.of(x.bsdf(), active)
        all_matt = listed & lambertian
        return all_matt if place is None else all_matt | (self._even(place, active) == 1)

    def _even(self, place: Place, active: mi.Bool) -> mi.Float:
        """ρ of the phase function at a vertex, 0 on surfaces."""
        return self.evens.of(place.medium, active & place.scatters)[1]

    def tilted(self, x: mi.SurfaceInteraction3f, active: mi.Bool) -> mi.Bool:
        """Whether a bump or normal map may tilt the diffuse part.

        A tilted diffuse part scatters no light into some directions into which a matt surface scatters light.
        """
        listed, tilted = self.tilts.of(x.bsdf(), active)
        return active & (~listed | tilted)

    def reflectance(self, x: mi.SurfaceInteraction3f, place: Place | None, active: mi.Bool) -> mi.Color3f:
        """ρ in [0, 1].

        On a surface ρ is π times f of the diffuse lobe, for one direction on the side of ``wi``. In a medium it is the
        ρ of the phase function.
        """
        on_surface = active & ~media.scatters(place)
        known, ρ = self.plain.of(x, on_surface)
        ρ = dr.select(known, ρ, reflectance(x.bsdf(), x, on_surface & ~known))
        return ρ if place is None else dr.select(place.scatters, mi.Color3f(self._even(place, active)), ρ)


class MattTable:
    """A table of ρ for both sides of all matt materials that have no texture.

    Reading the table is faster than calling the materials.
    """

    def __init__(self, bsdfs: dict[int, mi.BSDF]):
        # For each material and side: RGB of ρ, and 1 if ρ is known
        table = np.zeros((max(bsdfs, default=0) + 1, 2, 4), np.float32)
        x = dr.zeros(mi.SurfaceInteraction3f, 2)
        x.wi = mi.Vector3f(0, 0, mi.Float([1, -1]))
        for number, bsdf in bsdfs.items():
            if is_lambertian(bsdf) and is_constant(bsdf):
                table[number, :, :3] = np.array(reflectance(bsdf, x, mi.Bool(True))).T
                table[number, :, 3] = 1
        # The size is opaque: the numbers of materials may differ between processes, but the kernel should not.
        self.size, self.table = dr.opaque(mi.UInt32, len(table)), mi.Float(table.ravel())
        dr.eval(self.table)

    def of(self, x: mi.SurfaceInteraction3f, active: mi.Bool) -> tuple[mi.Bool, mi.Color3f]:
        """Whether the table has the material at ``x``, and its ρ on the side of ``wi``."""
        number = dr.reinterpret_array(mi.UInt32, x.bsdf())
        row = 2 * number + dr.select(x.wi.z < 0, mi.UInt32(1), 0)
        v = dr.gather(mi.Vector4f, self.table, row, active & (number < self.size))
        return v.w > 0, mi.Color3f(v.x, v.y, v.z)


def reflectance(bsdf: mi.BSDF | mi.BSDFPtr, x: mi.SurfaceInteraction3f, active: mi.Bool) -> mi.Color3f:
    """ρ in [0, 1], evaluated by the material: π times f of its diffuse lobe, see ``Matt.reflectance``."""
    context = mi.BSDFContext()
    # With this mask, all materials of several lobes except ``principled`` leave out the other lobes.
    context.type_mask = mi.BSDFFlags.DiffuseReflection
    along = mi.Vector2f(x.wi.x, x.wi.y)
    across = dr.rsqrt(dr.maximum(dr.squared_norm(along), 1e-12)) * along
    wo = dr.normalize(mi.Vector3f(_TILT * across.x, _TILT * across.y, dr.mulsign(mi.Float(1), x.wi.z)))
    f = mi.Color3f(mi.unpolarized_spectrum(bsdf.eval(context, x, wo, active)))
    ρ = f * (dr.pi / dr.abs(wo.z))
    return dr.select(active & dr.isfinite(dr.sum(ρ)), dr.clip(ρ, 0, 1), 0)


def is_lambertian(bsdf: mi.BSDF) -> bool:
    """Whether a material scatters only like a matt surface, on one side or on both sides."""
    flags = bsdf.flags()
    more = any(mi.has_flag(flags, getattr(mi.BSDFFlags, name)) for name in _ELSE)
    known = bsdf.class_name() in ("SmoothDiffuse", "TwoSidedBRDF") and not _BUMPS.search(str(bsdf))
    return known and mi.has_flag(flags, mi.BSDFFlags.DiffuseReflection) and not more


def is_constant(bsdf: mi.BSDF) -> bool:
    """Whether a matt material has no texture, so that all of its parameters are constant reflectances."""
    keys = list(mi.traverse(bsdf).keys())
    return bool(keys) and all(key.split(".")[-2:] == ["reflectance", "value"] for key in keys)


def even_part(phase: mi.PhaseFunction) -> float:
    """ρ of a phase function: 4π times its least value; 0 if that is below ``_LEAST_EVEN`` or not known."""
    name, ρ = phase.class_name(), 0.0
    if name == "IsotropicPhaseFunction":
        ρ = 1.0
    elif name == "RayleighPhaseFunction":
        ρ = 0.75
    elif name == "HGPhaseFunction":
        # g is read as an element: a conversion to NumPy would evaluate the variable, and kernels could no longer be
        # recorded.
        g = abs(float(mi.traverse(phase)["g"][0]))
        ρ = (1 - g) / (1 + g) ** 2
    return ρ if ρ >= _LEAST_EVEN else 0.0


def matt_lobe(x: mi.SurfaceInteraction3f, place: Place | None, wo: mi.Vector3f) -> mi.Float:
    """On a surface, f cos θ of a matt surface of reflectance 1, on the side of ``wi``. In a medium, 1 / 4π."""
    cosine = dr.maximum(dr.mulsign(wo.z, x.wi.z), 0) * dr.inv_pi
    return cosine if place is None else dr.select(place.scatters, dr.inv_four_pi, cosine)


def along_lobe(x: mi.SurfaceInteraction3f, place: Place | None, u: mi.Point2f) -> mi.Vector3f:
    """A direction sampled with the density ``matt_lobe``."""
    wo = mi.warp.square_to_cosine_hemisphere(u)
    wo.z *= dr.mulsign(mi.Float(1), x.wi.z)
    return wo if place is None else dr.select(place.scatters, mi.warp.square_to_uniform_sphere(u), wo)


def evaluate_and_sample(
    bsdf: mi.BSDFPtr,
    x: mi.SurfaceInteraction3f,
    place: Place | None,
    wo: mi.Vector3f,
    u: tuple[mi.Float, mi.Point2f],
    both: mi.Bool,
) -> tuple[mi.Spectrum, mi.Float, mi.BSDFSample3f, mi.Spectrum]:
    """As ``data_gen.paths.media.evaluate_and_sample``, but with two ways of sampling in the lanes of ``both``.

    In these lanes, half of the directions are sampled with the density ``matt_lobe``, and the other half by the
    material or phase function. Each density is the mean of these two densities. ``u`` are the random numbers for the
    lobe and for the direction.
    """
    u_lobe, u_direction = u
    by_lobe = both & (u_lobe < 0.5)
    u_lobe = dr.select(both, 2 * u_lobe - dr.select(by_lobe, mi.Float(0), 1), u_lobe)
    f, p, sample, f_p = media.evaluate_and_sample(bsdf, x, place, wo, u_lobe, u_direction)
    p = dr.select(both, 0.5 * (p + matt_lobe(x, place, wo)), p)

    own = along_lobe(x, place, u_direction)
    f_own, p_own = media.evaluate_vertex(bsdf, x, place, own, by_lobe)
    sample.wo = dr.select(by_lobe, own, sample.wo)
    sample.eta = dr.select(by_lobe, 1, sample.eta)
    sample.sampled_type = dr.select(by_lobe, mi.UInt32(+mi.BSDFFlags.DiffuseReflection), sample.sampled_type)
    p_material = dr.select(by_lobe, p_own, sample.pdf)
    smooth = event_kind(sample.sampled_type) == SMOOTH
    together = 0.5 * (p_material + dr.select(smooth, matt_lobe(x, place, sample.wo), 0))
    scattered = dr.select(by_lobe, f_own, f_p * p_material)
    f_p = dr.select(both, scattered * dr.rcp(dr.maximum(together, 1e-20)), f_p)
    sample.pdf = dr.select(both, together, sample.pdf)
    return f, p, sample, f_p
