"""The configuration of an evaluation: a TOML file, checked before any work starts."""

from dataclasses import asdict, dataclass, field
from glob import glob, has_magic
from pathlib import Path
from typing import Any

from ngpt.errors import NgptError
from ngpt.evaluation.renders import KINDS, Render
from ngpt.io.frames import natural
from ngpt.measure.metrics import METRICS
from ngpt.methods import METHODS
from ngpt.options import settings
from ngpt.system.parts import find_renderer
from ngpt.system.records import check, from_table, read_toml

# The values of ``images``: the seeds whose images are kept.
IMAGES = ("first", "all", "none")
# The values of ``time``: the clock that measures equal time. Other work on the machine hardly changes processor time.
CLOCKS = ("wall", "processor")


@dataclass(frozen=True)
class Column:
    """A column of the tables: a method with its options, on the stacks of one sampler.

    ``name``     the name in tables: the family, and the sampler in brackets if several are compared
    ``family``   the name in the configuration: a method or a variant
    ``method``   the name in ``ngpt.methods.METHODS``; for an unknown name, the rows say so
    ``sampler``  the name of the sampler in the configuration; ``render`` has the renderer's name for it
    ``render``   the stacks that the method reads
    ``options``  the options of the method that differ from their defaults
    """

    name: str
    family: str
    method: str
    sampler: str
    render: Render
    options: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class EvaluationConfig:
    """The settings of an evaluation. configs/eval-tiny.toml explains them by example.

    ``ngpt evaluate --init FILE`` writes all of them to a file.

    ``title``     the title of the report
    ``scenes``    built-in scenes, scene files, patterns, or folders of stacks: KIND-SPP-SEED.exr and reference.exr
    ``size``      width and height in pixels
    ``spp``       samples per pixel of stacks by ``clock``; other stacks get as many samples as take the same time
    ``rival_spp``  the same for the columns of ``against``; empty: as ``spp``. With larger numbers, the curves of rivals
              reach the whole time of methods that take longer to reconstruct
    ``seeds``     the number of renders of each stack, each with its own seed
    ``methods``   methods of `ngpt info`, or variants: tables [variants.NAME] with method, options, stack and sampler
    ``samplers``, ``rivals``  samplers of stacks with gradients, and without; tables [samplers.NAME] give them options,
              and ``subpixels`` as for ``ngpt render`` (none by default)
    ``clock``     the sampler whose samples ``spp`` counts
    ``time``      "wall", or "processor": all cores together, which other work on the machine hardly changes
    ``metrics``   the metrics to measure; E-LPIPS needs a table [elpips] with backbone and weights
    ``primary``   the metric of tables and plots
    ``reference_spp``, ``reference_seconds``  samples per pixel of a reference; if that is 0, seconds of rendering
    ``reference_sampler``  the sampler of references, which must find all light of the scenes
    ``timing_spp``, ``timing_repeats``  samples per pixel and number of the renders that measure the cost of a sample
    ``images``    the images to keep: of the "first" seed, of "all", or "none"
    ``elpips``    files of E-LPIPS: backbone and weights
    ``references``  references from elsewhere, NAME = "FILE" or NAME = ["FILE", "FILE"] for two halves
    ``groups``    groups of scenes, NAME = ["SCENE", ...]: tables have rows with the means of each group
    ``against``   rivals at equal whole time, NAME = ["COLUMN", ...]: the columns are settings of one rival, of which
              the best counts at each time
    ``variants``  methods with other options, by name
    """

    title: str = "Evaluation"
    scenes: tuple[str, ...] = ()
    size: tuple[int, int] = (320, 180)
    spp: tuple[int, ...] = (4, 16, 64)
    rival_spp: tuple[int, ...] = ()
    seeds: int = 3
    methods: tuple[str, ...] = ("primal", "l1", "wcv")
    samplers: tuple[str, ...] = (KINDS["gradients"],)
    rivals: tuple[str, ...] = (KINDS["features"],)
    clock: str = KINDS["gradients"]
    time: str = "wall"
    metrics: tuple[str, ...] = ("relMSE", "relMSE trimmed", "relMSE NGPT", "SMAPE", "PSNR", "SSIM", "FLIP")
    primary: str = "relMSE trimmed"
    reference_spp: int = 0
    reference_seconds: float = 60.0
    reference_sampler: str = KINDS["path"]
    timing_spp: int = 32
    timing_repeats: int = 3
    images: str = "first"
    elpips: dict[str, str] = field(default_factory=dict)
    references: dict[str, Any] = field(default_factory=dict)
    groups: dict[str, Any] = field(default_factory=dict)
    against: dict[str, Any] = field(default_factory=dict)
    variants: dict[str, dict[str, Any]] = field(default_factory=dict)
    # The tables [samplers.NAME]. Files have no entry of this name.
    sampler_options: dict[str, dict[str, Any]] = field(default_factory=dict, metadata={"internal": True})

    def __post_init__(self) -> None:
        low = min((*self.spp, *self.rival_spp, self.seeds, *self.size, self.timing_spp, self.timing_repeats), default=0)
        unknown = [name for name in (*self.metrics, self.primary) if name not in METRICS]
        for bad, text in (
            (not self.spp or not self.methods, "spp and methods must not be empty"),
            (low < 1, "spp, seeds, size and timing must be at least 1"),
            (self.reference_spp <= 0 and self.reference_seconds <= 0, "set reference_spp or reference_seconds"),
            (bool(unknown), f"no metric '{''.join(unknown[:1])}'; there are: {', '.join(METRICS)}"),
            (self.primary not in self.metrics, f"primary = '{self.primary}' is not among metrics"),
            (self.images not in IMAGES, f"images = '{self.images}': choose one of: {', '.join(IMAGES)}"),
            (self.time not in CLOCKS, f"time = '{self.time}': choose one of: {', '.join(CLOCKS)}"),
            (len(set(self.methods)) < len(self.methods), "a method is listed twice"),
            (not self.samplers or not self.rivals, "samplers and rivals must not be empty"),
            (len({*self.samplers, *self.rivals}) < len(self.samplers) + len(self.rivals), "a sampler is listed twice"),
        ):
            if bad:
                raise NgptError(f"evaluation: {text}")
        for name, table in self.variants.items():
            if table.get("stack", "path") not in KINDS:
                raise NgptError(f"evaluation: variants.{name}: stack must be one of {', '.join(KINDS)}")
            if "method" not in table:
                raise NgptError(f"evaluation: variants.{name}: method is missing; name the method that it varies")
            if table["method"] in METHODS:
                options = {key: value for key, value in table.items() if key not in ("method", "stack", "sampler")}
                try:
                    settings(f"method '{table['method']}'", METHODS[table["method"]].options, options)
                except NgptError as error:
                    raise NgptError(f"evaluation: variants.{name}: {error}") from None
        for name in self.sampler_options:
            self.sampler(name)
        for name, files in self.references.items():
            if not isinstance(files, str) and (not isinstance(files, list) or [type(f) for f in files] != [str, str]):
                raise NgptError(f"evaluation: references.{name} = {files!r}: must be a file, or a list of two files")
        columns = [column.name for column in self.columns()]
        for entry, what in (("groups", "scenes"), ("against", "columns")):
            for name, listed in getattr(self, entry).items():
                if not isinstance(listed, list) or not all(isinstance(item, str) for item in listed):
                    raise NgptError(f"evaluation: {entry}.{name} = {listed!r}: must be a list of {what}' names")
        for name, listed in self.against.items():
            if not listed:
                raise NgptError(f"evaluation: against.{name} is empty: name its columns, or leave it out")
            if unknown := [item for item in listed if item not in columns]:
                raise NgptError(
                    f"evaluation: against.{name}: there is no column '{unknown[0]}' among: {', '.join(columns)}"
                )
        parts = [file_part(column) for column in columns]
        if repeated := next((part for i, part in enumerate(parts) if part in parts[:i]), ""):
            raise NgptError(f"evaluation: two columns would be called '{repeated}'; rename the variant")

    def places(self) -> list[tuple[int, int, list[Column]]]:
        """Tuples (samples per pixel by ``clock``, seed, columns that are measured), in the order of the tables."""
        settings = {column for listed in self.against.values() for column in listed} if self.rival_spp else set()
        pairs = [(column, self.rival_spp if column.name in settings else self.spp) for column in self.columns()]
        return [
            (spp, seed, [column for column, counts in pairs if spp in counts])
            for spp in sorted({spp for _, counts in pairs for spp in counts})
            for seed in range(self.seeds)
        ]

    def columns(self) -> list[Column]:
        """All columns, in the order of the tables."""
        return [column for name in self.methods for column in self._columns(name)]

    def _columns(self, name: str) -> list[Column]:
        """The columns of a method or variant: one if it names a sampler, otherwise one for each listed sampler."""
        table = dict(self.variants.get(name, {}))
        method, kind, sampler = table.pop("method", name), table.pop("stack", ""), table.pop("sampler", "")
        layers = (*METHODS[method].needs, *METHODS[method].uses) if method in METHODS else ()
        kind = kind or ("gradients" if "dx" in layers else "features" if len(layers) > 1 else "path")
        samplers = (sampler,) if sampler else self.samplers if kind == "gradients" else self.rivals
        names = [f"{name} ({sampler})" if len(samplers) > 1 else name for sampler in samplers]
        return [Column(n, name, method, s, self.render(kind, s), table) for n, s in zip(names, samplers, strict=True)]

    def render(self, kind: str, sampler: str) -> Render:
        """The render of stacks of this ``kind`` by the sampler that the configuration calls ``sampler``.

        Only the default sampler of images can leave features out. With another sampler, the kind "path" becomes
        "features". Raises NgptError for options that the sampler does not have.
        """
        name, given = self.sampler(sampler)
        return Render("features" if kind == "path" and name != KINDS["path"] else kind, name, given)

    def sampler(self, name: str) -> tuple[str, str]:
        """The renderer's name of the sampler that the configuration calls ``name``, and its options, as text.

        The text has only the options that differ from their defaults. The default of ``subpixels`` is 1, and not "auto"
        as in `ngpt render`, so that configurations and stored tables keep their meaning. Raises NgptError for options
        that the sampler does not have.
        """
        table = dict(self.sampler_options.get(name, {}))
        if not table:
            return name, ""
        own = table.pop("sampler", name)
        try:
            return own, find_renderer().unusual(own, table)
        except NgptError as error:
            raise NgptError(f"evaluation: samplers.{name}: {error}") from None

    def scene_files(self) -> dict[str, str]:
        """Name -> built-in scene, scene file or folder of stacks, after resolving patterns.

        Raises NgptError if there are no scenes, if a pattern matches no file, or if two scenes have the same name.
        """
        if not self.scenes:
            raise NgptError("evaluation: no scenes: name built-in ones, scene files, patterns or folders with --scenes")
        result: dict[str, str] = {}
        for entry in self.scenes:
            found = sorted(glob(entry, recursive=True), key=natural) if has_magic(entry) else [entry]
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


