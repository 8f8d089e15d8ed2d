"""Renders that were begun: whether a file has all that is asked for, and what is left to render of it.

The rest gets its own seed, made from the requested seed and the number of existing parts. So its samples are
independent of those in the file, and parts are merged exactly as stacks with different seeds are (``ngpt.merging``).
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from data_gen.samplers import FRAME_SAMPLERS, SAMPLERS
from ngpt.errors import NgptError
from ngpt.io.exr import pass_through, read, with_channels, write
from ngpt.io.openexr import read_header
from ngpt.io.results import MADE_BY
from ngpt.io.whole import finished
from ngpt.merging import DIAGNOSTICS, OPTIONS, UNFINISHED, merge
from ngpt.stack import GradientStack
from ngpt.subpixels import SUBPIXELS
from ngpt.system.files import save
from ngpt.windows import Window

# Attributes: which scene a stack is of, and for how many seconds it was to be rendered
SCENE, TIME = "ngpt:scene", "ngpt:time"
# Options that a render decides on, where nobody else does: points by the number of samples, tails by what pays
_EITHER = {"points=rounds", "points=sobol", "tails=shared", "tails=paths"}
# And one that "auto" decides on
_NO_FEATURES = "features=false"
# Parts of a variant's name that say where and how precisely it computes, and nothing of the light
_MACHINES = {"scalar", "llvm", "cuda", "metal", "ad", "double"}
# The fraction of the time asked for that is too little to go on for
_NOTHING = 0.02
# Samples per pixel that are too few to be shared out: what is left is rendered evenly then.
SHARED = 32


def frame_seed(seed: int, frame: int, use: int = 0) -> int:
    """The seed of a frame: one of its own, whatever other frames are rendered; and of each use of it."""
    # Entropy must not be negative, frames may be.
    entropy = [seed, frame % 2**64]
    return int(np.random.SeedSequence([*entropy, use] if use else entropy).generate_state(1, np.uint64)[0])


def part_seed(seed: int, part: int) -> int:
    """The seed of a part of a render; part 0 has the one that was asked for."""
    return int(np.random.SeedSequence([seed, part, 0, 1]).generate_state(1, np.uint64)[0]) if part else seed


def scene_name(scene: str, parameters: Mapping[str, str], *files: str | None) -> str:
    """What a header says of a scene: its name, and a checksum of its file, of its parameters and of further ``files``.

    Meshes and textures do not count. Raises NgptError for files that cannot be read.
    """
    digest = hashlib.sha256(repr(sorted(parameters.items())).encode())
    for file in (scene, *files):
        if file is not None and Path(file).is_file():
            try:
                digest.update(Path(file).read_bytes())
            except OSError as error:
                raise NgptError(f"{file}: cannot be read: {error.strerror or error}") from error
    return f"{Path(scene).name} {digest.hexdigest()[:16]}"


class Unfinished(NgptError):
    """What failed amid a render, and the ``stack`` of the samples that were done by then."""

    def __init__(self, message: str, stack: GradientStack):
        super().__init__(message)
        self.stack = stack


@dataclass(frozen=True)
class Rest:
    """What is left of a render that already has so many ``parts``."""

    parts: int
    spp: int | None
    seconds: float | None
    error: float | None
    sampler: str
    adaptive: str = ""  # the method that samples are shared out for
    subpixels: int = 1  # of a pixel: K for K x K
    features: bool = True

    def method(self, asked: str | None) -> str | None:
        """What samples are shared out for; None where they are not."""
        return self.adaptive or (asked if self.error is not None else None)

    def options(self, seed: int) -> dict[str, Any]:
        """Options of ``render_scene`` and ``render_frames`` for the rest of a render asked for with ``seed``."""
        given = {"spp": self.spp, "seconds": self.seconds, "sampler": self.sampler, "subpixels": self.subpixels}
        return given | {"seed": part_seed(seed, self.parts)} | ({} if self.features else {"features": False})


@dataclass(frozen=True)
class Asked:
    """What is asked for; of ``spp``, ``seconds`` and ``error`` the one reached first ends a render."""

    scene: str
    seed: int
    sampler: str = "auto"
    options: Mapping[str, Any] = field(default_factory=dict)
    size: tuple[int, int] | None = None
    spp: int | None = None
    seconds: float | None = None
    error: float | None = None
    adaptive: str = ""  # the method that samples are shared out for
    frame: int | None = None
    unbiased: bool = False  # paths must not share what they find
    variant: str = ""  # of Mitsuba; "": its colours are not compared
    diagnostics: bool = False
    subpixels: int | str = "auto"

    def left(self, path: Path) -> Rest | None:
        """What is left to render of the stack in a file, None where nothing is.

        Raises NgptError where the stack is another render: scene, frame, seed, size, sampler or its options, colours
        of the variant, or how samples are shared out differ; where it is biased, and what is asked for is not; and
        where it has not the channels that are asked for.
        """
        attributes, _ = read_header(path)
        # With a crop window, the film that was asked for is the display window.
        size = Window.of_box(attributes["displayWindow"]).size
        seeds = str(attributes.get("ngpt:seed", "")).split()
        sampler = str(attributes.get("ngpt:sampler", ""))
        self._check(path, attributes, size, seeds, sampler)
        done, took = (_number(attributes, name) for name in ("ngpt:spp", "ngpt:seconds"))
        if self.spp is not None and done >= self.spp:
            return None
        given = took if UNFINISHED in attributes else max(took, _number(attributes, TIME))
        if self.seconds is not None and given >= (1 - _NOTHING) * self.seconds:
            return None
        reached = _number(attributes, "ngpt:error") or math.inf
        if self.error is not None and reached <= (1 + 1e-6) * self.error:  # headers have 32 bits
            return None
        if sampler in FRAME_SAMPLERS:
            raise NgptError(
                f"{path}: has {done:g} of {self.spp} samples per pixel, and sampler '{sampler}' cannot go on with a "
                "frame; remove it, or pass --force"
            )
        spp = None if self.spp is None else self.spp - int(done)
        even = spp is not None and spp < SHARED
        return Rest(
            len(seeds),
            spp,
            None if self.seconds is None else self.seconds - given,
            None if self.error is None or even else 1 / math.sqrt(self.error**-2 - reached**-2),
            sampler,
            "" if even else str(attributes.get("ngpt:adaptive", self.adaptive)),
            int(_number(attributes, SUBPIXELS)) or 1,
            _NO_FEATURES not in _options(str(attributes.get(OPTIONS, ""))),
        )

    def done(self, path: Path) -> bool:
        """Whether the file is there, whole, and has all that is asked for."""
        with suppress(NgptError):
            return finished(path) and self.left(path) is None
        return False

    def name(self, stack: GradientStack) -> None:
        """Has the stack's header say what it is of, and for how long it was to be rendered."""
        stack.attributes[SCENE] = self.scene
        if self.seconds is not None:
            stack.attributes[TIME] = self.seconds

    def _check(self, path: Path, attributes: Mapping, size: tuple[int, int], seeds: list[str], sampler: str) -> None:
        ours = [part_seed(self.seed, part) for part in range(max(len(seeds), 1))]
        if self.frame is not None and self.sampler not in FRAME_SAMPLERS:
            ours = [frame_seed(seed, self.frame) for seed in ours]
        named = _options(str(attributes.get(OPTIONS, "")))
        options = named - _EITHER - ({_NO_FEATURES} if self.sampler == "auto" else set())
        # What the file's sampler is called with if any will do; one from another package may be missing here.
        own = SAMPLERS.get(sampler) if self.sampler in ("auto", sampler) else None
        entry = FRAME_SAMPLERS.get(self.sampler) or own
        wanted = _options(entry.unusual(entry.settings(self.options))) - _EITHER if entry else options
        unbiased = self.unbiased or self.options.get("tails") == "paths"
        kept = int(_number(attributes, SUBPIXELS)) or 1
        theirs_shared, ours_shared = self._sharing(attributes, len(seeds))
        colours = _colours(str(attributes.get("software", "")).rpartition(" ")[2])
        for what, theirs, asked in (
            ("scene", attributes.get(SCENE, self.scene), self.scene),
            ("frame", attributes.get("ngpt:frame"), self.frame),
            ("size", "{}x{}".format(*size), "{}x{}".format(*(self.size or size))),
            ("seed", " ".join(seeds), " ".join(map(str, ours))),
            ("sampler", sampler, sampler if self.sampler == "auto" else self.sampler),
            ("options", options, wanted),
            ("tails", "shared", "of each path (--unbiased)" if unbiased and "tails=shared" in named else "shared"),
            ("samples", theirs_shared, ours_shared),
            ("subpixels", kept, kept if self.subpixels == "auto" else self.subpixels),
            ("colours", colours, _colours(self.variant) if colours and self.variant else colours),
        ):
            if theirs != asked:
                # Names alike differ in the checksum, which says nothing to anybody.
                alike = what == "scene" and str(theirs).rpartition(" ")[0] == str(asked).rpartition(" ")[0]
                why = " (its file, -D, --sensor, --camera, --fps or --dt was another)" if alike else ""
                raise NgptError(
                    f"{path}: is another render: {what} {_text(theirs)}, not {_text(asked)}{why}; give another name, "
                    "or --force in place of --skip-existing to replace it"
                )
        if self.diagnostics != any(channel.name.startswith(DIAGNOSTICS) for channel in attributes["channels"]):
            has, remedy = ("none", "leave --diagnostics out") if self.diagnostics else ("some", "pass --diagnostics")
            raise NgptError(
                f"{path}: has {has} of the channels that --diagnostics writes; {remedy}, or give another name"
            )

    def _sharing(self, attributes: Mapping, parts: int) -> tuple[str, str]:
        """How the samples of a file are shared out, and how they should be; the same where it does not matter."""
        theirs = str(attributes.get("ngpt:adaptive", ""))
        by_itself = self.sampler == "auto" and self.seconds is not None and self.spp is None
        if not theirs and self.adaptive and parts == 1 and UNFINISHED not in attributes:
            return "alike for all pixels", f"for '{self.adaptive}' (--adaptive)"
        if theirs and not self.adaptive and self.error is None and not by_itself:
            return f"for '{theirs}' (--adaptive)", "alike for all pixels"
        if theirs and self.adaptive not in ("", "auto", theirs):
            return f"for '{theirs}'", f"for '{self.adaptive}'"
        return theirs, theirs


