"""Names of layers in other renderers' files; ``ngpt.io.resolution`` finds layers by them."""

from collections.abc import Iterable
from typing import NamedTuple

from ngpt.layers import LAYERS


class Alias(NamedTuple):
    """The ``name`` under which the program ``producer`` stores ``layer``; "" is the root of the file.

    ``note``     a remark for users
    ``only``     the suffixes that its channels must have, beginning with those of the layer; () for any
    ``factors``  the factors of the channels, if a renderer uses another sign or unit
    ``writer``   the only program, as returned by ``writer_of``, in whose files the alias counts; "" for all
    """

    layer: str
    producer: str
    name: str
    note: str = ""
    only: tuple[str, ...] = ()
    factors: tuple[float, ...] = ()
    writer: str = ""


# Names of the contract that other programs give to other layers -> layers that only ngpt writes. A file of ngpt holds
# at least one of these beside the named layer.
OWN: dict[str, set[str]] = {
    "direct": {"dx", "dy"},
    "caustic": {"dx", "dy", "caustic_var"},
    "diffuse": {"diffuse_var"},
    "specular": {"specular_var"},
    "shared": {"primal_var"},
}

# Of the names of a layer, the first that a file holds is taken. Some names are left out on purpose: pbrt-v4's
# `Variance` and Mitsuba's moments are variances of a sample, not of the pixel mean; `diffuse` is light in half of the
# other renderers; V-Ray's VRayZDepth is a shade of grey between two distances.
ALIASES: tuple[Alias, ...] = (
    *(Alias(name, "ngpt", name) for name in LAYERS if name not in (*OWN, "error")),
    Alias("direct", "ngpt", "direct", "in files of ngpt, or beside dx or dy: elsewhere `direct` is direct lighting"),
    Alias("caustic", "ngpt", "caustic", "in files of ngpt, or beside dx, dy or caustic_var: elsewhere it is any light"),
    Alias("diffuse", "ngpt", "diffuse", "in files of ngpt, or beside diffuse_var: elsewhere any light, or a colour"),
    Alias("specular", "ngpt", "specular", "in files of ngpt, or beside specular_var: elsewhere it is other light"),
    Alias("shared", "ngpt", "shared", "in files of ngpt, or beside primal_var: elsewhere it may be anything"),
    Alias("error", "ngpt", "error", "in results: of the reconstruction"),
    Alias("primal", "Cycles", "Noisy Image", "the render before Cycles' own denoiser"),
    Alias("primal", "Cycles", "Combined", "denoised already if Cycles denoised and stored no Noisy Image"),
    Alias("primal", "RenderMan", "Ci"),
    Alias("primal", "Arnold", "RGBA"),
    Alias("primal", "Karma", "C"),
    Alias("primal", "V-Ray, Mitsuba 3, pbrt-v4", "", "root R G B of the first part, in files of ngpt too"),
    Alias("albedo", "Cycles", "Denoising Albedo", "follows mirrors and glass to what is seen in them"),
    Alias("albedo", "Arnold", "denoise_albedo"),
    Alias("albedo", "pbrt-v4", "Albedo"),
    Alias("albedo", "Arnold", "diffuse_albedo", "older files"),
    Alias("albedo", "V-Ray", "diffuse", "elsewhere `diffuse` with channels R G B is light", ("red", "green", "blue")),
    Alias("albedo", "V-Ray", "diffuse", "in files with V-Ray's attributes (vrayInfo)", writer="V-Ray"),
    Alias("albedo", "V-Ray for 3ds Max", "VRayDiffuseFilter"),
    Alias("albedo", "Redshift", "DiffuseFilter"),
    Alias("albedo", "Cycles", "Diffuse Color", "diffuse closures only"),
    Alias("albedo", "Cycles", "DiffCol", "before Blender 5.0"),
    Alias("albedo", "LuxCore", "ALBEDO", "in Blender's files; LuxCore itself writes each buffer to a file of its own"),
    Alias("normal", "Cycles", "Denoising Normal", "camera space, but +z away from the viewer"),
    Alias("normal", "pbrt-v4", "Ns", "shading normal, camera space unless the film says otherwise"),
    Alias("normal", "Redshift", "BumpNormals", "bump included"),
    Alias("normal", "Arnold, pbrt-v4, Karma, Redshift", "N"),
    Alias("normal", "V-Ray", "bump_normals", "screen space"),
    Alias("normal", "V-Ray for 3ds Max", "VRayBumpNormals", "screen space"),
    Alias("normal", "V-Ray for 3ds Max", "VRayNormals", "without bump"),
    Alias("normal", "Mitsuba 3", "normals", "the name in the documentation of its denoiser; world space"),
    Alias("normal", "Mitsuba 3", "sh_normal", "AOV names are the user's; world space"),
    Alias("normal", "Mitsuba 3", "nn", "the name in Mitsuba's documentation; world space"),
    Alias("normal", "Cycles", "Normal", "world space"),
    Alias("normal", "LuxCore", "AVG_SHADING_NORMAL", "world space"),
    Alias("normal", "LuxCore", "SHADING_NORMAL", "of one sample; world space"),
    Alias("depth", "Cycles", "Denoising Depth", "ray length"),
    Alias("depth", "RenderMan", "zfiltered"),
    Alias("depth", "Mitsuba 3", "dd.y", "the name in Mitsuba's documentation; ray length"),
    Alias("depth", "Mitsuba 3", "dd", "ray length"),
    Alias("depth", "Cycles", "Depth", "along the viewing axis, not the ray"),
    Alias("depth", "Arnold, Redshift", "Z"),
    Alias("motion", "Cycles", "Vector", "to the frame before, y up; Z W: from the next", tuple("XYZW"), (1.0, -1.0)),
    Alias("alpha", "all", "A", "failing that, the A of the layer that holds primal"),
    Alias("alpha", "RenderMan", "a"),
)

