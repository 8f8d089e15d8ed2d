"""``ngpt denoise --temporal``: chooses between history and windows of frames, and reconstructs shots by windows.

With history, each result is blended with the results before it. With windows, several frames are reconstructed
together.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path

from ngpt.cli.denoise_files import Frame, View
from ngpt.cli.denoise_request import DenoiseRequest
from ngpt.errors import NgptError
from ngpt.io.exr import layers_in, read_views
from ngpt.io.resolution import propose
from ngpt.sequence.history import NO_MOTION
from ngpt.sequence.wcv_windows import LENGTH, LINK, reconstruct_shot
from ngpt.stack import GradientStack


def choose_blending(request: DenoiseRequest) -> tuple[bool, str]:
    """Returns whether windows of frames are used for the shot, and a message about how its frames are blended.

    Windows are used if the method is ``wcv`` without options, and if all frames but the first have the layers that lead
    to the previous frame. The layers are read from the headers of all files. Files that cannot be read are ignored
    here. Each of them counts as a cut, and is reported when it is processed.
    """
    history = "history, each frame by those before it"
    if request.method != "wcv" or request.options:
        return False, history
    known = {}
    for path, _ in request.pairs:
        try:
            known[path] = layers_in(path, request.layer)
        except NgptError:
            continue
    lacking = [path for path, layers in list(known.items())[1:] if not layers.issuperset(LINK)]
    if len(known) > 1 and not lacking:
        return True, f"windows of {LENGTH} frames, by the differences in time of all frames"
    example = f": {lacking[0]} lacks some" if len(lacking) < len(known) - 1 else ""
    return False, f"{history}; windows need {', '.join(LINK)} in all frames but the first{example}"


def motion_hint(request: DenoiseRequest, reports: Sequence[dict]) -> str:
    """The message about a shot without motion, and about layers that may hold motion; "" for a shot with motion."""
    why = [report["why no history"] for report in reports[1:] if "why no history" in report]
    if not why or any(reason != NO_MOTION for reason in why):
        return ""
    stack = read_views(request.pairs[-1][0], request.layer, request.untrusted, view=request.view)[0]
    proposed = propose(stack.source.view.parts, stack.source.resolution).get("motion") if stack.source else None
    found = f"; if these lead to the next frame, y up: --layer motion={proposed}" if proposed else ""
    lack = "--temporal: without the layer 'motion' each frame is denoised by itself"
    return f"{lack}{found}; see docs, from-your-renderer.md#motion"


def option_of_one_view(target: Path, request: DenoiseRequest) -> str:
    """The option, or the target, that allows only one view; "" if any number of views is allowed."""
    if target.suffix.lower() != ".exr":
        return str(target)
    return "--ref" if request.reference is not None else next((f"--{layer}" for layer in request.files), "")


def windowed(
    request: DenoiseRequest,
    read: Callable[[tuple[Path, Path]], Frame],
    write: Callable[[Frame], dict],
) -> Iterator[dict | NgptError]:
    """Yields the report on each pair, in order. A file that cannot be read counts as a cut, and is reported.

    ``read`` and ``write`` are the functions of ``ngpt.cli.denoise`` for frames. A frame whose result exists is read but
    not written.
    """
    frames: dict[int, Frame] = {}
    errors: dict[int, NgptError] = {}

    def stacks() -> Iterator[GradientStack | None]:
        for number, pair in enumerate(request.pairs):
            try:
                frames[number] = read(pair)
                if len(frames[number].views) > 1:
                    raise NgptError(f"{pair[0]}: has several views; --temporal -m wcv takes one: choose it with --view")
            except NgptError as error:
                errors[number] = error
                yield None
                continue
            yield frames[number].views[0].stack

    def reports_until(last: int) -> Iterator[dict | NgptError]:
        """Yields the reports on frames without a new result that come before the frame ``last``."""
        for number in range(done, last):
            yield errors[number] if number in errors else write(frames.pop(number))

    done = 0
    for number, _, result in reconstruct_shot(stacks(), lambda number: not frames[number].exists):
        yield from reports_until(number)
        frame = frames.pop(number)
        notes = request.reference.errors(result.image, frame.views[0].stack) if request.reference is not None else {}
        view = View(frame.views[0].stack, result, {"ngpt:temporal": "windows"}, notes)
        yield write(replace(frame, views=(view,)))
        done = number + 1
    yield from reports_until(len(request.pairs))
