"""Runs inputs of a target one after the other and tells its parent, ``campaign``, what became of each.

python tests/campaigns/fuzz/child.py TARGET FIRST LAST [MIB]

Inputs are FIRST .. LAST - 1; each may take at most MIB more memory than there was at the start.
"""

import os
import resource
import sys
import tempfile
import time
import traceback
from pathlib import Path

from targets import TARGETS

from ngpt.errors import NgptError

LONGEST_MESSAGE = 1000


def outcome(run, number: int, folder: Path) -> str:
    """In one word, or after "FAILED" what is wrong."""
    try:
        run(number, folder)
    except NgptError as error:
        text = str(error)
        if "\n" in text or len(text) > LONGEST_MESSAGE:
            return f"FAILED the error is not one short line: {text[:300]!r}"
        if str(folder) not in text:
            return f"FAILED the error names no file: {text}"
        return "named error"
    except BaseException as error:
        place = traceback.extract_tb(error.__traceback__)[-1]
        return f"FAILED {type(error).__name__} in {place.filename}:{place.lineno}: {' '.join(str(error).split())[:200]}"
    return "accepted"


def mebibytes(name: str) -> float:
    with open("/proc/self/status") as file:
        return next(int(line.split()[1]) / 1024 for line in file if line.startswith(name))


def main(target: str, first: int, last: int, mib: int = 512) -> None:
    run = TARGETS[target]
    # The tests' own messages are kept apart from what a library prints to standard output.
    report = os.fdopen(os.dup(1), "w", buffering=1)
    os.dup2(2, 1)
    with tempfile.TemporaryDirectory() as folder:
        whole = outcome(run, -1, Path(folder))  # imports what is needed, starts threads
        if whole != "accepted":
            raise SystemExit(f"the whole input of {target} is refused: {whole}")
        resource.setrlimit(resource.RLIMIT_AS, (int((mebibytes("VmSize") + 2 * mib) * 2**20), resource.RLIM_INFINITY))
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        for number in range(first, last):
            print("start", number, file=report)
            before, begun = mebibytes("VmRSS"), time.process_time()
            Path("/proc/self/clear_refs").write_text("5")  # the largest size so far is forgotten
            result = outcome(run, number, Path(folder))
            seconds, grown = time.process_time() - begun, mebibytes("VmHWM") - before
            if grown > mib and not result.startswith("FAILED"):
                result = f"FAILED took {grown:.0f} MiB"
            print("end", number, f"{seconds:.4f} {grown:.1f}", result, file=report)


if __name__ == "__main__":
    main(sys.argv[1], *map(int, sys.argv[2:]))
