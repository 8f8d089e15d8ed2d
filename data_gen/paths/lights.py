"""Emitters seen from path vertices, and how a shifted path reuses the emitter samples of its base path."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import drjit as dr
import mitsuba as mi

from data_gen.paths.bent import BentLamps, sample_emitter
from data_gen.paths.camera import QUARTERS, CameraSamples
from data_gen.scenes.lamp_mesh import is_area
from data_gen.scenes.lamps import Chosen, Places
from data_gen.scenes.load import path_depths

# Shapes that Mitsuba samples uniformly by area, besides meshes; for spheres it samples the visible part.
_UNIFORM_SHAPES = ("Rectangle", "Disk", "Cylinder")
# The fields of an interaction that emission depends on. With thousands of shapes, computing all fields would take twice
# as long to record.
_EMISSION = mi.RayFlags.UV | mi.RayFlags.ShadingFrame


class Lights:
    """The emitters of a scene, and whether equal random numbers sample the same point or direction from everywhere.

    Equal random numbers do so for emitters that are infinitely far away, and for area lights on shapes that are sampled
    uniformly. Replaying the sample at another vertex changes only the solid angle, so such emitters need not be sampled
    again. ``shared`` is True if all emitters of the scene are of these kinds. ``near`` and ``far`` say whether there
    are emitters at finite and at infinite distance. ``places`` chooses lamps by place; None means that the scene's own
    probabilities hold everywhere. ``bent`` are the lamps that Mitsuba samples with a wrong density, or None. A bent
    lamp does not shine to all vertices in front of its faces, so scenes with bent lamps are not shared.
    """

    def __init__(self, scene: mi.Scene, places: Places | None = None):
        lamps = [shape for shape in scene.shapes() if shape.is_emitter()]
        far = [mi.has_flag(emitter.flags(), mi.EmitterFlags.Infinite) for emitter in scene.emitters()]
        lamps = [shape for shape in lamps if is_area(shape.emitter())]
        uniform = [shape.is_mesh() or shape.class_name() in _UNIFORM_SHAPES for shape in lamps]
        self.near, self.far = not all(far), any(far)
        # Emitters that are neither infinitely far away nor on a shape (point lights) are not counted as uniform.
        self.bent = BentLamps.of(scene)
        self.shared = not self.bent and sum(uniform) + sum(far) == len(scene.emitters())
        self.places = places

    def sample(self, scene, x: mi.SurfaceInteraction3f, u: mi.Point2f, active: mi.Bool) -> tuple:
        """A direction sample, its Le / p, and the chosen lamp, which is None if lamps are not chosen by place.

        The sample and Le / p are as from ``scene.sample_emitter_direction(x, u, False, active)``.
        """
        if not self.places:
            return *self.anywhere(scene, x, u, active), None
        chosen = self.places.choose(x, u)
        return *self.at(x, chosen, active), chosen

    def anywhere(self, scene, x: mi.SurfaceInteraction3f, u: mi.Point2f, active: mi.Bool) -> tuple:
        """A direction sample and Le / p. Lamps are chosen with the scene's own probabilities."""
        return sample_emitter(scene, self.bent, x, u, active)[:2]

    def seen(self, scene, x: mi.SurfaceInteraction3f, u: mi.Point2f, active: mi.Bool) -> tuple:
        """As ``anywhere()``, but with Le V / p, where V is the visibility of the sampled point."""
        if not self.bent:
            return scene.sample_emitter_direction(x, u, True, active)
        light, weight = self.anywhere(scene, x, u, active)
        return light, dr.select(scene.ray_test(x.spawn_ray_to(light.p), active & (light.pdf > 0)), 0, weight)

    def at(self, x: mi.SurfaceInteraction3f, chosen: Chosen, active: mi.Bool) -> tuple:
        """A direction sample and Le / p for the lamp that was ``chosen`` by place."""
        return self.bent.sample(x, chosen, active)[:2] if self.bent else self.places.sample(x, chosen, active)


@dataclass
class LightSample:
    """An emitter in direction ``d``, found with density ``p`` in solid angle; ``weight`` = Le / p, or Le V / p."""

    d: mi.Vector3f
    p: mi.Float
    delta: mi.Bool
    weight: mi.Spectrum
    target: mi.Point3f  # where a shadow ray ends


def sample_light(
    scene: mi.Scene, si: mi.SurfaceInteraction3f, u: mi.Point2f, active: mi.Bool, lights: Lights | None = None
) -> LightSample:
    """Emitter sampling at a vertex. The weight is Le V / p, or Le / p without occlusion if ``lights`` are given."""
    if lights:
        return _sampled(*lights.anywhere(scene, si, u, active), active)
    return _sampled(*scene.sample_emitter_direction(si, u, True, active), active)


