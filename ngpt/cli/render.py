"""``ngpt render``: from a scene to a gradient stack."""

import argparse
import shlex
import signal
from collections.abc import Callable, Iterator
from concurrent.futures import as_completed
from contextlib import contextmanager
from pathlib import Path

from data_gen.samplers import FRAME_SAMPLERS, by_standing, check_options
from ngpt.cli.arguments import add_force, add_json, assignment, duration, natural, part, positive, print_json, size
from ngpt.cli.frame_patterns import filled, frames, targets, varies
from ngpt.errors import NgptError
from ngpt.io.exr import write
from ngpt.system.console import Console
from ngpt.system.files import check_output

DEFAULT_SPP = 32
# Of a cluster: frames that a worker renders with one scene in memory, and kernels compiled once.
FRAMES_OF_A_PART = 8


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("scene", metavar="SCENE", help="a Mitsuba 3 scene file, or a built-in scene (see `ngpt info`)")
    parser.add_argument("-o", "--output", metavar="FILE", help="stack to write (default: SCENE.exr in this folder)")
    parser.add_argument("--spp", type=positive, help=f"paths per pixel (default: {DEFAULT_SPP})")
    parser.add_argument(
        "--time",
        type=duration,
        metavar="SECONDS",
        help="render for this long, kernel compilation included, instead of a number of paths; with both: until the "
        "first of them is reached",
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
        "--time alone: what a pilot chooses the sampler for, and whether samples are adaptive, by the error that it "
        "expects of the result; with `auto` it chooses the method too. --time is then that of pilot, render and method",
    )
    parser.add_argument("--size", type=size, metavar="WxH", help="pixels (default: the scene's own)")
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
        help="an option of the sampler; may be repeated. See `ngpt info SAMPLER`",
    )
    parser.add_argument("--seed", type=natural, default=0, help="the same seed gives the same stack (default: 0)")
    parser.add_argument(
        "--memory", type=positive, metavar="MIB", help="memory for paths and film, beside the scene (default: 6144)"
    )
    parser.add_argument(
        "--diagnostics",
        action="store_true",
        help="write the rates of failed shifts and of discarded values for each pixel too",
    )
    parser.add_argument("--variant", help="Mitsuba variant (default: llvm_ad_rgb; cuda_ad_rgb for an NVIDIA GPU)")
    parser.add_argument(
        "-D", dest="define", action="append", default=[], type=assignment, metavar="NAME=VALUE", help="scene parameter"
    )
    shot = parser.add_argument_group(
        "sequences",
        "SCENE, the values of -D and the output may hold {frame}, {frame:04d} or {10 + frame * 3:.2f}. The output may "
        "be a folder.",
    )
    shot.add_argument(
        "--frames",
        type=frames,
        metavar="FRAMES",
        help="frames to render, a stack with motion vectors for each: 0:120 (120 is not in it), 0:120:2, 1,5,9",
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
        help="write differences to the frame before too, of so many pairs of paths a pixel (2 or more), for "
        "`ngpt denoise --temporal -m wcv`: a quarter of --spp is enough",
    )
    shot.add_argument("--fps", type=float, default=24.0, help="frames a second of a .glb or .gltf (default: 24)")
    shot.add_argument(
        "--shard", type=part, metavar="i/n", help="render only this part of the frames, for job arrays: 0/4 to 3/4"
    )
    shot.add_argument("--cluster", metavar="ADDRESS", help="scheduler of a Dask cluster to render the frames on")
    existing = parser.add_mutually_exclusive_group()
    add_force(existing)
    existing.add_argument(
        "--skip-existing", action="store_true", help="leave frames out whose stacks are there: goes on with a sequence"
    )
    add_json(parser)


