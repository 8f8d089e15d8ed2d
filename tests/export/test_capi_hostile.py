"""The C library with networks, sizes, strides and names that lie: one line that says so, and no harm."""

import ctypes
import os
import re

import numpy as np
import pytest
from capi import (
    BAD_ARGUMENT,
    BAD_NETWORK,
    FAILED,
    OK,
    OUT_OF_MEMORY,
    PROGRESS,
    Job,
    Network,
    example,
    place,
    those,
)
from hostile_networks import hostile, network, statistics

pytest.importorskip("onnx")


def layers_of(opened, height=8, width=8) -> dict[str, np.ndarray]:
    library, rng = opened.library, np.random.default_rng(0)
    channels = [library.ngpt_layer_channels(opened.handle, i) for i in range(opened.count())]
    return {name: rng.random((height, width, c), np.float32) for name, c in zip(opened.names, channels, strict=True)}


def test_networks_that_lie(library, tmp_path):
    opened = Network(library, network(tmp_path / "right.onnx"))
    job = Job(opened, layers_of(opened))
    assert job.run() == OK and np.array_equal(job.image, job.layers["primal"])
    for name, path in hostile(tmp_path).items():
        opened = Network(library, path)
        if opened.handle is None:
            assert opened.message.startswith(str(path)) and opened.message.isprintable(), (name, opened.message)
            continue
        job = Job(opened, layers_of(opened))
        assert job.run() in (BAD_NETWORK, OUT_OF_MEMORY, FAILED), name
        assert job.message().startswith(str(path)) and job.message().isprintable(), (name, job.message())
        assert (job.image == -7).all(), name
        job.free()
        opened.close()


@pytest.mark.parametrize(
    "wrong", [{"kind": "UINT8"}, {"kind": "FLOAT16"}, {"count": 4}, {"count": 6}, {"name": "numbers"}], ids=str
)
def test_statistics_that_lie(library, tmp_path, wrong):
    path = network(tmp_path / "network.onnx", metadata={"ngpt.bytes per pixel": "65536"})
    statistics(path, **wrong)
    opened = Network(library, path)
    job = Job(opened, layers_of(opened, 40, 40))
    assert job.run(5) == BAD_NETWORK and "statistics" in job.message(), job.message()
    assert job.run() == OK
    statistics(path)
    opened = Network(library, path)
    job = Job(opened, layers_of(opened, 40, 40))
    assert job.run(5) == OK and np.array_equal(job.image, job.layers["primal"]), job.message()


@pytest.mark.parametrize("size", [(65536, 65536), (65536, 30000)])
def test_images_that_no_machine_has_room_for(library, fast, size):
    """They are refused before anything is made: else the system ends the process when pages are written to."""
    if os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") > 2**38:
        pytest.skip("this machine may have room for them")
    job = Job(fast, those(fast, example()))
    for _ in range(2):
        assert library.ngpt_run(job.handle, *size, 0, PROGRESS(), None) == OUT_OF_MEMORY
        assert re.search(rf"^{size[0]}x{size[1]} pixels take \d+ MiB .* \d+ MiB are left", job.message())
        assert library.ngpt_prepare(job.handle, *size, PROGRESS(), None) == OUT_OF_MEMORY
    assert (job.image == -7).all() and job.run() == OK
    job.free()


PTRDIFF = np.iinfo(np.intp)
STRIDES = [
    (0, 0, PTRDIFF.max),
    (0, 0, PTRDIFF.min),
    (0, PTRDIFF.max, 0),
    (PTRDIFF.min, 0, 0),
    (PTRDIFF.max, PTRDIFF.max, PTRDIFF.max),
    (0, 0, PTRDIFF.max // 22),
    (0, 2**60, 2**58),
]


@pytest.mark.parametrize("strides", STRIDES, ids=str)
@pytest.mark.parametrize("kind", ["layer", "output"])
def test_strides_that_lead_out_of_memory(library, fast, strides, kind):
    job = Job(fast, those(fast, example()))
    address, form, channels, *_ = place(job.image if kind == "output" else job.layers["albedo"])
    name = b"image" if kind == "output" else b"albedo"
    function = getattr(library, f"ngpt_set_{kind}")
    assert function(job.handle, name, address, form, channels, *strides) == OK
    assert job.run() == BAD_ARGUMENT
    assert job.message() == f"{name.decode()}: its strides lead out of memory for 29x23 pixels"
    assert function(job.handle, name, address, form, 2**31 - 1, 0, 0, 0) == BAD_ARGUMENT
    assert "65536 at most" in job.message()
    job.free()


@pytest.mark.parametrize("letter", ["é", "大", "🎨"])
def test_messages_cut_no_letter(library, fast, tmp_path, letter):
    path = tmp_path / (letter * 60) / "none.onnx"
    whole = Network(library, path).message
    assert whole.startswith(str(path)) and len(whole.encode()) <= 400
    for size in range(1, 200):
        message = ctypes.create_string_buffer(b"?" * 300)
        assert library.ngpt_open(str(path).encode(), 1, message, size) is None
        assert whole.startswith(message.value.decode()) and size - 4 <= len(message.value) + 1 <= size
    job = Job(fast, {"primal": example()["primal"]})
    for shift in range(4):
        name = "x" * shift + letter * 30
        assert library.ngpt_set_layer(job.handle, name.encode(), None, 0, 3, 0, 0, 0) == BAD_ARGUMENT
        assert name[:5] in job.message()
    job.free()


def test_devices(library, fast):
    assert Network(library, device="gpu").message.startswith("device 'gpu': no, this ONNX Runtime has: cpu")
    assert Network(library, device="").message.startswith("device '': no, ")
    opened = Network(library, device="cpu")
    assert opened.handle and opened.names == fast.names
    opened.close()
    import onnxruntime

    for name, provider in (("cuda", "CUDAExecutionProvider"), ("tensorrt", "TensorrtExecutionProvider")):
        if provider not in onnxruntime.get_available_providers():
            assert Network(library, device=name).message.startswith(f"device '{name}': no, this ONNX Runtime has: cpu")


def test_weights_outside_of_the_file_are_not_read(library, tmp_path):
    """A network may name another file for its weights; such a file may be without an end."""
    from onnx import TensorProto, helper, load

    path = network(tmp_path / "network.onnx")
    model = load(path)
    for where in ("/dev/zero", "../secret", "/etc/passwd"):
        tensor = TensorProto(name="more", data_type=1, dims=[1], data_location=TensorProto.EXTERNAL)
        tensor.external_data.add(key="location", value=where)
        tensor.external_data.add(key="length", value="4")
        del model.graph.node[3:]
        model.graph.node.append(helper.make_node("Add", ["same", "more"], ["image"]))
        del model.graph.initializer[1:]
        model.graph.initializer.append(tensor)
        path.write_bytes(model.SerializeToString())
        assert Network(library, path).handle is None


def test_pixels_below_the_first_address(library, fast):
    job = Job(fast, those(fast, example()))
    assert library.ngpt_set_layer(job.handle, b"albedo", 4096, 0, 3, 0, 0, -4096) == OK
    assert job.run() == BAD_ARGUMENT and "albedo: its strides" in job.message()
    job.free()
