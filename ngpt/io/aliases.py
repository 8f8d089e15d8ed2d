"""Names of layers in other renderers' files, and the search that connects them to the contract (``ngpt.layers``).

Everything here works on channel *names*; no file is opened. OpenEXR calls channel ``C`` of layer ``L`` ``L.C``, layers
nest with dots, and layer names may hold spaces: ``ViewLayer.Denoising Albedo.R`` is channel ``R`` of the layer
``ViewLayer.Denoising Albedo``. A name matches a layer when it is the layer's name or its tail after a dot.
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

from ngpt.errors import NgptError, did_you_mean
from ngpt.layers import LAYERS, RGB, XY, XYZ, Layer


class Alias(NamedTuple):
    """A name under which ``producer`` stores ``layer``; ``""`` is the root, ``only`` demands these channel suffixes."""

    layer: str
    producer: str
    name: str
    note: str = ""
    only: tuple[str, ...] = ()


# Names of ours that mean something else in files that are not, and what shows that a file is.
_OWN: dict[str, set[str]] = {
    "direct": {"dx", "dy"},
    "caustic": {"dx", "dy", "caustic_var"},
    "diffuse": {"diffuse_var"},
    "specular": {"specular_var"},
}

# The first name that a file holds wins, so order is preference. Absent on purpose: pbrt-v4's `Variance` and Mitsuba's
# moments are variances of a sample, not of the pixel mean, half of what other renderers call `diffuse` is light, and
# V-Ray's VRayZDepth is a shade of grey between two distances.
ALIASES: tuple[Alias, ...] = (
    *(Alias(name, "ngpt", name) for name in LAYERS if name not in (*_OWN, "error")),
    Alias("direct", "ngpt", "direct", "in files of ngpt, or beside dx or dy: elsewhere `direct` is direct lighting"),
    Alias("caustic", "ngpt", "caustic", "in files of ngpt, or beside dx, dy or caustic_var: elsewhere it is any light"),
    Alias("diffuse", "ngpt", "diffuse", "in files of ngpt, or beside diffuse_var: elsewhere any light, or a colour"),
    Alias("specular", "ngpt", "specular", "in files of ngpt, or beside specular_var: elsewhere it is other light"),
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
    Alias(
        "albedo", "V-Ray", "diffuse", "with red green blue only: elsewhere `diffuse` is light", ("red", "green", "blue")
    ),
    Alias("albedo", "V-Ray for 3ds Max", "VRayDiffuseFilter"),
    Alias("albedo", "Redshift", "DiffuseFilter"),
    Alias("albedo", "Cycles", "Diffuse Color", "diffuse closures only"),
    Alias("albedo", "Cycles", "DiffCol", "before Blender 5.0"),
    Alias("albedo", "LuxCore", "ALBEDO", "in Blender's files; alone, each buffer has a file of its own"),
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
    Alias("alpha", "all", "A", "failing that, the A of the layer that holds primal"),
    Alias("alpha", "RenderMan", "a"),
)

_COLOUR = (("R", "r", "red"), ("G", "g", "green"), ("B", "b", "blue"))
_SPELLINGS = {
    RGB: (_COLOUR,),
    # Tools that write an (H, W, 3) array name its channels R G B whatever it holds.
    XYZ: ((("X", "x"), ("Y", "y"), ("Z", "z")), _COLOUR),
    XY: ((("X", "x"), ("Y", "y")),),
    ("Z",): ((("Z", "z", "V", "v", "T", "t", "Y", "y", "D", "d", "R", "r", ""),),),
    ("N",): ((("N", "n", ""),),),
    ("A",): ((("A", "a", "alpha", ""),),),
}
# Parts of names, in small letters without blanks and underscores, that make a layer look like one of the contract.
_LOOKS = {
    "albedo": ("albedo", "diffusefilter", "diffusecol", "basecol", "diffcol", "reflectance"),
    "normal": ("normal",),
    "depth": ("depth", "distance"),
    "dx": ("gradientx", "gradx"),
    "dy": ("gradienty", "grady"),
}
# How names of variances and errors end.
_NOISE = ("var", "variance", "mse", "error")


class Found(NamedTuple):
    """Where a file holds a layer: part index, channel names in canonical order, and the layer's name in the file."""

    part: int
    channels: tuple[str, ...]
    name: str


Resolution = dict[str, Found]


class _Group(NamedTuple):
    """The channels of one layer of a file: suffix -> channel name. ``name`` is "" for the root."""

    part: int
    name: str
    channels: dict[str, str]


def format_aliases() -> str:
    """Returns the alias table as text, one alias a line, in order of preference within each layer."""
    rows = [("layer", "written by", "layer name in the file", "channels", "note")]
    for layer in LAYERS.values():
        for alias in (alias for alias in ALIASES if alias.layer == layer.name):
            channels = " ".join(alias.only or layer.channels)
            rows.append((layer.name, alias.producer, alias.name or "(root)", channels, alias.note or "-"))
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return "\n".join(
        "  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip() for row in rows
    )


