"""The settings of a training run. They are stored in TOML files: ``configs/*.toml``."""

import dataclasses
import tomllib
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from ngpt.errors import NgptError, WrongUse
from ngpt.methods import METHODS, unknown_method
from ngpt.network.config import ModelConfig
from ngpt.network.features import PARTS
from ngpt.system.records import from_table, read_toml
from ngpt.training.augment import Augmentation
from ngpt.training.settings_text import difference, flat


@dataclass(frozen=True)
class DataSettings:
    """The sources of training examples.

    ``folders``     data sets (``python -m data_gen``) or folders of stacks with references; all are mixed
    ``validation``  prefixes of the names of scenes that are kept out of training
    ``validation_share``  share of the scenes that are kept out if ``validation`` is empty, at least one scene; 0 keeps
                    none out
    ``crop``        side of an example in pixels
    ``pairs``       share of examples without a reference, where one half of the samples is trained against the other
                    half; only used if there are also crops with references
    ``kept``        folder for the references of sets that are rendered during training: references are rendered once,
                    and used again with new noise in the inputs. "" always renders new ones
    ``workers``     processes that prepare examples, at most one for each processor; 0 prepares them between steps
    ``cache``       MiB of memory for prepared examples, in each of these processes
    """

    folders: tuple[str, ...] = ()
    validation: tuple[str, ...] = ()
    validation_share: float = 0.1
    crop: int = 128
    pairs: float = 0.5
    kept: str = ""
    workers: int = 0
    cache: int = 2048


@dataclass(frozen=True)
class OptimizerSettings:
    """Adam and its schedule (``ngpt.training.schedule``); the defaults are those of the NGPT paper (Kettunen et al.
    2019).

    ``learning_rate``  the largest learning rate of the schedule
    ``betas``      decays of Adam's two moments
    ``schedule``   "paper" (warm-up, flat, exponential decay) or "cosine" (warm-up, half a cosine to 1 % at the end)
    ``warmup``     steps until the learning rate is reached; a tenth of the run if the run would end before that
    ``flat``       step until which the rate is constant ("paper")
    ``half_life``  after the step ``flat``, the rate halves in this number of steps ("paper")
    ``clip``       largest norm of the gradient; 0 does not clip
    ``ema``        decay per step of the moving average of the weights. If set, this average is what is validated and
                   exported; 0 means no average
    """

    learning_rate: float = 5e-4
    betas: tuple[float, float] = (0.9, 0.99)
    schedule: str = "paper"
    warmup: int = 10_000
    flat: int = 50_000
    half_life: int = 70_000
    clip: float = 0.0
    ema: float = 0.0


@dataclass(frozen=True)
class RunSettings:
    """Length, precision and intervals of a run.

    ``steps``, ``batch``  length of the run, and examples per step over all processes
    ``precision``  precision of the network's body: "float32" or "bfloat16". CPUs without instructions for bfloat16
                   compute in float32, because emulation takes several times as long
    ``seed``       seed of all random numbers: weights, order, augmentation, transforms of the loss
    ``minutes``    wall-clock budget of one call; 0 means no limit. A run that reaches it can be resumed
    ``log``, ``save``, ``validate``  steps between two log entries, checkpoints or validations
    ``views``      number of inputs in each validation, spread evenly over all
    """

    steps: int = 600_000
    batch: int = 20
    precision: str = "float32"
    seed: int = 0
    minutes: float = 0.0
    log: int = 100
    save: int = 1000
    validate: int = 1000
    views: int = 64


@dataclass(frozen=True)
class TemporalSettings:
    """Settings for the network that blends frames (``ngpt.training.temporal``) in place of one that makes images.

    ``methods``  the reconstruction methods whose results it learns to blend
    ``round``    number of training steps in a round. At the start of each round, the current network blends the frame
                 sequences (shots) again, and training uses these results as the earlier frames
    ``clips``    number of clips in a round, drawn at random. A clip is one shot, with its frames reconstructed by one
                 of the methods
    """

    methods: tuple[str, ...] = ("ngpt-fast", "ngpt-combine", "oidn", "wcv")
    round: int = 400
    clips: int = 120


@dataclass(frozen=True)
class Settings:
    """All settings of a run. Either ``model`` or ``temporal`` is set. ``ngpt.training.loss.make_loss`` reads ``loss``.

    ``initial``  weights to start from, with the same [model]: a file, or the name of a network that comes with ngpt; ""
                 starts from random weights
    """

    model: ModelConfig | None = None
    temporal: TemporalSettings | None = None
    data: DataSettings = field(default_factory=DataSettings)
    augmentation: Augmentation = field(default_factory=Augmentation)
    loss: dict[str, Any] = field(default_factory=dict)
    optimizer: OptimizerSettings = field(default_factory=OptimizerSettings)
    run: RunSettings = field(default_factory=RunSettings)
    initial: str = ""

    def to_dict(self) -> dict[str, Any]:
        """The settings as nested dicts for JSON, which ``from_dict`` reads."""
        return {name: value for name, value in dataclasses.asdict(self).items() if value is not None}


