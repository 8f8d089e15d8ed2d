"""The configuration of an evaluation: a TOML file, checked before any work starts."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from glob import glob, has_magic
from pathlib import Path
from typing import Any

from ngpt.errors import NgptError
from ngpt.measure.metrics import FORMULAS
from ngpt.methods import METHODS
from ngpt.system.records import from_table, read_toml

# What a method is given, and what the renderer makes for it:
#   gradients  a gradient stack of the nominal samples per pixel
#   features   path tracing with albedo, normal and depth, as many samples as the gradient stack's time buys
#   path       path tracing alone, likewise
KINDS = ("gradients", "features", "path")

# Of which seeds pictures are kept.
IMAGES = ("first", "all", "none")


@dataclass(frozen=True)
class Column:
    """A method as the tables have it: one of the registry's, with options, on a kind of stack.

    ``name``     in tables and file names
    ``method``   in ``ngpt.methods.METHODS``; another name makes a row that says so
    ``stack``    one of ``KINDS``
    ``options``  of the method
    """

    name: str
    method: str
    stack: str
    options: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Config:
    """See configs/eval-tiny.toml, which explains each entry."""

    title: str = "Evaluation"
    scenes: tuple[str, ...] = ()
    size: tuple[int, int] = (320, 180)
    spp: tuple[int, ...] = (4, 16, 64)
    seeds: int = 3
    methods: tuple[str, ...] = ("primal", "l1", "wcv")
    metrics: tuple[str, ...] = ("relMSE", "relMSE trimmed", "relMSE NGPT", "SMAPE", "PSNR", "SSIM", "FLIP")
    primary: str = "relMSE trimmed"
    reference_spp: int = 0
    reference_seconds: float = 60.0
    timing_spp: int = 32
    timing_repeats: int = 3
    images: str = "first"
    elpips: dict[str, str] = field(default_factory=dict)
    references: dict[str, str] = field(default_factory=dict)
    variants: dict[str, dict[str, Any]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        low = min((*self.spp, self.seeds, *self.size, self.timing_spp, self.timing_repeats), default=0)
        unknown = [name for name in (*self.metrics, self.primary) if name not in FORMULAS]
        for bad, text in (
            (not self.scenes, "no scenes: name built-in scenes, scene files, patterns or folders of stacks"),
            (not self.spp or not self.methods, "spp and methods must not be empty"),
            (low < 1, "spp, seeds, size and timing must be at least 1"),
            (self.reference_spp <= 0 and self.reference_seconds <= 0, "set reference_spp or reference_seconds"),
            (bool(unknown), f"no metric '{''.join(unknown[:1])}'; there are: {', '.join(FORMULAS)}"),
            (self.primary not in self.metrics, f"primary = '{self.primary}' is not among metrics"),
            (self.images not in IMAGES, f"images = '{self.images}': choose one of: {', '.join(IMAGES)}"),
            (len(set(self.methods)) < len(self.methods), "a method is listed twice"),
        ):
            if bad:
                raise NgptError(f"evaluation: {text}")
        for name, table in self.variants.items():
            if table.get("stack", "path") not in KINDS:
                raise NgptError(f"evaluation: variants.{name}: stack must be one of {', '.join(KINDS)}")
            if "method" not in table:
                raise NgptError(f"evaluation: variants.{name}: method is missing: which one it is a variant of")

    def columns(self) -> list[Column]:
        """The methods in the order of the tables."""
        return [self._column(name) for name in self.methods]

    def _column(self, name: str) -> Column:
        table = dict(self.variants.get(name, {}))
        method, stack = table.pop("method", name), table.pop("stack", "")
        needs = METHODS[method].needs if method in METHODS else ()
        default = "gradients" if "dx" in needs else "features" if len(needs) > 1 else "path"
        return Column(name, method, stack or default, table)

    def scene_files(self) -> dict[str, str]:
        """Name -> built-in scene, scene file or folder of stacks; patterns are resolved."""
        result: dict[str, str] = {}
        for entry in self.scenes:
            found = sorted(glob(entry, recursive=True)) if has_magic(entry) else [entry]
            if not found:
                raise NgptError(f"evaluation: no scene file matches '{entry}'")
            for file in found:
                name = scene_name(file)
                if name in result:
                    raise NgptError(f"evaluation: scenes {result[name]} and {file} are both called '{name}'")
                result[name] = file
        return result

    def to_dict(self) -> dict:
        return asdict(self)


def scene_name(scene: str) -> str:
    """What tables call a scene: the folder of a scene file and what its name adds to "scene"."""
    path = Path(scene)
    return f"{path.parent.name}{path.stem.removeprefix('scene')}" if path.suffix == ".xml" else path.name


def read_config(path: str | Path) -> Config:
    """Reads a TOML file; raises NgptError for entries that do not exist or have the wrong type."""
    return from_table(Config, read_toml(path), str(path))