def begun_stack(path: Path) -> GradientStack:
    """What was rendered of the stack in a file: without the image that a method made of it, if any."""
    found = read(path)
    layers = {name: found[name] for name in found.names if name != "error"}
    attributes = {name: value for name, value in found.attributes.items() if name not in MADE_BY}
    further = {name: channel for name, channel in pass_through(found).items() if name.startswith(DIAGNOSTICS)}
    stack = GradientStack(layers, attributes, path=found.path, place=found.place, fine=found.fine)
    return with_channels(stack, further) if further else stack


def joined_or_kept(path: Path, rest: GradientStack, begun: GradientStack) -> GradientStack:
    """Both parts merged; the attributes that say how the render ended come from ``rest``.

    Where that fails, the rest is written beside ``path``, and NgptError says so.
    """
    try:
        whole = merge([begun, rest])
    except NgptError as error:
        raise kept_apart(str(error), rest, path.with_name(f"{path.stem}.rest.exr"), "was rendered now") from error
    last = (UNFINISHED, TIME, "ngpt:adaptive")
    whole.attributes |= {name: rest.attributes[name] for name in last if name in rest.attributes}
    # Errors fall with the root of the samples.
    errors = [n for stack in (begun, rest) if (n := _number(stack.attributes, "ngpt:error"))]
    if errors:
        whole.attributes["ngpt:error"] = 1 / math.sqrt(sum(n**-2 for n in errors))
    return whole


