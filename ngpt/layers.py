"""The contract between all parts of ngpt: the layers of a gradient stack with their channels, units and signs."""

from dataclasses import dataclass

RGB = ("R", "G", "B")
XYZ = ("X", "Y", "Z")
XY = ("X", "Y")


@dataclass(frozen=True)
class Layer:
    """One layer of the contract.

    ``channels``       the suffixes of its channels, in the order of memory and files
    ``float_on_disk``  whether files need 32-bit floats, since half has too few bits (11) for differences, and too low a
                       limit (65504) for variances and distances
    """

    name: str
    channels: tuple[str, ...]
    float_on_disk: bool
    meaning: str


LAYERS: dict[str, Layer] = {
    layer.name: layer
    for layer in (
        Layer("primal", RGB, False, "Monte Carlo estimate of the pixel, directly seen emission included"),
        Layer("direct", RGB, False, "emission that the camera sees directly: part of primal, not of dx and dy"),
        Layer(
            "caustic", RGB, True, "light over rough surfaces, then mirrors or glass: part of primal, not of dx and dy"
        ),
        Layer("dx", RGB, True, "forward differences: dx[y,x] estimates I[y,x+1] - I[y,x], last column 0"),
        Layer("dy", RGB, True, "forward differences: dy[y,x] estimates I[y+1,x] - I[y,x], last row 0"),
        Layer("albedo", RGB, False, "reflectance at the first non-specular vertex, in [0, 1]"),
        Layer("normal", XYZ, False, "unit shading normal there, camera space: +x right, +y up, +z toward the viewer"),
        Layer("depth", ("Z",), True, "path length from the camera to that vertex, world units, 0 where it escapes"),
        Layer("diffuse", RGB, False, "light that diffuse lobes scatter toward the camera: part of primal"),
        Layer("specular", RGB, False, "all other light: primal - direct - diffuse"),
        Layer("primal_var", RGB, True, "sample variance of the pixel mean of primal - caustic (divided by spp)"),
        Layer("caustic_var", RGB, True, "sample variance of the pixel mean of caustic"),
        Layer("diffuse_var", RGB, True, "sample variance of the pixel mean of diffuse"),
        Layer("specular_var", RGB, True, "sample variance of the pixel mean of specular"),
        Layer("dx_var", RGB, True, "sample variance of the pixel mean of dx"),
        Layer("dy_var", RGB, True, "sample variance of the pixel mean of dy"),
        Layer("shared", RGB, False, "a sample of the noise that pixels share, part of primal_var: see ngpt.shared"),
        Layer("samples", ("N",), True, "number of base paths of the pixel, if pixels differ in it"),
        Layer("motion", XY, True, "pixels from here to this point's place one frame before: x right, y down, or NaN"),
        Layer("dt", RGB, True, "difference in time: estimates I[p] - I_before[p + motion], without direct; or NaN"),
        Layer("dt_var", RGB, True, "sample variance of the pixel mean of dt"),
        Layer("alpha", ("A",), False, "coverage, untouched by reconstruction"),
        Layer("error", RGB, True, "in results: estimated standard error of the reconstruction"),
    )
}


def stored_channels(name: str) -> tuple[str, ...]:
    """The names of a layer's channels in files of ngpt: "dx.R", but "R" for primal and "A" for alpha."""
    return tuple(suffix if name in ("primal", "alpha") else f"{name}.{suffix}" for suffix in LAYERS[name].channels)


# Layers of differences -> offset (x, y, frames) from a pixel to another one, with y pointing down. The difference is
# the value of the other pixel minus the value of the pixel itself.
DIFFERENCES: dict[str, tuple[int, int, int]] = {"dx": (1, 0, 0), "dy": (0, 1, 0)}

# Header attribute: the variance of the pixel mean of ``albedo`` or ``normal``, whichever is larger, averaged over
# pixels and channels
FEATURE_NOISE = "ngpt:featureNoise"

# Header attribute: 1 if the light in ``caustic`` comes from photons that were gathered within a radius. Neighbouring
# pixels gather the same photons and share their noise, which OIDN takes for detail.
GATHERED = "ngpt:gathered"
