"""The files of ``ngpt denoise``: where results go, how they are written, and what there is to say of them."""

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ngpt.cli.picture import exposed, in_picture
from ngpt.cli.reference import Errors
from ngpt.errors import WrongUse
from ngpt.image.pictures import write_picture
from ngpt.image.transforms import shown
from ngpt.io.exr import layers_of_result, write
from ngpt.io.foreign.pfm import write_pfm
from ngpt.io.framenames import named, number_of, varies
from ngpt.io.frames import RESULT_SUFFIX
from ngpt.io.primaries import converted, to_rec709
from ngpt.io.reduced import cut_pixels, smaller
from ngpt.io.resolution import propose
from ngpt.methods import METHODS, Result
from ngpt.stack import GradientStack
from ngpt.system.files import save
from ngpt.version import __version__


class Frame(NamedTuple):
    """A stack, its file and the file for its result; ``there`` says that the result was there already.

    ``cut`` says that a file is in its place that is not whole.
    ``over_time`` is what other frames were to the result, as header attributes; ``reason`` why they were nothing.
    ``others`` are the other views of the file.
    """

    source: Path
    target: Path
    stack: GradientStack | None
    result: Result | None = None
    errors: Errors | None = None
    groups: tuple[str, ...] = ()
    there: bool = False
    cut: bool = False
    over_time: Mapping[str, Any] = {}
    reason: str = ""
    others: tuple["Frame", ...] = ()

    @property
    def view(self) -> str:
        """The name of the view that it is of; "" in a file without views."""
        return self.stack.source.view.name if self.stack is not None and self.stack.source is not None else ""


def write_frame(
    frame: Frame,
    overwrite: bool,
    transform: str = "standard",
    exposure: float | str = 0.0,
    keep: bool = False,
    into: str | None = None,
    *,
    reduce: int = 1,
) -> dict:
    """Writes the result, with ``keep`` elsewhere where it must, and returns what there is to report.

    ``into``, ``reduce``  as of ``ngpt.write``
    """
    source, target, stack, result, errors, groups, there, cut, over_time, reason, others = frame
    report: dict[str, Any] = {"input": str(source), "output": str(target)}
    if there or stack is None or result is None:
        return report | {"skipped": True}
    made = {**result.attributes, **over_time}
    image, place = smaller(result.image, stack.place, reduce)

    def save_to(path: Path, overwrite: bool) -> None:
        if path.suffix.lower() == ".exr":
            views = [(one.result.image, one.stack) for one in (frame, *others) if one.result and one.stack]
            write(path, [image for image, _ in views], [of for _, of in views], overwrite, made, into, reduce=reduce)
        elif path.suffix.lower() == ".pfm":
            write_pfm(path, converted(image, to_rec709(stack.attributes)), overwrite)
        else:
            light = in_picture(converted(image, to_rec709(stack.attributes)), place)
            write_picture(path, shown(light, transform, exposed(exposure, light)), overwrite)

    if keep:
        save(target, save_to, overwrite or cut)
    else:
        save_to(target, overwrite or cut)
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
        "groups": list(groups),
    }
    if result.error is not None:
        report["pixels without standard error"] = int(np.isnan(result.error).any(axis=-1).sum())
    if target.suffix.lower() == ".exr":
        report["layers"], report["noisy layers"] = layers_of_result(stack, into)
    if stack.source is not None:
        found = propose(stack.source.view.parts, stack.source.resolution)
        report |= {
            "proposed": {name: found[name] for name in ("albedo", "normal") if name in found and name not in stack}
        }
    report |= {"views": [one.view for one in (frame, *others)]} if frame.view else {}
    report |= {"why no history": reason} if reason else {}
    if reduce > 1:
        report |= {"reduced by": reduce} | ({"cut": told} if (told := cut_pixels(stack.place, reduce)) else {})
    report |= {"in place of": "a file that was not whole"} if cut else {}
    report |= {name: over_time[f"ngpt:{name}"] for name in ("temporal", "history") if f"ngpt:{name}" in over_time}
    if errors is not None:
        report |= {"metrics": errors.metrics} | ({"compared": errors.part} if errors.part else {})
    return report


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
