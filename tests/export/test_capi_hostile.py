"""The C library with networks, sizes, strides and names that lie: one line that says so, and no harm."""

import ctypes
import os
import re

import numpy as np
import pytest
from capi import BAD_ARGUMENT, BAD_NETWORK, FAILED, OK, OUT_OF_MEMORY, Job, Network, example, place, those
from hostile_networks import hostile, network, statistics

pytest.importorskip("onnx")


def job_of(library, path, side=8):
    """A job with random layers; None where the network cannot be opened."""
    opened, rng = Network(library, path), np.random.default_rng(0)
    channels = [library.ngpt_layer_channels(opened.handle, i) for i in range(opened.count())]
    layers = {name: rng.random((side, side, c), np.float32) for name, c in zip(opened.names, channels, strict=True)}
    return opened, Job(opened, layers) if opened.handle else None


def test_networks_that_lie(library, tmp_path):
    _, job = job_of(library, network(tmp_path / "right.onnx"))
    assert job.run() == OK and np.array_equal(job.image, job.layers["primal"])
    for name, path in hostile(tmp_path).items():
        opened, job = job_of(library, path)
        message = opened.message
        if job:
            assert job.run() in (BAD_NETWORK, OUT_OF_MEMORY, FAILED), name
            assert (job.image == -7).all(), name
            message = job.message()
        assert message.startswith(str(path)) and message.isprintable(), (name, message)


@pytest.mark.parametrize(
    "wrong", [{"kind": "UINT8"}, {"kind": "FLOAT16"}, {"count": 4}, {"count": 6}, {"name": "numbers"}], ids=str
)
def test_statistics_that_lie(library, tmp_path, wrong):
    path = network(tmp_path / "network.onnx", metadata={"ngpt.bytes per pixel": "65536"})
    statistics(path, **wrong)
    _, job = job_of(library, path, 40)
    assert job.run(5) == BAD_NETWORK and "statistics" in job.message(), job.message()
    assert job.run() == OK
    statistics(path)
    _, job = job_of(library, path, 40)
    assert job.run(5) == OK and np.array_equal(job.image, job.layers["primal"]), job.message()


@pytest.mark.parametrize("size", [(65536, 65536), (65536, 30000)])
def test_images_that_no_machine_has_room_for(fast, size):
    """They are refused before anything is made: else the system ends the process when pages are written to."""
    if os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") > 2**38:
        pytest.skip("this machine may have room for them")
    job = Job(fast, those(fast, example()))
    for _ in range(2):
        assert job.run(size=size) == OUT_OF_MEMORY
        assert re.search(rf"^{size[0]}x{size[1]} pixels take \d+ MiB .* \d+ MiB are left", job.message())
        assert job.prepare(size=size) == OUT_OF_MEMORY
    assert (job.image == -7).all() and job.run() == OK


PTRDIFF = np.iinfo(np.intp)
STRIDES = [
    (0, 0, PTRDIFF.max),
    (0, 0, PTRDIFF.min),
    (0, PTRDIFF.max, 0),
    (PTRDIFF.min, 0, 0),
    (PTRDIFF.max, PTRDIFF.max, PTRDIFF.max),
    (0, 0, PTRDIFF.max // 22),
]


@pytest.mark.parametrize("name", ["albedo", "image"])
def test_strides_that_lead_out_of_memory(fast, name):
    job = Job(fast, those(fast, example()))
    address, form, channels, *_ = place(job.layers.get(name, job.image))
    function = job.set_output if name == "image" else job.set_layer
    for strides in STRIDES:
        assert function(name, address, form, channels, *strides) == OK
        assert job.run() == BAD_ARGUMENT, strides
        assert job.message() == f"{name}: its strides lead out of memory for 29x23 pixels"
    # Below the first address
    assert job.set_layer("albedo", 4096, 0, 3, 0, 0, -4096) == OK
    assert job.run() == BAD_ARGUMENT and "albedo: its strides" in job.message()


@pytest.mark.parametrize("letter", ["é", "大", "🎨"])
def test_messages_cut_no_letter(library, fast, tmp_path, letter):
    path = tmp_path / (letter * 60) / "none.onnx"
    whole = Network(library, path).message
    assert whole.startswith(str(path)) and len(whole.encode()) <= 400
    for size in range(1, 200):
        message = ctypes.create_string_buffer(b"?" * 300)
        assert library.ngpt_open(str(path).encode(), 1, message, size) is None
        assert whole.startswith(message.value.decode()) and size - 4 <= len(message.value) + 1 <= size
        assert message.raw[size:300] == b"?" * (300 - size)
    job = Job(fast, {"primal": example()["primal"]})
    for shift in range(4):
        name = "x" * shift + letter * 30
        assert job.set_layer(name, None, 0, 3, 0, 0, 0) == BAD_ARGUMENT
        assert name[:5] in job.message()


@pytest.mark.parametrize("where", ["/dev/zero", "../secret", "/etc/passwd"])
def test_weights_outside_of_the_file_are_not_read(library, tmp_path, where):
    """A network may name another file for its weights; such a file may be without an end."""
    from onnx import TensorProto, helper, load

    path = network(tmp_path / "network.onnx")
    model = load(path)
    tensor = TensorProto(name="more", data_type=1, dims=[1], data_location=TensorProto.EXTERNAL)
    tensor.external_data.add(key="location", value=where)
    tensor.external_data.add(key="length", value="4")
    model.graph.node[-1].CopyFrom(helper.make_node("Add", ["same", "more"], ["image"]))
    model.graph.initializer.append(tensor)
    path.write_bytes(model.SerializeToString())
    assert Network(library, path).handle is None
