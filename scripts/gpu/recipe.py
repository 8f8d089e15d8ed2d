"""What a window does, and how its time is split: a TOML file beside this one, checked before any work starts."""

import time
from dataclasses import dataclass, field
from pathlib import Path

from ngpt.errors import NgptError
from ngpt.system import configs
from ngpt.system.records import from_table, read_toml

FOLDER = Path(__file__).parent


@dataclass(frozen=True)
class Run:
    """A training: ``config`` with the changes ``set``, for ``share`` of the time that runs have."""

    name: str
    config: str
    share: float
    set: tuple[str, ...] = ()


@dataclass(frozen=True)
class Recipe:
    """See window.toml, which explains each entry."""

    variant: str
    device: str
    minutes: float
    checks: float
    data: float
    dataset: str
    validation: tuple[str, ...] = ()
    runs: tuple[Run, ...] = field(default_factory=tuple)

    def __post_init__(self) -> None:
        total = sum(run.share for run in self.runs)
        for bad, text in (
            (self.minutes <= 0, f"minutes = {self.minutes}: must be above 0"),
            (min(self.checks, self.data, *(run.share for run in self.runs), 0) < 0, "shares must not be negative"),
            (self.checks + self.data >= 1, f"checks and data take {self.checks + self.data:g}: must be below 1"),
            (self.runs and abs(total - 1) > 1e-6, f"the shares of the runs add up to {total:g}: must be 1"),
            (len({run.name for run in self.runs}) < len(self.runs), "two runs have the same name"),
        ):
            if bad:
                raise NgptError(text)
        configs.find_config(self.dataset, configs.DATASET)
        for run in self.runs:
            configs.find_config(run.config, configs.TRAINING)


def read_recipe(path: str | Path) -> Recipe:
    """The recipe of a file, or of the one of that name that lies here; raises NgptError for what makes no sense."""
    path = FOLDER / f"{path}.toml" if (FOLDER / f"{path}.toml").is_file() else Path(path)
    return from_table(Recipe, read_toml(path), str(path))


class Clock:
    """The seconds of one window; ``closing`` seconds are reserved for what has to be written at its end."""

    def __init__(self, minutes: float, closing: float = 0.0, now=time.monotonic):
        self._now, self.start = now, now()
        self.seconds = max(60 * minutes - closing, 0.0)

    @property
    def spent(self) -> float:
        return self._now() - self.start

    @property
    def left(self) -> float:
        return max(self.seconds - self.spent, 0.0)


def split(left: float, shares: list[float]) -> float:
    """Seconds of ``left`` for the first of what has these shares: what came before may have left more, or less."""
    total = sum(shares)
    return left * shares[0] / total if total else 0.0
