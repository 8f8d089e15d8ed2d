"""What each stage takes from a scene to an image, here and at an earlier commit: bench/results/stages.json.

    python -m bench.stages SCENE ... --sizes 320x180 640x360 --spp 16 --before COMMIT

    before         `ngpt render SCENE -o stack.exr` and `ngpt denoise stack.exr -o RESULT`, at the commit
    two commands   the same, here
    one command    `ngpt render SCENE -o RESULT --denoise`, here

Each runs once in a turn: first with an empty cache of kernels, "cold", then with that cache, "warm". A command is
watched from within: the functions of ``STAGES`` are wrapped as their modules are imported. A stage has the seconds of
its functions; a stage that runs inside another is taken off the outer one. Seconds are by the clock and of processors.
On a busy machine only processor seconds, of all threads together, mean anything. The totals are of whole processes.
"""

import argparse
import builtins
import importlib
import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from contextlib import contextmanager
from functools import wraps
from importlib.machinery import PathFinder
from pathlib import Path
from typing import Any

WORKER = "--worker"
# Stage -> functions, as "module:name". BLOCKS names a context manager; each use of it is a pass.
STAGES = {
    "variant": ["data_gen.backend:use_variant"],
    "load scene": ["data_gen.scenes.load:load_scene"],
    "choose sampler": ["data_gen.choosing.plans:plan_sampler", "data_gen.choosing.plans:plan"],
    "weigh lamps, rest of render": ["data_gen.render:render_stack"],
    "develop": ["data_gen.film.gradient_film:GradientFilm.develop"],
    "read": ["ngpt.io.exr:read_views", "ngpt.io.exr:read"],
    "load network": ["onnxruntime.capi.onnxruntime_inference_collection:InferenceSession.__init__"],
    "OIDN": ["ngpt.denoisers.oidn_filters:filtered"],
    "network": ["onnxruntime.capi.onnxruntime_inference_collection:InferenceSession.run"],
    "rest of method": ["ngpt.methods:reconstruct"],
    "write": ["ngpt.io.exr:write", "ngpt.report.pictures:write_picture"],
}
BLOCKS = "data_gen.passes:compilation"
ORDER = ["start of Python", "imports", "variant", "load scene", "choose sampler", "weigh lamps, rest of render"]
ORDER += ["first pass", "later passes", "develop", "read", "load network", "OIDN", "network", "rest of method"]
ORDER += ["write", "all else", "total"]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", nargs="+", metavar="SCENE")
    parser.add_argument("--before", metavar="COMMIT", required=True)
    parser.add_argument("--sizes", nargs="+", default=["320x180", "640x360", "1280x720"])
    parser.add_argument("--spp", type=int, default=16)
    parser.add_argument("--result", default="clean.exr", help="name of the image, which says its kind")
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("-o", "--output", type=Path, default=Path("bench/results/stages.json"))
    args = parser.parse_args()
    # Not in the worker, which must import nothing before it is told to.
    from bench.common import metadata, save
    from bench.speed import git

    result = {"benchmark": "stages", **vars(args), "metadata": metadata("mitsuba", "drjit", "onnxruntime"), "rows": {}}
    del result["output"]
    here = Path(__file__).parents[1]
    with tempfile.TemporaryDirectory() as folder:
        old = Path(folder) / "old"
        git("worktree", "add", "--detach", str(old), args.before)
        ways = {"before": (old, False), "two commands": (here, False), "one command": (here, True)}
        try:
            for scene in args.scenes:
                for size in args.sizes:
                    rows = measured(ways, scene, size, args)
                    result["rows"][f"{Path(scene).parent.name or scene} {size}"] = rows
                    show(f"{scene} {size}", rows)
                    save(args.output, result)
        finally:
            git("worktree", "remove", "--force", str(old))


def measured(ways: dict[str, tuple[Path, bool]], scene: str, size: str, args: argparse.Namespace) -> dict:
    """Way, "cold" or "warm" -> stage -> seconds by the clock and of processors; and the load average of each."""
    from bench.common import summary

    runs: dict[str, list[dict]] = {}
    for _ in range(args.repeats):
        for name, (tree, at_once) in ways.items():
            with tempfile.TemporaryDirectory() as cache:
                for kernels in ("cold", "warm"):
                    told = run(tree, at_once, scene, size, args, Path(cache))
                    runs.setdefault(f"{name}, {kernels}", []).append(told)
    rows: dict[str, dict] = {}
    for name, each in runs.items():
        rows[name] = {"load average": summary([one.pop("load average") for one in each])}
        for stage in ORDER:
            seconds = [one.get(stage, (0.0, 0.0)) for one in each]
            clock, processors = ([pair[i] for pair in seconds] for i in (0, 1))
            rows[name][stage] = {"clock": summary(clock), "processors": summary(processors)}
    return rows


def run(tree: Path, at_once: bool, scene: str, size: str, args: argparse.Namespace, cache: Path) -> dict:
    """Seconds of each stage from the scene to the image, by one command or by two."""
    scene = str(Path(scene).resolve()) if Path(scene).is_file() else scene
    with tempfile.TemporaryDirectory() as folder:
        image, stack = str(Path(folder) / args.result), str(Path(folder) / "stack.exr")
        how = ["--size", size, "--spp", str(args.spp)]
        calls = [["render", scene, "-o", image, "--denoise", *how]]
        if not at_once:
            calls = [["render", scene, "-o", stack, *how], ["denoise", stack, "-o", image]]
        told: dict[str, Any] = {"load average": os.getloadavg()[0]}
        for words in calls:
            for stage, seconds in watched(tree, words, cache).items():
                told[stage] = [a + b for a, b in zip(told.get(stage, (0.0, 0.0)), seconds, strict=True)]
    return told


