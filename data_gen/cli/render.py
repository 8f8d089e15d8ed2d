"""``ngpt render``: renders a scene to a gradient stack, or directly to a denoised image."""

from __future__ import annotations

import argparse
import shlex
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing, contextmanager, nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Any

from data_gen.begun import Unfinished, begun_stack
from data_gen.cli import KERNELS
from data_gen.cli.render_arguments import add_arguments as add_arguments
from data_gen.cli.render_arguments import targets
from data_gen.outputs import Denoising, Output
from data_gen.pattern import filled, varies
from data_gen.request import FIELDS, RenderRequest
from data_gen.session import render_scene, stop_on_ctrl_c
from data_gen.shot_files import Written, report_of, write_frames, write_frames_on_cluster
from ngpt.cli.arguments import output_file, print_json
from ngpt.cli.streams import STREAM, as_files
from ngpt.errors import NgptError, WrongUse
from ngpt.merging import UNFINISHED
from ngpt.methods import choose
from ngpt.result_file import IMAGES, Look
from ngpt.stack import GradientStack
from ngpt.system.console import Console
from ngpt.system.interrupts import Interrupt
from ngpt.system.limits import limit_threads
from ngpt.system.text import by_names

if TYPE_CHECKING:
    from data_gen.choosing.plans import Plan
    from data_gen.cli.onlook import Onlookers

# A render explains why it was late if it took this many times its time for at most this many samples per pixel.
_LATE, _FEW = 1.2, 16


def run(args: argparse.Namespace, console: Console) -> int:
    if args.output == STREAM and (args.json or args.frames):
        what = "--json also wants standard output" if args.json else "standard output is one file for several frames"
        raise WrongUse(f"-o -: {what}; name a file, or leave one out")
    if args.threads is not None:
        limit_threads(args.threads)
    denoising = denoising_of(args)
    with as_files([], args.output) as (_, args.output):
        return shot(args, denoising, console) if args.frames else image(args, denoising, console)


def denoising_of(args: argparse.Namespace) -> Denoising | None:
    """How the stack is to be denoised; None if the stack itself is written. Raises an error for requests that would
    fail after the render.
    """
    of_its_kind = Path(args.output or "").suffix.lower() in IMAGES[1:]
    if args.denoise is None and not of_its_kind:
        if args.keep:
            raise WrongUse(f"--keep {args.keep}: the output is the stack; add --denoise, or name a picture with -o")
        return None
    method = args.denoise if args.denoise not in (None, "auto") else args.method or "auto"
    if args.error is not None and args.method is None and method != "auto":
        args.method = method  # the error is measured on the image
    denoising = Denoising(method, Look(args.transform, args.exposure))
    denoising.check(args.sampler, args.spp)
    return denoising


def request_of(args: argparse.Namespace, denoising: Denoising | None) -> RenderRequest:
    """The request of the command line."""
    given = {name: value for name, value in vars(args).items() if name in FIELDS}
    given |= {"options": dict(args.option), "parameters": dict(args.define), "frames": tuple(args.frames or ())}
    return RenderRequest(
        **given,
        gradients=denoising is not None and denoising.needs_gradients,
        needs_features=denoising is None or denoising.method not in ("auto", "oidn"),
    )


def image(args: argparse.Namespace, denoising: Denoising | None, console: Console) -> int:
    for option, given in {"--shard": args.shard, "--cluster": args.cluster}.items():
        if given:
            raise WrongUse(f"{option} belongs to a shot; name its frames: --frames 0:120")
    for text in (args.scene, *(value for _, value in args.define)):
        if varies(text):
            raise WrongUse(f"'{text}' changes from frame to frame; name the frames: --frames 0:120")
    target = Path(args.output or f"{Path(args.scene).stem}.exr")
    request = request_of(args, denoising)
    output = Output(request, target, denoising, Path(args.keep) if args.keep else None)
    output.check(args.skip_existing)
    for file in {target, output.stack}:
        output_file(file, args)
    there = output.stack.exists()
    left = output.left() if args.skip_existing else request
    if left is None and output.done():
        console.say(f"{target}: skipped: the {'stack' if denoising is None else 'image'} is there")
        return 0
    begun = None if left is request else begun_stack(output.stack)
    if left is None:
        assert begun is not None
        made = output.image(begun, overwrite=True)
        console.say(f"{output.stack} -> {target}: {described(made)}; the stack was there")
        return 0
    if begun is not None:
        console.say(f"{output.stack}: has {begun.attributes['ngpt:spp']} samples per pixel; going on with it")
    with rendering(args, left, denoising, console) as (stack, failed, stop, looking):
        # Inside this context a signal that arrives while the samples are written does not lose them.
        if args.skip_existing and not there and output.done():
            console.say(f"{target}: skipped: it is there by now, of another process")
            return 0
        stack, made = output.write(stack, args.force or there, begun)
        looking.last(stack, f"ended: {target} is written")
    done = stack.attributes["ngpt:spp"]
    say(stack, made, args, target, console)
    if failed is not None:
        raise NgptError(f"{failed}; {target} has the {done} samples per pixel done before")
    if interrupted := UNFINISHED in stack.attributes:
        tell, why = (console.error, "interrupted") if stop() else (console.say, "enough")
        tell(f"{why}: {target} holds the {done} samples per pixel done by then")
    if denoising is None and by_names(str(target)) == str(target):
        # The method may differ from the requested one, which may need variances that one sample per pixel lacks.
        then = f"then: ngpt denoise {shlex.quote(str(target))}, which takes method '{choose(stack)}'"
        console.say(f"{target} is a stack, with its noise; {then}")
    if args.json:
        kept = {"stack": str(output.kept)} if output.kept else {}
        print_json(report_of(stack, target, made) | {"layers": stack.names} | kept)
    return stop.status if interrupted else 0


