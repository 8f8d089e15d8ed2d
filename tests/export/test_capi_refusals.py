"""The C library says what is wrong, and ends when it is told to; threads share its networks."""

import ctypes
import re
import shutil
from concurrent.futures import ThreadPoolExecutor
from functools import partial

import numpy as np
import pytest
from capi import (
    BAD_ARGUMENT,
    BAD_NETWORK,
    CANCELLED,
    FAST,
    HEADER,
    MISSING_LAYER,
    OK,
    PRIMAL,
    PROGRESS,
    WEIGHTS,
    Job,
    Network,
    example,
    place,
    result,
    those,
)

import ngpt


def test_null_everywhere(library, fast):
    message = ctypes.create_string_buffer(64)
    assert library.ngpt_open(None, 0, message, 64) is None and b"NULL" in message.value
    assert library.ngpt_open(None, 0, None, 0) is None
    library.ngpt_close(None)
    library.ngpt_job_free(None)
    assert library.ngpt_layer_count(None) == 0 and library.ngpt_layer_name(None, 0) is None
    assert library.ngpt_layer_channels(None, 0) == 0 and library.ngpt_layer_required(None, 0) == 0
    assert library.ngpt_metadata(None, b"ngpt.method") is None and library.ngpt_metadata(fast.handle, None) is None
    assert library.ngpt_job_new(None) is None and library.ngpt_message(None)
    job = Job(fast, those(fast, example()))
    for handle, name in ((None, b"primal"), (job.handle, None)):
        assert library.ngpt_set_layer(handle, name, message, 0, 3, 0, 0, 0) == BAD_ARGUMENT
        assert library.ngpt_set_output(handle, name, message, 0, 3, 0, 0, 0) == BAD_ARGUMENT
    assert library.ngpt_run(None, 1, 1, 0, PROGRESS(), None) == BAD_ARGUMENT
    assert library.ngpt_prepare(None, 1, 1, PROGRESS(), None) == BAD_ARGUMENT


def test_the_network_is_described(library, fast, primal):
    assert " ".join(fast.names[:10]) == "primal direct dx dy albedo normal depth primal_var dx_var dy_var"
    about = {
        name: (library.ngpt_layer_channels(fast.handle, i), library.ngpt_layer_required(fast.handle, i))
        for i, name in enumerate(fast.names)
    }
    assert about["primal"] == about["normal"] == (3, 1) and about["depth"] == (1, 1)
    assert about["direct"] == about["dx_var"] == about["base"] == (3, 0)
    assert primal.names[:2] == ["primal", "direct"] and "dx" not in primal.names
    for index in (-1, fast.count()):
        assert library.ngpt_layer_name(fast.handle, index) is None
        assert library.ngpt_layer_channels(fast.handle, index) == library.ngpt_layer_required(fast.handle, index) == 0
    assert library.ngpt_metadata(fast.handle, b"ngpt.method") == b"ngpt-fast"
    assert library.ngpt_metadata(fast.handle, b"no such key") is None
    assert library.ngpt_version().decode() == ngpt.__version__
    assert library.ngpt_abi() == int(re.search(r"define NGPT_ABI (\d+)", HEADER.read_text())[1])


RGB, GREY = (place(np.zeros((23, 29, channels), np.float32)) for channels in (3, 1))
NOWHERE = (None, 0, 3, 0, 0, 0)
# Calls of a job, of which the last is refused -> words
REFUSALS = [
    ([("set_layer", "beauty", *RGB)], "'beauty'; it reads primal, d"),
    ([("set_layer", "x" * 9999, *RGB)], "xxx"),
    ([("set_layer", "statistics", *RGB)], "statistics"),
    ([("set_layer", "albedo", *GREY)], "albedo: has 1 .* have 3"),
    ([("set_layer", "albedo", RGB[0], 0, 2**31 - 1, 0, 0, 0)], "65536 at most"),
    ([("set_layer", "albedo", RGB[0], 5, *RGB[2:])], "format is 5"),
    ([("set_output", "oidn", *RGB)], "no 'oidn'; it makes image$"),
    ([("set_output", "image", RGB[0], 0, 2, 0, 0, 0)], "image: has 2"),
    ([("run", 0, None, (0, 5))], "0x5 .* 65536"),
    ([("run", 0, None, (5, -1))], "5x-1 .* 65536"),
    ([("prepare", (65537, 1))], "65537x1 .* 65536"),
    ([("run", -3)], "-3 MiB"),
    ([("set_layer", "dx", *NOWHERE), ("set_layer", "depth", *NOWHERE), ("run",)], "needs the layers dx, depth"),
    ([("set_output", "image", *NOWHERE), ("run",)], "'image' is not set"),
]


def refused(status, expected, job, words):
    assert status == expected, job.message()
    assert re.search(words, job.message()) and "\n" not in job.message()
    assert (job.image == -7).all()


def test_what_a_job_refuses(fast):
    job = Job(fast, those(fast, example()))
    for calls, words in REFUSALS:
        for name, *arguments in calls:
            status = getattr(job, name)(*arguments)
        refused(status, BAD_ARGUMENT if len(calls) == 1 else MISSING_LAYER, job, words)
        job.set(job.layers)
    assert job.run() == OK and job.message() == ""


def test_tiles_need_the_statistics_of_their_network(library, tmp_path):
    alone = tmp_path / "ngpt-fast.onnx"
    shutil.copy(FAST, alone)
    network = Network(library, alone)
    job = Job(network, those(network, example(23, 700)))
    refused(job.run(30), BAD_NETWORK, job, "ngpt-fast.statistics.onnx: cannot be read.* tiles .*need it")
    assert job.run() == OK
    shutil.copy(PRIMAL, tmp_path / "other.onnx")
    shutil.copy(WEIGHTS / "ngpt-fast.statistics.onnx", tmp_path / "other.statistics.onnx")
    network = Network(library, tmp_path / "other.onnx")
    job = Job(network, those(network, example(400, 900)))
    refused(job.run(30), BAD_NETWORK, job, "belongs to another network, it reads dx")


def test_devices_and_threads(library, fast):
    assert Network(library, FAST, threads=-1).message == "the number of threads is -1; it must be 0 to 1024"
    assert Network(library, device="gpu").message.startswith("device 'gpu': no, this ONNX Runtime has: cpu")
    assert Network(library, device="").message.startswith("device '': no, ")
    assert Network(library, device="cpu").names == fast.names


# --- progress, threads, life -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("after", [0, 1, 3])
def test_cancelled_after_so_many_tiles(fast, after):
    job, fractions = Job(fast, those(fast, example(23, 700))), []

    def progress(fraction):
        fractions.append(fraction)
        return len(set(fractions)) > after

    refused(job.run(30, progress), CANCELLED, job, "^cancelled$")
    assert fractions == sorted(fractions) and len(set(fractions)) == after + 1
    assert job.run(30) == OK and (job.image != -7).any()


def test_threads_share_a_network(fast):
    inputs = [those(fast, example(40 + 3 * i, 90)) for i in range(4)]
    expected = [result(fast, layers) for layers in inputs]
    with ThreadPoolExecutor(4) as pool:
        found = list(pool.map(partial(result, fast), 5 * inputs))
    assert all(map(np.array_equal, found, 5 * expected))


def test_a_job_outlives_its_network(library, tmp_path):
    path = tmp_path / "Größe 大"
    shutil.copy(PRIMAL, path)
    network = Network(library, path)
    job = Job(network, those(network, example()))
    network.close()
    assert job.run() == OK and (job.image != -7).any()