def _sampled(light: mi.DirectionSample3f, weight: mi.Spectrum, active: mi.Bool) -> LightSample:
    return LightSample(light.d, light.pdf, light.delta, dr.select(active & (light.pdf != 0), weight, 0), light.p)


def shadowed(scene: mi.Scene, si: mi.SurfaceInteraction3f, light: LightSample, f: mi.Spectrum) -> mi.Spectrum:
    """f Le V / p of a ``light`` sample whose weight is Le / p. A shadow ray is traced only where f Le / p > 0."""
    lit = f * light.weight
    return dr.select(scene.ray_test(si.spawn_ray_to(light.target), dr.max(lit) > 0), 0, lit)


def replay_light(
    scene, lights: Lights, base, base_weight, u, y: mi.SurfaceInteraction3f, *, lit: mi.Bool
) -> LightSample:
    """``sample_light(scene, y, u, lit, lights)``, from the sample ``base`` that ``u`` gave at another vertex."""
    return _replayed(lights, base, base_weight, y, lit, lambda anew: sample_light(scene, y, u, anew, lights))


def replay_lamp(
    lights: Lights, base, base_weight, chosen: Chosen, x, y: mi.SurfaceInteraction3f, *, lit: mi.Bool
) -> tuple[LightSample, mi.Float]:
    """Replays at ``y`` the sample of a lamp that vertex ``x`` has ``chosen`` by place: the same point of that lamp.

    P is the probability of choosing the lamp. ``p`` of the result includes P(y), its ``weight`` includes P(x). The
    second value is the ratio P(y) / P(x), a factor of r.
    """
    sample = _replayed(lights, base, base_weight, y, lit, lambda anew: _sampled(*lights.at(y, chosen, anew), anew))
    ratio = lights.places.probability(y, chosen.lamp) / chosen.p
    # A base path that has ended has no vertex x and takes no part in the reverse shift: the MIS weight is 1/2.
    return replace(sample, p=sample.p * ratio), dr.select(x.is_valid(), ratio, 1)


def _replayed(lights: Lights, base, base_weight, y: mi.SurfaceInteraction3f, lit: mi.Bool, sample) -> LightSample:
    """The direction sample ``base`` seen from ``y``. Where it cannot be reused, ``sample`` (active) samples again."""
    if not lights.shared:
        return sample(lit)
    far = mi.Bool(lights.far)
    if lights.far and lights.near:
        far = mi.has_flag(base.emitter.flags(), mi.EmitterFlags.Infinite)
    to = mi.Vector3f(base.p - y.p)
    distance2 = dr.squared_norm(to)
    d = dr.select(far, base.d, to * dr.rsqrt(distance2))
    ratio = dr.dot(base.n, d) / dr.dot(base.n, base.d)
    # dω'/dω from either vertex to the point on the emitter
    J = dr.select(far, 1, dr.abs(ratio) * dr.square(base.dist) / distance2)
    # The other side of an emitter may emit differently.
    shared = (base.pdf > 0) & (far | (ratio > 0)) & dr.isfinite(J) & (J > 0)
    anew, shared = lit & ~shared, lit & shared
    p, weight = dr.select(shared, base.pdf / J, 0), dr.select(shared, base_weight * J, mi.Spectrum(0))
    known = LightSample(d, p, base.delta, weight, dr.select(far, y.p + d * base.dist, base.p))
    return dr.if_stmt((known,), anew, lambda _: sample(anew), lambda known: known)


def emission(
    scene, si: mi.SurfaceInteraction3f, ref: mi.SurfaceInteraction3f, active, sampled, lights: Lights | None = None
) -> tuple:
    """Le at ``si`` toward ``ref`` where ``active``, and the density of emitter sampling where ``sampled``. If
    ``lights`` are given, they compute the density. Otherwise Mitsuba does."""
    light, places = mi.DirectionSample3f(scene, si, ref), lights and lights.places
    p = places.density(ref, light, sampled) if places else scene.pdf_emitter_direction(ref, light, sampled)
    if lights and lights.bent:
        choice = partial(places.probability, ref) if places else scene.pdf_emitter
        p, _ = lights.bent.corrected(p, light, si, choice, sampled)
    return light.emitter.eval(si, active), p


