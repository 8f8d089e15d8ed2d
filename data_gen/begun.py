"""Unfinished renders: whether a file has all that was requested, and what is left to render.

What is left (the rest) gets its own seed, derived from the requested seed and the number of parts that exist. So the
samples of the rest are independent of those in the file, and both parts are merged like any stacks with different seeds
(``ngpt.merging``).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from data_gen.request import RenderRequest, said_by
from data_gen.samplers import FRAME_SAMPLERS
from ngpt.errors import NgptError
from ngpt.io.exr import pass_through, read, with_channels, write
from ngpt.io.results import MADE_BY
from ngpt.merging import DIAGNOSTICS, OPTIONS, REQUEST, UNFINISHED, merge
from ngpt.methods import METHODS
from ngpt.options import written
from ngpt.stack import GradientStack
from ngpt.subpixels import SUBPIXELS
from ngpt.system.files import save

# A rest below this fraction of the requested time is not worth rendering
_NOTHING = 0.02
# If fewer samples per pixel than this are left, they are too few to be adaptive and are rendered evenly.
SHARED = 32


def frame_seed(seed: int, frame: int, use: int = 0) -> int:
    """The seed of a frame, which depends on no other frame. Each ``use`` of the frame has another seed."""
    # Entropy must not be negative, but the number of a frame may be.
    entropy = [seed, frame % 2**64]
    return int(np.random.SeedSequence([*entropy, use] if use else entropy).generate_state(1, np.uint64)[0])


def part_seed(seed: int, part: int) -> int:
    """The seed of a part of a render; part 0 has the requested ``seed``."""
    return int(np.random.SeedSequence([seed, part, 0, 1]).generate_state(1, np.uint64)[0]) if part else seed


class Unfinished(NgptError):
    """A failure during a render. ``stack`` holds the samples that were rendered before it."""

    def __init__(self, message: str, stack: GradientStack):
        super().__init__(message)
        self.stack = stack


def rest_of(
    request: RenderRequest, path: Path, attributes: Mapping[str, Any], frame: int | None = None
) -> RenderRequest | None:
    """The part of a request that its file still lacks, for an image or for a ``frame``; None if it lacks nothing.

    ``attributes`` are from the header of the file at ``path``. The rest is rendered by the sampler that the header
    names, with the seed of the next part. Raises NgptError if the file belongs to another request.
    """
    said = _same(request, path, attributes, frame)
    seeds, sampler = str(attributes.get("ngpt:seed", "")).split(), str(attributes.get("ngpt:sampler", ""))
    done, took = (_number(attributes.get(name)) for name in ("ngpt:spp", "ngpt:seconds"))
    if request.spp is not None and done >= request.spp:
        return None
    given = took if UNFINISHED in attributes else max(took, _number(said.get("seconds")))
    if request.seconds is not None and given >= (1 - _NOTHING) * request.seconds:
        return None
    reached = _number(attributes.get("ngpt:error")) or math.inf
    if request.error is not None and reached <= (1 + 1e-6) * request.error:  # headers store 32-bit floats
        return None
    if sampler in FRAME_SAMPLERS:
        raise NgptError(
            f"{path}: has {done:g} of {request.spp} samples per pixel, and sampler '{sampler}' cannot go on with a "
            "frame; remove it, or pass --force"
        )
    spp = None if request.spp is None else request.spp - int(done)
    even = spp is not None and spp < SHARED
    shares = not even and (request.shares or "ngpt:adaptive" in attributes)
    # The method whose error the adaptive samples have followed so far, or else the one that will denoise the stack
    methods = (attributes.get("ngpt:adaptive"), request.method, attributes.get("ngpt:for"))
    bare = "features=false" in str(attributes.get(OPTIONS, "")).split(", ")
    return replace(
        request,
        seed=part_seed(request.seed, len(seeds)),
        spp=spp,
        seconds=None if request.seconds is None else request.seconds - given,
        error=None if request.error is None or even else 1 / math.sqrt(request.error**-2 - reached**-2),
        sampler=sampler,
        options={**request.options, **({"features": False} if bare else {})},
        subpixels=int(_number(attributes.get(SUBPIXELS))) or 1,
        adaptive=shares,
        method=next((method for method in methods if method in METHODS), None) if shares else None,
    )


def _same(request: RenderRequest, path: Path, attributes: Mapping[str, Any], frame: int | None) -> dict[str, Any]:
    """The request in the header of a file. Raises NgptError if it differs from ``request`` in more than the budget."""
    said = said_by(attributes)
    remedy = "give another name, or --force in place of --skip-existing to replace it"
    for what, given in {"scene": request.scene, "camera": request.camera}.items():
        if not isinstance(given, str | Path | None):
            raise NgptError(
                f"{path}: whether it is of this {what} cannot be known, for a {type(given).__name__} has no file; name "
                f"the {what}'s file, give another name, or --force (overwrite=True) to replace it"
            )
    if said is None:
        raise NgptError(
            f"{path}: is another render: its header has no request (it was merged, or is of an older ngpt); {remedy}"
        )
    for what, ours in request.identity(frame).items():
        if (theirs := said.get(what)) != ours:
            # If two scenes have the same name, they differ only in the checksum, which tells a user nothing.
            alike = what == "scene" and str(theirs).rpartition(" ")[0] == str(ours).rpartition(" ")[0]
            why = " (its file, -D, --sensor, --camera, --fps or --dt was another)" if alike else ""
            raise NgptError(
                f"{path}: is another render: {what} {_said(theirs)}, not {_said(ours)}{why}; ask for the same, {remedy}"
            )
    return said


def begun_stack(path: Path) -> GradientStack:
    """The stack in a file, without the image that a method may have made from this stack."""
    found = read(path)
    layers = {name: found[name] for name in found.names if name != "error"}
    attributes = {name: value for name, value in found.attributes.items() if name not in MADE_BY}
    further = {name: channel for name, channel in pass_through(found).items() if name.startswith(DIAGNOSTICS)}
    stack = GradientStack(layers, attributes, path=found.path, place=found.place, fine=found.fine)
    return with_channels(stack, further) if further else stack


def joined_or_kept(path: Path, rest: GradientStack, begun: GradientStack) -> GradientStack:
    """Merges both parts of a render. The attributes that say how the render ended come from ``rest``.

    If the parts cannot be merged, the rest is written to another file beside ``path``, and NgptError names that file.
    """
    try:
        whole = merge([begun, rest])
    except NgptError as error:
        raise kept_apart(str(error), rest, path.with_name(f"{path.stem}.rest.exr"), "was rendered now") from error
    last = (UNFINISHED, REQUEST, "ngpt:adaptive")
    whole.attributes |= {name: rest.attributes[name] for name in last if name in rest.attributes}
    # Errors are proportional to 1 / sqrt(samples), so the 1 / error² of the parts add up.
    errors = [n for stack in (begun, rest) if (n := _number(stack.attributes.get("ngpt:error")))]
    if errors:
        whole.attributes["ngpt:error"] = 1 / math.sqrt(sum(n**-2 for n in errors))
    return whole


def kept_apart(why: str, stack: GradientStack, path: Path, what: str = "was rendered") -> NgptError:
    """Writes a stack to ``path``, or elsewhere, after a failure. Returns an error whose message contains ``why`` and
    the name of that file."""
    try:
        save(path, lambda path, overwrite: write(path, stack, overwrite=overwrite))
    except NgptError as other:
        return NgptError(f"{why}; {other}")
    return NgptError(f"{why}; what {what} is in {path}")


def _number(value: Any) -> float:
    try:
        number = float(value) if isinstance(value, int | float | np.number) else 0.0
    except OverflowError:  # a whole number in JSON may be larger than any float
        return 0.0
    return number if math.isfinite(number) else 0.0


def _said(value: Any) -> str:
    return "none" if value is None else written(value)
