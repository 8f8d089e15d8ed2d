"""The arguments of ``ngpt render``."""

import argparse
import re
from pathlib import Path

from data_gen.pattern import filled, varies
from data_gen.request import DEFAULT_SPP
from data_gen.samplers import by_standing
from ngpt.cli.arguments import (
    Names,
    add_force,
    add_json,
    add_options,
    assignment,
    duration,
    natural,
    part,
    positive,
    relative,
    size,
)
from ngpt.cli.picture import add_look
from ngpt.errors import WrongUse
from ngpt.methods import METHODS
from ngpt.result_file import IMAGES
from ngpt.subpixels import choice


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.usage = f"{parser.prog} SCENE [options]"  # a list of all options would fill a fifth of the help
    parser.add_argument("scene", metavar="SCENE", help="a scene file of Mitsuba 3, or a built-in scene")
    parser.add_argument(
        "-o",
        "--output",
        metavar="FILE",
        help=f"file to write: the stack if it ends in .exr (default: SCENE.exr in this folder; -: standard output), "
        f"the denoised image if it ends in {' '.join(IMAGES[1:])}",
    )
    parser.add_argument(
        "--denoise",
        nargs="?",
        const="auto",
        metavar="METHOD",
        choices=Names(METHODS),
        help="write the denoised image to the .exr, which keeps the stack as further layers (default method: of --for, "
        "or of the pilot, else auto)",
    )
    parser.add_argument("--keep", metavar="STACK", help="also write the stack, where the output is an image")
    add_look(parser)
    parser.add_argument("--spp", type=positive, help=f"samples (paths) per pixel (default: {DEFAULT_SPP})")
    limit = parser.add_mutually_exclusive_group()
    limit.add_argument(
        "--time",
        dest="seconds",
        type=duration,
        metavar="SECONDS",
        help="render for this long, with kernel compilation; with --spp, whichever is reached first",
    )
    limit.add_argument(
        "--cpu-time",
        dest="cpu_seconds",
        type=duration,
        metavar="SECONDS",
        help="as --time, but in processor time, all cores together, which other work on the machine hardly changes",
    )
    parser.add_argument(
        "--adaptive",
        action="store_true",
        help="take more samples where the error of the result is large; --spp is their mean",
    )
    parser.add_argument(
        "--error",
        type=relative,
        metavar="E",
        help="as --adaptive, until the result is expected to have this relative error (0.05: 5 %%)",
    )
    parser.add_argument(
        "--for",
        dest="method",
        metavar="METHOD",
        help="the method that will denoise the render. With --time and without --spp: test renders choose the best "
        "sampler for this method, and with `auto` also the method; --time covers tests, render and method. With "
        "--adaptive or --error: samples go where this method leaves errors (default: wcv with --adaptive and "
        "gradients, else auto)",
    )
    parser.add_argument(
        "--size", type=size, metavar="WxH", help="size of the image in pixels (default: the scene's own)"
    )
    parser.add_argument(
        "--sensor", metavar="NAME|N", help="sensor of the scene: its id, or its number from 0 (default: the first)"
    )
    first = "; ".join(f"{name}: {entry.summary}" for name, entry in by_standing("use").items())
    others = ", ".join(by_standing("niche"))
    parser.add_argument(
        "--sampler",
        default="auto",
        metavar="NAME",
        help=f"auto: chosen for the scene, in long renders by test renders (default); {first}. For special cases: "
        f"{others}. `ngpt info NAME` describes a sampler",
    )
    add_options(parser, "sampler", "SAMPLER")
    parser.add_argument("--seed", type=natural, default=0, help="the same seed gives the same stack (default: 0)")
    parser.add_argument(
        "--memory", type=positive, metavar="MIB", help="memory limit for paths and film (default: 6144)"
    )
    parser.add_argument("--threads", type=positive, metavar="N", help="number of threads (default: all cores)")
    parser.add_argument(
        "--unbiased",
        action="store_true",
        help="trace all paths to their end, without the shared cache of light: no bias, more noise",
    )
    parser.add_argument(
        "--subpixels",
        type=subpixels,
        default="auto",
        metavar="K",
        help="keep KxK subpixels of each pixel, from which OIDN makes a better image: 1, 2, 4, or auto "
        "(2 where that is known to help; default)",
    )
    parser.add_argument(
        "--diagnostics",
        action="store_true",
        help="also write the rates of failed shifts and of discarded values, as channels",
    )
    parser.add_argument(
        "--live", action="store_true", help="show the image while it is rendered, on a page of this machine (127.0.0.1)"
    )
    parser.add_argument("--variant", help="Mitsuba variant: llvm_ad_rgb (default), cuda_ad_rgb")
    parser.add_argument(
        "-D", dest="define", action="append", default=[], type=assignment, metavar="NAME=VALUE", help="scene parameter"
    )
    shot = parser.add_argument_group(
        "shots",
        "SCENE, the values of -D and the output may contain {frame}, {frame:04d} or {10 + frame * 3:.2f}. The output "
        "may be a folder.",
    )
    shot.add_argument(
        "--frames",
        type=frames,
        metavar="FRAMES",
        help="frames to render, each to a stack with motion vectors: 0:120 (without 120), 0:120:2, 1,5,9; or as farms "
        "write them: 1-10 (with 10), 1-9x2",
    )
    shot.add_argument(
        "--camera",
        metavar="PATH",
        help="camera path: key frames (.json), or a file with an animated camera (.glb, .gltf)",
    )
    shot.add_argument(
        "--dt",
        type=positive,
        default=0,
        metavar="PAIRS",
        help="also render differences to the frame before, for `ngpt denoise --temporal -m wcv`, by this many pairs of "
        "paths per pixel (2 or more; a quarter of --spp is enough)",
    )
    shot.add_argument("--fps", type=float, default=24.0, help="frames per second of a .glb or .gltf (default: 24)")
    shot.add_argument(
        "--shard", type=part, metavar="i/n", help="render only this part of the frames, for job arrays: 0/4 to 3/4"
    )
    shot.add_argument("--cluster", metavar="ADDRESS", help="render the frames on the Dask cluster of this scheduler")
    existing = parser.add_mutually_exclusive_group()
    add_force(existing)
    existing.add_argument(
        "--skip-existing", action="store_true", help="skip finished images and continue unfinished ones"
    )
    add_json(parser)


