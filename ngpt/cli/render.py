"""``ngpt render``: from a scene to a gradient stack."""

import argparse
from pathlib import Path

from ngpt.cli.arguments import add_force, add_json, assignment, natural, positive, print_json, size
from ngpt.console import Console
from ngpt.errors import NgptError
from ngpt.exr import write
from ngpt.files import check_output


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("scene", metavar="SCENE", help="a Mitsuba 3 scene file, or a built-in scene (see `ngpt info`)")
    parser.add_argument("-o", "--output", metavar="FILE", help="stack to write (default: SCENE.exr in this folder)")
    parser.add_argument("--spp", type=positive, default=32, help="paths per pixel (default: 32)")
    parser.add_argument("--size", type=size, metavar="WxH", help="pixels (default: the scene's own)")
    parser.add_argument(
        "--sampler", default="auto", help="auto, gpt, gpt-basic, or primal: no gradients (default: auto)"
    )
    parser.add_argument("--seed", type=natural, default=0, help="the same seed gives the same stack (default: 0)")
    parser.add_argument("--variant", help="Mitsuba variant (default: llvm_ad_rgb; cuda_ad_rgb for an NVIDIA GPU)")
    parser.add_argument(
        "-D", dest="define", action="append", default=[], type=assignment, metavar="NAME=VALUE", help="scene parameter"
    )
    add_force(parser)
    add_json(parser)


def run(args: argparse.Namespace, console: Console) -> int:
    target = check_output(args.output or f"{Path(args.scene).stem}.exr", args.force)
    if target.suffix.lower() != ".exr":
        raise NgptError(f"{target}: ngpt writes OpenEXR; let the name end in .exr")
    # Only the verbs that render import the renderer.
    from data_gen.backend import DEFAULT_VARIANT, use_variant

    use_variant(args.variant or DEFAULT_VARIANT)
    from data_gen.render import load_scene, render_stack

    scene = load_scene(args.scene, args.size, dict(args.define))
    with console.progress(f"render {args.scene}", "spp") as progress:
        stack = render_stack(scene, args.spp, args.seed, args.sampler, progress)
    if stack.attributes["ngpt:discarded"]:
        console.say(f"{args.scene}: {stack.attributes['ngpt:discarded']} non-finite samples were left out")
    write(target, stack, overwrite=args.force)
    seconds = stack.attributes["ngpt:seconds"]
    console.say(f"{args.scene} -> {target}: {stack.width}x{stack.height}, {args.spp} spp, {seconds:.2f} s")
    if args.json:
        ours = {name.removeprefix("ngpt:"): value for name, value in stack.attributes.items() if "ngpt:" in name}
        print_json({"output": str(target), "width": stack.width, "height": stack.height, "layers": stack.names} | ours)
    return 0
