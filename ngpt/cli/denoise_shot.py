"""``ngpt denoise --temporal``: how a shot is blended, and blending by windows of the frames before and after."""

import argparse
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from ngpt.cli.reference import Reference
from ngpt.errors import NgptError
from ngpt.io.exr import layers_in, read_views
from ngpt.io.resolution import propose
from ngpt.sequence.history import NO_MOTION
from ngpt.sequence.wcv_windows import LENGTH, LINK, reconstruct_shot
from ngpt.stack import GradientStack


def way(sources: Sequence[Path], names: Mapping[str, str], by_wcv: bool) -> tuple[bool, str]:
    """Whether windows reconstruct the shot, and a message about it, from the headers of all its files.

    Windows do so if the method is ``wcv``, and all frames but the first have the layers that lead to the previous
    frame. ``names`` maps layer names, as for ``ngpt.io.exr.read``. Files that cannot be read are ignored here: each one
    counts as a cut, and is reported when it is processed.
    """
    history = "history, each frame by those before it"
    if not by_wcv:
        return False, history
    known = {}
    for path in sources:
        try:
            known[path] = layers_in(path, names)
        except NgptError:
            continue
    lacking = [path for path, layers in list(known.items())[1:] if not layers.issuperset(LINK)]
    if len(known) > 1 and not lacking:
        return True, f"windows of {LENGTH} frames, by the differences in time of all frames"
    those = f": {lacking[0]} lacks some" if len(lacking) < len(known) - 1 else ""
    return False, f"{history}; windows need {', '.join(LINK)} in all frames but the first{those}"


def motion_hint(pairs: Sequence[tuple[Path, Path]], reports: Sequence[dict], args: argparse.Namespace) -> str:
    """The message about a shot without motion, and about layers that may hold it; "" for a shot with motion."""
    why = [report["why no history"] for report in reports[1:] if "why no history" in report]
    if not why or any(reason != NO_MOTION for reason in why):
        return ""
    stack = read_views(pairs[-1][0], dict(args.layer), args.untrusted, view=args.view)[0]
    proposed = propose(stack.source.view.parts, stack.source.resolution).get("motion") if stack.source else None
    found = f"; if these lead to the next frame, y up: --layer motion={proposed}" if proposed else ""
    lack = "--temporal: without the layer 'motion' each frame is denoised by itself"
    return f"{lack}{found}; see docs, from-your-renderer.md#motion"


def one_view_only(target: Path, args: argparse.Namespace, files: Mapping[str, str]) -> str:
    """The words of a message for an option that allows only one view; "" if there is no such option."""
    if target.suffix.lower() != ".exr":
        return f"{target} is of one"
    if args.ref:
        return "--ref is of one"
    return f"--{next(iter(files))} is of one" if files else ""


def windowed(
    pairs: Sequence[tuple[Path, Path]],
    read: Callable[[tuple[Path, Path]], Any],
    write: Callable[[Any], dict],
    reference: Reference | None,
) -> Iterator[dict | NgptError]:
    """Yields the report on each pair, in order. A file that cannot be read counts as a cut, and is reported.

    ``read`` and ``write`` are the functions of ``ngpt.cli.denoise`` for frames. A frame marked ``there`` is read but
    not written.
    """
    frames: dict[int, Any] = {}
    told: dict[int, dict | NgptError] = {}

    def stacks() -> Iterator[GradientStack | None]:
        for number, pair in enumerate(pairs):
            try:
                frames[number] = read(pair)
                if frames[number].others:
                    raise NgptError(
                        f"{pair[0]}: has several views, and --temporal -m wcv takes one; choose it with --view"
                    )
            except NgptError as error:
                told[number] = error
                yield None
                continue
            yield frames[number].stack

    done = 0
    for number, _, result in reconstruct_shot(stacks(), lambda number: not frames[number].there):
        while done < number:
            yield told[done] if done in told else write(frames.pop(done))
            done += 1
        more = reference.errors(result.image, frames[number].stack) if reference is not None else {}
        over_time = {"ngpt:temporal": "windows"}
        yield write(replace(frames.pop(number), result=result, over_time=over_time, told=more))
        done = number + 1
    while done < len(pairs):
        yield told[done] if done in told else write(frames.pop(done))
        done += 1
