"""No file that ngpt reads can run code: nothing in the project unpickles or evaluates, and hostile files show it."""

import ast
import os
import pickle
import re
import struct
import sys
import zipfile

import numpy as np
import pytest
from full_stack import full_stack
from hostile_networks import network
from processes import ENVIRONMENT, ROOT, complete

import ngpt
from ngpt.errors import NgptError
from ngpt.network.shipped import WEIGHTS

ROOMS = ("ngpt", "data_gen", "export", "bench", "scripts")
SOURCES = [ROOT / "train.py", ROOT / "eval.py", *(path for room in ROOMS for path in (ROOT / room).rglob("*.py"))]
MODULES = {"pickle", "cPickle", "_pickle", "dill", "cloudpickle", "joblib", "shelve", "marshal", "yaml", "pickletools"}
# Names called on anything, whatever it was imported as.
CALLS = {"torch.load", "torch.jit.load", "torch.export.load", "torch.package", "torch.hub.load"}
CALLS |= {"hub.load_state_dict_from_url", "np.load", "numpy.load", "pd.read_pickle"}
CALLS |= {"eval", "exec", "compile", "__import__"}
# The one exception: a file whose checksum is torchvision's own, by the reader that takes nothing but tensors.
ALLOWED = {("ngpt/measure/distances/backbones.py", "torch.load")}


def offences(source, name):
    """Places in a program that could turn a file into code, as "line: what"."""
    for node in ast.walk(ast.parse(source)):
        names = []
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            names = [node.module or "", *(f"{node.module}.{alias.name}" for alias in node.names)]
        yield from (f"{node.lineno}: import {n}" for n in names if n.split(".")[0] in MODULES or n in CALLS)
        if not isinstance(node, ast.Call):
            continue
        called = ast.unparse(node.func)
        options = {word.arg: word.value for word in node.keywords}
        if "allow_pickle" in options:
            yield f"{node.lineno}: allow_pickle"
        tensors_only = isinstance(options.get("weights_only"), ast.Constant) and options["weights_only"].value is True
        if called in CALLS and not ((name, called) in ALLOWED and tensors_only):
            yield f"{node.lineno}: {called}"


def test_nothing_in_the_project_unpickles_or_evaluates():
    assert len(SOURCES) > 100
    texts = {path.relative_to(ROOT).as_posix(): path.read_text() for path in SOURCES}
    # Only what has one of the words is taken apart.
    words = {call.split(".")[-1] for call in CALLS} | MODULES | {"allow_pickle", "hub"}
    named = re.compile(rf"\b(?:{'|'.join(words)})\b")
    found = {name: list(offences(text, name)) for name, text in texts.items() if named.search(text)}
    assert {name: places for name, places in found.items() if places} == {}


class Payload:
    def __reduce__(self):
        return (os.mkdir, (os.environ["NGPT_PAYLOAD"],))


def hostile(folder):
    """Pickles under every name that is read, plain, zipped as PyTorch does it, and inside of arrays."""
    data = pickle.dumps({"x": Payload()})
    (folder / "set" / "shards").mkdir(parents=True)
    np.save(folder / "array.npy", np.array([Payload()], object), allow_pickle=True)
    contents = dict.fromkeys(("a.exr", "a.safetensors", "a.onnx", "a.toml", "a.pth", "set/manifest.json"), data)
    contents["magic.exr"] = b"\x76\x2f\x31\x01" + data
    contents["length.safetensors"] = struct.pack("<Q", len(data)) + data
    contents["npy.exr"] = (folder / "array.npy").read_bytes()
    contents["set/shards/a.safetensors"] = data
    for name, content in contents.items():
        (folder / name).write_bytes(content)
    with zipfile.ZipFile(folder / "zip.safetensors", "w") as archive:
        archive.writestr("archive/data.pkl", data)
        archive.writestr("archive/version", "3")
    return sorted(path for path in folder.rglob("*") if path.is_file() and path.suffix not in (".npy", ".json"))


