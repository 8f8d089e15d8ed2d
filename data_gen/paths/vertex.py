"""Path vertices: whether a shifted path may connect to one, and what kind of event scatters light there."""

from __future__ import annotations

import re
from collections.abc import Callable

import drjit as dr
import mitsuba as mi
import numpy as np

# Kinds of scattering events: only after a smooth one can another path have gone the same way. An event that found no
# direction at all counts as DELTA.
SMOOTH, DELTA, NULL = 0, 1, 2

# Parameters that hold a microfacet roughness, as mi.traverse() spells them: constants and textures, at any nesting.
_ROUGHNESS = re.compile(r"(?:^|\.)(alpha|alpha_u|alpha_v|roughness)(?:\.value|\.data)?$")


class Materials:
    """Which materials of a scene scatter so widely that any two directions may be joined at them.

    A vertex is *connectable* if its material has a component without a Dirac delta, and the smallest roughness of all
    such components exceeds ``threshold``. This includes materials that also have a mirror component (``plastic``),
    although the shift is rejected when the mirror is sampled at the shared vertex. Connectability depends only on the
    material, so that a path and its shifted copy agree on it, which keeps the shift invertible. Textured roughness
    counts with its smallest texel; materials with no parameter for it (``diffuse``, ``measured``) count as rough.

    Shapes that are ``passed`` have no vertices, and do not count. With ``media`` in the scene rough glass is not
    connectable, however rough: light that leaves a medium by it is found by few paths, see docs/samplers/media.md.

    ``unconnectable`` lists the materials, as "shape.material (class)", at which a vertex is not connectable or an event
    may be other than smooth; ``all_connectable`` is True where there are none.
    """

    def __init__(
        self,
        scene: mi.Scene,
        threshold: float,
        passed: Callable[[mi.Shape], bool] = lambda shape: False,
        media: bool = False,
    ):
        shapes = [shape for shape in scene.shapes() if not passed(shape)]
        # By Dr.Jit's number of each material, one of the shapes that are made of it
        users = {dr_number(shape.bsdf()): shape for shape in shapes if shape.bsdf() is not None}
        table = np.ones(max(users, default=0) + 1, bool)
        self.unconnectable: list[str] = []
        for number, shape in users.items():
            bsdf = shape.bsdf()
            frosted = media and mi.has_flag(bsdf.flags(), mi.BSDFFlags.GlossyTransmission)
            table[number] = smallest_roughness(bsdf) > threshold and not frosted
            sharp = any(mi.has_flag(bsdf.flags(), flag) for flag in (mi.BSDFFlags.Delta, mi.BSDFFlags.Null))
            if sharp or not (table[number] and mi.has_flag(bsdf.flags(), mi.BSDFFlags.Smooth)):
                name = ".".join(filter(None, (shape.id(), bsdf.id())))
                self.unconnectable.append(f"{name} ({bsdf.class_name()})".strip())
        # Materials inside shape groups are not listed: they count as rough, but what else they do is unknown.
        if any(shape.class_name() == "Instance" for shape in shapes):
            self.unconnectable.append("those inside shape groups")
        self.unconnectable.sort()
        self.all_connectable = not self.unconnectable
        self.rough = ByMaterial(mi.Bool(table))

    def connectable(self, bsdf: mi.BSDFPtr) -> mi.Bool:
        """The classification of a vertex with this material; False where there is none, as for a path that escaped."""
        listed, rough = self.rough.of(bsdf)
        return mi.has_flag(bsdf.flags(), mi.BSDFFlags.Smooth) & (~listed | rough)

    def sharp(self, si: mi.SurfaceInteraction3f, scene: mi.Scene) -> mi.Bool:
        """Whether a path can leave vertex ``si`` only by mirror, glass or sharp gloss, and no emitter is there."""
        bsdf = si.bsdf()
        dark = si.emitter(scene) == None  # noqa: E711 - a comparison of arrays of pointers
        return si.is_valid() & dark & ~self.connectable(bsdf) & ~mi.has_flag(bsdf.flags(), mi.BSDFFlags.Null)


