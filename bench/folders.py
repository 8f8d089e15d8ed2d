"""Folders of frames: how much of file access and computing is hidden behind the other.

    python -m bench.folders
    python -m bench.folders --sizes 1920x1080 --methods oidn --frames 12

Per size and method, on folders of synthetic stacks with features and variances, all in this process, in turn and warm:

    files       reading each stack and writing its result, nothing else
    computing   each reconstruction, its stack in memory
    one by one  all of it without overlap: read, compute, write, read ...
    folder      `ngpt denoise FOLDER -o OUT`, which reads ahead and writes behind

The ratio to look at is folder / max(files, computing), within one run. It cannot fall below 1, nor below what the
processor has to do in all: ``busy`` is its seconds in `folder` over those of the clock, times the cores; where it
is near 1 nothing is left to hide anything behind.
"""

import argparse
import os
import tempfile
import time
from pathlib import Path

import ngpt
from bench.common import measure, metadata, save
from bench.onnx import stack_of
from ngpt.cli import main as ngpt_command
from ngpt.io.exr import read, write
from ngpt.methods import METHODS, reconstruct

SIZES = ("1280x720", "1920x1080")
NAMES = ("oidn", "ngpt-fast", "wcv")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sizes", nargs="*", default=SIZES, metavar="WxH")
    parser.add_argument("--methods", nargs="*", default=NAMES, choices=METHODS)
    parser.add_argument("--frames", type=int, default=8)
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("-o", "--output", type=Path, default=Path("bench/results/folders.json"))
    args = parser.parse_args()
    result = {"benchmark": "frames", "frames": args.frames, "repeats": args.repeats, "sizes": {}}
    result["metadata"] = metadata("onnxruntime", "OpenEXR", "mitsuba-oidn")
    result["load"] = os.getloadavg()[0] if hasattr(os, "getloadavg") else None
    for size in args.sizes:
        result["sizes"][size] = {}
        with tempfile.TemporaryDirectory() as folder:
            source = make_frames(Path(folder), *map(int, size.split("x")), args.frames)
            for method in args.methods:
                if lack := METHODS[method].missing():
                    result["sizes"][size][method] = {"absent": lack}
                    continue
                row = result["sizes"][size][method] = bench_folder(source, Path(folder) / "out", method, args.repeats)
                print(size, method, {name: round(value, 3) for name, value in row["ratios"].items()}, flush=True)
    save(args.output, result)


def make_frames(folder: Path, width: int, height: int, count: int) -> Path:
    """A folder of ``count`` files of one stack; decoding does not know that it has seen them before."""
    source = folder / "frames"
    source.mkdir()
    stack = stack_of(width, height)
    for i in range(count):
        ngpt.write(source / f"{i:04}.exr", stack)
    return source


def bench_folder(source: Path, out: Path, method: str, repeats: int) -> dict:
    out.mkdir(exist_ok=True)
    paths = sorted(source.iterdir())
    stack = read(paths[0])
    image = reconstruct(stack, method).image
    busy: list[float] = []

    def files() -> None:
        for path in paths:
            write(out / path.name, image, like=read(path), overwrite=True)

    def computing() -> None:
        for _ in paths:
            reconstruct(stack, method)

    def one_by_one() -> None:
        for path in paths:
            loaded = read(path)
            write(out / path.name, reconstruct(loaded, method).image, like=loaded, overwrite=True)

    def folder() -> None:
        start, work = time.perf_counter(), time.process_time()
        assert ngpt_command(["denoise", str(source), "-o", str(out), "-m", method, "--force", "-q"]) == 0
        cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
        busy.append((time.process_time() - work) / (time.perf_counter() - start) / cores)

    calls = {"files": files, "computing": computing, "one by one": one_by_one, "folder": folder}
    seconds = measure(calls, repeats)
    median = {name: row["median"] for name, row in seconds.items()}
    longer = max(median["files"], median["computing"])
    ratios = {
        "folder / longer": median["folder"] / longer,
        "one by one / longer": median["one by one"] / longer,
        "folder / one by one": median["folder"] / median["one by one"],
        "busy": sorted(busy)[len(busy) // 2],
    }
    return {"seconds": seconds, "ratios": ratios}


if __name__ == "__main__":
    main()
