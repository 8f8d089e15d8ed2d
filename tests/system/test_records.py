"""Records in JSON and TOML, and the errors about them: short, of one line, and with the place."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import pytest

from ngpt.errors import NgptError
from ngpt.system.records import check, from_table, parse_json, read_json, read_toml


@pytest.mark.parametrize(
    ("value", "shape", "message"),
    [
        (True, int, "a.json is True; it must be int"),
        (2**63, int, "a.json is 9223372036854775808; it must be int"),
        ("x" * 10**6, (int, float), f"a.json is '{'x' * 59}; it must be int or float"),
        ({"a": {"b": None}}, {"a": {str: int}}, "a.json: 'a': 'b' is None; it must be int"),
        ({}, {"a": int}, "a.json: lacks 'a'"),
    ],
)
def test_what_is_not_is_named_with_its_place(value, shape, message):
    with pytest.raises(NgptError) as caught:
        check(value, shape, "a.json")
    assert str(caught.value) == message


@pytest.mark.parametrize("reader", [read_json, read_toml])
@pytest.mark.parametrize(
    "data", [None, b"\xff\xfe", b"{", b"x = [" + b"[" * 100_000, b"[" * 100_000, b'{"a": 1' + b"0" * 5000]
)
def test_files_that_cannot_be_read(tmp_path, reader, data):
    path = tmp_path / "a"
    if data is not None:
        path.write_bytes(data)
    with pytest.raises(NgptError) as caught:
        reader(path)
    assert str(caught.value).startswith(f"{path}: not found" if data is None else f"{path}: cannot be read: ")
    with pytest.raises(NgptError, match=r"^here: cannot be read: "):
        parse_json("[", "here")


@dataclass
class Window:
    pane: str
    panes: int = 4
    open: bool = False


@dataclass
class House:
    door: Window
    floors: int = 2
    height: float = 6.5
    name: str = ""
    size: tuple[float, float] = (8.0, 9.0)
    years: tuple[int, ...] = ()
    windows: tuple[Window, ...] = ()
    names: dict[str, str] = field(default_factory=dict)
    anything: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self):
        if self.floors < 1:
            raise NgptError("a house has a floor")


DOOR = {"door": {"pane": "glass"}}


def test_a_table_becomes_a_dataclass():
    door = Window("glass")
    assert from_table(House, DOOR, "h.toml") == House(door)
    values = {"height": 7, "size": [3, 4.5], "years": [1900, 1950], "windows": [{"pane": "oak", "open": True}]}
    values |= {"names": {"a": "b"}, "anything": {"x": [1]}}
    house = from_table(House, DOOR | values, "h.toml")
    assert house == House(door, 2, 7, "", (3, 4.5), (1900, 1950), (Window("oak", 4, True),), {"a": "b"}, {"x": [1]})


@pytest.mark.parametrize(
    ("values", "message"),
    [
        (3, "h.toml = 3: must be a table"),
        ({}, "h.toml: lacks 'door'"),
        (
            DOOR | {"flours": 3},
            "h.toml: unknown key 'flours'; did you mean 'floors'? there are: door, floors, height, ",
        ),
        (DOOR | {"floors": 2.5}, "h.toml: floors = 2.5: must be a whole number, like 2"),
        (DOOR | {"floors": 16**5000}, "h.toml: floors = a number of thousands of digits: must be a whole number"),
        (DOOR | {"height": "tall"}, "h.toml: height = 'tall': must be a number, like 6.5"),
        (DOOR | {"name": ["x"]}, "h.toml: name = ['x']: must be a string"),
        (DOOR | {"size": [3]}, "h.toml: size = [3]: must be a list of 2 numbers, like [8.0, 9.0]"),
        (DOOR | {"years": [1900, "x"]}, "h.toml: years = [1900, 'x']: must be a list of whole numbers"),
        (DOOR | {"names": {"a": 1}}, "h.toml: names = {'a': 1}: must be a table of strings"),
        (DOOR | {"windows": [{"pane": "oak"}, {"open": 1}]}, "h.toml: [windows][1]: open = 1: must be true or false"),
        ({"door": {}}, "h.toml: [door]: lacks 'pane'"),
        (DOOR | {"floors": 0}, "h.toml: a house has a floor"),
    ],
)
def test_a_table_that_is_none_of_it_is_refused_in_one_line(values, message):
    with pytest.raises(NgptError) as caught:
        from_table(House, values, "h.toml")
    assert str(caught.value).startswith(message) and "\n" not in str(caught.value)
    assert len(str(caught.value)) < 200
