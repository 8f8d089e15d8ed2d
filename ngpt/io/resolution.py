"""Finds the layers of the contract (``ngpt.layers``) among the channel names of a file (``ngpt.io.aliases``).

No file is opened here. In OpenEXR, channel ``C`` of layer ``L`` has the name ``L.C``. Names of layers may contain dots
and spaces: ``ViewLayer.Denoising Albedo.R`` is channel ``R`` of the layer ``ViewLayer.Denoising Albedo``. A name fits a
layer if it is the whole name of the layer, or the end of that name after a dot.
"""

import re
from collections.abc import Iterator, Mapping, Sequence
from typing import NamedTuple

from ngpt.errors import NgptError, did_you_mean
from ngpt.io.aliases import ALIASES, LOOKS, NO_LIGHT, NOISE, NOT_LOOKS, OWN, Alias, plain
from ngpt.layers import LAYERS, RGB, XY, XYZ, Layer

# The name of each part of a file, and its channels. These are a list of names, or a mapping whose keys are the names
# that are searched and whose values are the names in the file (``ngpt.io.views``).
Parts = Sequence[tuple[str, Sequence[str] | Mapping[str, str]]]

_COLOUR = (("R", "r", "red"), ("G", "g", "green"), ("B", "b", "blue"))
_SPELLINGS = {
    RGB: (_COLOUR,),
    # Some tools name the channels of any (H, W, 3) array R G B.
    XYZ: ((("X", "x"), ("Y", "y"), ("Z", "z")), _COLOUR),
    XY: ((("X", "x"), ("Y", "y")),),
    ("Z",): ((("Z", "z", "V", "v", "T", "t", "Y", "y", "D", "d", "R", "r", ""),),),
    ("N",): ((("N", "n", ""),),),
    ("A",): ((("A", "a", "alpha", ""),),),
}
# A channel with a sign and a factor: "-N.Z", "-1920*velocity.R".
_TERM = re.compile(r"\s*([+-]?)(?:([0-9.]+(?:e[+-]?[0-9]+)?)\*)?(.+?)\s*")


class Found(NamedTuple):
    """The place of a layer in a file: index of the part, channels in the order of the contract, and its name there.

    ``factors`` has a factor for each channel; () means 1 for all.
    """

    part: int
    channels: tuple[str, ...]
    name: str
    factors: tuple[float, ...] = ()


Resolution = dict[str, Found]


class _Group(NamedTuple):
    """The channels of one layer of a file: suffix -> channel name. ``name`` is "" for the root."""

    part: int
    name: str
    channels: dict[str, str]


class _Home(NamedTuple):
    """The part of the primal, the prefix of its name, and the prefixes of other layers that could be the primal."""

    part: int | None
    prefix: str = ""
    rivals: frozenset[str] = frozenset()


