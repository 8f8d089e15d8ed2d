"""Options of methods from the command line, and methods that are others with options of their own."""

import json

import numpy as np
import pytest
from full_stack import full_stack

import ngpt
from ngpt.cli import main
from ngpt.denoisers import oidn
from ngpt.methods import METHODS

needs_oidn = pytest.mark.skipif(bool(oidn.missing()), reason=oidn.missing())


@pytest.fixture
def source(tmp_path):
    return str(ngpt.write(tmp_path / "stack.exr", full_stack(20, 24)))


def denoise(source, *arguments):
    """The image and what the header says of it."""
    target = f"{source}.out.exr"
    assert main(["denoise", source, "-o", target, "--force", "-q", *arguments]) == 0
    return ngpt.read_image(target), ngpt.read(target).attributes


def test_an_option_of_any_method(source):
    stack = ngpt.read(source)
    for arguments, expected in (
        (["-m", "l1", "-O", "alpha=0.5"], {"alpha": 0.5}),
        (["-m", "l2", "--option", "alpha=auto"], {}),
        (["-m", "ngpt-fast", "-O", "memory=700"], {"memory": 700}),
    ):
        image, header = denoise(source, *arguments)
        assert np.array_equal(image, ngpt.denoise(stack, arguments[1], **expected))
        assert header.get("ngpt:options", "") == ", ".join(f"{name}={value}" for name, value in expected.items())
    assert np.array_equal(
        denoise(source, "-m", "l1", "-O", "alpha=0.5")[0], denoise(source, "-m", "l1", "--alpha", "0.5")[0]
    )


@needs_oidn
def test_quality_and_features_of_oidn(source):
    stack = ngpt.read(source)
    image, header = denoise(source, "-m", "oidn", "-O", "auxiliary=noisy", "-O", "quality=fast")
    assert header["ngpt:options"] == "auxiliary=noisy, quality=fast" and header["ngpt:method"] == "oidn"
    assert np.array_equal(image, ngpt.denoise(stack, "oidn", auxiliary="noisy", quality="fast"))
    assert not np.array_equal(image, ngpt.denoise(stack, "oidn"))


@needs_oidn
@pytest.mark.parametrize("name", [name for name, method in METHODS.items() if method.variant])
def test_rows_of_tables_are_methods(source, name, capsys):
    image, header = denoise(source, "-m", name)
    entry = METHODS[name]
    assert header["ngpt:method"] == name and "ngpt:options" not in header
    assert np.array_equal(image, ngpt.denoise(ngpt.read(source), entry.variant, **entry.options))
    assert main(["info", source, "--json"]) == 0
    assert name in json.loads(capsys.readouterr().out)["methods"]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["-m", "oidn", "-O", "quality=best"], "quality 'best': choose one of: high, balanced, fast"),
        (["-m", "oidn", "-O", "auxiliary=7"], "auxiliary '7': choose one of: prefiltered, clean"),
        (["-m", "oidn", "-O", "alpha=1"], "method 'oidn' has no option 'alpha'; it has: auxiliary, quality"),
        (["-m", "wcv", "-O", "alpha=1"], "method 'wcv' has no option 'alpha'; it has: none"),
        (["-m", "l1", "-O", "alpha=much"], "alpha 'much': must be a number, or 'auto'"),
        (["-m", "ngpt-fast", "-O", "memory=much"], "memory is 'much'; it must be a whole number"),
    ],
)
def test_errors_are_those_of_the_method(source, arguments, message, capfd):
    if "oidn" in arguments and "alpha=1" not in arguments and oidn.missing():
        pytest.skip(oidn.missing())
    assert main(["denoise", source, *arguments]) == 1
    assert message in capfd.readouterr().err


def test_an_option_without_a_value_is_wrong_usage(source, capfd):
    with pytest.raises(SystemExit):
        main(["denoise", source, "-O", "memory"])
    assert "'memory' is not of the form NAME=VALUE" in capfd.readouterr().err
