"""Albedo, normal and depth at the first vertex that is not specular."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from data_gen.paths.spectrum import reflectance_to_rgb
from data_gen.scenes.facts import media_of, shapes_of

# The longest chain of mirrors. Behind a longer chain the features are zero, as for a path that escapes.
MAX_SPECULAR_VERTICES = 32

# Steps of a ray through a medium whose density varies
MEDIUM_STEPS = 8

# Materials that turn the shading frame. Only Mitsuba's `aov` integrator gives the turned normal.
_TURNS_NORMALS = ("BumpMap", "NormalMap")


def features(scene, sensor, sampler, ray: mi.RayDifferential3f) -> dict[str, mi.Color3f | mi.Float]:
    """One sample of every feature layer along a camera ray, in the conventions of the gradient stack.

    ``albedo``  reflectance in [0, 1], tinted by the mirrors and glass on the way; media dim it, and add their own
                albedo in proportion to the light that they remove
    ``normal``  unit shading normal in camera space, +x right, +y up, +z toward the viewer, on the side seen
    ``depth``   path length from the camera, not from its near plane, in world units
    All are zero where the path escapes, except the albedo of media. Normal and depth describe the surface behind media.
    Bump and normal maps change the normal if they are a shape's outermost material. Mitsuba does not expose maps inside
    other materials (``twosided``, ``mask``).
    """
    si, last, depth, reflectance, scattered = first_nonspecular_vertex(
        scene, sampler, ray, *in_media(scene, sensor.get_medium())
    )
    found = si.is_valid()
    normal = si.sh_frame.n
    if any(shape.bsdf() is not None and shape.bsdf().class_name() in _TURNS_NORMALS for shape in shapes_of(scene)):
        aov = mi.load_dict({"type": "aov", "aovs": "normal:sh_normal"})
        normal = mi.Normal3f(aov.sample(scene, sampler.clone(), mi.RayDifferential3f(last), active=found)[2])
    # The shading normal may point to either side; the layer has the one on the side of the incoming ray.
    normal = dr.mulsign(normal, si.wi.z)
    # A Mitsuba camera looks along its +z with +x to the left of the image.
    right, up, back = (sign * axis for sign, axis in zip((-1, 1, -1), axes(sensor), strict=True))
    normal = mi.Color3f(dr.dot(normal, right), dr.dot(normal, up), dr.dot(normal, back))
    # In polarised variants the reflectance is a Mueller matrix, but the albedo of media is not.
    reflectance = mi.unpolarized_spectrum(dr.select(found, reflectance, 0))
    albedo = reflectance_to_rgb(reflectance + scattered, ray.wavelengths)
    return {
        "albedo": albedo,
        "normal": dr.select(found, normal, 0),
        "depth": dr.select(found, depth + before_near_plane(sensor, ray), 0),
    }


def axes(sensor) -> list[mi.Vector3f]:
    """x, y and z of a camera in the world, of length 1 whatever the scale of its ``to_world``."""
    to_world = sensor.world_transform()
    return [dr.normalize(to_world @ mi.Vector3f(*axis)) for axis in ((1, 0, 0), (0, 1, 0), (0, 0, 1))]


def before_near_plane(sensor, ray) -> mi.Float:
    """The distance along ``ray`` from the camera (orthographic: its plane) to the near plane, where the ray begins."""
    if not isinstance(sensor, mi.ProjectiveCamera):
        return mi.Float(0)
    # near_clip of an orthographic camera is in units of to_world, which may be scaled.
    along = dr.norm(sensor.world_transform() @ mi.Vector3f(0, 0, 1))
    return sensor.near_clip() * along / dr.dot(ray.d, axes(sensor)[2])


def in_media(scene, medium) -> tuple[mi.MediumPtr | None, int]:
    """The ``medium`` of the camera, and the number of steps through a medium: None and 0 if the scene has no media."""
    media = media_of(scene)
    if not media:
        return None, 0
    # One step through a medium of one density is exact.
    return mi.MediumPtr(medium), 1 if all(medium.is_homogeneous() for medium in media) else MEDIUM_STEPS


@dr.syntax
def through_medium(medium, ray, length, sampler, steps: int):
    """The transmittance of a ``medium`` (none: 1) along ``ray`` up to ``length``, and the albedo that the medium adds.

    That albedo is the single-scattering albedo, weighted by the share of light that the medium removes in each step.
    """
    transmittance = mi.unpolarized_spectrum(mi.Spectrum(1))
    albedo = mi.unpolarized_spectrum(mi.Spectrum(0))
    spectrum = type(albedo)
    # From ``first`` to ``end`` the ray is in the box of a grid; a medium without a box fills the whole ray.
    inside = medium != None  # noqa: E711 - a comparison of arrays of pointers
    hit, first, end = medium.intersect_aabb(ray)
    first, end = dr.maximum(first, 0), dr.minimum(end, length)
    inside &= hit & (end > first)
    step = (end - first) / steps
    mei = dr.zeros(mi.MediumInteraction3f)
    mei.wavelengths, mei.medium, mei.wi, mei.sh_frame = ray.wavelengths, medium, -ray.d, mi.Frame3f(-ray.d)
    jitter = sampler.next_1d(inside)
    i = mi.UInt32(0)
    while inside & (i < steps):
        mei.t = first + (i + jitter) * step
        mei.p = ray(mei.t)
        scattering, _, extinction = medium.get_scattering_coefficients(mei, inside)
        passed = dr.exp(-mi.unpolarized_spectrum(extinction) * step)
        own = mi.unpolarized_spectrum(scattering) / mi.unpolarized_spectrum(extinction)
        # Spectra combined with masks become plain arrays, but the state of a loop must keep its types.
        albedo = spectrum(albedo + transmittance * (1 - passed) * dr.select(own > 0, own, 0))
        transmittance = spectrum(transmittance * passed)
        i += 1
    return transmittance, albedo


@dr.syntax
def first_nonspecular_vertex(scene, sampler, ray, medium=None, steps=0):
    """Follows ``ray`` through mirrors, clear glass and the holes of masks to the first vertex that scatters smoothly.

    Returns the surface interaction there (invalid where the path escapes or the chain is too long), the ray that led
    there from the vertex before, the path length up to it, a sample of its reflectance times the reflectance of the
    chain, and the albedo of the media on the way. ``medium`` and ``steps`` are as in ``in_media``.
    """
    ray = mi.Ray3f(ray)
    last = mi.Ray3f(ray)
    si = dr.zeros(mi.SurfaceInteraction3f)
    depth = mi.Float(0)
    tint = mi.unpolarized_spectrum(mi.Spectrum(1))
    reflectance = mi.Spectrum(0)
    scattered = mi.unpolarized_spectrum(mi.Spectrum(0))
    vertices = mi.UInt32(0)
    found = mi.Bool(False)
    searching = mi.Bool(True)
    while searching:
        last = mi.Ray3f(ray)
        # Camera rays of one pixel are coherent, and Embree traces coherent rays faster.
        si = scene.ray_intersect(ray, mi.RayFlags.All, vertices == 0)
        depth += si.t
        if dr.hint(steps > 0, mode="scalar"):
            # For a path that escapes: far away, but a distance that float32 can hold.
            length = dr.minimum(dr.minimum(si.t, ray.maxt), 1e9)
            passed, albedo = through_medium(medium, ray, length, sampler, steps)
            scattered = type(scattered)(scattered + tint * albedo)
            tint *= passed
        bsdf = si.bsdf(mi.RayDifferential3f(ray))
        flags = bsdf.flags()
        # eval_diffuse_reflectance() is free of noise, but means nothing without a diffuse component. For any material
        # the mean weight of a sampled direction is the directional albedo. The factor η² undoes the change of radiance
        # at a refraction, which is no loss of power.
        diffuse = mi.has_flag(flags, mi.BSDFFlags.DiffuseReflection)
        sampled = si.is_valid() & (~diffuse | mi.has_flag(flags, mi.BSDFFlags.Null))
        context = mi.BSDFContext()
        sample, weight = bsdf.sample(context, si, sampler.next_1d(), sampler.next_2d(), sampled)
        weight = mi.unpolarized_spectrum(weight) * dr.square(sample.eta)
        through_hole = mi.has_flag(sample.sampled_type, mi.BSDFFlags.Null)
        found = si.is_valid() & mi.has_flag(flags, mi.BSDFFlags.Smooth) & ~(sampled & through_hole)
        albedo = mi.unpolarized_spectrum(bsdf.eval_diffuse_reflectance(si, found))
        reflectance = mi.Spectrum(tint * dr.select(diffuse, albedo, weight))
        tint *= weight
        vertices += 1
        searching = sampled & ~found & (vertices < MAX_SPECULAR_VERTICES) & (dr.max(tint) > 0)
        ray = si.spawn_ray(si.to_world(sample.wo))
        if dr.hint(steps > 0, mode="scalar"):
            medium = dr.select(si.is_medium_transition(), si.target_medium(ray.d), medium)
    si.t = dr.select(found, si.t, dr.inf)
    return si, last, depth, reflectance, scattered
