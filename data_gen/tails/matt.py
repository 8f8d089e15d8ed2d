"""Which materials let a path end in the cache, and the share of arriving light that they scatter like a matt surface.

The cache knows the light that *arrives* at a surface, weighted by the cosine: its irradiance over π. Every material
with a diffuse part scatters some of that light as a matt surface of reflectance ρ would,

    f cos θ = ρ cos θ / π + rest.

The path ends for the first term and goes on for the rest: gloss, metal, mirrors, what goes through, and what bumps and
Fresnel's law change about the diffuse part. Any ρ gives the right mean, and the closer it comes to the material, the
less is left to go on for. No light is divided by ρ, which may be 0.
"""

from __future__ import annotations

import re

import drjit as dr
import mitsuba as mi
import numpy as np

from data_gen.paths import media
from data_gen.paths.vertex import SMOOTH, ByMaterial, consistent, evaluate, event_kind, materials_of

# The tangent of the angle between the normal and the direction that ρ is read off: as far from a mirror direction as
# from the horizon
_TILT = 1.0
# Flags of all other lobes
_ELSE = ("Delta", "Delta1D", "Null", "Glossy", "DiffuseTransmission")
# Materials that disturb the normal of the material inside
_BUMPS = re.compile("(Bump|Normal)Map")


class Matt:
    """Facts about a scene's materials that the cache needs."""

    def __init__(self, scene: mi.Scene):
        bsdfs = materials_of(scene)
        table = np.zeros(max(bsdfs, default=0) + 1, bool)
        table[[number for number, bsdf in bsdfs.items() if is_lambertian(bsdf)]] = True
        # Materials inside shape groups are not listed.
        groups = any(shape.class_name() == "Instance" for shape in scene.shapes())
        self.any = groups or any(mi.has_flag(bsdf.flags(), mi.BSDFFlags.DiffuseReflection) for bsdf in bsdfs.values())
        self.nothing_else = ByMaterial(mi.Bool(table))
        tilted = np.zeros(len(table), bool)
        tilted[[number for number, bsdf in bsdfs.items() if _BUMPS.search(str(bsdf))]] = True
        # Materials inside shape groups may tilt their normals too.
        self.any_tilted = groups or bool(tilted.any())
        self.tilts = ByMaterial(mi.Bool(tilted))
        self.plain = Plain(bsdfs)

    def at(self, x: mi.SurfaceInteraction3f, place: media.Place | None, active: mi.Bool) -> mi.Bool:
        """Whether a vertex is in a medium, or its material has a diffuse part."""
        return active & (media.scatters(place) | mi.has_flag(x.bsdf().flags(), mi.BSDFFlags.DiffuseReflection))

    def lambertian(self, x: mi.SurfaceInteraction3f, place: media.Place | None, active: mi.Bool) -> mi.Bool:
        """Whether a path that ends at the vertex has no rest to go on for: a material of nothing but a diffuse part, or
        a medium that scatters alike in all directions."""
        listed, lambertian = self.nothing_else.of(x.bsdf(), active)
        return (listed & lambertian) | (active & media.scatters(place))

    def tilted(self, x: mi.SurfaceInteraction3f, active: mi.Bool) -> mi.Bool:
        """Whether its diffuse part may be tilted by a bump or normal map, and so miss directions of a matt surface."""
        listed, tilted = self.tilts.of(x.bsdf(), active)
        return active & (~listed | tilted)

    def reflectance(self, x: mi.SurfaceInteraction3f, place: media.Place | None, active: mi.Bool) -> mi.Color3f:
        """ρ in [0, 1]: π times the diffuse lobe's f in a direction on the side of ``wi``; 1 in media, whose albedo
        is in the throughput."""
        inside = media.scatters(place)
        known, ρ = self.plain.of(x, active & ~inside)
        ρ = dr.select(known, ρ, reflectance(x.bsdf(), x, active & ~known & ~inside))
        return dr.select(active & inside, 1, ρ)


class Plain:
    """ρ of the materials that have one for each side: matt ones without a texture. A table is quicker than to ask
    them."""

    def __init__(self, bsdfs: dict[int, mi.BSDF]):
        # By material and side: RGB, and 1 where it is known
        table = np.zeros((max(bsdfs, default=0) + 1, 2, 4), np.float32)
        x = dr.zeros(mi.SurfaceInteraction3f, 2)
        x.wi = mi.Vector3f(0, 0, mi.Float([1, -1]))
        for number, bsdf in bsdfs.items():
            if is_lambertian(bsdf) and is_constant(bsdf):
                table[number, :, :3] = np.array(reflectance(bsdf, x, mi.Bool(True))).T
                table[number, :, 3] = 1
        # Opaque: the numbers may be others in each process, and the kernel is to be the same.
        self.size, self.table = dr.opaque(mi.UInt32, len(table)), mi.Float(table.ravel())
        dr.eval(self.table)

    def of(self, x: mi.SurfaceInteraction3f, active: mi.Bool) -> tuple[mi.Bool, mi.Color3f]:
        number = dr.reinterpret_array(mi.UInt32, x.bsdf())
        row = 2 * number + dr.select(x.wi.z < 0, mi.UInt32(1), 0)
        v = dr.gather(mi.Vector4f, self.table, row, active & (number < self.size))
        return v.w > 0, mi.Color3f(v.x, v.y, v.z)


