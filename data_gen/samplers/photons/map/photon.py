"""A photon where it is gathered: what it is, who is near to it, and what light it brings there."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from data_gen.samplers.bdpt.vertex import RADIANCE, context

# Photons on surfaces that face another way, by more than about 45 degrees, belong to another surface.
NORMAL_COSINE = 0.7


@dataclass
class Photon:
    """A photon, or a copy of one: where it is, from where it came along ``d``, and the power Φ it brings."""

    p: mi.Point3f
    n: mi.Normal3f
    d: mi.Vector3f
    Φ: mi.Spectrum
    place: mi.UInt32 | None = None  # in the map; None of a copy, here and below
    depth: mi.UInt32 | None = None  # edges from the light
    medium: mi.MediumPtr | None = None  # around it; None in scenes without media, too
    channel: mi.UInt32 | None = None  # the colour of its light path


def is_near(photon: Photon, x: mi.SurfaceInteraction3f, radius2: mi.Float) -> mi.Bool:
    """Whether a photon is gathered at ``x``."""
    return (dr.squared_norm(photon.p - x.p) < radius2) & faces(photon, x)


def faces(photon: Photon, x: mi.SurfaceInteraction3f) -> mi.Bool:
    """Whether a photon lies on a surface that faces the same way as the surface at ``x``."""
    return dr.dot(photon.n, x.n) > NORMAL_COSINE


def light(photon: Photon, x: mi.SurfaceInteraction3f, bsdf: mi.BSDFPtr, active) -> mi.Spectrum:
    """f Φ, what a photon adds to radiance at ``x``, of material ``bsdf``; the kernel is not in it."""
    f = bsdf.eval(context(RADIANCE), x, x.to_local(-photon.d), active)
    # f has a cosine; the photons lie as densely as the geometric one is large.
    L = f * photon.Φ / dr.abs(dr.dot(photon.n, photon.d))
    return dr.select(active & dr.isfinite(dr.sum(L)), L, 0)


def photon_of(photons, j: mi.UInt32, active=True) -> Photon:
    """The photon of that place in the map."""

    def its(name: str):
        value = getattr(photons, name)
        return dr.gather(type(value), value, j, active)

    of_media = (its("medium"), its("channel")) if hasattr(photons, "medium") else (None, None)
    return Photon(its("p"), its("n"), its("d"), its("β"), j, its("depth"), *of_media)
