"""Progress on terminals of all widths: one line, with how far it is and how long it takes; and what --verbose shows."""

import io
import logging
import re
import sys

import pytest

import ngpt
from ngpt.system import console
from ngpt.system.console import Console


class Terminal(io.StringIO):
    def isatty(self):
        return True


@pytest.fixture
def shown(monkeypatch):
    """What a bar looks like at the end of work, by columns of the terminal and whether it tells a rate."""

    def look(columns, rate=False, label="render scenes/a-long-name-of-a-folder/scene.xml"):
        screen = Terminal()
        monkeypatch.setattr(sys, "stderr", screen)
        for name, value in {"COLUMNS": str(columns), "LINES": "24", "TERM": "xterm"}.items():
            monkeypatch.setenv(name, value)
        clock = iter(range(1000))
        monkeypatch.setattr(console.time, "monotonic", lambda: float(next(clock)))
        with Console().progress(label, "spp", rate) as update:
            for done in range(0, 3001, 1000):
                update(done, 4000)
        plain = re.sub(r"\x1b\[[0-9;?]*[a-zA-Z]", "", screen.getvalue())
        return [line.rstrip() for line in plain.replace("\r", "\n").split("\n") if line.strip()]

    return look


@pytest.mark.parametrize("columns", [40, 50, 60, 70, 80, 100, 160])
@pytest.mark.parametrize("rate", [False, True])
def test_it_fits_and_says_how_far_it_is_and_how_long_it_takes(shown, columns, rate):
    last = shown(columns, rate)[-1]
    assert len(last) <= columns and "3000/4000" in last and "s left" in last
    assert ("…" in last) == ("render scenes" not in last)


def test_a_program_hears_it_only_if_it_asks(noisy_stack, caplog):
    with caplog.at_level(logging.INFO, logger="ngpt"):
        ngpt.denoise(noisy_stack[0], "l1")
    assert "method l1" in caplog.text
    assert isinstance(logging.getLogger("ngpt").handlers[0], logging.NullHandler)
