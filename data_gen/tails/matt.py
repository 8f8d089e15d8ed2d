"""Which materials may end a path in the cache: those whose light is nearly the same in all directions."""

from __future__ import annotations

import re

import drjit as dr
import mitsuba as mi
import numpy as np

from data_gen.paths.vertex import ByMaterial, materials_of, smallest_roughness
from data_gen.tails.cache import FINENESS

# Gloss that is rougher than this passes for matt beside a diffuse part, where cells are coarsest: its α.
ROUGH = 0.15
# What is added to the diffuse reflectance of materials with gloss: what they scatter beside it
_GLOSS = 0.05
# The largest share of metal in a principled material
_MOST_METAL = 0.5
_METAL = re.compile(r"(?:^|\.)metallic(?:\.value|\.data)?$")


class Matt:
    """A table of a scene's materials, by Dr.Jit's number of each.

    A material is *matt* that has a diffuse part, and beside it nothing but gloss of a roughness above ``ROUGH``. Clear
    plastic is not: what its mirror shows is another thing in each direction, and cached as if it were matt it was the
    worst bias of all. Nor are masks and holes, and what is inside shape groups, which cannot be listed.
    """

    def __init__(self, scene: mi.Scene):
        bsdfs = materials_of(scene)
        # Below 0: not matt
        table = np.full(max(bsdfs, default=0) + 1, -1.0, np.float32)
        for number, bsdf in bsdfs.items():
            if is_matt(bsdf):
                table[number] = smallest_roughness(bsdf) if mi.has_flag(bsdf.flags(), mi.BSDFFlags.Glossy) else 0
        self.any = bool((table >= 0).any())
        self.α = ByMaterial(mi.Float(table))

    def at(self, x: mi.SurfaceInteraction3f, fineness: mi.Float, active: mi.Bool) -> tuple[mi.Bool, mi.Bool]:
        """Whether the vertices are of such a material, and whether it has gloss that counts at that ``fineness``.

        More gloss counts the finer the cells are, in the end all of it: so its bias vanishes too.
        """
        listed, α = self.α.of(x.bsdf(), active)
        return listed & (α >= 0), listed & (α > 0) & (α < ROUGH * dr.square(fineness / FINENESS))

    def reflectance(self, x: mi.SurfaceInteraction3f, active: mi.Bool) -> mi.Color3f:
        """What light is divided by in the cache, and multiplied with where it is read: above 0, textured."""
        bsdf = x.bsdf()
        rho = mi.Color3f(mi.unpolarized_spectrum(bsdf.eval_diffuse_reflectance(x, active)))
        return dr.clip(rho + dr.select(self.α.of(bsdf, active)[1] > 0, _GLOSS, 0), 1e-3, 1)


def is_matt(bsdf: mi.BSDF) -> bool:
    """Whether a material is matt, see ``Matt``; textures count with their glossiest or most metallic texel."""
    flags = bsdf.flags()
    if any(mi.has_flag(flags, f) for f in (mi.BSDFFlags.Delta, mi.BSDFFlags.Null, mi.BSDFFlags.Transmission)):
        return False
    if not mi.has_flag(flags, mi.BSDFFlags.DiffuseReflection) or smallest_roughness(bsdf) <= ROUGH:
        return False
    params = mi.traverse(bsdf)
    metal = (np.array(params[key]) for key in params.keys() if _METAL.search(key))  # noqa: SIM118 - not a dict
    return all(float(np.max(each)) < _MOST_METAL for each in metal)