def subpixels(text: str) -> int | str:
    """K of the K x K subpixels of a pixel, or "auto"."""
    try:
        return choice(text)
    except WrongUse as error:
        raise argparse.ArgumentTypeError(str(error)) from None


# More than anyone renders; a typing error must not fill the memory.
_MOST = 1_000_000


def frames(text: str) -> list[int]:
    """Frames such as ``0:120`` (without 120), ``0:120:2``, ``7``, or several of them separated by commas, in order.

    In the notation of render farms the last frame is included: ``1-10``, ``1-9x2``, ``1-9:2``.
    """
    numbers: dict[int, None] = {}
    for some in text.split(","):
        try:
            values = _of_a_farm(some) or [int(number) for number in some.split(":")]
        except ValueError:
            values = []
        if len(values) not in (1, 2, 3):
            raise argparse.ArgumentTypeError(
                f"'{some}' is no frame; write 7, 0:120 (120 is not in it), 0:120:2, or 0-119 (119 is in it)"
            )
        found = range(values[0], values[0] + 1) if len(values) == 1 else range(*values) if 0 not in values[2:] else ()
        if not found or len(found) > _MOST:
            raise argparse.ArgumentTypeError(f"'{some}' are {len(found)} frames; write START:END or START:END:STEP")
        numbers.update(dict.fromkeys(found))
    return list(numbers)


def _of_a_farm(some: str) -> list[int]:
    """First, end and step of a text such as ``1-10``, which includes 10; [] for other texts."""
    if not (match := re.fullmatch(r"(-?\d+)-(-?\d+)(?:[x:](-?\d+))?", some)):
        return []
    step = int(match[3] or 1)
    return [int(match[1]), int(match[2]) + (1 if step > 0 else -1), step]


def targets(output: str | None, scene: str, numbers: list[int]) -> dict[int, Path]:
    """Frame -> file. ``output`` is a pattern (``shot.{frame:04d}.exr``), or a folder, which need not exist.

    Raises WrongUse if several frames would have the same file.
    """
    stem = re.sub(r"[._-]*\{[^{}]*\}", "", Path(scene).stem) or "frame"
    pattern = output if output is not None else f"{stem}.{{frame:04d}}.exr"
    if not varies(pattern):
        folder = Path(pattern)
        if folder.suffix.lower() in IMAGES and not folder.is_dir():
            if len(numbers) > 1:
                named = f"{folder.with_suffix('')}.{{frame:04d}}{folder.suffix}"
                raise WrongUse(f"{folder}: is one file for {len(numbers)} frames; write -o '{named}', or a folder")
            return {numbers[0]: folder}
        pattern = str(folder / f"{stem}.{{frame:04d}}.exr")
    found = {number: Path(filled(pattern, number)) for number in numbers}
    seen: dict[Path, int] = {}
    for number, path in found.items():
        if (other := seen.setdefault(path, number)) != number:
            raise WrongUse(f"{path}: would be frame {other} and frame {number}; write {{frame:04d}} in the name")
    return found