def read_settings(path: str | Path, changes: list[str] = ()) -> Settings:  # type: ignore[assignment]
    """The settings of a TOML file, after ``changes`` of the form "run.steps=100".

    Raises NgptError for a file that cannot be read, for unknown keys, and for values of a wrong type.
    """
    values = read_toml(path)
    for change in changes:
        _change(values, change)
    return from_dict(values, str(path))


def from_dict(values: dict[str, Any], path: str) -> Settings:
    """Settings from nested dicts; ``path`` is for messages. Raises NgptError as ``read_settings``."""
    settings = from_table(Settings, values, path)
    _check(settings, path)
    return settings


def changed(before: Settings, now: Settings) -> list[str]:
    """The settings that have changed, each as "table.key: before -> now"."""
    one, other = flat(before.to_dict()), flat(now.to_dict())
    return [f"{name}: {one.get(name)} -> {other.get(name)}" for name in difference(one, other)]


def published(settings: Settings) -> dict[str, Any]:
    """The settings for published files, with the names of folders and files but not their paths."""
    values = settings.to_dict()
    values["data"]["folders"] = [Path(folder).name for folder in settings.data.folders]
    values["initial"] = Path(settings.initial).name
    values["loss"] = {k: Path(v).name if k in ("backbone", "weights") else v for k, v in settings.loss.items()}
    return values


def _check(settings: Settings, path: str) -> None:
    for value, name, allowed in (
        (settings.run.precision, "run.precision", ("float32", "bfloat16")),
        (settings.optimizer.schedule, "optimizer.schedule", ("paper", "cosine")),
    ):
        if value not in allowed:
            raise NgptError(f"{path}: {name} = '{value}': choose one of: {', '.join(allowed)}")
    if (settings.model is None) == (settings.temporal is None):
        raise NgptError(f"{path}: needs [model], for a network that makes images, or [temporal], and not both")
    if settings.temporal is not None:
        _check_temporal(settings, settings.temporal, path)
    parts = [name for name in PARTS if settings.model is not None and name in settings.model.layers]
    if parts and settings.augmentation.quieter:
        raise NgptError(
            f"{path}: augmentation.quieter: cannot be used with a network that reads {' and '.join(parts)}: references "
            "do not contain these parts of the light separately; remove augmentation.quieter"
        )
    for name in ("steps", "batch", "log", "save", "validate"):
        if getattr(settings.run, name) < 1:
            raise NgptError(f"{path}: run.{name} = {getattr(settings.run, name)}: must be at least 1")
    if not 0 < settings.data.pairs < 1:
        raise NgptError(f"{path}: data.pairs = {settings.data.pairs}: must be a share between 0 and 1")
    shares = {"data.validation_share": settings.data.validation_share, "optimizer.ema": settings.optimizer.ema}
    for name, share in shares.items():
        if not 0 <= share < 1:
            raise NgptError(f"{path}: {name} = {share}: must be at least 0 and below 1")


def _check_temporal(settings: Settings, table: TemporalSettings, path: str) -> None:
    for name in ("round", "clips"):
        if getattr(table, name) < 1:
            raise NgptError(f"{path}: temporal.{name} = {getattr(table, name)}: must be at least 1")
    if not table.methods:
        raise NgptError(f"{path}: temporal.methods = []: give one at least")
    for method in table.methods:
        if method not in METHODS:
            raise NgptError(f"{path}: temporal.methods: {unknown_method(method)}")
    if settings.loss or settings.augmentation != Augmentation():
        raise NgptError(f"{path}: [loss] and [augmentation] are for networks that make images; leave them out")
    if streams := [folder for folder in settings.data.folders if folder.endswith(".toml")]:
        raise NgptError(
            f"{path}: data.folders: {streams[0]}: shots cannot be rendered during training; render a data set "
            "first and name its folder"
        )


def _change(values: dict[str, Any], change: str) -> None:
    name, equals, text = change.partition("=")
    if not equals:
        raise WrongUse(f"--set {change}: give it as table.key=value, for example run.steps=1000")
    try:
        value = tomllib.loads(f"value = {text}")["value"]
    except tomllib.TOMLDecodeError:
        value = text  # a string without quotes, as people type it in a shell
    *tables, key = name.strip().split(".")
    for name in tables:
        values = values.setdefault(name, {})
        if not isinstance(values, dict):
            raise WrongUse(f"--set {change}: '{name}' is not a table")
    values[key] = value
