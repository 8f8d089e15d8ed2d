"""Makes files smaller: each K x K pixels become one, by rules that keep the meaning of each channel.

| channels | rule |
|---|---|
| colours, light, albedo, alpha, masks, mist, all others | mean of the values that are finite |
| normals | mean, so the length is below 1 on edges |
| depth | least value above 0, or 0 if all are 0: a mean would lie between two surfaces |
| positions, texture coordinates | value of the pixel with that depth, or of the first if the part has no depth |
| ids: whole numbers, ``IndexOB``, ``IndexMA`` and similar | most frequent value; the first of equally frequent ones |
| Cryptomatte | coverages are added up by id and divided by K²; the existing ranks keep the largest |
| motion vectors | mean divided by K, because their unit is the pixel |
| variances of the pixel mean (``*_var``) | mean divided by K² |
| ``samples`` | sum |

Gradients are refused, because differences between small pixels are not differences between large ones. Motion vectors
of unknown unit are also refused, and Cryptomatte in half floats, which has lost its ids.
"""

import re
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from ngpt.errors import NgptError, WrongUse
from ngpt.io.aliases import LOOKS, NOISE, plain
from ngpt.io.layout import data_window
from ngpt.io.openexr import ExrImage, ExrPart
from ngpt.stack import GradientStack
from ngpt.windows import Place, Window

# Header attribute of a result: K
REDUCED = "ngpt:reduced"

# Ends of the names of layers, in lower case without blanks and underscores
_IDS = ("indexob", "indexma", "objectid", "materialid", "objectindex", "materialindex", "id")
_PLACES = ("position", "uv", "texcoord", "p", "pref", "pworld")
# Cryptomatte's ranks: NAME00.R is an id, NAME00.G its coverage, NAME00.B the next id.
_RANK = re.compile(r"(.*)(\d\d)\.([RGBArgba])")
_DEEPEST = "Z"