def resolve(
    parts: Parts, overrides: Mapping[str, str] | None = None, path: str = "image", writer: str = "", origin: str = ""
) -> Resolution:
    """Finds the layers of the contract among the channel names of a file.

    ``parts``      each part's name and its channel names
    ``overrides``  names of the contract -> the name of a layer in the file, whole or its end after a dot; or channels
                   with signs and factors, "-velocity.R,velocity.G". Aliases are not tried for these layers
    ``path``       the name of the file for messages
    ``writer``     the program that wrote the file, as ``writer_of`` finds it. If it is not "ngpt", a layer
                   called ``direct``, ``caustic`` or another name in ``OWN`` is accepted only if the file also has a
                   layer that only ngpt writes
    ``origin``     in a result file, the layer that the input was read from

    A channel without a dot belongs to the root; in a file of several parts, it belongs to the layer named like its
    part. In such a file, other layers can also be called ``part.layer``. If a name fits several layers, the first
    choice is a layer whose name begins like the primal's (``Near.Combined``, ``Near.Depth``), the second is a layer
    with exactly this name, and the third is a layer in the primal's part. A layer whose name begins like that of
    another possible primal belongs to that other image, and is not used. If no layer has a known name of a primal, the
    only layer of colour is the primal.

    Raises NgptError if there is no primal, a name fits several layers, a layer lacks channels or has one twice, or no
    layer fits an override.
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
    home = _Home(None)
    for layer in LAYERS.values():
        if layer.name in overrides:
            found[layer.name] = _chosen(layer, overrides[layer.name], groups, home, path)
        else:
            aliases = (alias for alias in ALIASES if alias.layer == layer.name and alias.writer in ("", writer))
            matches = (match for alias in aliases if (match := _match(alias, layer, groups, home, path)))
            if match := next(matches, None):
                found[layer.name] = match
        if layer.name == "primal":
            if "primal" not in overrides and ("primal" not in found or found["primal"][:2] in _features(groups)):
                lone = _of_other_channels(groups, writer) or _lone(groups)
                if lone is None:
                    raise _no_primal(groups, path)
                found["primal"] = lone
            home = _home(groups, found["primal"], origin)
    primal = found["primal"]
    for name, other in found.items():
        # In a file of several parts, the first part is also the root. If that part is called `albedo`, it is no primal.
        if name != "primal" and "primal" not in overrides and other[:2] == primal[:2]:
            raise _no_primal(groups, path)
    for name, beside in OWN.items():
        if name in found and name not in overrides and writer != "ngpt" and not beside & found.keys():
            del found[name]
    if "alpha" not in found:
        own = next((group for group in groups if group.part == primal.part and group.name == primal.name), None)
        if own and (channels := _complete(LAYERS["alpha"], own)):
            found["alpha"] = Found(own.part, channels, own.name)
    return found


def resolve_alone(parts: Parts, name: str, path: str) -> Found:
    """Finds layer ``name`` in a separate file; ``parts`` is as for ``resolve``.

    It is the layer with one of the known names of ``name``, or else the root of the first part, or else the only layer
    with such channels. Raises NgptError if there is no such layer, or more than one.
    """
    groups, layer = _group(parts), LAYERS[name]
    for alias in (alias for alias in ALIASES if alias.layer == name and not alias.writer):
        if found := _match(alias, layer, groups, _Home(None), path):
            return found
    candidates = list(_distinct(layer, sorted(groups, key=lambda group: group.name != "")))
    if not candidates:
        channels = " ".join(layer.channels)
        raise NgptError(f"{path}: no layer for '{name}' with channels {channels}; the file holds {_listing(groups)}")
    if len(candidates) > 1 and candidates[0].name:
        names = ", ".join(f'"{candidate.name}"' for candidate in candidates)
        raise NgptError(f"{path}: layer '{name}' could be any of {names}; write a file with one of them")
    return candidates[0]


def propose(parts: Parts, found: Resolution) -> dict[str, str]:
    """Guesses layers of the contract that ``found`` lacks: layer -> its name in the file.

    The guesses are made from names, and the user decides: ``--layer albedo="NAME"`` accepts one. Each layer of the file
    is proposed once. Motion is proposed as channels with signs, such as "-X,Y". The signs are right for vectors that
    point to the next frame with y up, which most renderers write.
    """
    taken = {(layer.part, channel) for layer in found.values() for channel in layer.channels}
    proposed: dict[str, str] = {}
    groups = _group(parts)
    rivals = _home(groups, found["primal"], "").rivals if "primal" in found else frozenset()
    for name, looks in LOOKS.items():
        for group in groups if name not in found else ():
            text = plain(group.name)
            if not any(look in text for look in looks) or any(other in text for other in NOT_LOOKS.get(name, ())):
                continue
            if text.endswith(NOISE) or group.name in proposed.values() or group.name.rpartition(".")[0] in rivals:
                continue
            if name == "motion":
                first, second = (next((c for c in pair if c in group.channels), None) for pair in ("XRxr", "YGyg"))
                if first and second:
                    proposed[name] = f"-{group.channels[first]},{group.channels[second]}"
                    break
                continue
            channels = _complete(LAYERS[name], group)
            if channels and not {(group.part, channel) for channel in channels} & taken:
                proposed[name] = group.name
                break
    return proposed


def layers_of_light(parts: Parts, found: Resolution) -> dict[str, Found]:
    """The layers of colour that are not in ``found``: name -> place."""
    taken = {(layer.part, channel) for layer in found.values() for channel in layer.channels}
    light = {}
    for group in _group(parts):
        channels = _complete(LAYERS["primal"], group)
        if group.name and channels and not {(group.part, channel) for channel in channels} & taken:
            light[group.name] = Found(group.part, channels, group.name)
    return light


def holds_colour(parts: Parts) -> bool:
    """Whether any layer has channels R G B."""
    return any(_complete(LAYERS["primal"], group) for group in _group(parts))


def _group(parts: Parts) -> list[_Group]:
    """Groups the channels by layers. A channel without a dot is also a layer of its own, with the channel's name."""
    filled = [index for index, (_, channels) in enumerate(parts) if channels]
    several = len(filled) > 1
    groups: dict[tuple[int, str], dict[str, str]] = {}
    for index in filled:
        part, channels = parts[index]
        for channel, own in channels.items() if isinstance(channels, Mapping) else zip(channels, channels, strict=True):
            layer, dot, suffix = channel.rpartition(".")
            if several and part and layer != part and not layer.startswith(f"{part}."):
                layer = f"{part}.{layer}" if dot else part
            held = groups.setdefault((index, layer), {})
            # If a layer has a channel twice (R and beauty.R in the part beauty), the one with the layer's name counts.
            held[suffix] = own if dot else held.get(suffix, own)
            if not dot:
                groups.setdefault((index, f"{layer}.{suffix}" if layer else suffix), {})[""] = own
                if several and index == filled[0]:
                    groups.setdefault((index, ""), {})[suffix] = own
    return [_Group(index, name, channels) for (index, name), channels in groups.items()]