@contextmanager
def rendering(
    args: argparse.Namespace, request: RenderRequest, denoising: Denoising | None, console: Console
) -> Iterator[tuple[GradientStack, NgptError | None, Interrupt, Onlookers]]:
    """Renders and shows progress. Yields the stack, the failure that ended the render or None, the interrupts, and the
    onlookers."""
    from data_gen.cli.onlook import onlookers  # its import takes as long as all others that --help needs

    def chosen(plan: Plan) -> None:
        if denoising is not None:
            denoising.check(plan.sampler, request.spp)
        how = f"{', adaptive samples' if plan.shared else ''}, method '{plan.method}'" if plan.method else ""
        console.say(f"{args.scene}: sampler '{plan.sampler}'{how}: {plan.reason}")

    unit = "spp" if request.budget.seconds is None else "s"
    with (
        closing(onlookers(args.live, args.scene, args.command, console, unit)) as looking,
        console.progress(f"render {args.scene}", unit, begins=KERNELS) as progress,
        stop_on_ctrl_c(ending) as stop,
    ):

        def both(done: int, total: int) -> None:
            progress(done, total)
            looking.progress(done, total)

        def ended() -> bool:
            return stop() or looking.enough

        try:
            stack, _ = render_scene(
                request, progress=both, stop=ended, newest=looking.newest, chosen=chosen, said=console.say
            )
            failed = None
        except Unfinished as error:
            stack, failed = error.stack, error
        yield stack, failed, stop, looking


def say(stack: GradientStack, made: dict[str, Any], args: argparse.Namespace, target: Path, console: Console) -> None:
    """Prints how long the render took, and warnings about its samples."""
    attributes = stack.attributes
    done, took = attributes["ngpt:spp"], attributes["ngpt:seconds"]
    if attributes["ngpt:discarded"]:
        console.say(f"{args.scene}: {attributes['ngpt:discarded']} non-finite values were left out")
    if args.error is not None and "ngpt:error" in attributes:
        expected, method = attributes["ngpt:error"], attributes["ngpt:adaptive"]
        short = "" if expected <= args.error else f", not {args.error:g}: it was ended before"
        console.say(f"{args.scene}: '{method}' is expected to have an error of {expected:.3g}{short}")
    by = f", {described(made)}" if made else ""
    console.say(f"{args.scene} -> {target}: {stack.place}, {done} spp, {took:.2f} s{by}")
    if args.seconds is not None and took > _LATE * args.seconds and done <= _FEW:
        console.say(
            f"{args.scene}: it took longer than {args.seconds:g} s: kernels and a least pass ({done} spp) are not "
            "quicker on this machine now; a smaller --size is"
        )


def shot(args: argparse.Namespace, denoising: Denoising | None, console: Console) -> int:
    for option, asked_for in {"--live": args.live, "--cpu-time": args.cpu_seconds}.items():
        if asked_for:
            raise WrongUse(f"{option} is for single images; leave it out with --frames")
    if args.adaptive or args.error is not None or args.method is not None:
        raise WrongUse("--adaptive, --error and --for are for single images; leave them out with --frames")
    if args.threads and args.cluster:
        raise WrongUse("--threads is for this process, and --cluster renders in others; start its workers with fewer")
    if args.shard and args.cluster:
        raise WrongUse("--cluster distributes the frames itself; leave --shard out")
    if args.keep:
        raise WrongUse("--keep is for single images; name frames .exr, which have their stacks in them")
    files = targets(args.output, args.scene, args.frames)
    request = request_of(args, denoising)
    more: Any = {"overwrite": args.force, "skip_existing": args.skip_existing, "denoising": denoising}
    with ExitStack() as shown:
        said = 0
        progress: Callable[[int, int], None] | None = None

        def begin() -> Callable[[int, int], None]:
            return shown.enter_context(console.progress(f"render {args.scene}", "frames", begins=KERNELS))

        # On a cluster the progress bar appears only when the cluster has answered.
        if not args.cluster:
            progress = begin()

        def made(written: Written, total: int) -> None:
            nonlocal said, progress
            progress = progress or begin()
            for report in written.frames[said:]:
                frame, what = report["frame"], "{width}x{height}, {spp} spp, {seconds:.2f} s".format(**report)
                what += ", {method} {reconstructSeconds:.2f} s".format(**report) if denoising else ""
                if report["discarded"]:
                    console.say(f"frame {frame}: {report['discarded']} non-finite values were left out")
                what += f", in place of {report['in place of']}" if "in place of" in report else ""
                console.say(f"{filled(args.scene, frame)} frame {frame} -> {report['output']}: {what}")
            said = len(written.frames)
            progress(written.done, total)

        # A signal that arrives here cannot stop the workers of a cluster within this pass.
        with nullcontext(Interrupt()) if args.cluster else stop_on_ctrl_c(ending) as stop:
            if args.cluster:
                written = write_frames_on_cluster(args.cluster, request, files, made=made, **more)
            else:
                shard = args.shard or (0, 1)
                written = write_frames(request, files, shard=shard, made=made, stop=stop, **more)
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


def described(made: dict[str, Any]) -> str:
    return f"{made['ngpt:method']} {made['ngpt:reconstructSeconds']:.2f} s"


def ending() -> None:
    Console().say("interrupted: ending with this pass; Ctrl-C, or a second signal, discards it all")