def run(args: argparse.Namespace, console: Console) -> int:
    if args.frames:
        report = on_cluster(args, console) if args.cluster else render_frames(args, console)
        if report is not None and args.json:
            print_json(report)
        return 0 if report is not None else 130
    apart = {"--camera": args.camera, "--dt": args.dt, "--shard": args.shard, "--cluster": args.cluster}
    for option, given in (apart | {"--skip-existing": args.skip_existing}).items():
        if given:
            raise NgptError(f"{option} belongs to a sequence; name its frames: --frames 0:120")
    for text in (args.scene, *(value for _, value in args.define)):
        if varies(text):
            raise NgptError(f"'{text}' changes from frame to frame; name the frames: --frames 0:120")
    target = check_output(args.output or f"{Path(args.scene).stem}.exr", args.force)
    if target.suffix.lower() != ".exr":
        raise NgptError(f"{target}: ngpt writes OpenEXR; let the name end in .exr")
    # Only the verbs that render import the renderer.
    from data_gen.backend import DEFAULT_VARIANT, use_variant

    use_variant(args.variant or DEFAULT_VARIANT)
    from data_gen.adaptive import Adaptive
    from data_gen.choosing.pilot import choose_by_pilot
    from data_gen.choosing.pipelines import plan
    from data_gen.passes import DEFAULT_MEMORY
    from data_gen.render import check_limits, render_stack
    from data_gen.scenes.load import load_scene

    spp = args.spp or (DEFAULT_SPP if args.time is None and args.error is None else None)
    memory = args.memory or DEFAULT_MEMORY
    adaptive = sharing(args)
    # Before the scene is loaded, which may take long.
    check_limits(spp, args.seed, args.sampler, args.time, memory, args.error is not None)
    check_options(args.sampler, dict(args.option))
    scene = load_scene(args.scene, args.size, dict(args.define))
    sampler, seconds, planned = args.sampler, args.time, None
    # A pilot compares samplers at even samples, and may choose one that renders no others.
    if args.method is not None and adaptive is None:
        planned = plan(scene, args.time, args.method, memory)
        sampler, seconds, adaptive = planned.sampler, planned.render, Adaptive() if planned.shared else None
        shared = ", samples shared out" if planned.shared else ""
        console.say(f"{args.scene}: sampler '{sampler}'{shared}, method '{planned.method}': {planned.reason}")
    elif sampler == "auto" and adaptive is None:
        choice = choose_by_pilot(scene, spp, seconds, memory)
        sampler = choice.sampler
        console.say(f"{args.scene}: sampler '{sampler}': {choice.reason}")
        seconds = seconds and max(seconds - choice.seconds, 1e-3)
    with console.progress(f"render {args.scene}", "s" if args.time else "spp") as progress, stop_on_ctrl_c() as stop:
        stack = render_stack(
            scene,
            spp,
            args.seed,
            sampler,
            progress,
            seconds=seconds,
            memory=memory,
            stop=stop,
            diagnostics=args.diagnostics,
            adaptive=adaptive,
            **dict(args.option),
        )
    if planned:
        stack.attributes["ngpt:for"] = planned.method
    if stack.attributes["ngpt:discarded"]:
        console.say(f"{args.scene}: {stack.attributes['ngpt:discarded']} non-finite values were left out")
    write(target, stack, overwrite=args.force)
    done, took = stack.attributes["ngpt:spp"], stack.attributes["ngpt:seconds"]
    interrupted = stop() and done != spp
    if args.error is not None and "ngpt:error" in stack.attributes:
        expected, method = stack.attributes["ngpt:error"], stack.attributes["ngpt:adaptive"]
        short = "" if expected <= args.error else f", not {args.error:g}: it was ended before"
        console.say(f"{args.scene}: '{method}' is expected to have an error of {expected:.3g}{short}")
    if interrupted:
        console.error(f"interrupted: {target} holds the {done} samples per pixel done by then")
    console.say(f"{args.scene} -> {target}: {stack.width}x{stack.height}, {done} spp, {took:.2f} s")
    if planned:
        console.say(f"then: ngpt denoise {shlex.quote(str(target))} --method {planned.method}")
    if args.json:
        ours = {name.removeprefix("ngpt:"): value for name, value in stack.attributes.items() if "ngpt:" in name}
        print_json({"output": str(target), "width": stack.width, "height": stack.height, "layers": stack.names} | ours)
    return 130 if interrupted else 0


def sharing(args: argparse.Namespace):
    """How samples are shared out; None: evenly."""
    if args.error is None and not args.adaptive:
        if args.method is not None and (args.sampler != "auto" or args.time is None or args.spp is not None):
            raise NgptError(
                "--for says what --adaptive and --error go by; give one of them too, or let a pilot choose for it: "
                "with --time, and without --sampler and --spp"
            )
        return None
    from data_gen.adaptive import Adaptive

    return Adaptive(args.error, args.method or "auto")


