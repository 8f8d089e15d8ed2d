"""Campaigns: many broken inputs, in processes of their own, so that a crash or a hang is an outcome like others.

python tests/campaigns/fuzz/campaign.py exr 10000          inputs 0 .. 9999 of that target
python tests/campaigns/fuzz/campaign.py exr --replay 1234  one of them, in this process, with all it says
"""

import argparse
import faulthandler
import os
import resource
import subprocess
import sys
import tempfile
import time
import traceback
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path

HERE = Path(__file__).resolve().parent
sys.path[:0] = [str(HERE), str(HERE.parents[1]), str(HERE.parents[2])]
SECONDS, MEBIBYTES = 5.0, 512  # of processor time and memory that one input of some kB may take
PATIENCE = 60.0  # seconds by the clock, in which a machine with other work to do gives it that much
LONGEST_MESSAGE = 1000


@dataclass
class Report:
    """What came out. ``failures``: input number -> what is wrong."""

    outcomes: Counter = field(default_factory=Counter)
    failures: dict[int, str] = field(default_factory=dict)
    worst: dict[str, float] = field(default_factory=lambda: {"seconds": 0.0, "MiB": 0.0})
    seconds: float = 0.0

    def count(self, number: int, seconds: float, mebibytes: float, result: str) -> None:
        self.worst = {"seconds": max(self.worst["seconds"], seconds), "MiB": max(self.worst["MiB"], mebibytes)}
        if result.startswith("FAILED"):
            self.failures[number] = result.removeprefix("FAILED ")
            result = "failed"
        self.outcomes[result] += 1


def run(target: str, first: int, count: int) -> Report:
    """Inputs first .. first + count - 1 of ``target``; a new process goes on behind one that dies or hangs."""
    report, number, begun = Report(), first, time.perf_counter()
    known = os.environ | {"OMP_NUM_THREADS": "1", "PYTHONFAULTHANDLER": "1"}
    while number < first + count:
        command = [sys.executable, __file__, target, str(first + count - number), "--first", str(number), "--work"]
        done = subprocess.run(command, env=known, capture_output=True, text=True, errors="replace", check=False)
        for line in done.stdout.splitlines():
            word, told, *rest = line.split(" ", 4)
            number = int(told) + (word == "end")
            if word == "end":
                report.count(int(told), float(rest[0]), float(rest[1]), rest[2])
        if not done.stdout:
            raise RuntimeError(f"{target}: the process does not start: {done.stderr[-600:]}")
        if done.returncode or number < first + count:
            # It died, or hung until its own watchdog ended it.
            report.count(
                number, 0, 0, f"FAILED the process ended ({done.returncode}): {' '.join(done.stderr.split())[-600:]}"
            )
            number += 1
    report.seconds = time.perf_counter() - begun
    return report


def work(target: str, first: int, last: int) -> None:
    """Runs inputs one after the other, and prints what became of each."""
    from targets import TARGETS

    run = TARGETS[target]
    # Our own lines are kept apart from what a library prints to standard output.
    report = os.fdopen(os.dup(1), "w", buffering=1)
    os.dup2(2, 1)
    with tempfile.TemporaryDirectory() as folder:
        whole = outcome(run, -1, Path(folder))  # imports what is needed, starts threads
        if whole != "accepted":
            raise SystemExit(f"the whole input of {target} is refused: {whole}")
        most = int((status("VmSize") + 2 * MEBIBYTES) * 2**20)
        resource.setrlimit(resource.RLIMIT_AS, (most, resource.RLIM_INFINITY))
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        for number in range(first, last):
            print("start", number, file=report)
            faulthandler.dump_traceback_later(PATIENCE, exit=True)
            before, begun = status("VmRSS"), time.process_time()
            Path("/proc/self/clear_refs").write_text("5")  # the largest size so far is forgotten
            result = outcome(run, number, Path(folder))
            seconds, grown = time.process_time() - begun, status("VmHWM") - before
            if not result.startswith("FAILED") and (grown > MEBIBYTES or seconds > SECONDS):
                result = f"FAILED took {seconds:.0f} s and {grown:.0f} MiB"
            print("end", number, f"{seconds:.4f} {grown:.1f}", result, file=report)


def outcome(run, number: int, folder: Path) -> str:
    """In one word, or after "FAILED" what is wrong."""
    from ngpt.errors import NgptError

    try:
        run(number, folder)
    except NgptError as error:
        text = str(error)
        if "\n" in text or len(text) > LONGEST_MESSAGE:
            return f"FAILED the error is not one short line: {text[:300]!r}"
        return "named error" if str(folder) in text else f"FAILED the error names no file: {text}"
    except BaseException as error:
        place = traceback.extract_tb(error.__traceback__)[-1]
        return f"FAILED {type(error).__name__} in {place.filename}:{place.lineno}: {' '.join(str(error).split())[:200]}"
    return "accepted"


def status(name: str) -> float:
    """MiB, by what the system says of this process."""
    with open("/proc/self/status") as file:
        return next(int(line.split()[1]) / 1024 for line in file if line.startswith(name))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("target")
    parser.add_argument("count", type=int, nargs="?", default=1000)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--replay", type=int)
    parser.add_argument("--work", action="store_true", help="as a process of a campaign")
    args = parser.parse_args()
    if args.work:
        work(args.target, args.first, args.first + args.count)
    elif args.replay is not None:
        from targets import TARGETS

        with tempfile.TemporaryDirectory() as folder:
            TARGETS[args.target](args.replay, Path(folder))
    else:
        report = run(args.target, args.first, args.count)
        for number, failure in report.failures.items():
            print(f"{args.target} {number}: {failure}")
        print(dict(report.outcomes), report.worst, f"{report.seconds:.1f} s")


if __name__ == "__main__":
    main()
