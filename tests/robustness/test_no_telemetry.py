"""What SECURITY.md promises: nothing is kept in a user's home, and nothing sent, by the libraries that we load."""

import json
import os
import re
import shutil
import sys

import numpy as np
import pytest
from processes import NGPT, ROOT, complete

import ngpt

pytest.importorskip("onnxruntime")

SWITCH = "ORT_DISABLE_TELEMETRY"
DENOISE = """
import numpy as np
import ngpt
from ngpt.stack import GradientStack

image = np.random.default_rng(0).random((16, 24, 3), np.float32)
layers = {name: image for name in ("primal", "dx", "dy", "albedo", "normal")} | {"depth": image[..., :1]}
ngpt.reconstruct(GradientStack(layers), "ngpt-fast")
"""
DATA = "seed = 1\nsize = 32\ninputs = 2\nspp = [2, 4]\nscenes = 2\ncrops = 1\ncrops_per_shard = 1\nreference_spp = 4\n"
CELLS = (
    'scenes = ["diffuse"]\nsize = [24, 16]\nspp = [4]\nseeds = 1\nmethods = ["l2", "ngpt-fast"]\nreference_spp = 16\n'
)
FEW = ["--set", "run.steps=2", "--set", "run.batch=1", "--set", "data.crop=32"]

# Of strace's lines: calls that make or change the file that they name last, and addresses, IPv4 and IPv6.
CALLS = "%network,open,openat,creat,mkdir,mkdirat,rename,renameat,renameat2,link,linkat,symlink,symlinkat"
MADE = re.compile(r"\b(?:creat|mkdir\w*|rename\w*|(?:sym)?link(?:at)?)\(|\bopen(?:at)?\(.*\bO_(?:WRONLY|RDWR|CREAT)\b")
ADDRESS = re.compile(r'(?:inet_addr\(|inet_pton\(AF_INET6, )"([^"]+)"')


class Place:
    """A machine on which nobody has worked: ``home``, ``tmp`` and ``work``, and no word of the switch."""

    def __init__(self, folder, **more):
        self.folder, self.home, self.work = folder, folder / "home", folder / "work"
        for name in ("home", "tmp", "work"):
            (folder / name).mkdir(parents=True)
        known = {name: value for name, value in os.environ.items() if name != SWITCH and not name.startswith("XDG_")}
        self.environment = known | {"HOME": str(self.home), "USERPROFILE": str(self.home), **more}
        self.environment |= {"TMPDIR": str(folder / "tmp"), "PYTHONPATH": str(ROOT), "PYTHONDONTWRITEBYTECODE": "1"}

    def run(self, *command):
        done = complete(command, cwd=self.work, env=self.environment, timeout=600)
        assert done.returncode == 0, done.stderr[-2000:]
        return done

    def left_in_home(self, code) -> list[str]:
        self.run(sys.executable, "-c", code)
        return [str(path) for path in self.home.rglob("*") if path.is_file()]

    def traced(self, *command) -> tuple[set[str], set[str]]:
        """The files that a command and its children made or wrote, and what they spoke to beyond this machine."""
        if shutil.which("strace") is None:
            pytest.skip("strace is not installed")
        record = self.folder / "strace.txt"
        if "trace" in complete(["strace", "-o", record, "true"]).stderr:
            pytest.skip("strace may not trace here")
        self.run("strace", "-f", "-qq", "-s", "4096", "-e", f"trace={CALLS}", "-o", record, *command)
        lines = record.read_text(errors="replace").splitlines()
        made = [line for line in lines if MADE.search(line) and not re.search(r"= -1 E", line)]
        files = {os.path.normpath(self.work / re.findall(r'"((?:[^"\\]|\\.)*)"', line)[-1]) for line in made}
        said = [line for line in lines if re.search(r"\b(?:connect|sendto|sendm?msg)\(", line)]
        spoken_to = {address for line in said for address in ADDRESS.findall(line)}
        return files, {address for address in spoken_to if not re.fullmatch(r"127\..*|::1|::ffff:127\..*", address)}

    def outside(self, files) -> list[str]:
        """Files elsewhere than where it works, in the folder for temporary files, and in Dr.Jit's cache."""
        own = [str(self.folder / name) for name in ("work", "tmp", "home/.drjit")]
        own += ["/dev/null", "/dev/shm", "/dev/tty", "/proc"]
        return sorted(path for path in files if not path.startswith(tuple(own)))


