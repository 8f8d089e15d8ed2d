"""The configuration of a training set: a TOML file that is checked before any work starts."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from glob import glob
from pathlib import Path
from typing import Any

from data_gen.samplers import check_options, find
from data_gen.scenes.procedural.variety import SHARES
from ngpt.errors import NgptError
from ngpt.io.frames import natural
from ngpt.methods import METHODS
from ngpt.subpixels import CHOICES
from ngpt.system.records import from_table, read_toml


@dataclass(frozen=True)
class Files:
    """Scene files that match ``pattern``, with ``crops`` crops each. ``boxes``: scene -> [low, high] for its
    cameras."""

    pattern: str
    crops: int
    parameters: dict[str, str] = field(default_factory=dict)
    boxes: dict[str, list] = field(default_factory=dict)


@dataclass(frozen=True)
class DatasetConfig:
    """The entries of a training set. ``ngpt dataset --init FILE`` writes them all with their meanings.

    ``seed``       of scenes, cameras and samples
    ``size``       pixels of a crop's side
    ``inputs``     stacks of each crop; their sample counts are log-uniform and stratified within ``spp``
    ``frames``     frames of a shot: 1 makes single crops; with more, each crop is a shot, whose frames are crops too
    ``spp``        least and greatest samples per pixel of the inputs
    ``sampler``    of the inputs and references: a name of `ngpt info`, or "auto", chosen for each scene
    ``samplers``   options of that sampler, a table [samplers.NAME]
    ``subpixels``  2 or 4: inputs keep 2x2 or 4x4 subpixels of each pixel (docs/use/subpixels.md); 1: none
    ``roll``       the camera's largest roll, degrees
    ``lens``       standard deviation of the aperture's radius, relative to the focus distance
    ``crops_per_shard``  crops of one job, which are lost if it is killed; they share the kernels of their scene
    ``reference_spp``  samples per pixel of references, in two halves; 0 makes pairs, without references
    ``reference_method``  method that reconstructs the references
    ``scenes``     number of procedural scenes
    ``varied``     whether procedural scenes may have sights, which are rare features
    ``sights``     share of the varied scenes with each sight (data_gen.scenes.procedural.variety.SHARES has the names)
    ``adaptive``   share of adaptive ones among inputs with at least 32 samples, see docs/use/adaptive.md
    ``crops``      number of crops of each procedural scene
    ``files``      scene files, a table [[files]] each: pattern and crops, optionally parameters and boxes
    """

    seed: int = 0
    size: int = 128
    inputs: int = 4
    frames: int = 1
    spp: tuple[int, int] = (2, 64)
    sampler: str = "gpt"
    samplers: dict[str, dict[str, Any]] = field(default_factory=dict)
    subpixels: int = 1
    roll: float = 20.0
    lens: float = 0.005
    crops_per_shard: int = 4
    reference_spp: int = 256
    reference_method: str = "wcv"
    scenes: int = 0
    varied: bool = False
    sights: dict[str, float] = field(default_factory=dict)
    adaptive: float = 0.0
    crops: int = 4
    files: tuple[Files, ...] = ()

    def __post_init__(self) -> None:
        low, high = self.spp
        unknown = ", ".join(f"'{name}'" for name in self.sights if name not in SHARES)
        shares = all(0 <= share <= 1 for share in self.sights.values())
        few = 0 < self.reference_spp < 4 or self.reference_spp < 0
        _refuse(
            (not 2 <= low <= high, f"spp = [{low}, {high}]: at least 2 (one sample has no variance), low to high"),
            (self.size < 8, f"size = {self.size}: at least 8 pixels"),
            (min(self.inputs, self.frames, self.crops, self.crops_per_shard) < 1, "counts must be at least 1"),
            (few, f"reference_spp = {self.reference_spp}: at least 4, two for each of its halves; or 0, for pairs"),
            (self.subpixels not in CHOICES, f"subpixels = {self.subpixels}: {', '.join(map(str, CHOICES))}"),
            (self.reference_method not in METHODS, f"reference_method: no method '{self.reference_method}'"),
            (bool(unknown), f"sights: no sight is called {unknown}; there are {', '.join(SHARES)}"),
            (not shares, f"sights = {self.sights}: each is the share of scenes that have it, 0 to 1"),
            (bool(self.sights) and not self.varied, "only varied scenes have sights; set varied = true"),
            (not self.scenes and not self.files, "no scenes: set scenes = N, or add a [[files]] table"),
        )
        for name, options in self.samplers.items():
            if name != self.sampler:
                raise NgptError(f"data configuration: samplers.{name}: this set is rendered by '{self.sampler}'")
            check_options(name, options)
        if self.sampler != "auto":
            find(self.sampler).subpixels(self.subpixels, None)  # raises WrongUse if it cannot keep them
        if self.adaptive:
            self._check_adaptive()
        flat = self.sampler != "auto" and not find(self.sampler).gradients
        if self.pairs:
            halves = "(reference_spp = 0 asks for pairs)"
            teach = (
                f"sampler = '{self.sampler}': renders no gradients, and without them halves teach nothing; use 'gpt'"
            )
            _refuse(
                (
                    self.inputs != 2,
                    f"inputs = {self.inputs}: set inputs = 2, the halves that judge each other {halves}",
                ),
                (self.frames > 1, f"frames = {self.frames}: shots are learnt from references; leave it out {halves}"),
                (self.adaptive > 0, f"adaptive = {self.adaptive:g}: halves are alike; leave it out {halves}"),
                (flat, f"{teach} {halves}"),
            )
        elif flat and "dx" in METHODS[self.reference_method].needs:
            raise NgptError(
                f"data configuration: reference_method '{self.reference_method}' needs gradients, and sampler "
                f"'{self.sampler}' renders none; use 'oidn', or 'primal' with many samples"
            )

    @property
    def options(self) -> dict[str, Any]:
        return self.samplers.get(self.sampler, {})

    @property
    def unbiased_options(self) -> dict[str, Any]:
        """The sampler's options for references: without ``tails``, since references must be unbiased."""
        return {name: value for name, value in self.options.items() if name != "tails"}

    @property
    def pairs(self) -> bool:
        """Whether crops have no reference, but two inputs with equally many samples that judge each other."""
        return self.reference_spp == 0

    def _check_adaptive(self) -> None:
        from data_gen.adaptive import LEAST  # this import needs the renderer

        name, of = self.sampler, f"adaptive = {self.adaptive:g}:"
        even = name != "auto" and find(name).even
        _refuse(
            (not 0 < self.adaptive <= 1, f"{of} the share of inputs whose samples are shared out, 0 to 1"),
            (self.frames > 1, f"{of} frames of shots have even samples; leave it out"),
            (
                self.spp[1] < LEAST,
                f"{of} fewer than {LEAST} samples cannot be shared out; spp goes up to {self.spp[1]}",
            ),
            (even, f"{of} the samples of '{name}' depend on each other; use 'gpt'"),
        )

    def plan(self, turn: int = 0) -> list[Job]:
        """The jobs, one for each shard. They depend only on the configuration, so several machines can divide them.

        ``turn``  number of the turn, for endless use: from 1 on, more procedural scenes and more views of scene files
        """
        sources: list[tuple] = [(made_name(turn * self.scenes + i), self.crops) for i in range(self.scenes)]
        for source in self.files:
            paths = sorted(glob(source.pattern, recursive=True), key=natural)
            if not paths:
                raise NgptError(f"data configuration: no scene file matches '{source.pattern}'")
            for path in paths:
                name = f"{Path(path).parent.name}-{Path(path).stem}"
                sources.append((name, source.crops, path, source.parameters, source.boxes.get(name)))
        names = [source[0] for source in sources]
        if len(set(names)) < len(names):
            raise NgptError("data configuration: two scene files have the same folder and name; rename one")
        return [job for source in sources for job in self._scene_jobs(turn, *source)]

    def _scene_jobs(
        self, turn: int, name: str, crops: int, path: str = "", parameters: dict | None = None, box: list | None = None
    ) -> list[Job]:
        starts = range(0, crops, self.crops_per_shard)
        # Each turn has new procedural scenes, with all their crops.
        turn = turn if path else 0
        jobs = []
        for i, start in enumerate(starts, turn * len(starts)):
            batch = range(turn * crops + start, turn * crops + min(start + self.crops_per_shard, crops))
            jobs.append(Job(name, i, tuple(batch), path, parameters or {}, box))
        return jobs


def _refuse(*cases: tuple[bool, str]) -> None:
    for bad, text in cases:
        if bad:
            raise NgptError(f"data configuration: {text}")


def made_name(number: int) -> str:
    """The name of a procedural scene, from which its seed is computed."""
    return f"made-{number:05d}"


@dataclass(frozen=True)
class Job:
    """One shard: some crops of one scene. ``path`` is empty for a scene made from its seed."""

    scene: str
    batch: int
    crops: tuple[int, ...]
    path: str
    parameters: dict[str, str]
    box: list | None

    @property
    def file(self) -> str:
        return f"shards/{self.scene}-{self.batch:03d}.safetensors"


def read_config(path: str | Path) -> DatasetConfig:
    """Reads a TOML file; raises NgptError for entries that do not exist or have the wrong type."""
    return from_table(DatasetConfig, read_toml(path), str(path))


def as_json(config: DatasetConfig) -> dict:
    return asdict(config) | {"spp": list(config.spp), "files": [asdict(source) for source in config.files]}
