"""What reconstructions take beside OIDN, and what they took at an earlier commit: bench/results/speed.json.

    python -m bench.speed --before f72936e

On a synthetic stack with features and variances. Each row runs once in a turn, so that a busy moment hits all alike;
those of the commit run in a process of their own, which takes its turn like the others.

    wcv, ngpt-fast, ngpt-combine   as ``ngpt denoise`` runs them
    oidn            Open Image Denoise with albedo and normal as they are
    oidn-small, oidn-default   networks of that shape, weights at random, on wcv: ``ngpt denoise --weights NET.tza``
    before: ...     the same at the commit

Seconds by the clock and of processors, and the latter over those of "oidn" in the same turn: medians and quartiles. On
a busy machine only processor time means anything.
"""

import argparse
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

from bench.common import metadata, save, summary

WORKER = "--worker"
BEFORE = ("wcv", "ngpt-fast", "ngpt-combine")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--before", metavar="COMMIT", required=True)
    parser.add_argument("--size", default="1280x720")
    parser.add_argument("--repeats", type=int, default=7)
    parser.add_argument("--without", nargs="*", default=[], help="rows that are left out")
    parser.add_argument("-o", "--output", type=Path, default=Path("bench/results/speed.json"))
    args = parser.parse_args()
    result = {"benchmark": "speed", **vars(args), "metadata": metadata("onnxruntime", "mitsuba-oidn")}
    del result["output"]
    with tempfile.TemporaryDirectory() as folder:
        old = Path(folder) / "old"
        git("worktree", "add", "--detach", str(old), args.before)
        try:
            worker = start(old, args.size)
            calls: dict[str, Callable[[], tuple[float, float]]] = {
                name: lambda call=call: timed(call) for name, call in rows(args.size, Path(folder)).items()
            }
            calls |= {f"before: {name}": lambda name=name: ask(worker, name) for name in BEFORE}
            calls = {name: call for name, call in calls.items() if name not in args.without}
            result["rows"] = measured(calls, args.repeats)
            worker.kill()
            worker.wait()
        finally:
            git("worktree", "remove", "--force", str(old))
    for name, row in result["rows"].items():
        clock, cpu, ratio = (row[key]["median"] for key in ("clock", "processors", "over oidn"))
        print(f"{name:22}{clock:8.3f} s by the clock {cpu:8.3f} s of processors {ratio:8.2f} times oidn")
    save(args.output, result)


def git(*arguments: str) -> None:
    root = Path(__file__).parents[1]
    subprocess.run(["git", *arguments], cwd=root, check=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)


def rows(size: str, folder: Path) -> dict[str, Callable[[], object]]:
    import mitsuba_oidn
    import numpy as np
    import torch

    from bench.onnx import stack_of
    from ngpt.methods import reconstruct
    from ngpt.network import tza
    from ngpt.network.oidnet import SHAPES, OidnUNet

    stack = stack_of(*map(int, size.split("x")))
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
        **{name: lambda name=name: reconstruct(stack, name) for name in BEFORE},
        **{name: lambda file=file: reconstruct(stack, "ngpt", weights=str(file)) for name, file in files.items()},
    }


def measured(calls: dict[str, Callable[[], tuple[float, float]]], repeats: int) -> dict:
    runs: dict[str, list[tuple[float, float]]] = {name: [] for name in calls}
    for repeat in range(repeats + 1):
        for name, call in calls.items():
            told = call()
            if repeat:
                runs[name].append(told)
    return {
        name: {
            "clock": summary([clock for clock, _ in told]),
            "processors": summary([cpu for _, cpu in told]),
            "over oidn": summary([a / b for (_, a), (_, b) in zip(told, runs["oidn"], strict=True)]),
        }
        for name, told in runs.items()
    }


def timed(call: Callable[[], object]) -> tuple[float, float]:
    """Seconds by the clock and of the processor."""
    clock, cpu = time.perf_counter(), time.process_time()
    call()
    return time.perf_counter() - clock, time.process_time() - cpu


def start(folder: Path, size: str) -> subprocess.Popen:
    """This file again, which imports the methods of ``folder``."""
    return subprocess.Popen(
        # Without -P the folder of this file would hide modules of the same names.
        [sys.executable, "-P", __file__, WORKER, size],
        env=os.environ | {"PYTHONPATH": str(folder)},
        cwd=folder,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )


def ask(worker: subprocess.Popen, name: str) -> tuple[float, float]:
    assert worker.stdin and worker.stdout
    worker.stdin.write(f"{name}\n")
    worker.stdin.flush()
    clock, cpu = map(float, worker.stdout.readline().split())
    return clock, cpu


def work(size: str) -> None:
    """Runs each method that comes in, and tells what it took."""
    from bench.onnx import stack_of
    from ngpt.methods import reconstruct

    stack = stack_of(*map(int, size.split("x")))
    for name in sys.stdin:
        print(*timed(lambda name=name: reconstruct(stack, name.strip())), flush=True)


if __name__ == "__main__":
    work(sys.argv[2]) if sys.argv[1:2] == [WORKER] else main()
