"""One window on a GPU, of as many as are to be had: checks, then crops, then training, and all of it in a report.

    python -m scripts.gpu --data SETS... --work WORK --out OUT [--minutes 9]      the next window on the same machine
    python -m scripts.gpu --data SETS... --work WORK --out OUT --from EARLIER     the next one on another machine
    python -m scripts.gpu --recipe rehearsal --work WORK --out OUT                a rehearsal on processors, much
    smaller

Nothing stops it: what is missing, fails, crashes or hangs is in the report, and the rest runs. It ends with 1 where
nothing was trained. OUT holds report.md,
report.json and a parcel (`scripts.gpu.parcel`), from which the next window goes on where WORK is lost.
"""

import argparse
import json
import signal
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

from ngpt.errors import NgptError
from ngpt.system.limits import processors
from ngpt.system.writing import write_json
from scripts.gpu import parcel
from scripts.gpu.checks import FAILED, names, one_line
from scripts.gpu.recipe import Clock, Recipe, Run, read_recipe, split
from scripts.gpu.report import crops, in_words, scenes, steps, write_report
from scripts.gpu.work import GRACE, Work, workers

# Seconds at a window's end for the report and the parcel; those a training needs to start and to save.
CLOSING, LEAST = 20.0, 15.0
OUT_OF_TIME = "out of time"