def kept_apart(why: str, stack: GradientStack, path: Path, what: str = "was rendered") -> NgptError:
    """Writes a stack to ``path``, or elsewhere, after a failure; returns the error that says why, and where it is."""
    try:
        save(path, lambda path, overwrite: write(path, stack, overwrite=overwrite))
    except NgptError as other:
        return NgptError(f"{why}; {other}")
    return NgptError(f"{why}; what {what} is in {path}")


def write_part(path: Path, stack: GradientStack, overwrite: bool, begun: GradientStack | None = None) -> GradientStack:
    """Writes a stack, in place of the one that was ``begun`` and together with it; returns what is written.

    Nothing that was rendered is lost: what cannot be written there goes elsewhere (``ngpt.system.files.save``).
    """
    if begun is not None:
        stack, overwrite = joined_or_kept(path, stack, begun), True
    save(path, lambda path, overwrite: write(path, stack, overwrite=overwrite), overwrite)
    return stack


def _text(value: Any) -> str:
    value = ", ".join(sorted(value)) or "none" if isinstance(value, set) else value
    return "unknown" if value in ("", None) else str(value)


def _options(text: str) -> set[str]:
    return {option for option in text.split(", ") if option}


def _colours(variant: str) -> str:
    """What a variant of Mitsuba knows of light: "rgb", "spectral", "mono", "rgb polarized"; "" of no variant."""
    machine, *parts = variant.split("_")
    return " ".join(part for part in parts if part not in _MACHINES) if machine in _MACHINES else ""


def _number(attributes: Mapping[str, Any], name: str) -> float:
    value = attributes.get(name)
    return float(value) if isinstance(value, int | float | np.number) and math.isfinite(value) else 0.0
