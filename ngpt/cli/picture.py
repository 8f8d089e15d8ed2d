"""``ngpt picture``: writes images as PNG, JPEG or WebP, and shots as films, after a view transform."""

import argparse
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from ngpt.cli.arguments import add_force, add_view, number, output_file
from ngpt.cli.streams import standard_input
from ngpt.errors import WrongUse
from ngpt.image.display import squared
from ngpt.image.pictures import PICTURES, SHOTS, check_kind, write_picture, write_shot
from ngpt.image.transforms import TRANSFORMS, shown
from ngpt.io.exr import read_picture
from ngpt.io.framenames import named, number_of, varies
from ngpt.io.frames import is_shot, remarks, shot_files
from ngpt.result_file import Look, in_picture
from ngpt.system.console import Console
from ngpt.windows import put


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.epilog = (
        "A picture shows the noisy image of a stack, and the clean image of a result. It has the pixels of the data "
        "window that lie in the display window. Frames of a folder show their whole display window, with one exposure."
    )
    parser.add_argument(
        "image",
        metavar="IMAGE",
        help="image of any renderer (-: standard input), or frames: a folder, a pattern, or shot.%%04d.exr",
    )
    parser.add_argument(
        "-o",
        "--output",
        required=True,
        metavar="FILE",
        help=f"picture to write ({' '.join(PICTURES)}); for frames a film ({' '.join(SHOTS)}), a folder of PNGs, or "
        "names as pic.%%04d.png",
    )
    add_look(parser)
    add_view(parser, "default: the first")
    parser.add_argument("--fps", type=frames_a_second, default=24.0, help="frames per second of a film (default: 24)")
    add_force(parser)


def run(args: argparse.Namespace, console: Console) -> int:
    target = Path(args.output)
    if is_shot(args.image):
        return shot(args, args.image, target, console)
    check_kind(target, PICTURES)
    output_file(target, args)
    with standard_input([args.image]) as (name,):
        image = in_picture(*read_picture(name, view=args.view))
        write_picture(target, Look(args.transform, args.exposure).of(image), args.force)
        console.say(f"{name} -> {target}: {image.shape[1]}x{image.shape[0]}")
    return 0


def shot(args: argparse.Namespace, folder: str, target: Path, console: Console) -> int:
    """Writes the frames of a folder or a pattern as one film, or as one picture each."""
    files, numbered = shot_files(folder), varies(str(target))
    film = bool(target.suffix) and not numbered
    targets = [target / f"{file.stem}.png" for file in files]
    if numbered:
        targets = [Path(named(str(target), number_of(file, str(target)))) for file in files]
    elif film:
        targets = [target]
    elif target.exists() and not target.is_dir():
        raise WrongUse(f"{target}: is a file; name a folder for the pictures, or a film ({' '.join(SHOTS)})")
    check_kind(targets[0], SHOTS if film else PICTURES)
    for path in targets:
        output_file(path, args)
    for remark in remarks(folder, files):
        console.say(remark)
    stops = Look(args.transform, args.exposure).stops(in_picture(*read_picture(files[0], view=args.view)))

    def pictures() -> Iterator[np.ndarray]:
        for done, file in enumerate(files):
            progress(done, len(files))
            pixels, place = read_picture(file, view=args.view)
            yield shown(squared(put(pixels, place.data, place.display), place.aspect), args.transform, stops)
        progress(len(files), len(files))

    with console.progress("pictures", "frames") as progress:
        if film:
            write_shot(target, pictures(), args.fps, args.force)
        else:
            for path, picture in zip(targets, pictures(), strict=True):
                write_picture(path, picture, args.force)
    console.say(f"{folder} -> {target}: {len(files)} frames")
    return 0


def add_look(parser: argparse.ArgumentParser) -> None:
    """Adds the options of the view transform (``ngpt.image.transforms``)."""
    parser.add_argument(
        "--transform",
        default="standard",
        choices=TRANSFORMS,
        metavar="NAME",
        help="view transform of the picture: standard (sRGB, default), filmic (AgX), aces (needs OpenColorIO)",
    )
    parser.add_argument(
        "--exposure", type=stops, default=0.0, metavar="STOPS", help="a number of stops (default: 0), or auto"
    )


def stops(text: str) -> float | str:
    """The value of ``--exposure``: a number of stops, or "auto"."""
    if text == "auto":
        return text
    return number(text, lambda stops: abs(stops) <= 100, "is neither a number of stops, from -100 to 100, nor auto")


def frames_a_second(text: str) -> float:
    return number(text, lambda rate: 0 < rate <= 1000, "is not a number of frames a second, up to 1000")