READ_ALL = """
import sys
from pathlib import Path
seen = []
def hook(event, arguments):
    if event in ("pickle.find_class", "os.system", "os.exec", "os.mkdir") and armed:
        seen.append((event, arguments))
armed = False
sys.addaudithook(hook)
import ngpt, ngpt.io.isolated
from full_stack import full_stack
from data_gen.dataset.config import read_config
from ngpt.training.dataset import Dataset
from ngpt.training.loss import make_loss
from ngpt.training.settings import read_settings
from ngpt.network.safetensors import load_weights, read_tensors
from ngpt.training.shards import Shard
stack = full_stack(8, 8)
readers = {
    "read": ngpt.read, "read_image": ngpt.read_image, "Shard": Shard, "weights": load_weights,
    "tensors": read_tensors, "settings": read_settings, "config": read_config,
    "Dataset": lambda path: Dataset(path.parent.parent if path.parent.name == "shards" else path.parent),
    "denoise": lambda path: ngpt.denoise(stack, "ngpt", weights=str(path)),
    "loss": lambda path: make_loss({"kind": "elpips-squeeze", "backbone": str(path), "weights": str(path)}),
}
armed = True
for path in map(Path, sys.argv[1:]):
    for name, reader in readers.items():
        try:
            reader(path)
        except ngpt.NgptError as error:
            assert str(error), (name, path)
        else:
            raise SystemExit(f"{name} accepts {path}")
print(len(sys.argv) - 1, seen)
"""


def test_hostile_files_run_nothing(tmp_path, monkeypatch):
    """Every reader on every file, watched by Python's audit hooks: no class is looked up for a pickle, nothing runs."""
    pytest.importorskip("torch")
    marker = tmp_path / "code was run"
    monkeypatch.setenv("NGPT_PAYLOAD", str(marker))
    files = hostile(tmp_path / "in")
    path = os.pathsep.join([str(ROOT), str(ROOT / "tests")])
    known = ENVIRONMENT | {"PYTHONPATH": path, "NGPT_PAYLOAD": str(marker)}
    done = complete([sys.executable, "-c", READ_ALL, *files], env=known)
    assert done.returncode == 0, done.stderr[-2000:]
    assert done.stdout.splitlines()[-1] == f"{len(files)} []" and not marker.exists()
    pickle.loads((tmp_path / "in" / "a.exr").read_bytes())
    assert marker.exists(), "the payload works"


# --- ONNX files that users give --------------------------------------------------------------------------------------


def refused(path, message):
    with pytest.raises(NgptError, match=rf"a\.onnx: {message}"):
        ngpt.denoise(full_stack(8, 8), "ngpt-fast", weights=str(path))


@pytest.mark.parametrize("location", ["{parent}/secret.bin", "../secret.bin", "link.bin", "missing.bin"])
def test_networks_that_refer_to_other_files_are_refused(tmp_path, location):
    """With the largest tensor there."""
    model = pytest.importorskip("onnx").load(WEIGHTS / "ngpt-fast.onnx")
    folder = tmp_path / "in"
    folder.mkdir()
    tensor = max(model.graph.initializer, key=lambda t: len(t.raw_data))
    (tmp_path / "secret.bin").write_bytes(tensor.raw_data)
    (folder / "link.bin").symlink_to("../secret.bin")
    place = {"location": location.format(parent=tmp_path), "offset": "0", "length": str(len(tensor.raw_data))}
    tensor.ClearField("raw_data")
    tensor.data_location = tensor.EXTERNAL
    for key, value in place.items():
        tensor.external_data.add(key=key, value=value)
    (folder / "a.onnx").write_bytes(model.SerializeToString())
    refused(folder / "a.onnx", "ONNX Runtime cannot load it")


@pytest.mark.parametrize(
    ("key", "value", "message"),
    [
        ("ngpt.alignment", "0", "its alignment is 0"),
        ("ngpt.alignment", "-8", "its alignment is -8"),
        ("ngpt.overlap with base", "1000000000", "its overlap is 1000000000"),
        ("ngpt.bytes per pixel", "0", "0 bytes per pixel"),
        ("ngpt.base", "../x", r"base '\.\./x'"),
        ("ngpt.inputs", "primal, secret", "but its metadata list base, primal, secret, statistics"),
        ("ngpt.alignment", "many", "lacks the metadata"),
        ("ngpt.optional", "direct, albedo", "this network reads only colour, as in earlier versions"),
        ("ngpt.emission", "true", "this network reads only colour, as in earlier versions"),
    ],
)
def test_networks_whose_metadata_lie_are_refused(tmp_path, key, value, message):
    pytest.importorskip("onnx")
    refused(network(tmp_path / "a.onnx", metadata={"ngpt.base": "wcv", key: value}), f".*{message}")
