"""The C library says what is wrong, and ends when it is told to; threads share its networks."""

import ctypes
import re
import shutil
import threading

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

# --- what is wrong ---------------------------------------------------------------------------------------------------


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
    assert library.ngpt_set_layer(None, b"primal", None, 0, 3, 0, 0, 0) == BAD_ARGUMENT
    assert library.ngpt_set_output(None, b"image", None, 0, 3, 0, 0, 0) == BAD_ARGUMENT
    assert library.ngpt_run(None, 1, 1, 0, PROGRESS(), None) == BAD_ARGUMENT
    job = library.ngpt_job_new(fast.handle)
    assert library.ngpt_set_layer(job, None, message, 0, 3, 0, 0, 0) == BAD_ARGUMENT
    assert library.ngpt_set_output(job, None, message, 0, 3, 0, 0, 0) == BAD_ARGUMENT
    assert library.ngpt_prepare(None, 1, 1, PROGRESS(), None) == BAD_ARGUMENT
    library.ngpt_job_free(job)


def test_the_network_is_described(library, fast, primal):
    assert fast.names[:10] == [
        "primal",
        "direct",
        "dx",
        "dy",
        "albedo",
        "normal",
        "depth",
        "primal_var",
        "dx_var",
        "dy_var",
    ]
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


def refused(status, expected, job, words):
    assert status == expected, job.message()
    assert re.search(words, job.message()) and "\n" not in job.message()
    assert (job.image == -7).all()


def test_what_a_job_refuses(library, fast):
    layers = those(fast, example())
    job, primal = Job(fast, layers), place(layers["primal"])
    handle = job.handle
    refused(library.ngpt_set_layer(handle, b"beauty", *primal), BAD_ARGUMENT, job, "'beauty'; it reads primal, d")
    refused(library.ngpt_set_output(handle, b"oidn", *primal), BAD_ARGUMENT, job, "no 'oidn'; it makes image$")
    refused(library.ngpt_set_layer(handle, b"x" * 9999, *primal), BAD_ARGUMENT, job, "xxx")
    refused(library.ngpt_set_layer(handle, b"statistics", *primal), BAD_ARGUMENT, job, "statistics")
    refused(
        library.ngpt_set_layer(handle, b"albedo", *place(layers["depth"])), BAD_ARGUMENT, job, "albedo: has 1 .* have 3"
    )
    refused(library.ngpt_set_layer(handle, b"albedo", primal[0], 5, *primal[2:]), BAD_ARGUMENT, job, "format is 5")
    refused(library.ngpt_set_output(handle, b"image", primal[0], 0, 2, 0, 0, 0), BAD_ARGUMENT, job, "image: has 2")
    for size in ((0, 5), (5, -1), (65537, 1)):
        refused(
            library.ngpt_run(handle, *size, 0, PROGRESS(), None), BAD_ARGUMENT, job, f"{size[0]}x{size[1]} .* 65536"
        )
    refused(library.ngpt_run(handle, 29, 23, -3, PROGRESS(), None), BAD_ARGUMENT, job, "-3 MiB")
    assert job.run() == OK and job.message() == ""
    job.free()


def test_what_is_missing(library, fast):
    layers = those(fast, example())
    job = Job(fast, {name: layer for name, layer in layers.items() if name not in ("dx", "depth")})
    refused(job.run(), MISSING_LAYER, job, "needs the layers dx, depth")
    job.free()
    job = Job(fast, layers)
    assert library.ngpt_set_output(job.handle, b"image", None, 0, 3, 0, 0, 0) == OK
    refused(job.run(), MISSING_LAYER, job, "'image' is not set")
    job.free()


