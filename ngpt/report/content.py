"""The content of a page: pictures of scenes, their metrics, and the overview after them."""

import math
import statistics
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

REFERENCE = "reference"  # the name of Scene.reference among the pictures
BASELINE = "primal"  # the picture that tables compare the others to; without it, the first picture


@dataclass
class ReportEntry:
    """One picture of a scene: the result of a method, or the contents of a file.

    ``name``     'primal', 'l2', ...: unique in its scene
    ``image``    (H, W, 3) scene-linear; values may be negative or not finite
    ``seconds``  time of the reconstruction
    ``metrics``  name -> value, or one value per seed, of which the table shows the median and the range
    ``maps``     name ('FLIP', 'SSIM') -> difference from the reference, (H, W) from 0 (equal) to 1
    """

    name: str
    image: np.ndarray
    seconds: float | None = None
    metrics: Mapping[str, float | Sequence[float]] = field(default_factory=dict)
    maps: dict[str, np.ndarray] = field(default_factory=dict)


@dataclass
class Scene:
    """One tab of the report. All arrays have the same height and width.

    ``caption``    one line, such as 'diffuse room, 128x128, 16 spp, render 1.2 s'
    ``reference``  (H, W, 3) scene-linear
    ``layers``     further views, (H, W), (H, W, 1) or (H, W, 3), which ``display.layer_view`` shows by their names
    ``rising``     the metrics for which higher is better; all others are errors
    ``meanings``   maps that do not show a difference: name -> (meaning, five labels of the scale from 0 to 1)
    """

    name: str
    caption: str
    reference: np.ndarray | None
    entries: list[ReportEntry]
    layers: dict[str, np.ndarray] = field(default_factory=dict)
    rising: Collection[str] = ()
    meanings: dict[str, tuple[str, list[str]]] = field(default_factory=dict)

    @property
    def pictures(self) -> list[tuple[str, np.ndarray]]:
        """The names and images of the entries, and then of the reference, in the order of the page."""
        pictures = [(entry.name, np.asarray(entry.image)) for entry in self.entries]
        return pictures if self.reference is None else [*pictures, (REFERENCE, np.asarray(self.reference))]

    @property
    def baseline(self) -> ReportEntry:
        """The entry that the other entries are compared to."""
        return next((entry for entry in self.entries if entry.name == BASELINE), self.entries[0])

    def best(self, metric: str) -> int | None:
        """The index of the entry with the best value of a metric; None if no value is finite."""
        values = [(median(entry.metrics.get(metric, math.nan)), row) for row, entry in enumerate(self.entries)]
        values = [(-value if metric in self.rising else value, row) for value, row in values if math.isfinite(value)]
        return min(values)[1] if values else None


@dataclass
class Overview:
    """The part of the page after the scenes; everything is optional."""

    tables: dict[str, list[list[str]]] = field(default_factory=dict)  # title -> rows of text, the header first
    formulas: dict[str, str] = field(default_factory=dict)  # metric -> its formula in plain text


def median(values: float | Sequence[float]) -> float:
    """The median over seeds; NaN if any value is not finite, because that seed failed."""
    values = [values] if isinstance(values, int | float | np.number) else list(values)
    return statistics.median(values) if values and all(map(math.isfinite, values)) else math.nan
