"""The files of ``ngpt denoise``: where results go, how they are written, and what is reported about them."""

from __future__ import annotations

import argparse
import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from ngpt.errors import WrongUse
from ngpt.io.exr import layers_of_result
from ngpt.io.framenames import named, number_of, varies
from ngpt.io.frames import RESULT_SUFFIX
from ngpt.io.reduced import cut_pixels, smaller
from ngpt.io.resolution import propose
from ngpt.methods import METHODS, Result
from ngpt.result_file import Look, write_result
from ngpt.stack import GradientStack
from ngpt.system.files import save
from ngpt.version import __version__


@dataclass(frozen=True)
class Frame:
    """A stack, its file and the file for its result; ``there`` says that the result existed already."""

    source: Path
    target: Path
    stack: GradientStack | None
    result: Result | None = None
    there: bool = False
    cut: bool = False  # whether an incomplete file is in its place
    over_time: Mapping[str, Any] = field(default_factory=dict)  # use of other frames, as header attributes
    told: Mapping[str, Any] = field(default_factory=dict)  # further entries of the report
    others: tuple[Frame, ...] = ()  # the other views of the file

    @property
    def view(self) -> str:
        """The name of its view; "" in a file without views."""
        return self.stack.source.view.name if self.stack is not None and self.stack.source is not None else ""


def write_frame(frame: Frame, args: argparse.Namespace, keep: bool) -> dict:
    """Writes the result, and returns its report.

    With ``keep``, a result that cannot be written to its place is written elsewhere.
    """
    target, stack, result = frame.target, frame.stack, frame.result
    report: dict[str, Any] = {"input": str(frame.source), "output": str(target)}
    if frame.there or stack is None or result is None:
        return report | {"skipped": True}
    views = [(one.result.image, one.stack) for one in (frame, *frame.others) if one.result and one.stack]
    made, look = {**result.attributes, **frame.over_time}, Look(args.transform, args.exposure)

    def save_to(path: Path, overwrite: bool) -> None:
        write_result(path, views, made, look, overwrite, into=args.into, reduce=args.reduce)

    if keep:
        save(target, save_to, args.force or frame.cut)
    else:
        save_to(target, args.force or frame.cut)
    image, _ = smaller(result.image, stack.place, args.reduce)
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
        report["layers"], report["noisy layers"] = layers_of_result(stack, args.into)
    if stack.source is not None:
        found = propose(stack.source.view.parts, stack.source.resolution)
        report |= {
            "proposed": {name: found[name] for name in ("albedo", "normal") if name in found and name not in stack}
        }
    report |= {"views": [one.view for one in (frame, *frame.others)]} if frame.view else {}
    if args.reduce > 1:
        cut = cut_pixels(stack.place, args.reduce)
        report |= {"reduced by": args.reduce} | ({"cut": cut} if cut else {})
    report |= {"in place of": "a file that was not whole"} if frame.cut else {}
    over_time = {name.removeprefix("ngpt:"): value for name, value in frame.over_time.items()}
    report |= {name: over_time[name] for name in ("temporal", "history") if name in over_time}
    return {**report, **frame.told}


def describe(report: dict) -> str:
    if "skipped" in report:
        return f"{report['input']} -> {report['output']}: skipped, exists already"
    text = f"{report['input']} -> {report['output']}: {report['method']}"
    if report["weights"] and report["method"] not in METHODS:
        text += f", sha256 {report['weights']['sha256'][:12]}"
    text += f", {report['seconds']:.2f} s"
    if len(report.get("layers", ())) > 1:
        text += f", layers {' and '.join(report['layers'])}"
    if report.get("noisy layers"):
        name = report["noisy layers"][0]
        text += f", {name} stays as it was (--into {name.rpartition('.')[2]} replaces it)"
    if report.get("views"):
        text += f", views {', '.join(report['views'])}"
    if "reduced by" in report:
        text += f", {report['reduced by']}x{report['reduced by']} pixels as one: {report['width']}x{report['height']}"
        text += f" ({report['cut']})" if "cut" in report else ""
    if report["repaired"]:
        text += f", repaired {report['repaired']} pixels"
    if report["untrusted"]:
        text += f", left out {report['untrusted']} gradients"
    if "in place of" in report:
        text += f", in place of {report['in place of']}"
    if "history" in report:
        text += f", {report['history']:.0%} history"
        text += f" ({report['why no history']})" if "why no history" in report else ""
    if report["groups"]:
        text += f", light groups {', '.join(report['groups'])}"
    if "metrics" in report:
        text += ", " + ", ".join(f"{name} {report['metrics'][name]:.5g}" for name in ("relMSE", "relMSE trimmed"))
        text += f" of the pixels that both have: {report['compared']}" if "compared" in report else ""
    return text


def output_paths(sources: list[Path], output: str | None) -> list[tuple[Path, Path]]:
    if output is None:
        targets = [path.with_name(f"{path.stem}{RESULT_SUFFIX}.exr") for path in sources]
    elif varies(output):
        targets = [Path(named(output, number_of(path, output))) for path in sources]
    elif len(sources) == 1 and Path(output).suffix and not Path(output).is_dir() and not output.endswith(("/", os.sep)):
        targets = [Path(output)]
    else:
        folder = Path(output)
        named_file = folder.suffix.lower() == ".exr" and not output.endswith(("/", os.sep))
        if not folder.is_dir() and (folder.exists() or named_file):
            kind = "is a file" if folder.exists() else "is the name of a file"
            raise WrongUse(f"{folder}: {kind}; the results of {len(sources)} stacks need a folder")
        targets = [folder / (path.name if path.suffix.lower() == ".exr" else f"{path.stem}.exr") for path in sources]
    repeated = next((t for i, t in enumerate(targets) if t in targets[:i]), None)
    if repeated:
        raise WrongUse(f"{repeated}: would be the result of two stacks of that name; denoise them one by one")
    return list(zip(sources, targets, strict=True))