def file_part(column: str) -> str:
    """The name of a column in file names: "wcv (gpt-basic)" becomes wcv-gpt-basic."""
    return column.replace(" (", "-").removesuffix(")")


def scene_name(scene: str) -> str:
    """The name of a scene in tables. For a file, it is its folder's name, and what follows "scene" in its own name."""
    path = Path(scene)
    return f"{path.parent.name}{path.stem.removeprefix('scene')}" if path.suffix == ".xml" else path.name


def read_config(path: str | Path) -> EvaluationConfig:
    """Reads a TOML file. Raises NgptError for unknown entries, and for values of a wrong type.

    The entry ``base`` names another file, relative to the folder of this file. Missing entries are taken from that
    file. If ``samplers`` are tables of options, the samplers with gradients among them are compared, except for those
    that a variant names. ``rivals``, ``clock`` and other entries may name the samplers without gradients.
    """
    values = _with_base(Path(path))
    if isinstance(tables := values.get("samplers"), dict):
        check(tables, {str: dict}, f"{path}: samplers")
        gradients = find_renderer().gradients
        own = {table.get("sampler") for table in values.get("variants", {}).values()}
        with_gradients = [n for n, table in tables.items() if n not in own and gradients(table.get("sampler", n))]
        values |= {"samplers": with_gradients or [KINDS["gradients"]], "sampler_options": tables}
    return from_table(EvaluationConfig, values, str(path))


def _with_base(path: Path, above: tuple[Path, ...] = ()) -> dict[str, Any]:
    """The entries of a file and of its base. ``above`` are the files that have this file as their base."""
    values = read_toml(path)
    base = values.pop("base", None)
    if base is None:
        return values
    above = (*above, path.resolve())
    if not isinstance(base, str) or (path.parent / base).resolve() in above:
        raise NgptError(f"{path}: base = {base!r}: must be the name of another file, which is not built on this one")
    return _merged(_with_base(path.parent / base, above), values)


def _merged(base: dict[str, Any], values: dict[str, Any]) -> dict[str, Any]:
    """``base`` updated with ``values``. Tables that both have are merged entry by entry."""
    tables = {
        name: _merged(base[name], value)
        for name, value in values.items()
        if isinstance(value, dict) and isinstance(base.get(name), dict)
    }
    return base | values | tables