def reflectance(bsdf: mi.BSDF | mi.BSDFPtr, x: mi.SurfaceInteraction3f, active: mi.Bool) -> mi.Color3f:
    """ρ by the material itself: π times f of its diffuse lobe, see ``Matt.reflectance``."""
    context = mi.BSDFContext()
    # Materials of several lobes leave out the other lobes, except ``principled``.
    context.type_mask = mi.BSDFFlags.DiffuseReflection
    along = mi.Vector2f(x.wi.x, x.wi.y)
    across = dr.rsqrt(dr.maximum(dr.squared_norm(along), 1e-12)) * along
    wo = dr.normalize(mi.Vector3f(_TILT * across.x, _TILT * across.y, dr.mulsign(mi.Float(1), x.wi.z)))
    f = mi.Color3f(mi.unpolarized_spectrum(bsdf.eval(context, x, wo, active)))
    ρ = f * (dr.pi / dr.abs(wo.z))
    return dr.select(active & dr.isfinite(dr.sum(ρ)), dr.clip(ρ, 0, 1), 0)


def is_lambertian(bsdf: mi.BSDF) -> bool:
    """Whether a material scatters as a matt surface, on one side or on both, and not otherwise."""
    flags = bsdf.flags()
    more = any(mi.has_flag(flags, getattr(mi.BSDFFlags, name)) for name in _ELSE)
    known = bsdf.class_name() in ("SmoothDiffuse", "TwoSidedBRDF") and not _BUMPS.search(str(bsdf))
    return known and mi.has_flag(flags, mi.BSDFFlags.DiffuseReflection) and not more


def is_constant(bsdf: mi.BSDF) -> bool:
    """Whether a matt material has no texture: its only parameter is a reflectance."""
    keys = list(mi.traverse(bsdf).keys())
    return bool(keys) and all(key.split(".")[-2:] == ["reflectance", "value"] for key in keys)


def matt_lobe(x: mi.SurfaceInteraction3f, wo: mi.Vector3f) -> mi.Float:
    """f cos θ of a matt surface of reflectance 1, on the side that the path has come to."""
    return dr.maximum(dr.mulsign(wo.z, x.wi.z), 0) * dr.inv_pi


def evaluate_and_sample(
    bsdf: mi.BSDFPtr,
    x: mi.SurfaceInteraction3f,
    place: media.Place | None,
    wo: mi.Vector3f,
    u_lobe: mi.Float,
    u_direction: mi.Point2f,
    both: mi.Bool,
) -> tuple[mi.Spectrum, mi.Float, mi.BSDFSample3f, mi.Spectrum]:
    """As ``data_gen.paths.media.evaluate_and_sample``, but half of the directions of ``both`` lanes come by the cosine,
    as at a matt surface. Each density is the mean of both ways."""
    by_cosine, u_phase = both & (u_lobe < 0.5), mi.Float(u_lobe)
    u_lobe = dr.select(both, 2 * u_lobe - dr.select(by_cosine, mi.Float(0), 1), u_lobe)
    f, p, sample, f_p = bsdf.eval_pdf_sample(mi.BSDFContext(), x, wo, u_lobe, u_direction)
    sample = consistent(bsdf, x, sample, f_p)
    p = dr.select(both, 0.5 * (p + matt_lobe(x, wo)), p)

    own = mi.warp.square_to_cosine_hemisphere(u_direction)
    own.z *= dr.mulsign(mi.Float(1), x.wi.z)
    f_own, p_own = evaluate(bsdf, x, own, by_cosine)
    sample.wo = dr.select(by_cosine, own, sample.wo)
    sample.eta = dr.select(by_cosine, 1, sample.eta)
    sample.sampled_type = dr.select(by_cosine, mi.UInt32(+mi.BSDFFlags.DiffuseReflection), sample.sampled_type)
    p_material = dr.select(by_cosine, p_own, sample.pdf)
    smooth = event_kind(sample.sampled_type) == SMOOTH
    together = 0.5 * (p_material + dr.select(smooth, matt_lobe(x, sample.wo), 0))
    scattered = dr.select(by_cosine, f_own, f_p * p_material)
    f_p = dr.select(both, scattered * dr.rcp(dr.maximum(together, 1e-20)), f_p)
    sample.pdf = dr.select(both, together, sample.pdf)
    if place is None:
        return f, p, sample, f_p
    phase = place.medium.phase_function()
    inside = media.in_medium(x, place)
    f_phase, p_phase = phase.eval_pdf(mi.PhaseFunctionContext(), inside, wo, place.scatters)
    f, p = dr.select(place.scatters, f_phase, f), dr.select(place.scatters, p_phase, p)
    return f, p, *media.scattered(x, place, u_phase, u_direction, sample, f_p)