# A layer is only proposed to the user if its name in the file contains one of these parts (in lower case without blanks
# and underscores). It is not used at once because, for example, only the user knows the direction and unit of most
# motion vectors.
LOOKS = {
    "albedo": ("albedo", "diffusefilter", "diffusecol", "basecol", "diffcol", "reflectance"),
    "normal": ("normal",),
    "depth": ("depth", "distance"),
    "dx": ("gradientx", "gradx"),
    "dy": ("gradienty", "grady"),
    "motion": ("motionvec", "velocity", "vector"),
}
# A layer is not proposed if its name in the file contains one of these parts.
NOT_LOOKS = {"depth": ("zdepth",)}
# Parts of the names of layers that are not light although their channels are R G B
NO_LIGHT = ("crypto", "position", "matte", "mask", "noise", "samples")
# The ends of the names of variances and errors
NOISE = ("var", "variance", "mse", "error")

# Prefixes of attributes -> the program that writes them
_WRITERS = {"ngpt:sampler": "ngpt", "vrayInfo": "V-Ray", "generatedBy": "Mitsuba"}


def is_image(name: str) -> bool:
    """Whether renderers give this name to their final image, and not to the noisy one."""
    known = {alias.name for alias in ALIASES if alias.layer == "primal"} - {"", "primal", "Noisy Image"}
    return name.rpartition(".")[2] in known


def plain(name: str) -> str:
    """A name in lower case without blanks and underscores."""
    return name.lower().replace(" ", "").replace("_", "")


def writer_of(attributes: Iterable[str]) -> str:
    """The program that wrote a file with these header attributes; "" if they do not say."""
    names = tuple(attributes)
    return next((who for start, who in _WRITERS.items() for name in names if name.startswith(start)), "")


def format_aliases() -> str:
    """The table of aliases as text: one alias a line, in order of preference within each layer."""
    rows = [("layer", "written by", "layer name in the file", "channels", "note")]
    for layer in LAYERS.values():
        for alias in (alias for alias in ALIASES if alias.layer == layer.name):
            channels = " ".join(alias.only[: len(layer.channels)] or layer.channels)
            rows.append((layer.name, alias.producer, alias.name or "(root)", channels, alias.note or "-"))
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return "\n".join(
        "  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip() for row in rows
    )
