"""Path vertices: whether a shifted path may connect to them, and what kind of event scatters light there."""

from __future__ import annotations

import re
from collections.abc import Callable

import drjit as dr
import mitsuba as mi
import numpy as np

# Kinds of scattering events. Only after a smooth event could another path have taken the same direction. An event that
# found no direction counts as DELTA.
SMOOTH, DELTA, NULL = 0, 1, 2

# Parameters that hold a microfacet roughness, as mi.traverse() spells them: constants and textures, at any nesting.
_ROUGHNESS = re.compile(r"(?:^|\.)(alpha|alpha_u|alpha_v|roughness)(?:\.value|\.data)?$")


class Materials:
    """Which materials of a scene scatter so widely that paths may be connected at them.

    A vertex is *connectable* if its material has a component without a Dirac delta, and the smallest roughness of all
    such components exceeds ``threshold``. This includes materials that also have a mirror component (``plastic``),
    although the shift is rejected when the mirror is sampled at the shared vertex. Connectability depends only on the
    material, so a path and its shifted copy agree on it, which keeps the shift invertible. The smallest texel of a
    textured roughness counts. Materials without a roughness parameter (``diffuse``, ``measured``) count as rough.

    Shapes for which ``passed`` is true have no vertices and are ignored. With ``media`` in the scene, rough glass is
    never connectable, because few paths find light that leaves a medium through it, see docs/samplers/media.md.

    ``unconnectable`` lists the materials, as "shape.material (class)", at which a vertex is not connectable or an event
    may not be smooth. ``all_connectable`` is True if there are none.
    """

    def __init__(
        self,
        scene: mi.Scene,
        threshold: float,
        passed: Callable[[mi.Shape], bool] = lambda shape: False,
        media: bool = False,
    ):
        shapes = [shape for shape in scene.shapes() if not passed(shape)]
        # Dr.Jit's number of each material -> one of its shapes
        users = {dr_number(mi.BSDFPtr(shape.bsdf())): shape for shape in shapes if shape.bsdf() is not None}
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
        # Materials inside shape groups cannot be listed. They count as rough, but they may also have sharp components.
        if any(shape.class_name() == "Instance" for shape in shapes):
            self.unconnectable.append("those inside shape groups")
        self.unconnectable.sort()
        self.all_connectable = not self.unconnectable
        self.rough = ByMaterial(mi.Bool(table))

    def connectable(self, bsdf: mi.BSDFPtr) -> mi.Bool:
        """Whether a vertex with this material is connectable. False without a material, as for escaped paths."""
        listed, rough = self.rough.of(bsdf)
        return mi.has_flag(bsdf.flags(), mi.BSDFFlags.Smooth) & (~listed | rough)

    def sharp(self, si: mi.SurfaceInteraction3f, scene: mi.Scene) -> mi.Bool:
        """Whether a path can leave vertex ``si`` only by mirror, glass or sharp gloss, and no emitter is there."""
        bsdf = si.bsdf()
        dark = si.emitter(scene) == None  # noqa: E711 - a comparison of arrays of pointers
        return si.is_valid() & dark & ~self.connectable(bsdf) & ~mi.has_flag(bsdf.flags(), mi.BSDFFlags.Null)


class ByMaterial:
    """A table of values for materials or media, indexed by Dr.Jit's numbers.

    Mitsuba does not list the materials inside shape groups, so they have no value.
    """

    def __init__(self, values: mi.Bool | mi.Float):
        # Opaque: the numbers may differ between processes, and the kernel should not.
        self.size, self.values = dr.opaque(mi.UInt32, dr.width(values)), values
        dr.eval(self.values)

    def of(self, bsdf: mi.BSDFPtr | mi.MediumPtr, active: mi.Bool | bool = True) -> tuple[mi.Bool, mi.Bool | mi.Float]:
        """Whether each material is ``active`` and has a value, and the value, or 0."""
        number = dr.reinterpret_array(mi.UInt32, bsdf)
        listed = active & (number < self.size)
        return listed, dr.gather(type(self.values), self.values, number, listed)


def materials_of(scene: mi.Scene) -> dict[int, mi.BSDF]:
    """The materials of a scene's shapes by Dr.Jit's number of each."""
    return {dr_number(mi.BSDFPtr(shape.bsdf())): shape.bsdf() for shape in scene.shapes() if shape.bsdf() is not None}


def dr_number(pointer: mi.BSDFPtr | mi.MediumPtr | mi.ShapePtr) -> int:
    """The number of one object in Dr.Jit's arrays of pointers."""
    return int(dr.reinterpret_array(mi.UInt32, pointer)[0])


def smallest_roughness(bsdf: mi.BSDF) -> float:
    """The smallest microfacet roughness (Beckmann or GGX α) among all parameters of a material, 1 if it has none."""
    roughness = 1.0
    params = mi.traverse(bsdf)
    for key in params.keys():  # noqa: SIM118 - not a dict: iterating it yields pairs
        match = _ROUGHNESS.search(key)
        if match:
            value = float(np.min(np.array(params[key])))
            # ``roughness`` of the principled materials is perceptual: α is its square.
            roughness = min(roughness, value**2 if match[1] == "roughness" else value)
    return roughness


def event_kind(sampled_type: mi.UInt32) -> mi.UInt32:
    """SMOOTH, DELTA or NULL, given the ``sampled_type`` of a BSDF sample."""
    null = mi.has_flag(sampled_type, mi.BSDFFlags.Null)
    delta = mi.has_flag(sampled_type, mi.BSDFFlags.Delta)
    return dr.select(null, mi.UInt32(NULL), dr.select(delta, mi.UInt32(DELTA), mi.UInt32(SMOOTH)))


def seen_from(si: mi.SurfaceInteraction3f, direction: mi.Vector3f) -> mi.SurfaceInteraction3f:
    """Vertex ``si`` as if it had been reached along ``direction`` (world space). Escaped paths keep their direction."""
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
    """The BSDF ``sample``, with density 0 where ``evaluate`` gives density 0 for the sampled direction.

    Diffuse materials seen from behind, and rough metal below its horizon, sample directions with a density above 0 and
    f / p = 0, while ``evaluate`` gives the density 0. A shift would use the 0 for the offset path and the sampled
    density for the base path, so the weights of the pair would add up to more than 1.
    """
    asked = active & (event_kind(sample.sampled_type) == SMOOTH) & (sample.pdf > 0) & (dr.max(f_p) == 0)
    _, p = evaluate(bsdf, si, sample.wo, asked)
    sample.pdf = dr.select(asked & (p == 0), 0, sample.pdf)
    return sample


def evaluate(
    bsdf: mi.BSDFPtr, si: mi.SurfaceInteraction3f, wo: mi.Vector3f, active: bool | mi.Bool = True
) -> tuple[mi.Spectrum, mi.Float]:
    """f cos θ of a material and the density of sampling ``wo``, also for directions that its sampling cannot return.

    Such directions may lie below the horizon, where some materials (``roughplastic``) return NaN. Both values are 0
    then.
    """
    f, p = bsdf.eval_pdf(mi.BSDFContext(), si, wo, active)
    good = dr.isfinite(p) & dr.isfinite(dr.sum(f))
    return dr.select(good, f, 0), dr.select(good, p, 0)
