"""``ngpt render``: from a scene to a gradient stack."""

import argparse
import shlex
from contextlib import closing, nullcontext
from pathlib import Path
from typing import Any

from data_gen.begun import Asked, Unfinished, begun_stack, scene_name, write_part
from data_gen.cli import KERNELS
from data_gen.cli.frames import frames, targets
from data_gen.frames.pattern import filled, varies
from data_gen.samplers import by_standing, check_options
from data_gen.session import DEFAULT_SPP, render_scene, stop_on_ctrl_c
from data_gen.shot_files import Written, report_of, write_frames, write_frames_on_cluster
from ngpt.cli.arguments import (
    add_force,
    add_json,
    assignment,
    duration,
    natural,
    output_file,
    part,
    positive,
    print_json,
    size,
)
from ngpt.errors import NgptError, WrongUse
from ngpt.io.whole import finished
from ngpt.merging import UNFINISHED
from ngpt.system.console import Console
from ngpt.system.interrupts import Interrupt

# How many times its time a render takes whose user is told why, where it made no more than so many samples per pixel.
_LATE, _FEW = 1.2, 16


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("scene", metavar="SCENE", help="a Mitsuba 3 scene file, or a built-in scene (see `ngpt info`)")
    parser.add_argument("-o", "--output", metavar="FILE", help="stack to write (default: SCENE.exr in this folder)")
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
        help="--adaptive, until the result is expected to have this relative error (0.05: 5 %%); --spp and --time may "
        "end it before",
    )
    parser.add_argument(
        "--for",
        dest="method",
        metavar="METHOD",
        help="what --adaptive or --error go by (default: what `auto` takes; with --adaptive and gradients, wcv). With "
        "--time alone: what a pilot chooses sampler and samples for, by the error it expects; with `auto` the method "
        "too. --time is then that of pilot, render and method",
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
    parser.add_argument(
        "-O",
        "--option",
        action="append",
        default=[],
        type=assignment,
        metavar="NAME=VALUE",
        help="of the sampler; may be repeated. See `ngpt info NAME`",
    )
    parser.add_argument("--seed", type=natural, default=0, help="the same seed gives the same stack (default: 0)")
    parser.add_argument("--memory", type=positive, metavar="MIB", help="for paths and film (default: 6144)")
    parser.add_argument(
        "--diagnostics",
        action="store_true",
        help="write rates of failed shifts and of lost values too",
    )
    parser.add_argument(
        "--live",
        action="store_true",
        help="serve a page on 127.0.0.1 that shows the render, noisy and denoised, while it goes on",
    )
    parser.add_argument("--view", metavar="HOST:PORT", help="send the same to tev (its own: 127.0.0.1:14158)")
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


def run(args: argparse.Namespace, console: Console) -> int:
    return shot(args, console) if args.frames else image(args, console)


def asked(args: argparse.Namespace) -> dict[str, Any]:
    """What ``render_scene`` and ``render_frames`` both take, by their names."""
    names = ("spp", "seed", "sampler", "sensor", "size", "memory", "diagnostics", "variant")
    options = dict(args.option)
    check_options(args.sampler, options)  # so that none of them goes by another's name
    given = {name: getattr(args, name) for name in names}
    return given | {"seconds": args.time, "parameters": dict(args.define)} | options


def image(args: argparse.Namespace, console: Console) -> int:
    """One stack."""
    from data_gen.cli.onlook import onlookers  # takes as long as all else that help needs

    apart = {"--camera": args.camera, "--dt": args.dt, "--shard": args.shard, "--cluster": args.cluster}
    for option, given in apart.items():
        if given:
            raise WrongUse(f"{option} belongs to a shot; name its frames: --frames 0:120")
    for text in (args.scene, *(value for _, value in args.define)):
        if varies(text):
            raise WrongUse(f"'{text}' changes from frame to frame; name the frames: --frames 0:120")
    target = Path(args.output or f"{Path(args.scene).stem}.exr")
    if target.suffix.lower() != ".exr":
        raise WrongUse(f"{target}: ngpt writes OpenEXR; let the name end in .exr")
    output_file(target, args)
    given, begun, there = asked(args), None, target.exists()
    how = {"adaptive": args.adaptive, "error": args.error, "method": args.method}
    wanted = args.spp or (DEFAULT_SPP if args.time is None and args.error is None else None)
    whole = Asked(
        scene_name(args.scene, dict(args.define) | ({"--sensor": args.sensor} if args.sensor else {})),
        args.seed,
        args.sampler,
        dict(args.option),
        args.size,
        wanted,
        args.time,
        args.error,
        (args.method or "auto") if args.adaptive else "",
    )
    if args.skip_existing and finished(target):
        rest = whole.left(target)
        if rest is None:
            console.say(f"{target}: skipped: the stack is there")
            return 0
        begun = begun_stack(target, args.diagnostics)
        given |= rest.options(args.seed)
        how = {"adaptive": bool(rest.adaptive), "error": rest.error, "method": rest.method(args.method)}
        console.say(f"{target}: has {begun.attributes['ngpt:spp']} samples per pixel; going on with it")

    def chosen(plan) -> None:
        how = f"{', samples shared out' if plan.shared else ''}, method '{plan.method}'" if plan.method else ""
        console.say(f"{args.scene}: sampler '{plan.sampler}'{how}: {plan.reason}")

    unit = "s" if args.time else "spp"
    looking = onlookers(args.live, args.view, args.scene, args.command, console, unit)
    with (
        closing(looking),
        console.progress(f"render {args.scene}", unit, begins=KERNELS) as progress,
        stop_on_ctrl_c(ending) as stop,
    ):

        def ended() -> bool:
            return stop() or looking.enough

        def told(done: int, total: int) -> None:
            progress(done, total)
            looking.progress(done, total)

        failed = None
        try:
            stack, _ = render_scene(
                args.scene,
                progress=told,
                stop=ended,
                newest=looking.newest,
                chosen=chosen,
                said=console.say,
                **how,
                **given,
            )
        except Unfinished as error:
            stack, failed = error.stack, error
        # Within it: the samples of an hour are not lost to a signal that comes while they are written.
        whole.name(stack)
        if args.skip_existing and not there and whole.done(target):
            console.say(f"{target}: skipped: the stack is there by now, of another process")
            return 0
        stack = write_part(target, stack, args.force or there, begun)
        looking.last(stack, f"ended: {target} is written")
    if stack.attributes["ngpt:discarded"]:
        console.say(f"{args.scene}: {stack.attributes['ngpt:discarded']} non-finite values were left out")
    done, took = stack.attributes["ngpt:spp"], stack.attributes["ngpt:seconds"]
    if args.error is not None and "ngpt:error" in stack.attributes:
        expected, method = stack.attributes["ngpt:error"], stack.attributes["ngpt:adaptive"]
        short = "" if expected <= args.error else f", not {args.error:g}: it was ended before"
        console.say(f"{args.scene}: '{method}' is expected to have an error of {expected:.3g}{short}")
    if failed is not None:
        raise NgptError(f"{failed}; {target} has the {done} samples per pixel done before")
    if interrupted := UNFINISHED in stack.attributes:
        tell, how = (console.error, "interrupted") if stop() else (console.say, "enough")
        tell(f"{how}: {target} holds the {done} samples per pixel done by then")
    console.say(f"{args.scene} -> {target}: {stack.place}, {done} spp, {took:.2f} s")
    if args.time is not None and took > _LATE * args.time and done <= _FEW:
        console.say(
            f"{args.scene}: it took longer than {args.time:g} s: kernels and a least pass ({done} spp) are not quicker "
            "on this machine now; a smaller --size is"
        )
    if method := stack.attributes.get("ngpt:for"):
        console.say(f"then: ngpt denoise {shlex.quote(str(target))} --method {method}")
    if args.json:
        print_json(report_of(stack, target) | {"layers": stack.names})
    return stop.status if interrupted else 0


def shot(args: argparse.Namespace, console: Console) -> int:
    """A stack for each frame."""
    if args.live or args.view:
        raise WrongUse("--live and --view are for single images; leave them out with --frames")
    if args.adaptive or args.error is not None or args.method is not None:
        raise WrongUse("--adaptive, --error and --for are for single images; leave them out with --frames")
    files = targets(args.output, args.scene, args.frames)
    more = {"camera": args.camera, "fps": args.fps, "dt": args.dt}
    more |= {"overwrite": args.force, "skip_existing": args.skip_existing, **asked(args)}
    with console.progress(f"render {args.scene}", "frames", begins=KERNELS) as progress:
        said = 0

        def made(written: Written, total: int) -> None:
            nonlocal said
            for report in written.frames[said:]:
                frame, what = report["frame"], "{width}x{height}, {spp} spp, {seconds:.2f} s".format(**report)
                if report["discarded"]:
                    console.say(f"frame {frame}: {report['discarded']} non-finite values were left out")
                what += f", in place of {report['in place of']}" if "in place of" in report else ""
                console.say(f"{filled(args.scene, frame)} frame {frame} -> {report['output']}: {what}")
            said = len(written.frames)
            progress(written.done, total)

        # What the workers of a cluster are at, no signal that comes here ends with this pass.
        with nullcontext(Interrupt()) if args.cluster else stop_on_ctrl_c(ending) as stop:
            if args.cluster:
                written = write_frames_on_cluster(args.cluster, args.scene, files, shard=args.shard, made=made, **more)
            else:
                shard = args.shard or (0, 1)
                written = write_frames(args.scene, files, shard=shard, made=made, stop=stop, **more)
    if written.interrupted is not None:
        part = next((each["spp"] for each in written.frames if each["frame"] == written.interrupted), None)
        has = "is left out" if part is None else f"has {part} samples per pixel"
        console.error(f"interrupted: frame {written.interrupted} {has}; --skip-existing goes on with it")
        return stop.status
    if written.skipped:
        console.say(f"{written.skipped} of {written.done} frames were skipped: their stacks are there")
    if args.json:
        print_json({"frames": written.frames, "skipped": written.skipped})
    return 0


def ending() -> None:
    Console().say("interrupted: ending with this pass; Ctrl-C, or a second signal, discards it all")