class ByMaterial:
    """Values by Dr.Jit's number of a material.

    Mitsuba does not list the materials inside shape groups, so they have no value.
    """

    def __init__(self, values: mi.Bool | mi.Float):
        # Opaque: the numbers may be others in each process, and the kernel is to be the same.
        self.size, self.values = dr.opaque(mi.UInt32, dr.width(values)), values
        dr.eval(self.values)

    def of(self, bsdf: mi.BSDFPtr, active: mi.Bool | bool = True) -> tuple[mi.Bool, mi.Bool | mi.Float]:
        """Whether each of the ``active`` materials has a value, and the value, else 0."""
        number = dr.reinterpret_array(mi.UInt32, bsdf)
        listed = active & (number < self.size)
        return listed, dr.gather(type(self.values), self.values, number, listed)


def materials_of(scene: mi.Scene) -> dict[int, mi.BSDF]:
    """The materials of a scene's shapes by Dr.Jit's number of each."""
    return {dr_number(shape.bsdf()): shape.bsdf() for shape in scene.shapes() if shape.bsdf() is not None}


def dr_number(bsdf: mi.BSDF) -> int:
    """The number by which Dr.Jit's arrays of pointers know a material."""
    return int(dr.reinterpret_array(mi.UInt32, mi.BSDFPtr(bsdf))[0])


def smallest_roughness(bsdf: mi.BSDF) -> float:
    """The smallest microfacet roughness (Beckmann or GGX α) among all parameters of a material, 1 if it has none."""
    roughness = 1.0
    params = mi.traverse(bsdf)
    for key in params.keys():  # noqa: SIM118 - not a dict: iterating it yields pairs
        match = _ROUGHNESS.search(key)
        if match:
            value = float(np.min(np.array(params[key])))
            # The principled materials' parameter is perceptual: α is its square.
            roughness = min(roughness, value**2 if match[1] == "roughness" else value)
    return roughness


def event_kind(sampled_type: mi.UInt32) -> mi.UInt32:
    """SMOOTH, DELTA or NULL, of the ``sampled_type`` of a BSDF sample."""
    null = mi.has_flag(sampled_type, mi.BSDFFlags.Null)
    delta = mi.has_flag(sampled_type, mi.BSDFFlags.Delta)
    return dr.select(null, mi.UInt32(NULL), dr.select(delta, mi.UInt32(DELTA), mi.UInt32(SMOOTH)))


def seen_from(si: mi.SurfaceInteraction3f, direction: mi.Vector3f) -> mi.SurfaceInteraction3f:
    """Vertex ``si``, but reached along ``direction`` (world space). Escaped paths keep their direction."""
    other = mi.SurfaceInteraction3f(si)
    other.wi = dr.select(si.is_valid(), si.to_local(-direction), si.wi)
    return other


def consistent(
    bsdf: mi.BSDFPtr,
    si: mi.SurfaceInteraction3f,
    sample: mi.BSDFSample3f,
    f_p: mi.Spectrum,
    active: bool | mi.Bool = True,
) -> mi.BSDFSample3f:
    """A BSDF sample, with density 0 where the material evaluates the density of the sampled direction to 0.

    Diffuse materials seen from behind, and rough metal below its horizon, sample directions with a density above 0 and
    f / p = 0, while ``evaluate`` gives the density 0. A shift would use this 0 for the path it leads to, and the
    density of the sample for the path it comes from: the weights of the pair would add up to more than 1.
    """
    asked = active & (event_kind(sample.sampled_type) == SMOOTH) & (sample.pdf > 0) & (dr.max(f_p) == 0)
    _, p = evaluate(bsdf, si, sample.wo, asked)
    sample.pdf = dr.select(asked & (p == 0), 0, sample.pdf)
    return sample


def evaluate(
    bsdf: mi.BSDFPtr, si: mi.SurfaceInteraction3f, wo: mi.Vector3f, active: bool | mi.Bool = True
) -> tuple[mi.Spectrum, mi.Float]:
    """f cos θ of a material and the density of sampling ``wo``, for directions that were not sampled there.

    Such directions may lie below the horizon, where some materials (``roughplastic``) return NaN. Then the value is 0.
    """
    f, p = bsdf.eval_pdf(mi.BSDFContext(), si, wo, active)
    good = dr.isfinite(p) & dr.isfinite(dr.sum(f))
    return dr.select(good, f, 0), dr.select(good, p, 0)
