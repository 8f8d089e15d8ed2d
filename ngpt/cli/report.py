"""``ngpt report``: writes a page that compares images of any renderers and denoisers."""

import argparse
import os
from pathlib import Path
from typing import Any

import numpy as np

from ngpt.cli.arguments import add_force, output_file, tell_lacks
from ngpt.cli.streams import standard_input
from ngpt.errors import NgptError, WrongUse
from ngpt.io.exr import read, read_picture
from ngpt.io.framenames import frames_named, varies
from ngpt.io.frames import frame_name, is_shot, natural, remarks, shot_files
from ngpt.measure.flicker import change_maps, flicker, flicker_maps
from ngpt.measure.metrics import METRICS, exposure_mismatch
from ngpt.measure.shown import available, judge
from ngpt.report.content import REFERENCE, Overview, ReportEntry, Scene
from ngpt.report.layers import of_stack
from ngpt.report.page import oversize, write_report
from ngpt.system.console import Console, tell
from ngpt.system.text import by_names
from ngpt.system.writing import write_text
from ngpt.training.run_page import page, read_run
from ngpt.training.run_summary import is_run
from ngpt.version import __version__
from ngpt.windows import Place, overlap, put

Slices = tuple[slice, slice]

# A difference of exposure, in stops, that is reported. Denoising changes the mean by much less.
_STOPS = 0.5
FLICKER = (
    "mean of (d - d_r)^2 / (m + 0.001), d the change along motion from the frame before, d_r that of the reference r, "
    "m the mean of r^2 in both frames"
)
CHANGE = "map of the root of d^2 / (m + 0.001), with the mean m of the squared picture in both frames"
_MARKS = ["0", "0.25", "0.5", "0.75", "≥ 1"]
MEANINGS = {
    "change": ("change from the frame before, relative to the light", _MARKS),
    "flicker": ("flicker, relative to the light", _MARKS),
}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.epilog = (
        "The page shows the noisy image of a stack and the clean image of a result, or all layers if there is only one "
        "file. Images are compared in the pixels that all of them have, according to their data windows. Folders are "
        "shots: the page plays them, and with a folder of references it has a table of errors and flicker. For folders "
        "of training runs, it compares curves, pictures and settings."
    )
    parser.add_argument(
        "images",
        nargs="+",
        metavar="IMAGE",
        help="images of any renderer with the same resolution (-: standard input); or shots: folders, patterns, "
        "shot.%%04d.exr; or folders of training runs",
    )
    what = "reference image, or for folders a folder of references: adds errors, SSIM, FLIP and maps"
    parser.add_argument("--ref", metavar="REF.exr", help=what)
    parser.add_argument(
        "-o", "--output", default="report.html", metavar="PAGE.html", help="page to write (default: report.html)"
    )
    add_force(parser)


def run(args: argparse.Namespace, console: Console) -> int:
    if Path(args.output).suffix.lower() not in (".html", ".htm"):
        raise WrongUse(f"{args.output}: browsers know a page by its name; let it end in .html")
    target = output_file(args.output, args)
    if any(is_run(Path(path)) for path in args.images):
        return run_trainings(args, target, console)
    with standard_input([*args.images, args.ref or ""]) as (*args.images, args.ref):
        return images_or_shots(args, target, console)


def images_or_shots(args: argparse.Namespace, target: Path, console: Console) -> int:
    """Writes the page of images, or of shots if any of them is one, and returns the exit status."""
    names = labels(args.images)
    if any(is_shot(path) for path in args.images):
        return run_shots(args, names, target, console)
    paths = [*args.images, *([args.ref] if args.ref else [])]
    whole, places = zip(*map(read_picture, paths), strict=True)
    all_have = overlap(paths, places)
    if all_have.line:
        console.say(all_have.line)
    images = all_have.of(whole)
    reference = images.pop() if args.ref else None
    height, width = images[0].shape[:2]
    entries = [ReportEntry(name, image) for name, image in zip(names, images, strict=True)]
    layers: dict[str, np.ndarray] = {}
    formulas, caption = {}, "no reference: with --ref the page has errors, SSIM, FLIP and their maps"
    if len(images) == 1 and reference is None:
        entries, layers = of_stack(read(args.images[0]), images[0], names[0])
        caption = f"all layers of {by_names(args.images[0])}"
    if reference is not None:
        caption = f"reference {by_names(args.ref)}"
        metrics, lacks = available(height, width)
        tell_lacks(lacks, console)
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
        rows = [[entry.name, *(f"{value:.4g}" for value in entry.metrics.values())] for entry in entries]
        print_table([["", *entries[0].metrics], *rows])
    scene = Scene(f"{width}x{height}", caption, reference, entries, layers, _rising())
    title = ", ".join(names) if len(names) < 5 else f"{len(names)} images"
    return finish(args, target, title, [scene], Overview(formulas=formulas), console)


