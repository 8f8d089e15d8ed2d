"""Mitsuba's integrators: their names, and the integrators that our samplers follow instead of others."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import drjit as dr
import mitsuba as mi

from ngpt.errors import NgptError, stop_if_interrupted

# Class name -> plugin name, since a loaded integrator does not know its plugin
_PLUGINS = {
    "PathIntegrator": "path",
    "VolumetricPathIntegrator": "volpath",
    "VolpathMisIntegratorImpl": "volpathmis",
    "DirectIntegrator": "direct",
    "DepthIntegrator": "depth",
    "AOVIntegrator": "aov",
    "MomentIntegrator": "moment",
    "StokesIntegrator": "stokes",
    "ParticleTracerIntegrator": "ptracer",
    "PRBIntegrator": "prb",
    "BasicPRBIntegrator": "prb_basic",
    "PathProjectiveIntegrator": "prb_projective",
    "DirectProjectiveIntegrator": "direct_projective",
    "PRBVolpathIntegrator": "prbvolpath",
    "BasicVolumetricPrimitiveRadianceFieldIntegrator": "volprim_rf_basic",
}
# Plugin -> the integrator with the same image, and the one with the same image if emitters are hidden from the camera.
# The second is "" for Mitsuba's projective integrators, which treat hidden emitters differently.
_SAME = {
    "prb": ("path", "path"),
    "prb_basic": ("path", "path"),
    "prb_projective": ("path", ""),
    "direct_projective": ("path", ""),
    "prbvolpath": ("volpath", "volpath"),
}
# Integrators that trace no paths from the camera
_FROM_LAMPS = ("ptracer",)
# Integrators that add channels to the colour of another one; a stack has no use for these channels
AROUND = ("aov", "moment", "stokes")


def plugin_name(integrator: mi.Integrator) -> str:
    """The plugin name of an integrator, or its class name if it is not one of Mitsuba's."""
    name = integrator.class_name()
    if name not in _PLUGINS:  # An integrator in Python gives the name of its base class in Mitsuba.
        name = type(integrator).__name__
    return _PLUGINS.get(name, name)


def same_image(plugin: str, hides: bool) -> str:
    """The plugin that our samplers follow instead of ``plugin``, with the same image, or ``plugin`` itself.

    ``hides``: emitters are hidden from the camera.
    """
    return _SAME.get(plugin, ("", ""))[hides] or plugin


def followed(integrator: mi.Integrator) -> mi.Integrator:
    """The integrator whose image is rendered instead of this one: the one inside an ``aov``, ``moment`` or ``stokes``,
    one with the same image and depths, or this one itself."""
    name = plugin_name(integrator)
    if name in AROUND and len(nested := objects_in(integrator, mi.Integrator)) == 1:
        return followed(nested[0])
    hides = bool(getattr(integrator, "hide_emitters", False))
    same = same_image(name, hides)
    if same == name:
        return integrator
    depth = integrator.max_depth
    depths = {"max_depth": -1 if depth >= 0x7FFFFFFF else depth, "rr_depth": integrator.rr_depth}
    return mi.load_dict({"type": same, "hide_emitters": hides, **depths})


def objects_in(thing: mi.Object, kind: type) -> list:
    """The direct children of an object that are of a ``kind``, such as the materials of a mask."""

    # The class must refer only to its arguments, since its reference cycles would keep other objects and their scene
    # alive.
    class Inside(mi.TraversalCallback):
        def __init__(self, kind: type):
            super().__init__()
            self.kind = kind
            self.found: list = []

        def put(self, name, value, *_):
            if isinstance(value, self.kind):
                self.found.append(value)

    inside = Inside(kind)
    thing.traverse(inside)
    return inside.found


def lack(plugin: str, nested: int, from_camera: bool = True) -> str:
    """Why an integrator cannot render an image for a stack, or "". It has ``nested`` other integrators in it.

    ``from_camera``: whether it seems to trace paths from the camera. Integrators in ``_FROM_LAMPS`` do not.
    """
    if not from_camera or plugin in _FROM_LAMPS:
        return (
            f"integrator '{plugin}' does not trace paths from the camera, so it has no gradients; "
            "give the scene a 'path' or 'volpath' integrator"
        )
    if plugin in AROUND and not nested:
        return f"integrator '{plugin}' has no other in it, so it renders no colour; put a 'path' or 'volpath' into it"
    return ""


def check_integrator(integrator: mi.Integrator) -> None:
    """Raises NgptError for an integrator that does not compute radiance along a camera ray."""
    from_camera = isinstance(integrator, mi.SamplingIntegrator)
    if reason := lack(plugin_name(integrator), len(objects_in(integrator, mi.Integrator)), from_camera):
        raise NgptError(reason)


def own_estimate(scene: mi.Scene, integrator: mi.SamplingIntegrator) -> Callable[..., mi.Spectrum]:
    """A function (sampler, ray, medium, active) -> the integrator's own estimate of radiance along camera rays.

    The function raises NgptError if the integrator fails.
    """
    call: Callable[..., Any] = partial(integrator.sample, scene)
    if isinstance(integrator, mi.CppADIntegrator):
        # The arguments of the call in ``mi.ad.integrators.common.ADIntegrator.render``
        constant = {"mode": dr.ADMode.Primal, "scene": scene, "δL": None, "δaovs": None, "state_in": None}

        def call_as_render_does(sampler, ray, medium, active):
            with dr.suspend_grad():
                return integrator.sample(sampler=sampler, ray=ray, depth=mi.UInt32(0), active=active, **constant)

        call = call_as_render_does

    def estimate(sampler, ray, medium, active) -> mi.Spectrum:
        try:
            return call(sampler, ray, medium, active)[0]
        except Exception as error:
            stop_if_interrupted(error)
            why = " ".join(str(error).split())
            raise NgptError(
                f"integrator '{plugin_name(integrator)}' fails to estimate radiance ({type(error).__name__}: {why}); "
                "give the scene a 'path' or 'volpath' integrator"
            ) from error

    return estimate
