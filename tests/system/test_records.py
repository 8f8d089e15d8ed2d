"""Records in JSON and TOML, and the errors about them: short, of one line, and with the place."""

import pytest

from ngpt.errors import LONGEST, NgptError
from ngpt.system.records import check, parse_json, read_json, read_toml


@pytest.mark.parametrize(
    ("value", "shape"),
    [
        (3, int),
        (0.5, (int, float)),
        ([1, 2], [int]),
        ((), [int]),
        ({"a": {"x": 1, "y": 2.0}, "more": None}, {"a": {str: (int, float)}}),
        (True, bool),
    ],
)
def test_what_is_of_the_shape_passes(value, shape):
    check(value, shape, "a.json")


@pytest.mark.parametrize(
    ("value", "shape", "message"),
    [
        (True, int, "a.json is True; it must be int"),
        (2**63, int, "a.json is 9223372036854775808; it must be int"),
        ("x" * 10**6, (int, float), f"a.json is '{'x' * 59}; it must be int or float"),
        ([1, "x"], [int], "a.json[1] is 'x'; it must be int"),
        ({"a": []}, {"a": {str: int}}, "a.json: 'a' is []; it must be a table"),
        ({"a": {"b": None}}, {"a": {str: int}}, "a.json: 'a': 'b' is None; it must be int"),
        ({}, {"a": int}, "a.json: lacks 'a'"),
        ("ab", [str], "a.json is 'ab'; it must be a list"),
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
    assert str(caught.value).startswith(f"{path}: cannot be read: ")
    with pytest.raises(NgptError, match=r"^here: cannot be read: "):
        parse_json("[", "here")


def test_errors_are_one_short_line_whatever_they_quote():
    error = NgptError("a.exr: layer 'x\ny\r\nz' is wrong; " + "w" * 5000 + "; render it again")
    assert "\n" not in str(error) and len(str(error)) <= LONGEST
    assert str(error).startswith("a.exr: layer 'x y z'") and str(error).endswith("; render it again")