def run_trainings(args: argparse.Namespace, target: Path, console: Console) -> int:
    """Writes the page of training runs, and returns the exit status."""
    if args.ref:
        raise WrongUse("--ref is for images; leave it out for training runs")
    names = [Path(name).as_posix() for name in labels(args.images)]
    text = page([read_run(path, name) for path, name in zip(args.images, names, strict=True)], args.command)
    write_text(target, text, args.force)
    console.say(f"{target}: open it in a browser")
    return 0


def run_shots(args: argparse.Namespace, names: list[str], target: Path, console: Console) -> int:
    """Writes the page that plays shots, with measurements over all frames, and returns the exit status."""
    folders = [*args.images, *([args.ref] if args.ref else [])]
    for folder in folders:
        if not is_shot(folder):
            raise NgptError(f"{folder}: is not a folder, but others are; give only folders of frames, or only images")
    shots = [shot_files(folder) for folder in folders]
    frames = frames_of(folders, shots)
    for remark in (line for folder, files in zip(folders, shots, strict=True) for line in remarks(folder, files)):
        console.say(remark)
    start = str(frames[0][0])
    first = read_picture(start).place.display
    metrics, lacks = available(first.height, first.width) if args.ref else ([], {})
    tell_lacks(lacks, console)
    scenes: list[Scene] = []
    motions: list[np.ndarray | None] = []
    partly = 0
    # The frames of each folder for measurements: NaN where a frame does not cover the display window
    known: list[list[np.ndarray]] = [[] for _ in folders]
    with console.progress("report", "frames") as progress:
        for done, frame in enumerate(frames):
            progress(done, len(frames))
            paths = [str(path) for path in frame]
            whole, places = zip(*map(read_picture, paths), strict=True)
            all_have, display = overlap(paths, places), places[0].display
            both = all_have.common.common(display)
            if both is None or display.size != first.size:
                why = "render or crop them to one size" if both else "nothing of it is seen"
                raise NgptError(f"{paths[0]} is {places[0]} and {start} is of {first}; {why}")
            partly += bool(all_have.line)
            images = [put(image, window, display) for image, window in zip(whole, all_have.windows, strict=True)]
            for values, image, window in zip(known, whole, all_have.windows, strict=True):
                values.append(put(image, window, display, np.nan))
            reference = images.pop() if args.ref else None
            entries = [ReportEntry(name, image) for name, image in zip(names, images, strict=True)]
            motions.append(motion_of(paths, places[0]))
            if reference is not None:
                for entry, path in zip(entries, paths, strict=False):
                    add_errors(entry, metrics, reference, path, paths[-1], both.within(display))
            caption = f"{frame[0].name}, {first.width}x{first.height}"
            scenes.append(Scene(frame[0].stem, caption, reference, entries, rising=_rising(), meanings=MEANINGS))
        progress(len(frames), len(frames))
    if partly:
        console.say(f"{partly} of {len(frames)} frames: only the pixels that all images have are compared")
    tables = {}
    for place in range(len(names)):
        add_maps(scenes, place, "change", change_maps(known[place], motions))
    if args.ref and len(frames) > 1:
        references = known[-1]
        rows = [["", *metrics, "flicker"]]
        for place, name in enumerate(names):
            images = known[place]
            add_maps(scenes, place, "flicker", flicker_maps(images, references, motions))
            means = [float(np.mean([scene.entries[place].metrics[metric] for scene in scenes])) for metric in metrics]
            rows.append([name, *(f"{value:.4g}" for value in (*means, flicker(images, references, motions)))])
        if all(motion is None for motion in motions[1:]):
            console.say("flicker is nan: it needs motion vectors (layer 'motion'), which no frame after the first has")
        tables = {f"Means over {len(frames)} frames": rows}
        print_table(rows)
    formulas = {name: METRICS[name].formula for name in metrics} | ({"flicker": FLICKER} if tables else {})
    formulas |= {"change": CHANGE} if len(frames) > 1 else {}
    title = f"{', '.join(names)}: {len(frames)} frames"
    return finish(args, target, title, scenes, Overview(tables=tables, formulas=formulas), console)


