"""The time of reconstructions relative to OIDN, and at an earlier commit: bench/results/speed.json.

    python -m bench.speed --before f72936e

Stacks are synthetic, with features and variances. The rows run in turn, so that other work on the machine affects all
of them alike. The rows of the earlier commit run in a separate process, which waits for its turn.

    oidn            Open Image Denoise with unfiltered albedo and normal, at its highest quality
    wcv, ngpt-fast, ngpt-primal, ngpt-combine   as ``ngpt denoise`` runs them, with features that are known to be clean
    ..., caustic    on stacks with the layer ``caustic``, as of rooms with a mirror or glass
    ..., noisy      on stacks whose features have unknown noise
    oidn-small, oidn-default   networks of OIDN's shapes with random weights, as ``ngpt denoise --weights NET.tza`` runs
                    them on the result of wcv
    before: ...     the same row at the earlier commit

Results are medians and quartiles of wall-clock seconds, of processor seconds, and of processor seconds relative to
"oidn" in the same turn. On a busy machine only processor time is meaningful.
"""

import argparse
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import mitsuba_oidn
import numpy as np
import torch

import ngpt
from bench.common import metadata, save
from bench.onnx import stack_of
from ngpt.measure.averages import summary
from ngpt.methods import reconstruct
from ngpt.network import tza
from ngpt.network.oidnet import SHAPES, OidnUNet
from ngpt.stack import GradientStack

# The program of the earlier commit's process: reads lines "METHOD FILE", prints seconds. It uses only functions that
# every version has.
WORKER = """
import sys, time
import ngpt
from ngpt.methods import reconstruct
given = {}
for line in sys.stdin:
    name, file = line.split()
    if file not in given:
        given[file] = ngpt.read(file)
    clock, cpu = time.perf_counter(), time.process_time()
    reconstruct(given[file], name)
    print(time.perf_counter() - clock, time.process_time() - cpu, flush=True)
"""
# Method -> the kinds of stacks that it runs on; "" has neither light in ``caustic`` nor noisy features.
ROWS = {
    "wcv": ("", "caustic"),
    "ngpt-fast": ("", "caustic"),
    "ngpt-primal": ("", "noisy"),
    "ngpt-combine": ("", "caustic", "noisy"),
}
CALLS = {", ".join(filter(None, (name, kind))): (name, kind) for name, kinds in ROWS.items() for kind in kinds}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--before", metavar="COMMIT", required=True)
    parser.add_argument("--size", default="1280x720")
    parser.add_argument("--repeats", type=int, default=7)
    parser.add_argument("-o", "--output", type=Path, default=Path("bench/results/speed.json"))
    args = parser.parse_args()
    result = {"benchmark": "speed", **vars(args), "metadata": metadata("onnxruntime", "mitsuba-oidn")}
    del result["output"]
    with tempfile.TemporaryDirectory() as temporary:
        folder, given = Path(temporary), stacks(args.size)
        for kind, stack in given.items():
            ngpt.write(folder / f"{kind or 'clean'}.exr", stack)
        git("worktree", "add", "--detach", str(folder / "old"), args.before)
        try:
            worker = start(folder / "old")
            calls: dict[str, Callable[[], tuple[float, float]]] = {
                name: lambda call=call: timed(call) for name, call in rows(given, folder).items()
            }
            for row, (name, kind) in CALLS.items():
                line = f"{name} {folder / (kind or 'clean')}.exr"
                calls[f"before: {row}"] = lambda line=line: ask(worker, line)
            result["rows"] = measured(calls, args.repeats)
            worker.kill()
            worker.wait()
        finally:
            git("worktree", "remove", "--force", str(folder / "old"))
    for name, row in result["rows"].items():
        clock, cpu, ratio = (row[key]["median"] for key in ("clock", "processors", "over oidn"))
        print(f"{name:22}{clock:8.3f} s by the clock {cpu:8.3f} s of processors {ratio:8.2f} times oidn")
    save(args.output, result)


def git(*arguments: str) -> None:
    root = Path(__file__).parents[1]
    subprocess.run(["git", *arguments], cwd=root, check=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)


def rows(given: dict[str, GradientStack], folder: Path) -> dict[str, Callable[[], object]]:
    stack = given[""]
    torch.manual_seed(0)
    files = {}
    for name, channels in zip(("oidn-small", "oidn-default"), SHAPES, strict=True):
        files[name] = folder / f"{name}.tza"
        tensors = {key: tensor.numpy() for key, tensor in OidnUNet(channels).state_dict().items()}
        files[name].write_bytes(tza.packed(tensors, "wcv"))
    images = {name: np.ascontiguousarray(stack[name]) for name in ("primal", "albedo", "normal")}
    oidn = mitsuba_oidn.Quality.High
    return {
        "oidn": lambda: mitsuba_oidn.denoise(*images.values(), hdr=True, quality=oidn),
        **{row: lambda name=name, kind=kind: reconstruct(given[kind], name) for row, (name, kind) in CALLS.items()},
        **{name: lambda file=file: reconstruct(stack, "ngpt", weights=str(file)) for name, file in files.items()},
    }


def stacks(size: str) -> dict[str, GradientStack]:
    """Kind -> stack; in "caustic", half a percent of the pixels have light in that layer."""
    noisy = stack_of(*map(int, size.split("x")))
    clean = noisy.replace()
    # Features are known to be free of noise. Earlier commits may ignore this attribute.
    clean.attributes["ngpt:featureNoise"] = 0.0
    random = np.random.default_rng(2)
    lit = random.random(noisy["depth"].shape) < 0.005
    light = np.where(lit, 30 * random.random(noisy["primal"].shape), 0).astype(np.float32)
    caustic = clean.replace(primal=clean["primal"] + light, caustic=light, caustic_var=light**2)
    return {"": clean, "caustic": caustic, "noisy": noisy}


def measured(calls: dict[str, Callable[[], tuple[float, float]]], repeats: int) -> dict:
    runs: dict[str, list[tuple[float, float]]] = {name: [] for name in calls}
    for repeat in range(repeats + 1):
        for name, call in calls.items():
            seconds = call()
            if repeat:
                runs[name].append(seconds)
    return {
        name: {
            "clock": summary([clock for clock, _ in seconds]),
            "processors": summary([cpu for _, cpu in seconds]),
            "over oidn": summary([a / b for (_, a), (_, b) in zip(seconds, runs["oidn"], strict=True)]),
        }
        for name, seconds in runs.items()
    }


def timed(call: Callable[[], object]) -> tuple[float, float]:
    """Wall-clock and processor seconds of a call."""
    clock, cpu = time.perf_counter(), time.process_time()
    call()
    return time.perf_counter() - clock, time.process_time() - cpu


def start(folder: Path) -> subprocess.Popen:
    """A process that runs the methods of the version of ngpt in ``folder``."""
    how: dict[str, Any] = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True, "cwd": folder}
    return subprocess.Popen([sys.executable, "-c", WORKER], env=os.environ | {"PYTHONPATH": str(folder)}, **how)


def ask(worker: subprocess.Popen, line: str) -> tuple[float, float]:
    assert worker.stdin and worker.stdout
    worker.stdin.write(f"{line}\n")
    worker.stdin.flush()
    clock, cpu = map(float, worker.stdout.readline().split())
    return clock, cpu


if __name__ == "__main__":
    main()
