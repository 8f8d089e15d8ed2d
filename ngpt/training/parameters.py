"""Makes the tables of docs/train/training.md: ``python -m ngpt.training.parameters`` prints them.

The meaning of a parameter is in the docstring of its dataclass, after its ``name``. The purpose of a configuration is
the first sentence of its file.
"""

import re
import tomllib
from dataclasses import MISSING, Field, fields
from inspect import cleandoc
from typing import get_type_hints

from ngpt.network.config import ModelConfig
from ngpt.network.model import parameters
from ngpt.system import configs
from ngpt.system.records import described
from ngpt.system.templates import entries, template, toml
from ngpt.training import settings
from ngpt.training.augment import Augmentation
from ngpt.training.cost import network_of, per_pixel
from ngpt.training.loss import TERMS, LossSettings

# The tables of a configuration and their dataclasses; "" is its top level.
TABLES: dict[str, type] = {
    "": settings.Settings,
    "model": ModelConfig,
    "temporal": settings.TemporalSettings,
    "data": settings.DataSettings,
    "augmentation": Augmentation,
    "loss": LossSettings,
    "optimizer": settings.OptimizerSettings,
    "run": settings.RunSettings,
}


def parameter_tables() -> str:
    """A table in Markdown of all parameters of a configuration: name, kind of value, default, meaning."""
    lines = ["| parameter | value | default | meaning |", "|---|---|---|---|"]
    for table, kind in TABLES.items():
        known: dict[str, Field] = {field.name: field for field in fields(kind)}
        hints = get_type_hints(kind)
        for names, meaning in entries(kind):
            keys = ", ".join(f"`{table}.{name}`" if table else f"`{name}`" for name in names)
            defaults = ", ".join(_default(known[name]) for name in names)
            text = meaning.replace("``", "`").replace("|", "\\|")
            lines.append(f"| {keys} | {described(hints[names[0]])} | {defaults} | {text} |")
    return "\n".join(lines)


def tables_of(text: str) -> dict[str, type | None]:
    """The tables of a configuration; None in place of the dataclass for tables that its kind of network excludes."""
    other = ("temporal",) if "model" in tomllib.loads(text) else ("model", "loss", "augmentation")
    return TABLES | dict.fromkeys(other)


def training_template(text: str) -> str:
    """``ngpt.system.templates.template`` of a configuration, with weights for terms of other packages."""
    others = {
        name: f"weight of another package's term: {cleandoc(TERMS[name].__doc__ or name)}" for name in TERMS.load()
    }
    return template(text, tables_of(text), {"loss": {name: (meaning, 0.0) for name, meaning in others.items()}})


def _default(field: Field) -> str:
    return "none: must be given" if field.default is MISSING else f"`{toml(field.default)}`"


def configuration_table() -> str:
    """A table in Markdown of the configurations that come with ngpt, with their purposes and costs."""
    lines = ["| configuration | what | parameters | thousand multiplications per pixel |", "|---|---|--:|--:|"]
    return "\n".join(lines + [configuration_row(name) for name in configs.names(configs.TRAINING)])


def configuration_row(name: str) -> str:
    path = configs.find_config(name, configs.TRAINING)
    model, channels = network_of(settings.read_settings(path))
    cost, _ = per_pixel(model, channels)
    return f"| `{name}` | {purpose(path.read_text())} | {parameters(model):,} | {cost / 1e3:.0f} |"


def purpose(text: str) -> str:
    """The first sentence of the comment that a configuration begins with, without its full stop."""
    comment = re.match(r"(?:#.*\n)*", text)
    words = " ".join(line.lstrip("# ") for line in (comment[0] if comment else "").splitlines())
    return re.split(r"\.(?: |$)", words, maxsplit=1)[0]


if __name__ == "__main__":
    print(f"{configuration_table()}\n\n{parameter_tables()}")