def finish(
    args: argparse.Namespace, target: Path, title: str, scenes: list[Scene], about: Overview, console: Console
) -> int:
    """Writes the page of images, or the page that plays a shot, and returns the exit status."""
    facts, shot = {"ngpt": __version__}, any(is_shot(path) for path in args.images)
    more: Any = {"overview": about, "overwrite": args.force, "shot": shot}
    write_report(target, title, scenes, command=args.command, footer=facts, **more)
    if large := oversize(target):
        console.say(large)
    console.say(f"{target}: open it in a browser")
    return 0


def add_maps(scenes: list[Scene], place: int, name: str, changes: list[np.ndarray]) -> None:
    """Adds maps of squared relative changes, one for each frame but the first, to the entries at index ``place``."""
    for scene, change in zip(scenes, [np.zeros((1, 1, 3)), *changes], strict=True):
        image = scene.entries[place].image
        values = np.clip(np.sqrt(np.nan_to_num(change.mean(axis=-1))), 0, 1)
        scene.entries[place].maps[name] = np.broadcast_to(values, image.shape[:2])


def motion_of(paths: list[str], place: Place) -> np.ndarray | None:
    """The motion vectors of a frame, (H, W, 2), in its display window, from the first of its files that has them."""
    for path in paths:
        stack = read(path)
        window = stack.place.seen_from(place)
        if "motion" in stack and window is not None:
            return put(stack["motion"], window, place.display, np.nan)
    return None


def frames_of(folders: list[str], shots: list[list[Path]]) -> list[tuple[Path, ...]]:
    """The files of each frame, one from each shot, in the order of the first shot.

    Frames are matched by the names of their files, or by their numbers if all shots are names with a field for the
    number. Raises NgptError if a shot lacks a frame.
    """
    found: list[dict[Any, Path]] = [{frame_name(path): path for path in files} for files in shots]
    if all(map(varies, folders)):
        numbers = {path: number for folder in folders for number, path in frames_named(folder).items()}
        found = [{numbers[path]: path for path in files} for files in shots]
    for folder, files in zip(folders, found, strict=True):
        if differ := files.keys() ^ found[0].keys():
            frame = min(differ, key=natural)
            has, lacks = (folder, folders[0]) if frame in files else (folders[0], folder)
            path = files.get(frame) or found[0][frame]
            raise NgptError(f"{has} has {path.name} and {lacks} has not; give folders of the same frames")
    return [tuple(files[frame] for files in found) for frame in found[0]]


def labels(paths: list[str]) -> list[str]:
    """Names each file by its own name without the ending, after as many folders as are needed to make names differ."""
    places = [Path(os.path.abspath(path)) for path in paths]
    for place, path in zip(places, paths, strict=True):
        if places.count(place) > 1:
            raise WrongUse(f"{path}: is given twice; leave one out")
    bare = [place.with_suffix("").parts for place in places]
    for depth in range(1, max(map(len, bare)) + 1):
        names = ["/".join(parts[-depth:]) for parts in bare]
        if len(set(names)) == len(names) and REFERENCE not in names:
            return names
    return [str(place) for place in places]  # names that differ only in their endings


def add_errors(
    entry: ReportEntry, metrics: list[str], reference: np.ndarray, path: str, other: str, part: Slices = np.s_[:, :]
) -> None:
    """Measures ``part`` of the picture of file ``path`` against the reference of file ``other``."""
    try:
        entry.metrics, maps = judge(metrics, entry.image[part], reference[part])
    except NgptError as error:
        raise NgptError(f"{path} and {other}: {error}") from error
    for name, values in maps.items():
        entry.maps[name] = np.zeros(entry.image.shape[:2], values.dtype)
        entry.maps[name][part] = values


def _rising() -> list[str]:
    """The metrics for which higher is better."""
    return [name for name, metric in METRICS.items() if metric.better == "higher"]


def print_table(rows: list[list[str]]) -> None:
    """Prints the numbers of the page."""
    width = max(len(row[0]) for row in rows)
    for row in rows:
        tell(f"{row[0]:{width}}" + "".join(f"{cell:>16}" for cell in row[1:]))
