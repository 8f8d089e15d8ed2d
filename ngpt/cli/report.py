"""``ngpt report``: one page to compare the images of any renderers and denoisers in."""

import argparse
import os
from pathlib import Path

import numpy as np

from ngpt.cli.arguments import add_force
from ngpt.errors import NgptError
from ngpt.io.exr import read_image
from ngpt.measure.metrics import METRICS, exposure_mismatch
from ngpt.measure.shown import available, judge
from ngpt.report.content import REFERENCE, Entry, Overview, Scene
from ngpt.report.page import oversize, write_report
from ngpt.system.console import Console
from ngpt.system.files import check_output
from ngpt.version import __version__

# Denoising moves the mean by a fraction of this.
_STOPS = 0.5


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.epilog = "Of a stack the noisy image is shown, of a result the result. Pictures are named after their files."
    parser.add_argument("images", nargs="+", metavar="IMAGE.exr", help="images of one size, of any renderer")
    parser.add_argument(
        "--ref", metavar="REF.exr", help="what they should look like: adds errors, SSIM, FLIP, and maps"
    )
    parser.add_argument(
        "-o", "--output", default="report.html", metavar="PAGE.html", help="page to write (default: report.html)"
    )
    add_force(parser)


def run(args: argparse.Namespace, console: Console) -> int:
    target = check_output(args.output, args.force)
    names = labels(args.images)
    images = [read_image(path) for path in args.images]
    reference = read_image(args.ref) if args.ref else None
    for path, image in zip([*args.images[1:], args.ref], [*images[1:], reference], strict=True):
        check_size(path, image, args.images[0], images[0])
    height, width = images[0].shape[:2]
    entries = [Entry(name, image) for name, image in zip(names, images, strict=True)]
    formulas, caption = {}, "no reference: with --ref the page has errors, SSIM, FLIP and their maps"
    if reference is not None:
        caption = f"reference {args.ref}"
        metrics, lacks = available(height, width)
        for lack in lacks:
            console.say(lack)
        with console.progress("errors", "images") as progress:
            progress(0, len(entries))
            for done, (entry, path) in enumerate(zip(entries, args.images, strict=True), 1):
                add_errors(entry, metrics, reference, path, args.ref)
                progress(done, len(entries))
        for entry, path in zip(entries, args.images, strict=True):
            if abs(stops := exposure_mismatch(entry.image, reference)) >= _STOPS:
                much = f"{abs(stops):.1f} stops {'brighter' if stops > 0 else 'darker'}"
                console.say(f"{path}: {much} than {args.ref}; is it of the same scene and exposure?")
        formulas = {name: METRICS[name].formula for name in metrics}
        print_table(entries)
    rising = [name for name, metric in METRICS.items() if metric.better == "higher"]
    scene = Scene(f"{width}x{height}", caption, reference, entries, rising=rising)
    title = ", ".join(names) if len(names) < 5 else f"{len(names)} images"
    facts = {"ngpt": __version__}
    overview = Overview(formulas=formulas)
    write_report(target, title, [scene], command=args.command, footer=facts, overview=overview, overwrite=args.force)
    if large := oversize(target):
        console.say(large)
    console.say(f"{target}: open it in a browser")
    return 0


def labels(paths: list[str]) -> list[str]:
    """A name for each file: its own without the ending, and as many folders as make all names differ."""
    places = [Path(os.path.abspath(path)) for path in paths]
    for place, path in zip(places, paths, strict=True):
        if places.count(place) > 1:
            raise NgptError(f"{path}: is given twice; leave one out")
    bare = [place.with_suffix("").parts for place in places]
    for depth in range(1, max(map(len, bare)) + 1):
        names = ["/".join(parts[-depth:]) for parts in bare]
        if len(set(names)) == len(names) and REFERENCE not in names:
            return names
    return [str(place) for place in places]  # they differ in their endings only


def check_size(path: str, image: np.ndarray | None, first: str, expected: np.ndarray) -> None:
    """Raises NgptError unless the image is as large as the first."""
    if image is not None and image.shape != expected.shape:
        (height, width), (rows, columns) = image.shape[:2], expected.shape[:2]
        raise NgptError(f"{path} is {width}x{height} but {first} is {columns}x{rows}; render or crop them to one size")


def add_errors(entry: Entry, metrics: list[str], reference: np.ndarray, path: str, other: str) -> None:
    """Measures a picture of file ``path`` against the reference of file ``other``."""
    try:
        entry.metrics, entry.maps = judge(metrics, entry.image, reference)
    except NgptError as error:
        raise NgptError(f"{path} and {other}: {error}") from error


def print_table(entries: list[Entry]) -> None:
    """The numbers of the page, for those who do not open it."""
    width = max(len(entry.name) for entry in entries)
    print(f"{'':{width}}" + "".join(f"{metric:>16}" for metric in entries[0].metrics))
    for entry in entries:
        print(f"{entry.name:{width}}" + "".join(f"{value:16.4g}" for value in entry.metrics.values()))