def reduced_window(window: Window, k: int) -> Window:
    """The ``window`` in large pixels of K x K pixels each, without large pixels that its borders cut.

    Raises NgptError if no large pixel is whole.
    """
    left, top = -(-window.left // k), -(-window.top // k)
    width, height = (window.left + window.width) // k - left, (window.top + window.height) // k - top
    if width < 1 or height < 1:
        raise NgptError(f"{window} has no whole block of {k}x{k} pixels; reduce by less")
    return Window(left, top, width, height)


def reduced_place(place: Place, k: int) -> Place:
    """The place in large pixels. Raises NgptError as ``reduced_window`` does."""
    return Place(reduced_window(place.data, k), reduced_window(place.display, k), place.aspect)


def cut_pixels(place: Place, k: int) -> str:
    """A message about rows and columns that are left out because no whole block of K has them; "" if none are."""
    lines: list[str] = []
    for name, window in (("data", place.data), ("display", place.display)):
        small = reduced_window(window, k)
        whole = small.times(k)
        if whole != window and f"window {window}" not in " ".join(lines):
            lines.append(f"{name} window {window} is no multiple of {k}: {whole} of it is taken")
    return "; ".join(lines)


def smaller(image: np.ndarray, place: Place, k: int) -> tuple[np.ndarray, Place]:
    """An image (H, W, 3) after each K x K pixels have become one, and its place in large pixels."""
    return (image, place) if k == 1 else (reduced_layer(image, place.data, k), reduced_place(place, k))


def reduced_layer(layer: np.ndarray, window: Window, k: int) -> np.ndarray:
    """A layer (H, W, C) on ``window`` in large pixels, float32: the means of the finite values of K x K pixels."""
    return np.stack([_mean(_blocks(layer[..., c], window, k)) for c in range(layer.shape[-1])], axis=-1)


def check_reducible(stack: GradientStack, k: int) -> None:
    """Raises NgptError for a stack that cannot be made K times smaller: if it has gradients or is too small."""
    if k < 2:
        raise WrongUse(f"images are reduced by 2 or more, not by {k}")
    if gradients := [name for name in ("dx", "dy", "dt") if name in stack]:
        held = f"has {', '.join(gradients)}, differences between its pixels and not between larger ones"
        raise NgptError(f"{stack.path}: {held}; leave --reduce out, and render with --subpixels instead")
    try:
        reduced_place(stack.place, k)
    except NgptError as error:
        raise NgptError(f"{stack.path}: {error}") from error


def reduced(image: ExrImage, k: int, stacks: Sequence[GradientStack]) -> ExrImage:
    """The file after each K x K pixels have become one; ``stacks`` are the stacks of its views.

    Tiles keep their size in pixels. Raises NgptError for channels without a rule.
    """
    known: dict[int, str] = {}
    for stack in stacks:
        check_reducible(stack, k)
        if stack.source is not None:
            for name, found in stack.source.resolution.items():
                part = stack.source.image.parts[found.part]
                known |= {id(part.channels[channel]): name for channel in found.channels if channel in part.channels}
    attributes = [(key, value) for part in image.parts for key, value in part.header.items()]
    listed = [str(value) for key, value in attributes if re.fullmatch("cryptomatte/.*/name", key)]
    return ExrImage([_reduced_part(part, k, known, listed, stacks[0].path) for part in image.parts])


def _reduced_part(part: ExrPart, k: int, known: dict[int, str], listed: list[str], path: str) -> ExrPart:
    """The part in large pixels.

    ``known`` maps Python's id of a channel's array to its layer of the contract. ``listed`` has the names of
    Cryptomattes.
    """
    window = data_window(part)
    crypto = _cryptomattes(part, listed)
    kinds = {name: _kind(name, known.get(id(channel), "")) for name, channel in part.channels.items()}
    each = {name: _blocks(channel, window, k) for name, channel in part.channels.items()}
    depths = (each[name] for name, kind in kinds.items() if kind == "depth")
    channels: dict[str, np.ndarray] = {}
    nearest: np.ndarray | None = None
    ranked = {name for names in crypto.values() for name in names}
    for name, blocks in each.items():
        if name in ranked:
            continue
        kind = kinds[name] if blocks.dtype.kind != "u" else "id"
        if kind == "unknown motion":
            raise NgptError(
                f"{path}: channel '{name}' looks like motion vectors, and their unit is not known; name them: "
                '--layer motion="X,Y" in pixels of the large image, or leave the layer out'
            )
        if kind == "place":
            if nearest is None:
                depth = next(depths, np.zeros(blocks.shape))
                nearest = np.argmin(np.where(np.isfinite(depth) & (depth > 0), depth, np.inf), axis=-1)
            values = np.take_along_axis(blocks, nearest[..., None], axis=-1)[..., 0]
        else:
            values = _RULES[kind](blocks)
        with np.errstate(over="ignore"):
            channels[name] = np.ascontiguousarray(values, part.channels[name].dtype)
    for layer, names in crypto.items():
        if len(names) % 2:
            raise NgptError(f"{path}: Cryptomatte '{layer}' has {len(names)} channels, and ids and coverages are pairs")
        if any(part.channels[name].dtype != np.float32 for name in names):
            raise NgptError(f"{path}: Cryptomatte '{layer}' is not of 32-bit floats, so its ids are lost; render it so")
        channels |= _ranks(names, each)
    own = {name: channels[name] for name in part.channels}
    display = reduced_window(Window.of_box(part.header["displayWindow"]), k)
    header = part.header | {"dataWindow": reduced_window(window, k).box, "displayWindow": display.box}
    return replace(part, header=header, channels=own)


def _blocks(channel: np.ndarray, window: Window, k: int) -> np.ndarray:
    """The values of each block of K x K pixels, row by row, (h, w, K²), from a channel (H, W) on ``window``."""
    small = reduced_window(window, k)
    x, y = k * small.left - window.left, k * small.top - window.top
    inside = channel[y : y + k * small.height, x : x + k * small.width]
    return inside.reshape(small.height, k, small.width, k).swapaxes(1, 2).reshape(small.height, small.width, k * k)


def _kind(channel: str, layer: str) -> str:
    """The name of the rule for a channel. ``layer`` is the name of its layer in the contract, "" if it has none."""
    if layer in ("depth", "motion", "samples"):
        return layer
    if layer.endswith("_var"):
        return "variance"
    if layer:
        return "mean"
    own, _, suffix = channel.rpartition(".")
    name = plain(own.rpartition(".")[2])
    if plain(suffix) == _DEEPEST.lower() and name in ("", "depth", "z"):
        return "depth"
    if name in ("depth", "zfiltered") or plain(channel) in ("depth", "z"):
        return "depth"
    if any(look in name for look in LOOKS["motion"]):
        return "unknown motion"
    if name in _IDS or plain(suffix) in _IDS:
        return "id"
    if name in _PLACES:
        return "place"
    return "variance" if name.endswith(NOISE[:2]) and name not in NOISE else "mean"


def _mean(blocks: np.ndarray) -> np.ndarray:
    values = blocks.astype(np.float64)
    good = np.isfinite(values)
    if good.all():
        return values.mean(axis=-1).astype(np.float32)
    with np.errstate(invalid="ignore"):
        return (np.where(good, values, 0).sum(axis=-1) / good.sum(axis=-1)).astype(np.float32)


def _depth(blocks: np.ndarray) -> np.ndarray:
    values = np.where(np.isfinite(blocks) & (blocks > 0), blocks, np.inf).min(axis=-1)
    # An infinite depth stays infinite, unless a pixel has depth 0.
    return np.where(np.isfinite(values), values, np.where((blocks == 0).any(axis=-1), 0, blocks[..., 0]))


def _most_frequent(blocks: np.ndarray) -> np.ndarray:
    """The most frequent value of each block; the first of equally frequent ones."""
    votes = (blocks[..., :, None] == blocks[..., None, :]).sum(axis=-1)
    return np.take_along_axis(blocks, np.argmax(votes, axis=-1)[..., None], axis=-1)[..., 0]


_RULES: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "mean": _mean,
    "depth": _depth,
    "id": _most_frequent,
    "motion": lambda blocks: _mean(blocks) / np.float32(blocks.shape[-1] ** 0.5),
    "variance": lambda blocks: _mean(blocks) / np.float32(blocks.shape[-1]),
    "samples": lambda blocks: blocks.sum(axis=-1, dtype=np.float64),
}