def resolve(
    parts: Sequence[tuple[str, Sequence[str]]],
    overrides: Mapping[str, str] | None = None,
    path: str = "image",
    ours: bool = False,
) -> Resolution:
    """Finds the layers of the contract among the channel names of a file.

    ``parts`` lists each part's name and its channel names. ``overrides`` maps names of the contract to the name of a
    layer in the file, whole or its tail, and wins over the aliases. ``path`` is for messages. In a file of ``ours``
    ``direct`` and ``caustic`` are what the contract says; elsewhere only layers that nobody else writes show it.

    A channel without a dot belongs to the root, and in a file of several parts to the layer named like its part; there
    other layers can also be called ``part.layer``. Where a name fits several layers, the one it fits whole wins, then
    the one in the part that holds primal.

    Raises NgptError if there is no primal, a name fits several layers, a layer lacks channels or has one twice, or an
    override names something that is not there.
    """
    groups = _group(parts)
    overrides = dict(overrides or {})
    for name in overrides:
        if name not in LAYERS:
            meant = did_you_mean(name, LAYERS)
            raise NgptError(
                f"{path}: --layer {name}=...: no layer is called '{name}'; {meant}use one of {', '.join(LAYERS)}"
            )
    found: Resolution = {}
    for layer in LAYERS.values():
        main = found["primal"].part if "primal" in found else None
        if layer.name in overrides:
            aliases = [Alias(layer.name, "the user", overrides[layer.name])]
        else:
            aliases = [alias for alias in ALIASES if alias.layer == layer.name]
        for alias in aliases:
            match = _match(alias, layer, groups, main, path)
            if match:
                found[layer.name] = match
                break
        else:
            if layer.name in overrides:
                meant = did_you_mean(overrides[layer.name], {group.name for group in groups})
                wanted = f'--layer {layer.name}="{overrides[layer.name]}"'
                raise NgptError(
                    f"{path}: {wanted} fits no layer with channels {' '.join(layer.channels)}; "
                    f"{meant}the file holds {_listing(groups)}"
                )
        if layer.name == "primal" and "primal" not in found:
            raise _no_primal(groups, path)
    primal = found["primal"]
    for name, other in found.items():
        # The root of a multi-part file may be a part called `albedo`, say, and then it is no primal.
        if name != "primal" and "primal" not in overrides and other[:2] == primal[:2]:
            raise _no_primal(groups, path)
    for name, beside in _OWN.items():
        if name in found and name not in overrides and not ours and not beside & found.keys():
            del found[name]
    if "alpha" not in found:
        own = next((group for group in groups if group.part == primal.part and group.name == primal.name), None)
        if own and "A" in own.channels:
            found["alpha"] = Found(own.part, (own.channels["A"],), own.name)
    return found


def resolve_alone(parts: Sequence[tuple[str, Sequence[str]]], name: str, path: str) -> Found:
    """Finds layer ``name`` in a file of its own, ``parts`` as for ``resolve``.

    That is the layer of one of its names, else the root of the first part, else the one layer with such channels.

    Raises NgptError where there is none, or several and none of a known name.
    """
    groups, layer = _group(parts), LAYERS[name]
    for alias in (alias for alias in ALIASES if alias.layer == name):
        if found := _match(alias, layer, groups, None, path):
            return found
    fitting: dict[tuple[int, tuple[str, ...]], Found] = {}
    for group in sorted(groups, key=lambda group: group.name != ""):
        if channels := _complete(layer, group):
            fitting.setdefault((group.part, channels), Found(group.part, channels, group.name))
    candidates = list(fitting.values())
    if not candidates:
        raise NgptError(
            f"{path}: no layer with channels {' '.join(layer.channels)} for '{name}'; the file holds {_listing(groups)}"
        )
    if len(candidates) > 1 and candidates[0].name:
        names = ", ".join(f'"{candidate.name}"' for candidate in candidates)
        raise NgptError(f"{path}: layer '{name}' could be any of {names}; write a file with one of them")
    return candidates[0]


def propose(parts: Sequence[tuple[str, Sequence[str]]], found: Resolution) -> dict[str, str]:
    """Layers of a file that look like ones of the contract that ``found`` lacks: layer -> its name in the file.

    A guess from names, for the user to judge: ``--layer albedo="NAME"`` takes it. Each layer is proposed once.
    """
    taken = {(layer.part, channel) for layer in found.values() for channel in layer.channels}
    proposed: dict[str, str] = {}
    groups = _group(parts)
    for name, looks in _LOOKS.items():
        for group in groups if name not in found else ():
            plain = group.name.lower().replace(" ", "").replace("_", "")
            if not any(look in plain for look in looks) or plain.endswith(_NOISE) or group.name in proposed.values():
                continue
            channels = _complete(LAYERS[name], group)
            if channels and not {(group.part, channel) for channel in channels} & taken:
                proposed[name] = group.name
                break
    return proposed


