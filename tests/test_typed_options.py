"""Options of methods and samplers: what they take, and what they say to what they do not."""

import math

import pytest

from ngpt.errors import NgptError
from ngpt.options import Option, as_text, settings, unusual

OPTIONS = {
    "depth": Option(10, "how deep", range=(1, 64)),
    "radius": Option(0.5, "how wide", range=(0, math.inf)),
    "alpha": Option("auto", "a number or a word", choices=("auto",), range=(0, math.inf)),
    "shift": Option("replay", "which one", choices=("replay", "half-vector")),
    "tile": Option(2, "how many", choices=(2, 4)),
    "caustic": Option(True, "whether"),
    "weights": Option("", "a file"),
}
TAKEN = [
    ("depth", "3", 3),
    ("depth", 4.0, 4),
    ("radius", "1e-2", 0.01),
    ("radius", 2, 2.0),
    ("alpha", "auto", "auto"),
    ("alpha", ".25", 0.25),
    ("shift", "half-vector", "half-vector"),
    ("tile", "4", 4),
    ("caustic", "False", False),
    ("weights", "a.onnx", "a.onnx"),
]
REFUSED = [
    ("depth", 0, "method 'x', option 'depth': '0' is not allowed; it takes a whole number from 1 to 64"),
    ("depth", 65, "'65' is not allowed"),
    ("depth", "2.5", "'2.5' is not allowed"),
    ("depth", True, "'true' is not allowed"),
    ("radius", math.nan, "'nan' is not allowed; it takes a number of 0 or more"),
    ("alpha", "aut", "'aut' is not allowed; it takes a number of 0 or more, or auto; did you mean 'auto'"),
    ("alpha", -1, "'-1' is not allowed"),
    ("shift", "half", "'half' is not allowed; it takes replay, half-vector"),
    ("tile", 3, "it takes 2, 4"),
    ("caustic", 1, "it takes true or false"),
    ("weights", 3, "it takes a text"),
    ("dept", 3, "method 'x' has no option 'dept'; did you mean 'depth'?"),
    ("zoom", 3, "method 'x' has no option 'zoom'; it has: depth, radius"),
]


@pytest.mark.parametrize(("name", "given", "value"), TAKEN)
def test_texts_and_values_become_the_options_type(name, given, value):
    got = settings("method 'x'", OPTIONS, {name: given})[name]
    assert got == value and type(got) is type(value)


@pytest.mark.parametrize(("name", "given", "complaint"), REFUSED)
def test_what_is_not_allowed_is_said_in_one_line(name, given, complaint):
    with pytest.raises(NgptError) as error:
        settings("method 'x'", OPTIONS, {name: given})
    assert complaint in str(error.value)


def test_what_is_not_the_default_is_written_as_it_is_given():
    found = settings("method 'x'", OPTIONS, {"caustic": False, "radius": 0.1 + 0.2})
    assert as_text(unusual(OPTIONS, found)) == f"radius={0.1 + 0.2}, caustic=false"