def shared_emission(scene, lights: Lights, x1, Le, p, *, x, y, y1, J) -> tuple[mi.Spectrum, mi.Float]:
    """``emission(scene, y1, y, True, True, lights)``, computed from ``Le`` and ``p`` of ``x1`` as seen from ``x``.

    ``y1`` is ``x1`` with another incident direction; ``J`` is the ratio d'²/d² of the squared distances.
    """
    places = lights.places
    if not lights.shared:
        return emission(scene, y1, y, True, True, lights)
    escapes = ~x1.is_valid()
    ratio = dr.select(escapes, 1, y1.wi.z / x1.wi.z)
    shared = escapes | ((ratio > 0) & dr.isfinite(ratio))
    p1 = dr.select(shared, p * dr.select(escapes, 1, J / dr.abs(ratio)), 0)
    if places:
        lamp = places.index_of(x1.emitter(scene), p1 > 0)
        p1 *= places.probability(y, lamp) / places.probability(x, lamp)
    anew = (x1.emitter(scene) != None) & ~shared  # noqa: E711 - a comparison of arrays of pointers
    return dr.if_stmt((Le, p1), anew, lambda *_: emission(scene, y1, y, anew, anew, lights), lambda *known: known)


def emission_seen(scene, integrator, medium, ray: mi.RayDifferential3f, active) -> mi.Spectrum:
    """The emission at the first surface that a camera ray meets: the layer ``direct``.

    Zero if ``integrator`` hides emitters or has ``max_depth`` 0, and if the camera is in a ``medium``, which would dim
    it.
    """
    if not _shows(integrator) or medium is not None:
        return dr.zeros(mi.Spectrum, dr.width(ray))
    ray = mi.Ray3f(ray)
    hit = scene.ray_intersect_preliminary(ray, coherent=True, active=active)
    # Most rays meet no lamp: nothing else is computed for them.
    lamp = hit.is_valid() & (hit.shape.emitter() != None)  # noqa: E711 - a comparison of arrays of pointers
    shines = active & (lamp | ~hit.is_valid())
    si = hit.compute_surface_interaction(ray, _EMISSION, lamp)
    return si.emitter(scene, shines).eval(si, shines)


def _shows(integrator) -> bool:
    """Whether the image includes emission that the camera sees directly. With ``max_depth`` 0 the image is empty."""
    depth = getattr(integrator, "max_depth", None)
    if depth is None:  # Mitsuba's own integrators only print it
        depth = path_depths(integrator).get("max_depth")
    return not integrator.hide_emitters and depth != 0


def emission_in_pixel(
    scene: mi.Scene, camera: CameraSamples, Le: mi.Spectrum, emission: Callable[[mi.Ray3f], mi.Spectrum]
) -> mi.Spectrum:
    """The layer ``direct``: the mean over four rays, one in each quarter of a pixel. The first of them meets ``Le``.

    Lamps are much brighter than their surroundings. A pixel whose few samples happen to miss the lamp is a black dot,
    which no reconstruction fills, since this light is in no gradient. ``Le`` is weighted by the camera's importance.
    ``emission`` gives the emission that a ray meets, without that weight.
    """
    if not any(visible(emitter) for emitter in scene.emitters()):
        return Le
    seen = [camera.rays(shift)[:2] for shift in QUARTERS]
    return _sum_of([(mi.Ray3f(ray), importance) for ray, importance in seen], Le, emission) / 4


def _sum_of(seen: list[tuple[mi.Ray3f, mi.Spectrum]], Le: mi.Spectrum, emission: Callable) -> mi.Spectrum:
    """The sum of Le and the weighted emission that the rays in ``seen`` meet. The rays are handled in a loop, so that
    ``emission``, a call to all shapes, is recorded only once."""
    kind = type(Le)

    def add(i: mi.UInt32, Le: mi.Spectrum) -> tuple[mi.UInt32, mi.Spectrum]:
        ray, importance = seen[0]
        for number, (other, weight) in enumerate(seen[1:], 1):
            ray, importance = dr.select(i == number, other, ray), dr.select(i == number, weight, importance)
        return i + 1, kind(Le + importance * emission(ray))

    # Without dr.syntax, which would put the rays into the loop's state. State that no round changes makes Dr.Jit record
    # the loop again.
    return dr.while_loop((mi.UInt32(0), Le), lambda i, Le: i < len(seen), add)[1]


def visible(emitter: mi.Emitter) -> bool:
    """Whether a camera ray can meet the emitter: none meets a point or a single direction."""
    return not mi.has_flag(emitter.flags(), mi.EmitterFlags.Delta)