def watched(tree: Path, words: list[str], cache: Path) -> dict[str, list[float]]:
    """Seconds of the stages of a command by the code of ``tree``, and of its whole process."""
    with tempfile.NamedTemporaryFile() as file:
        before, start = resource.getrusage(resource.RUSAGE_CHILDREN), time.time()
        subprocess.run(
            # Without -P the folder of this file would hide modules of the same names.
            [sys.executable, "-P", __file__, WORKER, file.name, str(start), *words],
            env=os.environ | {"PYTHONPATH": str(tree), "DRJIT_CACHE_DIR": str(cache)},
            cwd=tree,
            stderr=subprocess.PIPE,
            check=True,
        )
        clock, after = time.time() - start, resource.getrusage(resource.RUSAGE_CHILDREN)
        told = json.loads(Path(file.name).read_text())
    processors = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    parts = zip(*told.values(), strict=True)
    rest = [whole - sum(part) for whole, part in zip((clock, processors), parts, strict=True)]
    return told | {"all else": rest, "total": [clock, processors]}


class Stopwatch:
    """Gives the time that passes to the innermost stage of those that are begun, of the main thread."""

    def __init__(self, start: float):
        self.seconds: dict[str, list[float]] = {"start of Python": [time.time() - start, time.process_time()]}
        self.begun, self.last, self.passes = ["all else"], self._now(), 0

    @staticmethod
    def _now() -> tuple[float, float]:
        return time.perf_counter(), time.process_time()

    def _give(self) -> None:
        now = self._now()
        spent = self.seconds.setdefault(self.begun[-1], [0.0, 0.0])
        for i, (a, b) in enumerate(zip(self.last, now, strict=True)):
            spent[i] += b - a
        self.last = now

    @contextmanager
    def stage(self, name: str):
        self._give()
        self.begun.append(name)
        try:
            yield
        finally:
            self._give()
            self.begun.pop()

    def function(self, name: str, wrapped: Callable) -> Callable:
        @wraps(wrapped)
        def call(*args, **options):
            with self.stage(name):
                return wrapped(*args, **options)

        return call

    def passes_of(self, wrapped: Callable) -> Callable:
        @contextmanager
        def block():
            self.passes += 1
            with self.stage("first pass" if self.passes == 1 else "later passes"), wrapped() as value:
                yield value

        return block

    def importing(self, wrapped: Callable) -> Callable:
        @wraps(wrapped)
        def call(name, *args, **options):
            if name in sys.modules:
                return wrapped(name, *args, **options)
            with self.stage("imports"):
                return wrapped(name, *args, **options)

        return call


class Watcher:
    """Finds the modules of ``STAGES`` as Python would, and wraps their functions once they are there."""

    def __init__(self, watch: Stopwatch):
        self.wraps: dict[str, list[tuple[str, Callable]]] = {}
        pairs = [(place, stage) for stage, places in STAGES.items() for place in places]
        for place, stage in pairs:
            module, _, name = place.partition(":")
            self.wraps.setdefault(module, []).append((name, lambda old, stage=stage: watch.function(stage, old)))
        module, _, name = BLOCKS.partition(":")
        self.wraps.setdefault(module, []).append((name, watch.passes_of))

    def find_spec(self, name: str, path: Any, target: Any = None) -> Any:
        if name not in self.wraps or not (spec := PathFinder.find_spec(name, path)):
            return None
        run = spec.loader.exec_module

        def run_and_wrap(module) -> None:
            run(module)
            for what, wrap in self.wraps[name]:
                *outer, last = what.split(".")
                holder = getattr(module, outer[0]) if outer else module
                setattr(holder, last, wrap(getattr(holder, last)))

        spec.loader.exec_module = run_and_wrap
        return spec


def work(file: str, start: str, words: list[str]) -> int:
    """Runs a command of ngpt, and writes the seconds of each stage into the file."""
    watch = Stopwatch(float(start))
    sys.meta_path.insert(0, Watcher(watch))
    builtins.__import__ = watch.importing(builtins.__import__)
    importlib.import_module = watch.importing(importlib.import_module)
    from ngpt.cli import main as command

    status = command(words)
    with watch.stage(""):
        Path(file).write_text(json.dumps({k: v for k, v in watch.seconds.items() if k != "all else"}))
    return status


def show(title: str, rows: dict) -> None:
    print(f"\n{title}: seconds of processors / by the clock, medians")
    print(f"{'':30}" + "".join(f"{name:>22}" for name in rows))
    for stage in ORDER:
        cells = [
            f"{row[stage]['processors']['median']:.2f} / {row[stage]['clock']['median']:.2f}" for row in rows.values()
        ]
        print(f"{stage:30}" + "".join(f"{cell:>22}" for cell in cells), flush=True)


if __name__ == "__main__":
    if sys.argv[1:2] == [WORKER]:
        sys.exit(work(sys.argv[2], sys.argv[3], sys.argv[4:]))
    main()
