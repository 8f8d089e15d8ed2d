"""Makes configurations to start from, in which comments list all parameters with their meanings and defaults.

The meaning of a parameter is an entry, ``name``  meaning, in the docstring of its dataclass.
"""

import re
import textwrap
import tomllib
from collections.abc import Mapping
from dataclasses import MISSING, fields
from inspect import cleandoc
from typing import Any

# The header of a table, [name], or of an array of tables, [[name]]
_HEAD = r"^\[+([\w-]+)[\w.-]*\]+ *(?:#.*)?$"


def entries(kind: type) -> list[tuple[tuple[str, ...], str]]:
    """The entries of a dataclass's docstring, ``one``, ``two``  meaning, as pairs of names and meaning."""
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


def template(
    text: str, tables: Mapping[str, type | None], others: Mapping[str, Mapping[str, tuple[str, Any]]] = {}
) -> str:
    """Adds comments to the configuration ``text``: the meaning and the default of each parameter that it does not set.

    ``tables``  the dataclass of each table, by its name; "" is the top level, and None stands for a table without
                comments
    ``others``  further parameters by table and name: their meanings and defaults
    """
    given = tomllib.loads(text)
    # The comments directly above a header belong to it.
    heads = [match.start() for match in re.finditer(rf"(?:^#.*\n)*{_HEAD}", text, re.M)]
    sections = [text[start:end] for start, end in zip([0, *heads], [*heads, len(text)], strict=True)]
    present = [match[1] if (match := re.search(_HEAD, section, re.M)) else "" for section in sections]
    for table, kind in tables.items():
        if kind and table not in present:
            sections.append(f"[{table}]\n")
            present.append(table)
    lines = []
    for table, section in zip(present, sections, strict=True):
        rest = ""
        if kind := tables.get(table):
            values = given.get(table, {}) if table else given
            rest = _commented(kind, {*values, *tables}, others.get(table, {}))
        lines.append(f"{section.rstrip()}\n{rest}\n")
    return "\n".join(line.rstrip("\n") + "\n" for line in lines)


def _commented(kind: type, given: set[str], others: Mapping[str, tuple[str, Any]]) -> str:
    """Comments for those parameters of a dataclass, and of ``others``, that are not ``given``."""
    meanings = entries(kind)
    explained = {name for names, _ in meanings for name in names}
    known = [field for field in fields(kind) if not field.metadata.get("internal")]
    meanings += [((field.name,), "") for field in known if field.name not in explained]
    meanings += [((name,), meaning) for name, (meaning, _) in others.items()]
    defaults = {f.name: f.default if f.default_factory is MISSING else f.default_factory() for f in known}
    defaults |= {name: default for name, (_, default) in others.items()}
    lines = []
    for names, meaning in meanings:
        if left := [name for name in names if name not in given]:
            words = meaning.replace("``", "").partition("\n")[0]
            lines += textwrap.wrap(words, 116, initial_indent="# ", subsequent_indent="#   ")
            lines += [f"# {name} = {toml(defaults[name])}" for name in left]
    return "\n".join(lines)


def toml(value: Any) -> str:
    """A value in TOML's notation."""
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, tuple):
        return f"[{', '.join(map(toml, value))}]"
    return f'"{value}"' if isinstance(value, str) else repr(value)
