"""The tables of docs/train/training.md: ``python -m ngpt.training.parameters`` prints them.

What a parameter means stands once, in the docstring of its dataclass: ``name``  meaning. What a configuration is for,
in the first sentence of its file.
"""

import re
import textwrap
import tomllib
from dataclasses import MISSING, Field, fields
from inspect import cleandoc
from typing import Any, get_type_hints

from ngpt.network.model import ModelConfig, Reconstructor, parameters
from ngpt.system import configs
from ngpt.system.records import described
from ngpt.training.augment import Augmentation
from ngpt.training.cost import per_pixel
from ngpt.training.loss import TERMS, LossSettings
from ngpt.training.settings import DataSettings, OptimizerSettings, RunSettings, Settings, read_settings

# The tables of a configuration and what reads them; "" is its top.
TABLES: dict[str, type] = {
    "": Settings,
    "model": ModelConfig,
    "data": DataSettings,
    "augmentation": Augmentation,
    "loss": LossSettings,
    "optimizer": OptimizerSettings,
    "run": RunSettings,
}


def entries(kind: type) -> list[tuple[tuple[str, ...], str]]:
    """The parameters that share an entry of the docstring, and what it says: ``one``, ``two``  meaning."""
    found: list[tuple[tuple[str, ...], str]] = []
    inside = False
    for line in cleandoc(kind.__doc__ or "").splitlines():
        if entry := re.match(r"((?:``\w+``, )*``\w+``)(?:  +(.*))?$", line):
            found.append((tuple(re.findall(r"``(\w+)``", entry[1])), entry[2] or ""))
        elif line.startswith(" ") and inside:
            names, meaning = found[-1]
            found[-1] = names, f"{meaning} {line.strip()}".strip()
        inside = bool(entry) or (inside and line.startswith(" "))
    return found


def parameter_tables() -> str:
    """All parameters of a configuration: name, kind of value, default, meaning. In Markdown."""
    lines = ["| parameter | value | default | meaning |", "|---|---|---|---|"]
    for table, kind in TABLES.items():
        known: dict[str, Field] = {field.name: field for field in fields(kind)}
        hints = get_type_hints(kind)
        for names, meaning in entries(kind):
            keys = ", ".join(f"`{table}.{name}`" if table else f"`{name}`" for name in names)
            defaults = ", ".join(_default(known[name]) for name in names)
            told = meaning.replace("``", "`").replace("|", "\\|")
            lines.append(f"| {keys} | {described(hints[names[0]])} | {defaults} | {told} |")
    return "\n".join(lines)


def template(text: str) -> str:
    """A configuration, with a comment for every parameter that it leaves at its default: what it means, and what that
    is. What is set by it stays as it is."""
    given = tomllib.loads(text)
    sections = re.split(r"^(?=\[\w+\])", text, flags=re.M)
    present = [match[1] if (match := re.match(r"\[(\w+)\]", section)) else "" for section in sections]
    for table in TABLES:
        if table not in present:
            sections.append(f"[{table}]\n")
            present.append(table)
    lines = []
    for table, section in zip(present, sections, strict=True):
        rest = _commented(table, given.get(table, {}) if table else given) if table in TABLES else ""
        lines.append(f"{section.rstrip()}\n{rest}\n")
    return "\n".join(line.rstrip("\n") + "\n" for line in lines)


def _commented(table: str, given: dict[str, Any]) -> str:
    """Lines for the parameters of a table that are not ``given``."""
    known: dict[str, Field] = {field.name: field for field in fields(TABLES[table])}
    told = [(names, meaning) for names, meaning in entries(TABLES[table])]
    explained = {name for names, _ in told for name in names}
    told += [((name,), "") for name in known if name not in explained and name not in TABLES]
    defaults = {name: field.default for name, field in known.items()}
    if table == "loss":
        for name in TERMS.load():
            told.append(((name,), f"weight of another package's term: {cleandoc(TERMS[name].__doc__ or name)}"))
            defaults[name] = 0.0
    lines = []
    for names, meaning in told:
        if others := [name for name in names if name not in given]:
            words = meaning.replace("``", "").partition("\n")[0]
            lines += textwrap.wrap(words, 116, initial_indent="# ", subsequent_indent="#   ")
            lines += [f"# {name} = {_toml(defaults[name])}" for name in others]
    return "\n".join(lines)


def _default(field: Field) -> str:
    """As TOML has it."""
    return "none: must be given" if field.default is MISSING else f"`{_toml(field.default)}`"


def _toml(value: Any) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, tuple):
        return f"[{', '.join(map(_toml, value))}]"
    return f'"{value}"' if isinstance(value, str) else repr(value)


def configuration_table() -> str:
    """The configurations that come with ngpt, what they are for and what their networks cost. In Markdown."""
    lines = ["| configuration | what | parameters | thousand multiplications per pixel |", "|---|---|--:|--:|"]
    return "\n".join(lines + [configuration_row(name) for name in configs.names(configs.TRAINING)])


def configuration_row(name: str) -> str:
    path = configs.find_config(name, configs.TRAINING)
    model = Reconstructor(read_settings(path).model)
    cost, _ = per_pixel(model)
    return f"| `{name}` | {purpose(path.read_text())} | {parameters(model):,} | {cost / 1e3:.0f} |"


def purpose(text: str) -> str:
    """The first sentence of the comment that a configuration begins with, without its full stop."""
    comment = re.match(r"(?:#.*\n)*", text)
    words = " ".join(line.lstrip("# ") for line in (comment[0] if comment else "").splitlines())
    return re.split(r"\.(?: |$)", words, maxsplit=1)[0]


if __name__ == "__main__":
    print(f"{configuration_table()}\n\n{parameter_tables()}")