class Window:
    """One window: what it does is in ``work``, so that the next one goes on from there."""

    def __init__(self, recipe: Recipe, source: str, data: list[Path], work: Path, minutes: float):
        self.recipe, self.source, self.data, self.work = recipe, source, data, work
        # Training that is asked to end finishes its step and saves.
        self.clock = Clock(minutes, CLOSING + min(GRACE, 6 * minutes))
        self.parts: list[dict[str, Any]] = []
        self.place = work / "windows" / f"{len(list(work.glob('windows/*.json'))):03d}.json"
        for folder in ("checks", "windows", "logs", "runs"):
            (work / folder).mkdir(parents=True, exist_ok=True)

    def run(self) -> None:
        self.checks()
        rendering = self.start_rendering()
        try:
            self.wait_for_crops(rendering)
            for number, run in enumerate(self.recipe.runs):
                self.train(run, split(self.clock.left, [r.share for r in self.recipe.runs[number:]]))
        finally:
            for name, work in rendering.items():
                ended = "" if work.running else f"ended by itself, status {work.status}: {work.last_words()}"
                work.end(grace=2)
                self.note(f"crops, {name}", work.seconds, ended or self.rendered())

    def note(self, part: str, seconds: float, told: str) -> None:
        """Records a part at once: what ends this window early finds it written."""
        self.parts.append({"part": part, "seconds": round(seconds, 1), "told": told})
        write_json(self.place, {"recipe": self.source, "parts": self.parts})
        print(f"{self.clock.spent:6.0f} s  {part}: {told}", flush=True)

    def checks(self) -> None:
        """Runs the checks that are not done yet, several at a time; checks that ran out of time before come last."""
        before = self.clock.spent
        records = {name: self.record(name) for name in names()}
        todo = [name for name, record in records.items() if not record]
        todo += [name for name, record in records.items() if record and record["status"] == OUT_OF_TIME]
        if not todo:
            return
        deadline = self.clock.spent + self.recipe.checks * self.clock.seconds

        def one(name: str) -> None:
            seconds = deadline - self.clock.spent
            if seconds < LEAST / 3:
                return
            file = self.work / "checks" / f"{name.replace(' ', '-')}.json"
            arguments = ["-m", "scripts.gpu.checks", name, "--recipe", self.source, "-o", str(file)]
            work = Work(arguments, self.work / "logs" / f"check-{name.replace(' ', '-')}.txt")
            try:
                in_time = work.wait(seconds)
            finally:
                work.end(grace=1)
            if not in_time or work.status or not file.exists():
                status = FAILED if in_time else OUT_OF_TIME
                how = f"ended with status {work.status}" if in_time else f"no end within {seconds:.0f} s"
                told = f"{how}: {work.last_words()}"
                write_json(file, {"check": name, "status": status, "error": told, "seconds": round(work.seconds, 1)})

        with ThreadPoolExecutor(max(1, processors() // 2)) as pool:
            list(pool.map(one, todo))
        counts: dict[str, int] = {}
        for name in names():
            status = (self.record(name) or {"status": "not yet made"})["status"]
            counts[status] = counts.get(status, 0) + 1
        self.note("checks", self.clock.spent - before, ", ".join(f"{n} {status}" for status, n in counts.items()))

    def rendered(self) -> str:
        return f"so far, in all: {in_words(crops(self.work / 'data'))}"

    def record(self, name: str) -> dict[str, Any] | None:
        path = self.work / "checks" / f"{name.replace(' ', '-')}.json"
        return json.loads(path.read_text()) if path.exists() else None

    def start_rendering(self) -> dict[str, Work]:
        """One process on the GPU, unless it renders wrong, and the others on processors: parts of one training set."""
        if not self.recipe.data:
            return {}
        command = ["-m", "data_gen", "--config", self.recipe.dataset, "--out", str(self.work / "data")]
        gpu = self.record("renderer gpt") or {}
        sides = {"processors": ["--shard", "0/2", "--workers", str(workers())]}
        if gpu.get("status") == FAILED:
            sides["processors"][1] = "0/1"
        else:
            # Kernels of a new scene are compiled for seconds by one core, and run for tenths of a second.
            several = str(max(1, workers() // 2))
            sides["gpu"] = ["--shard", "1/2", "--workers", several, "--variant", self.recipe.variant]
        return {
            name: Work([*command, *options], self.work / "logs" / f"crops-{name}.txt", nice=5 if name != "gpu" else 0)
            for name, options in sides.items()
        }

    def wait_for_crops(self, rendering: dict[str, Work]) -> None:
        """Until the GPU has rendered for its share; training starts earlier where it cannot.

        Without --data also until there are crops, wherever they are rendered, as long as time is left to train.
        """
        gpu = rendering.get("gpu")
        if gpu:
            gpu.wait(min(self.recipe.data * self.clock.seconds, self.clock.left))
        last = 2 * LEAST * len(self.recipe.runs)
        while not self.data and not crops(self.work / "data") and self.clock.left > last:
            if not any(side.running for side in rendering.values()):
                break
            for side in rendering.values():
                side.wait(0.5)
        if gpu and (gpu.running or not gpu.status):
            gpu.end(grace=2)
            self.note("crops, gpu", gpu.seconds, self.rendered())
            del rendering["gpu"]

    def validation(self, folders: list[str]) -> list[str]:
        """The recipe's, as far as such scenes are there; none, so that training sets some aside, where all are such."""
        there = {scene for folder in folders for scene in scenes(Path(folder))}
        names = [name for name in self.recipe.validation if any(scene.startswith(name) for scene in there)]
        return [] if all(scene.startswith(tuple(names)) for scene in there) else names

    def train(self, run: Run, seconds: float) -> None:
        """One run goes on for so many seconds; its state is saved in the end."""
        folders = [str(folder) for folder in self.data]
        if crops(self.work / "data"):
            folders.append(str(self.work / "data"))
        if not folders:
            self.note(run.name, 0, "no crops: neither --data nor any that were rendered here in time")
            return
        if seconds < LEAST:
            self.note(run.name, 0, f"{seconds:.0f} s are too few to start in")
            return
        changes = [*run.set, f"data.folders={json.dumps(folders)}"]
        changes.append(f"data.validation={json.dumps(self.validation(folders))}")
        arguments = ["train.py", "--config", run.config, "--out", str(self.work / "runs" / run.name)]
        arguments[0] = str(Path(__file__).parents[2] / arguments[0])
        for change in changes:
            arguments += ["--set", change]
        work = Work(arguments, self.work / "logs" / f"run-{run.name}.txt")
        try:
            ended = work.wait(seconds)
        finally:
            work.end()
        failed = f"ended by itself, status {work.status}: " if ended and work.status else ""
        self.note(run.name, work.seconds, failed + work.last_words(2))


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--recipe", default="window", help="file, or name beside this module (default: window)")
    parser.add_argument("--data", type=Path, nargs="*", default=[], metavar="SET", help="training sets to learn from")
    parser.add_argument("--work", type=Path, required=True, help="folder of all windows; the next one goes on from it")
    parser.add_argument("--out", type=Path, required=True, help="folder for the report and the parcel")
    parser.add_argument("--from", dest="earlier", type=Path, help="folder with a parcel, if WORK is not there any more")
    parser.add_argument("--minutes", type=float, help="of this window (default: the recipe's)")
    parser.add_argument("--most", type=float, default=parcel.MOST, metavar="MIB", help="of the parcel (default: 60)")
    args = parser.parse_args(arguments)
    try:
        recipe = read_recipe(args.recipe)
        missing = [str(folder) for folder in args.data if not (folder / "manifest.json").is_file()]
        if missing:
            raise NgptError(f"{missing[0]}: no training set there (manifest.json is missing)")
        args.out.mkdir(parents=True, exist_ok=True)
        if args.earlier and not any(args.work.glob("windows/*.json")) and not parcel.unpack(args.earlier, args.work):
            raise NgptError(f"{args.earlier}: holds no parcel (kept.000, ...)")
        work = args.work.resolve()
        window = Window(recipe, args.recipe, [d.resolve() for d in args.data], work, args.minutes or recipe.minutes)
    except NgptError as error:
        print(f"scripts.gpu: {error}", file=sys.stderr)
        return 2
    status, before = 0, steps(work)
    try:
        window.run()
    except BaseException as error:  # what there is by then is worth a report, whatever this was
        status = 1
        window.note("window", window.clock.spent, f"ended early: {type(error).__name__}: {one_line(error)}")
    try:
        left_out = parcel.pack(work, args.out, most=args.most)
    except Exception as error:
        left_out = [f"everything: {one_line(error)}"]
    write_report(work, args.out, left_out)
    print((args.out / "report.md").read_text())
    if not status and recipe.runs and steps(work) <= before:
        names = {run.name for run in recipe.runs}
        told = "; ".join(f"{part['part']}: {part['told']}" for part in window.parts if part["part"] in names)
        more = 2 * (args.minutes or recipe.minutes)
        print(
            f"scripts.gpu: nothing was trained ({told}); give it more time (--minutes {more:g}), or training sets "
            f"(--data); {args.work}/logs holds what each part said",
            file=sys.stderr,
        )
        return 1
    return status


if __name__ == "__main__":
    # Not in main(): whoever calls that keeps their own handlers.
    signal.signal(signal.SIGTERM, lambda number, frame: sys.exit(128 + number))
    sys.exit(main())
