"""Trains a network for as long as there is a core for it: run again, it goes on wherever it was.

    taskset -c 1 python -m scripts.keep_training                   ngpt-combine, in out/training
    python -m scripts.keep_training fast --state DIR --unless BUSY

Crops are rendered meanwhile, with references (kept in DIR, small) and without (pairs), so that no noise is seen twice.
Training begins with the weights in the repository. While the file BUSY exists, a benchmark say, all of it stands still.
It has a low priority, ends by itself after all steps, and at once by Ctrl-C or SIGTERM.

What is worth keeping is DIR/NETWORK/weights.safetensors; docs/train/training.md says how to see whether it is better.
"""

import argparse
import os
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path

ROOT = Path(__file__).parents[1]
# For a run that starts from finished weights: a small rate, which the average makes up for
SETTINGS = {"run.steps": "60000", "run.save": "100", "optimizer.learning_rate": "2e-4", "data.cache": "4096"}
SETS = ("data-cpu", "data-pairs")
NICE = 10
# Seconds between looks at the file that says to stand still.
LOOK = 2.0


def command(network: str, state: Path, changes: Sequence[str] = ()) -> list[str]:
    """What trains: `ngpt train`, the network's configuration, and what is changed of it."""
    sets = ", ".join(f'"{ROOT / "configs" / name}.toml"' for name in SETS)
    settings = SETTINGS | {"data.folders": f"[{sets}]", "data.kept": str(state / "references")}
    weights = ROOT / "export" / "weights" / f"ngpt-{network}.safetensors"
    settings |= {"initial": str(weights)} if weights.exists() else {}
    given = [f"{name}={value}" for name, value in settings.items()] + list(changes)
    options = [word for change in given for word in ("--set", change)]
    return [sys.executable, str(ROOT / "train.py"), "--config", network, "--out", str(state / network), *options]


def keep(words: Sequence[str], busy: Path | None) -> int:
    """Runs the command in a group of its own until it ends; the group stands still while ``busy`` exists.

    Returns its exit status. A signal to this process ends the command, which saves what it has.
    """
    process = subprocess.Popen(words, cwd=ROOT, start_new_session=True, preexec_fn=lambda: os.nice(NICE))
    still = False

    def end(number: int, _: object) -> None:
        _tell(process, signal.SIGCONT)
        # Not to its workers: it ends them, once its step is done.
        process.send_signal(number)

    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, end)
    while process.poll() is None:
        wanted = busy is not None and busy.exists()
        if wanted != still:
            still = wanted
            _tell(process, signal.SIGSTOP if still else signal.SIGCONT)
            print(f"{'stands still while there is' if still else 'goes on without'} {busy}", flush=True)
        time.sleep(LOOK)
    return process.returncode


def _tell(process: subprocess.Popen, number: int) -> None:
    """Sends a signal to the command and all that it has started."""
    if process.poll() is None:
        os.killpg(process.pid, number)


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("network", nargs="?", default="combine", help="configuration (default: combine)")
    parser.add_argument("--state", type=Path, default=ROOT / "out" / "training", metavar="DIR")
    parser.add_argument("--unless", type=Path, metavar="BUSY", help="stands still while this file exists")
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="change a setting")
    args = parser.parse_args(arguments)
    return keep(command(args.network, args.state.resolve(), args.set), args.unless)


if __name__ == "__main__":
    sys.exit(main())
