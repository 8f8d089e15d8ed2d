"""The arguments of ``ngpt render``."""

import argparse

from data_gen.cli.frames import frames
from data_gen.samplers import by_standing
from data_gen.session import DEFAULT_SPP
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
    size,
)
from ngpt.cli.picture import IMAGES, add_look
from ngpt.methods import METHODS


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.usage = f"{parser.prog} SCENE [options]"  # with all of them it is a fifth of the help
    parser.add_argument("scene", metavar="SCENE", help="a scene file of Mitsuba 3, or a built-in scene")
    parser.add_argument(
        "-o",
        "--output",
        metavar="FILE",
        help=f"stack (default: SCENE.exr here; -: standard output), or as {' '.join(IMAGES[1:])} the denoised image",
    )
    parser.add_argument(
        "--denoise",
        nargs="?",
        const="auto",
        metavar="METHOD",
        choices=Names(METHODS),
        help="write what `ngpt denoise` makes of the stack, which an .exr keeps (default: the method of --for, or of "
        "the pilot, else auto)",
    )
    parser.add_argument("--keep", metavar="STACK", help="write the stack as well, beside a picture")
    add_look(parser)
    parser.add_argument("--spp", type=positive, help=f"paths per pixel (default: {DEFAULT_SPP})")
    parser.add_argument(
        "--time",
        type=duration,
        metavar="SECONDS",
        help="render for this long, kernel compilation included; with --spp: until the first is reached",
    )
    parser.add_argument(
        "--adaptive",
        action="store_true",
        help="more samples where the error of the result is large; --spp is then their mean",
    )
    parser.add_argument(
        "--error",
        type=float,
        metavar="E",
        help="--adaptive, until the result is expected to have this relative error (0.05: 5 %%)",
    )
    parser.add_argument(
        "--for",
        dest="method",
        metavar="METHOD",
        help="what --adaptive or --error go by (default: what `auto` takes; with --adaptive and gradients, wcv). With "
        "--time alone: what a pilot chooses sampler and samples for, by the error it expects; with `auto` the method "
        "too. --time then holds pilot, render and method",
    )
    parser.add_argument("--size", type=size, metavar="WxH", help="pixels of the film (default: the scene's own)")
    parser.add_argument("--sensor", metavar="NAME|N", help="by id, or by number from 0 (default: the first)")
    first = "; ".join(f"{name}: {entry.summary}" for name, entry in by_standing("use").items())
    others = ", ".join(by_standing("niche"))
    parser.add_argument(
        "--sampler",
        default="auto",
        metavar="NAME",
        help=f"auto: by the scene and a pilot (default); {first}; for some scenes: {others}. See `ngpt info`",
    )
    add_options(parser, "sampler", "SAMPLER")
    parser.add_argument("--seed", type=natural, default=0, help="the same seed gives the same stack (default: 0)")
    parser.add_argument("--memory", type=positive, metavar="MIB", help="for paths and film (default: 6144)")
    parser.add_argument("--threads", type=positive, metavar="N", help="that work at once (default: all processors)")
    parser.add_argument(
        "--unbiased",
        action="store_true",
        help="all paths on their own: noisier",
    )
    parser.add_argument(
        "--diagnostics",
        action="store_true",
        help="write rates of failed shifts and of lost values too",
    )
    parser.add_argument(
        "--live",
        action="store_true",
        help="a page on 127.0.0.1 that shows the render as it goes",
    )
    parser.add_argument("--variant", help="Mitsuba variant: llvm_ad_rgb (default), cuda_ad_rgb")
    parser.add_argument(
        "-D", dest="define", action="append", default=[], type=assignment, metavar="NAME=VALUE", help="scene parameter"
    )
    shot = parser.add_argument_group(
        "shots",
        "SCENE, the values of -D and the output may hold {frame}, {frame:04d} or {10 + frame * 3:.2f}. The output may "
        "be a folder.",
    )
    shot.add_argument(
        "--frames",
        type=frames,
        metavar="FRAMES",
        help="frames to render, a stack with motion vectors for each: 0:120 (120 is not in it), 0:120:2, 1,5,9; "
        "as farms write them: 1-10 (10 is in it), 1-9x2",
    )
    shot.add_argument(
        "--camera",
        metavar="PATH",
        help="of the camera: key frames (.json), or a file with an animated one (.glb, .gltf)",
    )
    shot.add_argument(
        "--dt",
        type=positive,
        default=0,
        metavar="PAIRS",
        help="differences to the frame before too, of so many pairs of paths a pixel (2 or more; a quarter of --spp "
        "is enough), for `ngpt denoise --temporal -m wcv`",
    )
    shot.add_argument("--fps", type=float, default=24.0, help="frames a second of a .glb or .gltf (default: 24)")
    shot.add_argument(
        "--shard", type=part, metavar="i/n", help="render only this part of the frames, for job arrays: 0/4 to 3/4"
    )
    shot.add_argument("--cluster", metavar="ADDRESS", help="scheduler of a Dask cluster to render the frames on")
    existing = parser.add_mutually_exclusive_group()
    add_force(existing)
    existing.add_argument(
        "--skip-existing",
        action="store_true",
        help="leave out what is finished, and go on with what is there in part",
    )
    add_json(parser)