def test_damaged_networks(library, tmp_path):
    data = FAST.read_bytes()
    wrong = {
        "none": None,
        "empty": b"",
        "text": b"not a network",
        "cut": data[: len(data) // 2],
        "head": data[:100],
        "statistics": FAST.with_suffix(".statistics.onnx").read_bytes(),
        "alignment": data.replace(b"ngpt.alignment\x12\x0216", b"ngpt.alignment\x12\x02-8"),
        "layers": data.replace(b"dx, dy, albedo", b"dx, dy, albino"),
        "fewer": data.replace(b", depth, primal_var", b", dx_var, dy_var  "),
        "metadata": data.replace(b"ngpt.inputs", b"ngpt.outputs"[:11]),
    }
    for name, content in wrong.items():
        path = tmp_path / f"{name}.onnx"
        if content is not None:
            path.write_bytes(content)
        network = Network(library, path)
        assert network.handle is None and network.message.startswith(str(path)), (name, network.message)
        assert "\n" not in network.message
    rng = np.random.default_rng(5)
    for _ in range(20):
        bytes_ = np.frombuffer(data, np.uint8).copy()
        bytes_[rng.integers(0, len(data), 50)] = rng.integers(0, 256, 50)
        (tmp_path / "mutant.onnx").write_bytes(bytes_.tobytes())
        network = Network(library, tmp_path / "mutant.onnx")
        assert (network.handle is None) == bool(network.message)
        network.close()
    assert Network(library, FAST, threads=-1).message == "the number of threads is -1; it must be 0 to 1024"


def test_tiles_need_the_statistics(library, tmp_path):
    alone = tmp_path / "ngpt-fast.onnx"
    shutil.copy(FAST, alone)
    network = Network(library, alone)
    job = Job(network, those(network, example(23, 700)))
    refused(job.run(30), BAD_NETWORK, job, "ngpt-fast.statistics.onnx: cannot be read.* tiles .*need it")
    assert job.run() == OK
    job.free()
    network.close()
    other = WEIGHTS / "ngpt-fast.statistics.onnx"
    shutil.copy(PRIMAL, tmp_path / "other.onnx")
    shutil.copy(other, tmp_path / "other.statistics.onnx")
    network = Network(library, tmp_path / "other.onnx")
    job = Job(network, those(network, example(400, 900)))
    refused(job.run(30), BAD_NETWORK, job, "belongs to another network, it reads dx")
    job.free()
    network.close()


def test_paths_of_any_letters(library, tmp_path):
    folder = tmp_path / "Größe 大"
    folder.mkdir()
    shutil.copy(PRIMAL, folder / "network")
    network = Network(library, folder / "network")
    assert network.handle, network.message
    network.close()


# --- progress, threads, time -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("after", [0, 1, 2, 3])
def test_cancelled_after_so_many_tiles(fast, after):
    job, fractions = Job(fast, those(fast, example(23, 700))), []

    def progress(fraction):
        fractions.append(fraction)
        return len(set(fractions)) > after

    refused(job.run(30, progress), CANCELLED, job, "^cancelled$")
    assert fractions == sorted(fractions) and len(set(fractions)) == after + 1
    assert job.run(30) == OK and (job.image != -7).any()
    job.free()


def test_threads_share_a_network(fast):
    inputs = [those(fast, example(40 + 3 * i, 90)) for i in range(4)]
    expected, wrong = [result(fast, layers) for layers in inputs], []

    def work(layers, image):
        for _ in range(5):
            if not np.array_equal(result(fast, layers), image):
                wrong.append(layers)

    threads = [threading.Thread(target=work, args=pair) for pair in zip(inputs, expected, strict=True)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert not wrong


def test_a_job_outlives_its_network(library):
    network = Network(library, PRIMAL)
    job = Job(network, those(network, example()))
    network.close()
    assert job.run() == OK and (job.image != -7).any()
    job.free()


def test_messages_fit_where_they_go(library, tmp_path):
    for size in (0, 1, 2, 20):
        message = ctypes.create_string_buffer(b"?" * 30)
        assert library.ngpt_open(str(tmp_path / "none.onnx").encode(), 0, message, size) is None
        assert message.raw[max(size - 1, 0) : size] == b"\0" * min(size, 1) and message.raw[size:30] == b"?" * (
            30 - size
        )