def on_cluster(args: argparse.Namespace, console: Console) -> dict:
    """``render_frames`` in parts, each on a worker of a Dask cluster; what is there already is not made again."""
    if args.shard:
        raise NgptError("--cluster shares the frames out by itself; leave --shard out")
    for target in targets(args.output, args.scene, args.frames).values():
        check_output(target, args.force or args.skip_existing)
    from data_gen.dataset.jobs import cluster

    parts = -(-len(args.frames) // FRAMES_OF_A_PART)
    # A part that is tried again, since its worker died, goes on.
    each = vars(args) | {"cluster": None, "skip_existing": args.skip_existing or not args.force}
    reports: dict = {"frames": [], "skipped": 0}
    with cluster(args.cluster) as workers, console.progress(f"render {args.scene}", "frames") as progress:
        progress(0, len(args.frames))
        futures = [workers.submit(_render_part, each | {"shard": (i, parts)}) for i in range(parts)]
        for future in as_completed(futures):
            report = future.result()
            reports = {name: reports[name] + report[name] for name in reports}
            progress(len(reports["frames"]) + reports["skipped"], len(args.frames))
    reports["frames"].sort(key=lambda report: args.frames.index(report["frame"]))
    return reports


def _render_part(args: dict) -> dict:
    report = render_frames(argparse.Namespace(**args), Console(quiet=True))
    if report is None:
        raise NgptError("a worker was interrupted; run the same command with --skip-existing to continue")
    return report


def render_frames(args: argparse.Namespace, console: Console) -> dict | None:
    """A stack for each frame of ``--frames``, or of the part of them in ``--shard``: what ``--json`` prints of them.

    None where it was interrupted.
    """
    if args.adaptive or args.error is not None or args.method is not None:
        raise NgptError("--adaptive, --error and --for are for single images; leave them out with --frames")
    places = targets(args.output, args.scene, args.frames)
    number, parts = args.shard or (0, 1)
    # Of frames side by side, each needs the scene of the one before.
    part_of = {frame: i * parts // len(places) for i, frame in enumerate(places)}
    ours = [frame for frame in places if part_of[frame] == number]
    for frame in ours:
        check_output(places[frame], args.force or args.skip_existing)
    define = dict(args.define)

    def describe(frame: int) -> tuple[str, dict[str, str]]:
        return filled(args.scene, frame), {name: filled(text, frame) for name, text in define.items()}

    if args.dt == 1:
        raise NgptError("--dt 1: how much differences vary takes 2 pairs or more to tell; use --dt 2")
    describe(args.frames[0])
    from data_gen.backend import DEFAULT_VARIANT, use_variant

    use_variant(args.variant or DEFAULT_VARIANT)
    from data_gen.frames.camera_path import read_camera_path
    from data_gen.frames.gltf import read_gltf_camera
    from data_gen.frames.sequence import Shot, render_sequence
    from data_gen.passes import DEFAULT_MEMORY
    from data_gen.render import check_limits

    spp = args.spp or (DEFAULT_SPP if args.time is None else None)
    memory = args.memory or DEFAULT_MEMORY
    sampler = args.sampler
    if args.sampler in FRAME_SAMPLERS:
        spp, sampler = args.spp or FRAME_SAMPLERS[args.sampler].spp, "auto"
    check_limits(spp, args.seed, sampler, args.time, memory)
    check_options(args.sampler, dict(args.option))
    camera = None
    if args.camera:
        animated = Path(args.camera).suffix.lower() in (".glb", ".gltf")
        camera = read_gltf_camera(args.camera, args.fps) if animated else read_camera_path(args.camera)
    shot = Shot(describe, args.size, camera)
    reports, skipped = [], 0

    def skip(frame: int) -> bool:
        # Only when its turn has come, for several machines may be at work on one sequence.
        nonlocal skipped
        if part_of[frame] != number:
            return True
        there = args.skip_existing and places[frame].exists()
        skipped += there
        return there

    with console.progress(f"render {args.scene}", "frames") as progress, stop_on_ctrl_c() as stop:
        progress(0, len(ours))
        for frame, stack in render_sequence(
            shot,
            args.frames,
            spp,
            args.seed,
            args.dt,
            skip,
            sampler=args.sampler,
            seconds=args.time,
            memory=memory,
            stop=stop,
            diagnostics=args.diagnostics,
            **dict(args.option),
        ):
            done, seconds = stack.attributes["ngpt:spp"], stack.attributes["ngpt:seconds"]
            if stop():
                console.error(f"interrupted: frame {frame} is left out; --skip-existing goes on with it")
                return None
            if stack.attributes["ngpt:discarded"]:
                console.say(f"frame {frame}: {stack.attributes['ngpt:discarded']} non-finite values were left out")
            target = places[frame]
            # Another machine may have been faster.
            if not (args.skip_existing and target.exists()):
                write(target, stack, overwrite=args.force)
            size = f"{stack.width}x{stack.height}"
            console.say(f"{describe(frame)[0]} frame {frame} -> {target}: {size}, {done} spp, {seconds:.2f} s")
            made = {name.removeprefix("ngpt:"): value for name, value in stack.attributes.items() if "ngpt:" in name}
            reports.append({"output": str(target), "width": stack.width, "height": stack.height} | made)
            progress(len(reports) + skipped, len(ours))
    if skipped:
        console.say(f"{skipped} of {len(ours)} frames were skipped: their stacks are there")
    return {"frames": reports, "skipped": skipped}


@contextmanager
def stop_on_ctrl_c() -> Iterator[Callable[[], bool]]:
    """Yields a function that says whether Ctrl-C was pressed; pressed again, it interrupts as usual."""
    pressed = False

    def note(number, frame):
        nonlocal pressed
        pressed = True
        signal.signal(signal.SIGINT, before)
        Console().say("interrupted: ending with this pass; press Ctrl-C again to discard it all")

    before = signal.getsignal(signal.SIGINT)
    if before is signal.SIG_IGN:  # in the background of a script, whose Ctrl-C is not for us
        yield lambda: False
        return
    try:
        signal.signal(signal.SIGINT, note)
    except ValueError:  # not in the main thread, where alone signals arrive
        yield lambda: False
        return
    try:
        yield lambda: pressed
    finally:
        signal.signal(signal.SIGINT, before)
