"""Albedo, normal and depth at the first vertex that is not specular."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from data_gen.paths.spectrum import reflectance_to_rgb

# A longer chain of mirrors is cut: the features of what it shows are unknown then, as for a path that escapes.
MAX_SPECULAR_VERTICES = 32


# Materials that turn the shading frame; Mitsuba tells of the turn only through its `aov` integrator.
_TURNS_NORMALS = ("BumpMap", "NormalMap")


def features(scene, sensor, sampler, ray: mi.RayDifferential3f) -> dict[str, mi.Color3f | mi.Float]:
    """One sample of every feature layer along a camera ray, in the conventions of the gradient stack.

    ``albedo``  reflectance in [0, 1], tinted by the mirrors and the glass it is seen through
    ``normal``  unit shading normal in camera space, +x right, +y up, +z toward the viewer, on the side seen
    ``depth``   path length from the camera in world units
    All are zero where the path escapes. Media are not seen: the surfaces behind them are. Bump and normal maps count
    where they are a shape's outermost material; Mitsuba keeps those inside others (``twosided``, ``mask``) to itself.
    """
    si, last, depth, reflectance = first_nonspecular_vertex(scene, sampler, ray)
    found = si.is_valid()
    normal = si.sh_frame.n
    if any(shape.bsdf() is not None and shape.bsdf().class_name() in _TURNS_NORMALS for shape in scene.shapes()):
        aov = mi.load_dict({"type": "aov", "aovs": "normal:sh_normal"})
        normal = mi.Normal3f(aov.sample(scene, sampler.clone(), mi.RayDifferential3f(last), active=found)[2])
    # The shading frame knows no side; the normal is meant on that of the incoming ray.
    normal = dr.mulsign(normal, si.wi.z)
    # A Mitsuba camera looks along its +z with +x to the left of the image.
    local = dr.normalize(sensor.world_transform().inverse() @ mi.Normal3f(normal))
    normal = mi.Color3f(-local.x, local.y, -local.z)
    albedo = reflectance_to_rgb(reflectance, ray.wavelengths)
    return {
        "albedo": dr.select(found, albedo, 0),
        "normal": dr.select(found, normal, 0),
        "depth": dr.select(found, depth, 0),
    }


@dr.syntax
def first_nonspecular_vertex(scene, sampler, ray):
    """Follows ``ray`` through mirrors, clear glass and the holes of masks to the first vertex that scatters smoothly.

    Returns the surface interaction there (invalid where the path escapes or the chain is too long), the ray that led
    there from the vertex before, the path length up to it, and a sample of its reflectance times that of the chain.
    """
    ray = mi.Ray3f(ray)
    last = mi.Ray3f(ray)
    si = dr.zeros(mi.SurfaceInteraction3f)
    depth = mi.Float(0)
    tint = mi.unpolarized_spectrum(mi.Spectrum(1))
    reflectance = mi.Spectrum(0)
    vertices = mi.UInt32(0)
    found = mi.Bool(False)
    searching = mi.Bool(True)
    while searching:
        last = mi.Ray3f(ray)
        # Camera rays of one pixel go together, for which Embree has a way of its own.
        si = scene.ray_intersect(ray, mi.RayFlags.All, vertices == 0)
        depth += si.t
        bsdf = si.bsdf(mi.RayDifferential3f(ray))
        flags = bsdf.flags()
        # eval_diffuse_reflectance() is free of noise, but means nothing without a diffuse component. The weight of a
        # sampled direction has the directional albedo as its mean, for any material; η² takes out that radiance, not
        # power, changes where it is refracted.
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
    si.t = dr.select(found, si.t, dr.inf)
    return si, last, depth, reflectance