def _cryptomattes(part: ExrPart, listed: list[str]) -> dict[str, list[str]]:
    """The name of each Cryptomatte in a part -> its channels by rank, ids and coverages alternating.

    A layer is a Cryptomatte if headers list it (``listed``), or if its name contains "crypto".
    """
    found: dict[str, dict[tuple[int, int], str]] = {}
    for channel in part.channels:
        match = _RANK.fullmatch(channel)
        if match and (match[1] in listed or "crypto" in plain(match[1])):
            found.setdefault(match[1], {})[int(match[2]), "rgba".index(match[3].lower())] = channel
    return {name: [ranks[key] for key in sorted(ranks)] for name, ranks in found.items()}


def _ranks(names: Sequence[str], blocks: dict[str, Any]) -> dict[str, np.ndarray]:
    """The channels of a Cryptomatte: the coverages in each block are added up by id, and the largest come first.

    Ids are compared as bits. Coverage beyond the existing ranks is lost, as in any Cryptomatte.
    """
    ids = np.concatenate([blocks[name].view(np.uint32) for name in names[::2]], axis=-1)
    coverage = np.concatenate([blocks[name] for name in names[1::2]], axis=-1).astype(np.float64)
    pixels = blocks[names[0]].shape[-1]
    # An id may occur several times in a block. After sorting by id, each id is a run, whose sum is put at its end.
    order = np.argsort(ids, axis=-1, kind="stable")
    ids, coverage = (np.take_along_axis(each, order, axis=-1) for each in (ids, coverage))
    starts = np.ones(ids.shape, bool)
    starts[..., 1:] = ids[..., 1:] != ids[..., :-1]
    total = coverage.cumsum(axis=-1)
    ends = np.ones(ids.shape, bool)
    ends[..., :-1] = starts[..., 1:]
    # The sum of a run is the running total at its end minus the total before it.
    before = np.maximum.accumulate(np.where(starts, total - coverage, -np.inf), axis=-1)
    each = np.where(ends, total - before, 0.0) / pixels
    order = np.argsort(-each, axis=-1, kind="stable")[..., : len(names) // 2]
    ids, each = (np.take_along_axis(values, order, axis=-1) for values in (ids, each))
    ids = np.where(each > 0, ids, 0)
    result = {}
    for rank in range(len(names) // 2):
        result[names[2 * rank]] = np.ascontiguousarray(ids[..., rank]).view(np.float32)
        result[names[2 * rank + 1]] = np.ascontiguousarray(each[..., rank], np.float32)
    return result
