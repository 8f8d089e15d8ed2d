"""Reading and writing of EXR files over OpenEXR's own, and the base and the fast network over OIDN, as ratios.

    python -m bench.files

On synthetic stacks with all layers, all in this process and in turn, so that a busy machine slows all of them alike:

    read / OpenEXR     ngpt.read over OpenEXR.File(path, separate_channels=True), for each kind of file
    write / OpenEXR    ngpt.write of a result, its stack's layers beside it, over OpenEXR's own write of these channels
    wcv                the classical base of the networks, seconds
    ngpt-fast / oidn   as ngpt.reconstruct() runs both; oidn denoises its features first

Kinds of files: one part or one for each layer; float, or half where the contract allows it; ZIP, PIZ, uncompressed.
Ratios are of medians; their quartiles are those of the ratios of single rounds. Seconds of the processor are given
beside those of the clock: on a machine with other work they are the steadier measure of it.
"""

import argparse
import statistics
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import OpenEXR

import ngpt
from bench.common import metadata, save, summary
from bench.onnx import stack_of
from ngpt.layers import LAYERS
from ngpt.methods import METHODS, reconstruct
from ngpt.repair import repair
from ngpt.stack import GradientStack

# One part or many, half or float, compression.
KINDS = {
    "ZIP": (False, np.float32, OpenEXR.ZIP_COMPRESSION),
    "ZIP half": (False, np.float16, OpenEXR.ZIP_COMPRESSION),
    "ZIP parts": (True, np.float32, OpenEXR.ZIP_COMPRESSION),
    "PIZ": (False, np.float32, OpenEXR.PIZ_COMPRESSION),
    "none": (False, np.float32, OpenEXR.NO_COMPRESSION),
    "none parts": (True, np.float32, OpenEXR.NO_COMPRESSION),
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--size", default="1280x720", help="of the files; the methods run at 1280x720")
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("-o", "--output", type=Path, default=Path("bench/results/files.json"))
    args = parser.parse_args()
    result: dict = {"benchmark": "files", "size": args.size, "repeats": args.repeats}
    result["metadata"] = metadata("OpenEXR", "onnxruntime", "mitsuba-oidn")
    stack = stack_of(*map(int, args.size.split("x")))
    with tempfile.TemporaryDirectory() as folder:
        result["files"] = {}
        for name, kind in KINDS.items():
            result["files"][name] = bench_kind(stack, Path(folder), *kind, args.repeats)
            print(name, {key: round(row["median"], 2) for key, row in result["files"][name]["ratios"].items()})
    result["methods"] = bench_methods(stack_of(1280, 720), args.repeats)
    print({key: round(row["median"], 3) for key, row in result["methods"]["seconds"].items()})
    print({key: round(row["median"], 2) for key, row in result["methods"]["ratios"].items()})
    save(args.output, result)


def bench_kind(stack: GradientStack, folder: Path, many: bool, dtype: type, compression: object, repeats: int) -> dict:
    """Reads and writes one kind of file."""
    path, out, own = folder / "stack.exr", folder / "ngpt.exr", folder / "openexr.exr"
    OpenEXR.File(parts_of(stack, many, dtype, compression)).write(str(path))
    read = ngpt.read(path)
    image = read["primal"] + np.float32(0.5)
    ngpt.write(out, image, like=read, overwrite=True)
    # The very parts that ngpt.write makes, so that both write the same.
    parts = OpenEXR.File(str(out), separate_channels=True).parts
    calls = {
        "OpenEXR reads": lambda: OpenEXR.File(str(path), separate_channels=True),
        "ngpt.read": lambda: ngpt.read(path),
        "OpenEXR writes": lambda: OpenEXR.File(parts).write(str(own)),
        "ngpt.write": lambda: ngpt.write(out, image, like=read, overwrite=True),
    }
    pairs = {"read / OpenEXR": ("ngpt.read", "OpenEXR reads"), "write / OpenEXR": ("ngpt.write", "OpenEXR writes")}
    return rounds(calls, pairs, repeats)


def parts_of(stack: GradientStack, many: bool, dtype: type, compression: object) -> list[OpenEXR.Part]:
    """The layers as channels of one part, or each as a part."""
    groups: dict[str, dict[str, np.ndarray]] = {}
    for name in stack.names:
        layer = LAYERS[name]
        kind = np.float32 if layer.float_on_disk else dtype
        group = groups.setdefault(name if many else "", {})
        for index, channel in enumerate(layer.channels):
            prefix = "" if name == "primal" and not many else f"{name}."
            group[prefix + channel] = np.ascontiguousarray(stack[name][..., index], kind)
    header = {"type": OpenEXR.scanlineimage, "compression": compression}
    return [OpenEXR.Part(dict(header), channels, name) for name, channels in groups.items()]


def bench_methods(stack: GradientStack, repeats: int) -> dict:
    data = repair(stack)
    calls: dict[str, Callable[[], object]] = {
        "wcv": lambda: METHODS["wcv"].run(data),
        "ngpt-fast": lambda: reconstruct(stack, "ngpt-fast"),
    }
    pairs = {}
    if not METHODS["oidn"].missing():
        calls["oidn"] = lambda: reconstruct(stack, "oidn")
        pairs = {"wcv / oidn": ("wcv", "oidn"), "ngpt-fast / oidn": ("ngpt-fast", "oidn")}
    return rounds(calls, pairs, repeats)


def rounds(calls: dict[str, Callable[[], object]], pairs: dict[str, tuple[str, str]], repeats: int) -> dict:
    """Times the calls in turn after one warm-up: seconds, seconds of the processor, and ratios of ``pairs``."""
    clock: dict[str, list[float]] = {name: [] for name in calls}
    processor: dict[str, list[float]] = {name: [] for name in calls}
    for repeat in range(repeats + 1):
        for name, call in calls.items():
            used, begun = time.process_time(), time.perf_counter()
            call()
            if repeat:
                clock[name].append(time.perf_counter() - begun)
                processor[name].append(time.process_time() - used)
    result = {key: {n: summary(v) for n, v in table.items()} for key, table in (("seconds", clock), ("cpu", processor))}
    for key, table in (("ratios", clock), ("cpu ratios", processor)):
        result[key] = {}
        for pair, (ours, theirs) in pairs.items():
            quartiles = summary([a / b for a, b in zip(table[ours], table[theirs], strict=True)])
            medians = statistics.median(table[ours]) / statistics.median(table[theirs])
            result[key][pair] = quartiles | {"median": medians}
    return result


if __name__ == "__main__":
    main()