def _match(alias: Alias, layer: Layer, groups: list[_Group], home: _Home, path: str) -> Found | None:
    """The place of ``layer`` under the name of ``alias``; None if no place fits. Raises NgptError if several do."""
    complete: dict[tuple[int, tuple[str, ...]], Found] = {}
    partial: NgptError | None = None
    for group in groups:
        if not _named(group, alias) or group.name.rpartition(".")[0] in home.rivals:
            continue
        try:
            channels = _channels(layer, group, alias.only, path)
        except NgptError as error:
            partial = error
        else:
            if channels:
                complete.setdefault((group.part, channels), Found(group.part, channels, group.name, alias.factors))
    candidates = list(complete.values())
    for better in (
        [found for found in candidates if home.prefix and found.name.rpartition(".")[0] == home.prefix],
        [found for found in candidates if found.name == alias.name],
        [found for found in candidates if found.part == home.part],
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


def _named(group: _Group, alias: Alias) -> bool:
    return group.name == alias.name or bool(alias.name and group.name.endswith(f".{alias.name}"))


def _chosen(layer: Layer, text: str, groups: list[_Group], home: _Home, path: str) -> Found:
    """The place of a layer that the user chose by its name or its channels."""
    wide = home._replace(rivals=frozenset())
    if match := _match(Alias(layer.name, "the user", text), layer, groups, wide, path):
        return match
    terms = [_TERM.fullmatch(term) for term in text.split(",")]
    if len(terms) == len(layer.channels):
        places = [_places(term[3], groups) if term else set() for term in terms]
        shared = set.intersection(*({part for part, _ in place} for place in places))
        for part in sorted(shared, key=lambda part: part != home.part):
            channels = tuple(sorted(name for index, name in place if index == part)[0] for place in places)
            factors = tuple(float((term[1] or "") + (term[2] or "1")) for term in terms if term)
            return Found(part, channels, text, factors)
    wanted, meant = f'--layer {layer.name}="{text}"', did_you_mean(text, {group.name for group in groups} - {text})
    needed = " ".join(layer.channels)
    raise NgptError(f"{path}: {wanted} fits no layer with channels {needed}; {meant}the file holds {_listing(groups)}")


def _places(channel: str, groups: list[_Group]) -> set[tuple[int, str]]:
    """The (part, name) of each channel with this name; if no channel has it, of those whose names end with it."""
    names = {(g.part, own): f"{g.name}.{suffix}".strip(".") for g in groups for suffix, own in g.channels.items()}
    whole = {place for place, name in names.items() if channel in (name, place[1])}
    return whole or {place for place, name in names.items() if name.endswith(f".{channel}")}


def _distinct(layer: Layer, groups: Sequence[_Group]) -> Iterator[Found]:
    """The places among ``groups`` with the channels that ``layer`` needs, without repeats."""
    seen = set()
    for group in groups:
        channels = _complete(layer, group)
        if channels and (group.part, channels) not in seen:
            seen.add((group.part, channels))
            yield Found(group.part, channels, group.name)


def _features(groups: list[_Group]) -> set[tuple[int, tuple[str, ...]]]:
    """The places with channels R G B that have the name of a layer other than the primal."""
    others = [alias for alias in ALIASES if alias.layer not in ("primal", "alpha")]
    named = [group for group in groups if any(_named(group, alias) for alias in others)]
    return {found[:2] for found in _distinct(LAYERS["primal"], named)}


def _of_other_channels(groups: list[_Group], writer: str) -> Found | None:
    """The image of a file without R G B: a channel Y (luminance) that stands for all three, or Mitsuba's X Y Z."""
    for name in ("primal", ""):
        for group in (group for group in groups if group.name == name):
            suffixes = group.channels.keys() & {*RGB, *XYZ, "RY", "BY"}
            if suffixes == {"Y"}:
                return Found(group.part, 3 * (group.channels["Y"],), name)
            if suffixes == {*XYZ} and writer == "Mitsuba":
                return Found(group.part, tuple(group.channels[suffix] for suffix in XYZ), name)
    return None


def channels_like(found: Found) -> tuple[str, ...]:
    """The channel names of an image like ``found``: R G B, or as in ``_of_other_channels``."""
    suffixes = tuple(channel.rpartition(".")[2] for channel in found.channels)
    return suffixes if suffixes in (("Y", "Y", "Y"), XYZ) else RGB


def _lone(groups: list[_Group]) -> Found | None:
    """The only layer of colour that could be the primal, under any name; None if there is none or more than one."""
    features = _features(groups)
    words = (*NO_LIGHT, *(look for looks in LOOKS.values() for look in looks))
    tails = [(group, plain(group.name.rpartition(".")[2])) for group in groups if group.name]
    light = [g for g, tail in tails if not tail.endswith(NOISE) and not any(word in tail for word in words)]
    found = [found for found in _distinct(LAYERS["primal"], light) if found[:2] not in features]
    return found[0] if len(found) == 1 else None


def _home(groups: list[_Group], primal: Found, origin: str) -> _Home:
    """The home of the primal. Its rivals are layers named like this primal, or like primals of known renderers."""
    name = origin or primal.name
    prefix, _, tail = name.rpartition(".")
    tails = {alias.name for alias in ALIASES if alias.layer == "primal"} - {"primal"} | {tail}
    light = [group for group in groups if group.name.rpartition(".")[2] in tails and "." in group.name]
    others = {found.name.rpartition(".")[0] for found in _distinct(LAYERS["primal"], light)} - {prefix}
    return _Home(primal.part, prefix, frozenset(others) if prefix else frozenset())


def _channels(layer: Layer, group: _Group, only: tuple[str, ...], path: str) -> tuple[str, ...]:
    """The channels of ``group`` in the order of ``layer``; () if it has none of them, or lacks one of ``only``.

    Raises NgptError if it has some of the channels, or one twice.
    """
    if only:
        channels = [group.channels.get(suffix, "") for suffix in only]
        return tuple(channels[: len(layer.channels)]) if all(channels) else ()
    for spelling in _SPELLINGS[layer.channels]:
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
    """Like ``_channels``, but () also if the group has some of the channels, or one twice."""
    try:
        return _channels(layer, group, (), "")
    except NgptError:
        return ()


def _no_primal(groups: list[_Group], path: str) -> NgptError:
    root: set[str] = set().union(*(group.channels for group in groups if group.name == ""))
    if "Y" in root and not root & set(RGB):
        held = "luminance and chroma (channels Y RY BY)" if {"RY", "BY"} <= root else "channel Y beside others"
        return NgptError(f"{path}: holds {held} but no colours R G B; save the image with channels R G B")
    return NgptError(
        f"{path}: no primal image (root R G B, or a layer such as primal, Noisy Image or Combined); "
        f'the file holds {_listing(groups)}; name it with --layer primal="NAME"'
    )


def layers_held(parts: Parts) -> dict[str, str]:
    """All layers of a file: the name of each, "root" for the root, and its channels' suffixes, "R G B"."""
    return _held(_group(parts))


def _held(groups: list[_Group]) -> dict[str, str]:
    layers = [group for group in groups if "" not in group.channels]
    return {group.name or "root": " ".join(sorted(group.channels, key="RGBA".find)) for group in layers}


def _listing(groups: list[_Group], limit: int = 24) -> str:
    """The layers of a file and the suffixes of their channels as text, at most ``limit`` layers."""
    layers = _held(groups)
    names = [f'"{name}" ({channels})' for name, channels in list(layers.items())[:limit]]
    return ", ".join(names) + (f" and {len(layers) - limit} more" if len(layers) > limit else "")
