"""Processor seconds of tests: ``pytest --durations-to tests/durations.json`` (`make durations`).

A case's seconds are those of its process and of the programs that it waited for, in user and system mode: they differ
little between a quiet machine and a busy one. What builds a fixture counts where the fixture is first used.
"""

import json
import os
from collections import Counter
from pathlib import Path

import pytest

LEAST = 1.0  # processor seconds of a case that is listed by itself


def pytest_addoption(parser):
    parser.addoption("--durations-to", type=Path, help="write the processor seconds of files and of dear cases here")


def pytest_configure(config):
    if config.option.durations_to and not hasattr(config, "workerinput"):
        config.pluginmanager.register(Written(config.option.durations_to))


def processor() -> float:
    """Processor seconds of this process and of its children that have ended."""
    return sum(os.times()[:4])


_before = 0.0


def pytest_runtest_logstart():
    global _before
    _before = processor()


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport():
    """A report has the seconds since the one before it: of set-up, call or teardown."""
    global _before
    report, now = (yield), processor()
    # Attributes go from the workers of xdist to the process that writes.
    report.processor, _before = now - _before, now
    return report


class Written:
    """Sums up the reports of a run, and writes the sums when it ends."""

    def __init__(self, path: Path):
        self.path, self.cases = path, Counter()

    def pytest_runtest_logreport(self, report):
        self.cases[report.nodeid] += getattr(report, "processor", 0)

    def pytest_sessionfinish(self):
        files = Counter()
        for case, seconds in self.cases.items():
            files[case.split("::")[0]] += seconds
        cases = {case: seconds for case, seconds in self.cases.items() if seconds >= LEAST}
        found = {"files": _dearest(files), "cases": _dearest(cases)}
        self.path.write_text(json.dumps(found, indent=1) + "\n", "utf-8")


def _dearest(seconds: dict[str, float]) -> dict[str, float]:
    return {name: round(s, 1) for name, s in sorted(seconds.items(), key=lambda item: (-item[1], item[0]))}