def layers_of_light(parts: Sequence[tuple[str, Sequence[str]]], found: Resolution) -> dict[str, Found]:
    """The layers of colour that are none of the contract: name -> where they are."""
    taken = {(layer.part, channel) for layer in found.values() for channel in layer.channels}
    light = {}
    for group in _group(parts):
        channels = _complete(LAYERS["primal"], group)
        if group.name and channels and not {(group.part, channel) for channel in channels} & taken:
            light[group.name] = Found(group.part, channels, group.name)
    return light


def _group(parts: Sequence[tuple[str, Sequence[str]]]) -> list[_Group]:
    """Sorts channels into layers; one without a dot also makes a layer of its own, called like the channel."""
    several = len(parts) > 1
    groups: dict[tuple[int, str], dict[str, str]] = {}
    for index, (part, channels) in enumerate(parts):
        for channel in channels:
            layer, dot, suffix = channel.rpartition(".")
            if several and layer != part and not layer.startswith(f"{part}."):
                layer = f"{part}.{layer}" if dot else part
            groups.setdefault((index, layer), {})[suffix] = channel
            if not dot:
                groups.setdefault((index, f"{layer}.{suffix}" if layer else suffix), {})[""] = channel
                if several and index == 0:
                    groups.setdefault((0, ""), {})[suffix] = channel
    return [_Group(index, name, channels) for (index, name), channels in groups.items()]


def _match(alias: Alias, layer: Layer, groups: list[_Group], main: int | None, path: str) -> Found | None:
    """Returns the one place where the file holds ``layer`` under ``alias``, None if there is none."""
    complete: dict[tuple[int, tuple[str, ...]], Found] = {}
    partial: NgptError | None = None
    for group in groups:
        if group.name != alias.name and not (alias.name and group.name.endswith(f".{alias.name}")):
            continue
        try:
            channels = _channels(layer, group, alias.only, path)
        except NgptError as error:
            partial = error
        else:
            if channels:
                complete.setdefault((group.part, channels), Found(group.part, channels, group.name))
    candidates = list(complete.values())
    for better in (
        [found for found in candidates if found.name == alias.name],
        [found for found in candidates if found.part == main],
    ):
        if len(candidates) > 1 and better:
            candidates = better
    if len(candidates) > 1:
        names = ", ".join(f'"{found.name}"' for found in candidates)
        remedy = f'--layer {layer.name}="{candidates[0].name}"'
        raise NgptError(f"{path}: layer '{layer.name}' could be any of {names}; choose one, as in {remedy}")
    if not candidates and partial:
        raise partial
    return candidates[0] if candidates else None


def _channels(layer: Layer, group: _Group, only: tuple[str, ...], path: str) -> tuple[str, ...]:
    """Returns the channels of ``group`` in canonical order, or () if it has none of those that ``layer`` needs."""
    for spelling in (tuple((suffix,) for suffix in only),) if only else _SPELLINGS[layer.channels]:
        held = [[group.channels[suffix] for suffix in names if suffix in group.channels] for names in spelling]
        if not any(held):
            continue
        name = group.name or "root"
        missing = [names[0] for names, channels in zip(spelling, held, strict=True) if not channels]
        if missing:
            holds = ", ".join(group.channels.values())
            raise NgptError(
                f"{path}: layer '{layer.name}' is incomplete: '{name}' lacks channel {', '.join(missing)} "
                f"(it holds {holds}); write all of {' '.join(layer.channels)}"
            )
        twice = next((channels for channels in held if len(channels) > 1), None)
        if twice:
            raise NgptError(
                f"{path}: layer '{layer.name}' has one channel twice, {' and '.join(twice)}; remove or rename one"
            )
        return tuple(channels[0] for channels in held)
    return ()


def _complete(layer: Layer, group: _Group) -> tuple[str, ...]:
    """``_channels``, or () where they are incomplete or one is there twice."""
    try:
        return _channels(layer, group, (), "")
    except NgptError:
        return ()


def _no_primal(groups: list[_Group], path: str) -> NgptError:
    root: set[str] = set().union(*(group.channels for group in groups if group.name == ""))
    if "Y" in root and not root & set(RGB):
        held = "luminance and chroma (channels Y RY BY)" if {"RY", "BY"} <= root else "luminance (channel Y)"
        return NgptError(f"{path}: holds {held} but no colours R G B; save the image with channels R G B")
    return NgptError(
        f"{path}: no primal image (root R G B, or a layer such as primal, Noisy Image or Combined); "
        f'the file holds {_listing(groups)}; name it with --layer primal="NAME"'
    )


def _listing(groups: list[_Group], limit: int = 24) -> str:
    """Names the layers of a file and their channel suffixes, at most ``limit`` of them."""
    layers = [group for group in groups if "" not in group.channels]
    names = [
        f'"{group.name or "root"}" ({" ".join(sorted(group.channels, key="RGBA".find))})' for group in layers[:limit]
    ]
    return ", ".join(names) + (f" and {len(layers) - limit} more" if len(layers) > limit else "")
