"""Everything public can be pickled and copied: for pools of processes, Dask, and objects that hold ours."""

import copy
import pickle

import numpy as np
import pytest
from full_stack import full_stack

import ngpt
from ngpt.errors import WrongUse

WAYS = {"pickle": lambda thing: pickle.loads(pickle.dumps(thing)), "copy": copy.copy, "deepcopy": copy.deepcopy}
each_way = pytest.mark.parametrize("again", WAYS.values(), ids=WAYS)


@pytest.fixture
def stack():
    return full_stack(24, 32).replace(motion=np.zeros((24, 32, 2)))


@each_way
@pytest.mark.parametrize("name", ngpt.__all__)
def test_every_public_name(name, again):
    thing = getattr(ngpt, name)
    assert again(thing) is thing or (name == "METHODS" and list(again(thing)) == list(thing))


@each_way
@pytest.mark.parametrize("name", ["l1", "ngpt-fast"])
def test_results_tell_the_same(stack, name, again):
    result = ngpt.reconstruct(stack, name)
    found = again(result)
    assert np.array_equal(found.image, result.image) and found.attributes == result.attributes


@each_way
@pytest.mark.parametrize("kind", ["Denoiser", "Temporal"])
def test_what_goes_on_over_time_goes_on_the_same(stack, kind, again):
    """From the frame where it was copied; the copy and the original do not disturb each other."""
    thing = ngpt.Temporal() if kind == "Temporal" else ngpt.Denoiser((32, 24), temporal=True)

    def step(it):
        if kind == "Temporal":
            return it.next(stack, stack["primal"])
        return it(stack["primal"], flow=stack["motion"])

    step(thing)
    if again is copy.copy and kind == "Denoiser":
        assert again(thing)._temporal is thing._temporal  # shallow, as copies are
        return
    other = again(thing)
    assert np.array_equal(step(other), step(thing))


@each_way
@pytest.mark.parametrize("error", [ngpt.NgptError("a: no"), WrongUse("b: no")], ids=repr)
def test_errors_say_the_same(error, again):
    assert type(again(error)) is type(error) and str(again(error)) == str(error)


@each_way
def test_a_stack_from_a_file_is_written_as_it_was(tmp_path, stack, again):
    ngpt.write(tmp_path / "in.exr", stack)
    held = ngpt.read(tmp_path / "in.exr")
    for name, one in (("a.exr", held), ("b.exr", again(held))):
        ngpt.write(tmp_path / name, one)
    assert (tmp_path / "a.exr").read_bytes() == (tmp_path / "b.exr").read_bytes()
