"""The files of ``ngpt denoise``: how results are written, and the reports about them."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from ngpt.cli.denoise_request import DenoiseRequest
from ngpt.io.exr import layers_of_result
from ngpt.io.reduced import cut_pixels, smaller
from ngpt.io.resolution import propose
from ngpt.methods import METHODS, Result
from ngpt.result_file import write_result
from ngpt.stack import GradientStack
from ngpt.system.files import save
from ngpt.version import __version__


@dataclass(frozen=True)
class View:
    """The stack of one view of a file, and its result once it is computed.

    ``over_time``  header attributes about the use of other frames
    ``notes``      further entries of the report
    """

    stack: GradientStack
    result: Result | None = None
    over_time: Mapping[str, Any] = field(default_factory=dict)
    notes: Mapping[str, Any] = field(default_factory=dict)

    @property
    def name(self) -> str:
        """The name of the view; "" in a file without views."""
        return self.stack.source.view.name if self.stack.source is not None else ""


@dataclass(frozen=True)
class Frame:
    """A file to denoise, the file for its result, and its views. A frame without views is skipped.

    ``exists``               whether the result existed already
    ``replaces_incomplete``  whether the result replaces an incomplete file
    """

    source: Path
    target: Path
    views: tuple[View, ...] = ()
    exists: bool = False
    replaces_incomplete: bool = False


def write_frame(frame: Frame, request: DenoiseRequest) -> dict:
    """Writes the result, and returns its report.

    If the result of a single stack cannot be written to its place, it is written elsewhere. The result of one of
    several stacks is not written elsewhere, because the next call makes it again.
    """
    target = frame.target
    report: dict[str, Any] = {"input": str(frame.source), "output": str(target)}
    if frame.exists or not frame.views:
        return report | {"skipped": True}
    images = [(view.result.image, view.stack) for view in frame.views if view.result is not None]
    first, overwrite = frame.views[0], request.force or frame.replaces_incomplete
    stack, result = first.stack, first.result
    assert result is not None
    made = {**result.attributes, **first.over_time}

    def save_to(path: Path, overwrite: bool) -> None:
        write_result(path, images, made, request.look, overwrite, into=request.into, reduce=request.reduce)

    if len(request.pairs) == 1:
        save(target, save_to, overwrite)
    else:
        save_to(target, overwrite)
    image, _ = smaller(result.image, stack.place, request.reduce)
    report |= {
        "method": result.method,
        "weights": {"file": result.weights.file, "sha256": result.weights.sha256} if result.weights else None,
        "options": result.options,
        "estimated": list(result.estimated),
        "version": __version__,
        "seconds": result.seconds,
        "width": image.shape[1],
        "height": image.shape[0],
        "repaired": result.repaired,
        "untrusted": result.untrusted,
        "standard error": result.error is not None,
        "groups": [],
    }
    if result.error is not None:
        report["pixels without standard error"] = int(np.isnan(result.error).any(axis=-1).sum())
    if target.suffix.lower() == ".exr":
        report["layers"], report["noisy layers"] = layers_of_result(stack, request.into)
    if stack.source is not None:
        found = propose(stack.source.view.parts, stack.source.resolution)
        report["proposed"] = {name: found[name] for name in ("albedo", "normal") if name in found.keys() - {*stack}}
    if first.name:
        report["views"] = [view.name for view in frame.views]
    if request.reduce > 1:
        cut = cut_pixels(stack.place, request.reduce)
        report |= {"reduced by": request.reduce} | ({"cut": cut} if cut else {})
    if frame.replaces_incomplete:
        report["in place of"] = "a file that was not whole"
    over_time = {name.removeprefix("ngpt:"): value for name, value in first.over_time.items()}
    report |= {name: over_time[name] for name in ("temporal", "history") if name in over_time}
    return {**report, **first.notes}


def describe(report: dict) -> str:
    """The report on one file as a line of text."""
    names = f"{report['input']} -> {report['output']}: "
    if "skipped" in report:
        return f"{names}skipped, exists already"
    notes = [report["method"]]
    if report["weights"] and report["method"] not in METHODS:
        notes.append(f"sha256 {report['weights']['sha256'][:12]}")
    notes.append(f"{report['seconds']:.2f} s")
    if len(report.get("layers", ())) > 1:
        notes.append(f"layers {' and '.join(report['layers'])}")
    for name in report.get("noisy layers", ())[:1]:
        notes.append(f"{name} stays as it was (--into {name.rpartition('.')[2]} replaces it)")
    if report.get("views"):
        notes.append(f"views {', '.join(report['views'])}")
    if "reduced by" in report:
        blocks = f"{report['reduced by']}x{report['reduced by']} pixels as one: {report['width']}x{report['height']}"
        notes.append(blocks + (f" ({report['cut']})" if "cut" in report else ""))
    if report["repaired"]:
        notes.append(f"repaired {report['repaired']} pixels")
    if report["untrusted"]:
        notes.append(f"left out {report['untrusted']} gradients")
    if "in place of" in report:
        notes.append(f"in place of {report['in place of']}")
    if "history" in report:
        why = f" ({report['why no history']})" if "why no history" in report else ""
        notes.append(f"{report['history']:.0%} history{why}")
    if report["groups"]:
        notes.append(f"light groups {', '.join(report['groups'])}")
    if "metrics" in report:
        notes += [f"{name} {report['metrics'][name]:.5g}" for name in ("relMSE", "relMSE trimmed")]
        notes[-1] += f" of the pixels that both have: {report['compared']}" if "compared" in report else ""
    return names + ", ".join(notes)