def test_denoising_leaves_nothing_in_a_home(tmp_path):
    assert Place(tmp_path).left_in_home(DENOISE) == []


def test_the_library_would_leave_something_without_the_switch(tmp_path):
    """Otherwise the test above could not fail."""
    load = "import onnxruntime"
    assert Place(tmp_path / "off", **{SWITCH: "1"}).left_in_home(load) == [], "the switch works in this version"
    if not Place(tmp_path / "on").left_in_home(load):
        pytest.skip("this build of ONNX Runtime sends no telemetry")


def test_denoise_writes_its_result_and_speaks_to_nobody(tmp_path, rng):
    place = Place(tmp_path)
    layers = {name: rng.gamma(1.0, 1.0, (16, 24, 3)) for name in ("primal", "dx", "dy", "albedo", "normal")}
    ngpt.write(place.work / "noisy.exr", ngpt.GradientStack.from_arrays(**layers, depth=np.ones((16, 24))))
    files, spoken_to = place.traced(*NGPT, "denoise", "noisy.exr", "-o", "clean.exr", "-m", "ngpt-fast")
    assert str(place.work / "clean.exr") in files
    assert place.outside(files) == [] and spoken_to == set() and list(place.home.iterdir()) == []


@pytest.mark.slow
def test_making_data_training_and_evaluating_write_where_they_should_and_speak_to_nobody(renderer, tmp_path):
    """Dr.Jit keeps compiled kernels in ~/.drjit; nothing else is in a home after it all."""
    pytest.importorskip("torch")
    place = Place(tmp_path)
    (place.work / "data.toml").write_text(DATA)
    (place.work / "cells.toml").write_text(CELLS)
    for arguments in (
        ["dataset", "--config", "data.toml", "--out", "data"],
        ["train", "--config", "tiny", "--out", "run", *FEW],
        ["export", "--weights", "run/weights.safetensors", "-o", "own.onnx", "--vector", "vector"],
        ["evaluate", "--config", "cells.toml", "--out", "cells"],
    ):
        files, spoken_to = place.traced(*NGPT, *arguments)
        assert place.outside(files) == [] and spoken_to == set(), arguments
    assert [path.name for path in place.home.iterdir()] == [".drjit"]


@pytest.mark.slow
def test_a_long_program_asks_for_no_address(tmp_path):
    """Without the switch, the library sends events after a minute, and asks for the address of its maker."""
    assert Place(tmp_path).traced(sys.executable, "-c", f"{DENOISE}\nimport time; time.sleep(80)")[1] == set()


def test_the_runtime_is_loaded_in_one_place_and_examples_turn_it_off():
    loads = re.compile(r"^\s*(?:import|from) .*\bonnxruntime\b", re.M)
    rooms = [ROOT / room for room in ("ngpt", "data_gen", "export", "bench", "scripts")]
    files = [file for room in rooms for file in room.rglob("*.py") if "node_modules" not in file.parts]
    assert [file.name for file in files if loads.search(file.read_text())] == ["run_onnx.py"]
    examples = {page: page.read_text() for page in (*ROOT.glob("docs/[!l]*/*.md"), *ROOT.glob("export/*.md"))}
    for notebook in ROOT.glob("docs/**/*.ipynb"):
        cells = json.loads(notebook.read_text())["cells"]
        examples[notebook] = "\n".join("".join(cell["source"]) for cell in cells if cell["cell_type"] == "code")
    for page, text in examples.items():
        found = loads.search(text)
        assert not found or SWITCH in text[: found.start()], f"{page} loads ONNX Runtime with its telemetry on"
    for host in ("hosts/node/host.mjs", "capi/graph.cpp"):
        assert SWITCH in (ROOT / "export" / host).read_text(), host
