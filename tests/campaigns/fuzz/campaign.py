"""Campaigns: many broken inputs, in processes of their own, so that a crash or a hang is an outcome like others.

python tests/campaigns/fuzz/campaign.py exr 10000          inputs 0 .. 9999 of that target
python tests/campaigns/fuzz/campaign.py exr --replay 1234  one of them, in this process, with all it says
"""

import argparse
import os
import selectors
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path

HERE = Path(__file__).resolve().parent
SECONDS, MEBIBYTES = 5.0, 512  # of processor time and memory that one input of some kB may take
PATIENCE = 60.0  # seconds by the clock, in which a machine with other work to do gives it that much
START = 300.0  # seconds that a process may take until its first input


@dataclass
class Report:
    """What came out. ``failures``: input number -> what is wrong."""

    outcomes: Counter = field(default_factory=Counter)
    failures: dict[int, str] = field(default_factory=dict)
    worst: dict[str, float] = field(default_factory=lambda: {"seconds": 0.0, "MiB": 0.0})
    seconds: float = 0.0

    def count(self, number: int, result: str) -> None:
        if result.startswith("FAILED"):
            self.failures[number] = result.removeprefix("FAILED ")
            result = "failed"
        self.outcomes[result] += 1


def run(target: str, first: int, count: int, patience: float = PATIENCE) -> Report:
    """Inputs first .. first + count - 1 of ``target``; a new process goes on behind one that dies or hangs."""
    report, number, begun = Report(), first, time.perf_counter()
    while number < first + count:
        number = _batch(report, target, number, first + count, patience)
    report.seconds = time.perf_counter() - begun
    return report


def _batch(report: Report, target: str, first: int, last: int, patience: float) -> int:
    """Lets a process work until it is done, dead or too slow; returns the input to go on with."""
    command = [sys.executable, str(HERE / "child.py"), target, str(first), str(last), str(MEBIBYTES)]
    path = os.pathsep.join([str(HERE.parents[2]), str(HERE.parents[1]), os.environ.get("PYTHONPATH", "")])
    environment = os.environ | {"PYTHONPATH": path, "OMP_NUM_THREADS": "1", "PYTHONFAULTHANDLER": "1"}
    with (
        tempfile.TemporaryFile("w+") as stderr,
        subprocess.Popen(command, stdout=subprocess.PIPE, stderr=stderr, env=environment) as process,
        selectors.DefaultSelector() as selector,
    ):
        selector.register(process.stdout, selectors.EVENT_READ)
        current, pending = None, b""
        clock, used = time.monotonic(), 0.0
        while True:
            if not selector.select(0.5):
                waited, busy = time.monotonic() - clock, _processor_seconds(process.pid) - used
                if waited < (START if current is None else patience) and (current is None or busy < SECONDS):
                    continue
                process.send_signal(signal.SIGKILL)
                if current is None:
                    raise RuntimeError(f"{target}: the process does not start")
                report.count(current, f"FAILED hangs: no end after {busy:.0f} s of work, {waited:.0f} s by the clock")
                return current + 1
            clock, used = time.monotonic(), _processor_seconds(process.pid)
            data = os.read(process.stdout.fileno(), 1 << 16)
            if not data:
                break
            *lines, pending = (pending + data).split(b"\n")
            for line in lines:
                word, number, *rest = line.decode(errors="replace").split(" ", 4)
                if word == "end":
                    report.worst["seconds"] = max(report.worst["seconds"], float(rest[0]))
                    report.worst["MiB"] = max(report.worst["MiB"], float(rest[1]))
                    report.count(int(number), rest[2])
                current = int(number) + (word == "end")
        code = process.wait()
        if code == 0:
            return last
        stderr.seek(0)
        said = " ".join(stderr.read()[-600:].split())
        if current is None:
            raise RuntimeError(f"{target}: the process does not start: {said}")
        report.count(current, f"FAILED the process died ({code}): {said}")
        return current + 1


def _processor_seconds(pid: int) -> float:
    """That the process has used so far; 0 where it is gone."""
    try:
        fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    except OSError:
        return 0.0
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("target")
    parser.add_argument("count", type=int, nargs="?", default=1000)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--replay", type=int)
    args = parser.parse_args()
    if args.replay is not None:
        sys.path[:0] = [str(HERE.parents[2]), str(HERE.parents[1])]
        from targets import TARGETS

        with tempfile.TemporaryDirectory() as folder:
            TARGETS[args.target](args.replay, Path(folder))
        return
    report = run(args.target, args.first, args.count)
    for number, failure in report.failures.items():
        print(f"{args.target} {number}: {failure}")
    print(dict(report.outcomes), report.worst, f"{report.seconds:.1f} s")


if __name__ == "__main__":
    main()
