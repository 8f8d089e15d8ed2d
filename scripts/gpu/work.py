"""Programs that run until they end, or until their time is up: then they are asked to end, later made to."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

from ngpt.system.limits import processors

ROOT = Path(__file__).parents[2]
GRACE = 20.0  # seconds between the two


class Work:
    """``python ARGUMENTS`` in a process group of its own, all output in ``log``.

    A crash, a hang or a lack of memory stays there. ``nice`` is added to its priority.
    """

    def __init__(self, arguments: list[str], log: Path, nice: int = 0):
        self.log, self.start = log, time.monotonic()
        log.parent.mkdir(parents=True, exist_ok=True)
        # What is not installed may be on the path of whoever started this.
        path = os.pathsep.join(filter(None, (str(ROOT), os.environ.get("PYTHONPATH"))))
        environment = os.environ | {"PYTHONPATH": path, "PYTHONUNBUFFERED": "1"}
        command = [sys.executable, *arguments]
        if nice:
            command = ["nice", "-n", str(nice), *command]
        with open(log, "ab") as out:
            self._process = subprocess.Popen(
                command, stdout=out, stderr=out, stdin=subprocess.DEVNULL, env=environment, process_group=0
            )

    @property
    def running(self) -> bool:
        return self._process.poll() is None

    @property
    def status(self) -> int | None:
        """The exit status, negative for a signal; None while it runs."""
        return self._process.poll()

    @property
    def seconds(self) -> float:
        return time.monotonic() - self.start

    def wait(self, seconds: float) -> bool:
        """Whether it ended by itself within so many seconds; if not, it still runs."""
        try:
            self._process.wait(max(seconds, 0))
        except subprocess.TimeoutExpired:
            return False
        return True

    def end(self, grace: float = GRACE) -> None:
        """Ends it and all that it started: training saves its state when it is asked."""
        if self.running:
            self._process.terminate()
            self.wait(grace)
        for number in (signal.SIGTERM, signal.SIGKILL):
            # What it started may outlive it.
            try:
                os.killpg(self._process.pid, number)
            except ProcessLookupError:
                break
            time.sleep(0.2)
        self._process.wait()

    def last_words(self, lines: int = 3) -> str:
        """The last lines of its output, in one."""
        text = self.log.read_text(errors="replace").replace("\r", "\n")
        return " | ".join([line.strip() for line in text.splitlines() if line.strip()][-lines:])


def workers() -> int:
    """Processes that render beside a training, which keeps two cores for itself and its examples."""
    return max(1, processors() - 2)
