"""The commands as processes of their own: small work for each, what it leaves, and ways to end it before its time."""

import json
import multiprocessing
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from full_stack import full_stack

import ngpt
from ngpt.training.dataset import read_manifest

ROOT = Path(__file__).parents[1]
ENVIRONMENT = os.environ | {"PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1", "PYTHONDONTWRITEBYTECODE": "1"}


SIGNALS = {"Ctrl-C": signal.SIGINT, "SIGTERM": signal.SIGTERM}


def start(arguments, **options) -> subprocess.Popen:
    """A process at the root of the project, its errors in a pipe; it hears Ctrl-C even if we run where nobody does."""
    options = {"stdout": subprocess.DEVNULL, "stderr": subprocess.PIPE, "text": True, "cwd": ROOT} | options
    options["preexec_fn"] = _hear_interrupts
    return subprocess.Popen([str(a) for a in arguments], env=ENVIRONMENT, **options)


def _hear_interrupts() -> None:
    signal.signal(signal.SIGINT, signal.SIG_DFL)


def complete(arguments, **options) -> subprocess.CompletedProcess:
    options = {"capture_output": True, "text": True, "cwd": ROOT, "timeout": 300} | options
    if os.name == "posix":
        options.setdefault("preexec_fn", _hear_interrupts)
    return subprocess.run([str(a) for a in arguments], env=ENVIRONMENT, check=False, **options)


def shell(line, *arguments):
    """Runs a line of shell in which "$@" is a command."""
    return complete(["bash", "-c", f"set -o pipefail; {line}", "bash", *arguments])


needs_forks = pytest.mark.skipif("fork" not in multiprocessing.get_all_start_methods(), reason="no fork here")
no_warning_of_forks = pytest.mark.filterwarnings("ignore:.*fork.*:DeprecationWarning")


def in_a_child(work, i=0, seconds=60):
    """What ``work(i)`` returns in a forked child, as bytes; fails where the child takes longer."""
    ours, theirs = multiprocessing.Pipe(duplex=False)
    child = multiprocessing.get_context("fork").Process(target=lambda: theirs.send_bytes(work(i).tobytes()))
    child.start()
    try:
        assert ours.poll(seconds), "the child hangs"
        return ours.recv_bytes()
    finally:
        child.kill()
        child.join()


def temporary_files(folder: Path) -> list[Path]:
    return [path for path in folder.rglob(".ngpt-*") if path.is_file()]


def ended(process: subprocess.Popen, seconds: float, number: int = signal.SIGKILL, writing: Path | None = None) -> int:
    """Sends a signal after that many seconds, or so long after a file is being written in ``writing``; exit status."""
    if writing is not None:
        while process.poll() is None and not temporary_files(writing):
            time.sleep(0.002)
    try:
        return process.wait(seconds)
    except subprocess.TimeoutExpired:
        process.send_signal(number)
        return process.wait(120)


def wait_for(condition, seconds: float = 60) -> bool:
    deadline = time.monotonic() + seconds
    while not condition() and time.monotonic() < deadline:
        time.sleep(0.05)
    return bool(condition())


def running(pid: int) -> bool:
    """Whether there is such a process, zombies aside."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


def children(pid: int) -> list[int]:
    try:
        return [int(child) for child in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()]
    except OSError:
        return []


class Work:
    """One command on something small; what it writes goes into ``out``, and running it again continues it."""

    name: str

    def __init__(self, inputs: Path):
        self.inputs = inputs

    def arguments(self, out: Path) -> list:
        """The command line."""
        raise NotImplementedError

    def results(self, out: Path) -> dict[str, object]:
        """What is to be seen in ``out``, as values that are equal if it is; fails for anything half-written."""
        raise NotImplementedError

    def is_part(self, seen: dict[str, object], whole: dict[str, object]) -> bool:
        """Whether what a killed run shows is what one may see on the way to ``whole``."""
        raise NotImplementedError


def visible(folder: Path) -> list[Path]:
    if not folder.exists():
        return []
    return sorted(path for path in folder.rglob("*") if path.is_file() and not path.name.startswith("."))


def timeless(path: Path) -> bytes:
    """A result file but for the seconds it took, which are in its header."""
    data, name = bytearray(path.read_bytes()), b"ngpt:reconstructSeconds\0"
    assert data.count(name) == 1, f"{path}: does not say how long it took"
    # Name, type, and the size of the value, each string ended by a zero [OpenEXR's file layout].
    size = data.index(b"\0", data.index(name) + len(name)) + 1
    start = size + 4
    stop = start + int.from_bytes(data[size:start], "little")
    data[start:stop] = bytes(stop - start)
    return bytes(data)


class Denoise(Work):
    name = "ngpt denoise"

    def __init__(self, inputs: Path, method: str = "auto"):
        super().__init__(inputs)
        self.method = method
        for i in range(4):
            ngpt.write(inputs / f"{i}.exr", full_stack(48 + 8 * i, 64, seed=i))

    def arguments(self, out):
        return [sys.executable, "-m", "ngpt", "denoise", self.inputs, "-o", f"{out}/", "-m", self.method, "--force"]

    def results(self, out):
        for path in visible(out):
            ngpt.read(path)
        return {path.name: timeless(path) for path in visible(out)}

    def is_part(self, seen, whole):
        return seen.items() <= whole.items()


class DataGen(Work):
    name = "python -m data_gen"

    def arguments(self, out):
        return [sys.executable, "-m", "data_gen", "--config", "configs/data-tiny.toml", "--out", out]

    def results(self, out):
        from ngpt.training.shards import Shard

        seen: dict[str, object] = {}
        for path in visible(out):
            if path.suffix == ".safetensors":
                shard = Shard(path)
                seen[path.name] = {name: shard.tensor(name).tobytes() for name in shard.names}
            elif path.name == "manifest.json":
                listed = {entry["file"] for entry in read_manifest(out)["shards"]}
                assert listed <= {f"shards/{p.name}" for p in (out / "shards").iterdir()}
            else:
                assert path.name in ("README.md", "contact.png"), path
                seen[path.name] = path.read_bytes() if path.suffix == ".png" else path.read_text().endswith("\n")
        return seen

    def is_part(self, seen, whole):
        return all(whole[name] == value for name, value in seen.items())


class Train(Work):
    name = "train.py"

    def __init__(self, inputs: Path):
        super().__init__(inputs)
        for i in range(2):
            view = inputs / f"view{i}"
            view.mkdir(parents=True)
            ngpt.write(view / "reference.exr", full_stack(40, 40, seed=i)["primal"])
            ngpt.write(view / "few.exr", full_stack(40, 40, seed=10 + i))

    def arguments(self, out, **changes):
        changes = {
            "data.folders": [str(self.inputs)],
            "data.validation": ["view1"],
            "data.crop": 32,
            "model.channels": [4, 4],
            "model.units": [1, 1],
            "run.steps": 20,
            "run.batch": 1,
            "run.log": 5,
            "run.save": 2,
            "run.validate": 10,
        } | changes
        words = [word for name, value in changes.items() for word in ("--set", f"{name}={value!r}")]
        return [sys.executable, "train.py", "--config", "configs/tiny.toml", "--out", out, *words]

    def results(self, out):
        from ngpt.network import weights

        seen: dict[str, object] = {}
        for path in visible(out):
            if path.suffix == ".safetensors":
                tensors, header = weights.read_tensors(path)
                seen[path.name] = {name: tensor.numpy().tobytes() for name, tensor in tensors.items()}
                seen[f"{path.name} step"] = header.get("step") or header["training"]["step"]
            elif path.suffix == ".png":
                seen[path.name] = path.read_bytes()
            elif path.name == "settings.json":
                seen[path.name] = json.loads(path.read_text())
            elif path.name == "log.jsonl":
                entries = [json.loads(line) for line in path.read_text().splitlines()]
                seen[path.name] = [entry | {"seconds": 0} for entry in entries]
            else:
                assert path.parent.name == "tensorboard", path
        return seen

    def is_part(self, seen, whole):
        steps = [seen.get(f"{name}.safetensors step", 0) for name in ("checkpoint", "weights")]
        # The checkpoint comes first: whatever weights one finds, training continues from there or later.
        return steps[1] <= steps[0] <= whole["checkpoint.safetensors step"]


class Merge(Work):
    name = "ngpt merge"

    def arguments(self, out):
        for seed in (1, 2):
            stack = full_stack(40, 60, seed=seed)
            stack.attributes |= {"ngpt:spp": 4, "ngpt:seed": seed}
            ngpt.write(self.inputs / f"{seed}.exr", stack, overwrite=True)
        out.mkdir(exist_ok=True)
        stacks = [self.inputs / "1.exr", self.inputs / "2.exr"]
        return [sys.executable, "-m", "ngpt", "merge", *stacks, "-o", out / "merged.exr", "--force"]


class Render(Work):
    name = "ngpt render"

    def arguments(self, out):
        out.mkdir(exist_ok=True)
        words = ["diffuse", "-o", out / "s.exr", "--spp", 4, "--size", "48x32", "--force"]
        return [sys.executable, "-m", "ngpt", "render", *words]


# Renders of several passes, each of its own kind: what it adds to the command line.
RENDERS = {
    "adaptive": ("--adaptive", "--spp", 64, "--sampler", "gpt"),
    "error": ("--error", 0.06, "--for", "wcv", "--sampler", "gpt"),
    "photons": ("--sampler", "gpm", "--spp", 16),
    "time": ("--time", 3, "--sampler", "gpt"),
}


class RenderOf(Work):
    """``ngpt render`` of one of ``RENDERS``."""

    def __init__(self, inputs: Path, what: str):
        super().__init__(inputs)
        self.what, self.name = what, f"ngpt render, {what}"

    def arguments(self, out, words=None):
        out.mkdir(exist_ok=True)
        words = RENDERS[self.what] if words is None else words
        scene = ["diffuse", "-o", out / "s.exr", "--size", "96x64", "--memory", 512, "--force"]
        return [sys.executable, "-m", "ngpt", "render", *scene, *words]

    def results(self, out):
        """Layers and header but for the time it took; of a timed render, whether its header gives its bits again."""
        seen: dict[str, object] = {}
        for path in visible(out):
            stack = ngpt.read(path)
            seen[path.name] = self._content(stack)
            if self.what == "time":
                spp, more = stack.attributes["ngpt:spp"], stack.attributes["ngpt:samplerOptions"]
                again = self.inputs / "again"
                options = [word for option in more.split(", ") for word in ("-O", option)]
                run = complete(self.arguments(again, ["--spp", spp, "--sampler", "gpt", *options]))
                assert run.returncode == 0, run.stderr
                seen[path.name] = self._content(ngpt.read(again / "s.exr")) == seen[path.name]
        return seen

    @staticmethod
    def _content(stack):
        told = {name: str(value) for name, value in stack.attributes.items() if name != "ngpt:seconds"}
        return {name: stack[name].tobytes() for name in stack.names} | told

    def is_part(self, seen, whole):
        return seen.items() <= whole.items()


class Demo(Work):
    name = "ngpt demo"

    def arguments(self, out):
        words = ["-o", out, "--scene", "diffuse", "--spp", 4, "--reference-spp", 8, "--size", "48x32", "--force"]
        return [sys.executable, "-m", "ngpt", "demo", *words]


class Export(Work):
    name = "python -m export"

    def arguments(self, out):
        out.mkdir(exist_ok=True)
        return [sys.executable, "-m", "export", "--method", "l2", "-o", out / "l2.onnx", "--force"]


class Evaluation(Work):
    name = "eval.py"

    def arguments(self, out):
        folder = self.inputs / "scene"
        if not folder.exists():
            folder.mkdir()
            ngpt.write(folder / "reference.exr", full_stack(24, 32)["primal"])
            ngpt.write(folder / "gradients-4-0.exr", full_stack(24, 32, seed=1))
            settings = 'spp = [4]\nmethods = ["primal", "l2"]\nmetrics = ["relMSE"]\nprimary = "relMSE"\n'
            (self.inputs / "e.toml").write_text(f'scenes = ["{folder}"]\n{settings}')
        return [sys.executable, "eval.py", "--config", self.inputs / "e.toml", "--out", out]


COMMANDS = {
    "denoise": Denoise,
    "merge": Merge,
    "render": Render,
    "demo": Demo,
    "export": Export,
    "train": Train,
    "data_gen": DataGen,
    "eval": Evaluation,
}
NEEDS = {"render": "mitsuba", "demo": "mitsuba", "data_gen": "mitsuba", "train": "torch", "export": "onnx"}


def make_work(kind: str, folder: Path) -> Work:
    """One of ``COMMANDS``, with its inputs in ``folder``; skips the test where what it needs is not installed."""
    if kind in NEEDS:
        pytest.importorskip(NEEDS[kind])
    (folder / "inputs").mkdir()
    return COMMANDS[kind](folder / "inputs")


def make_render(what: str, folder: Path) -> Work:
    """One of ``RENDERS``; skips the test where Mitsuba is not installed."""
    pytest.importorskip("mitsuba")
    (folder / "inputs").mkdir()
    return RenderOf(folder / "inputs", what)


def half_written(folder: Path) -> list[Path]:
    """Files under a final name that cannot be read as what they are called."""
    return [path for path in visible(folder) if not _whole(path)]


def _whole(path: Path) -> bool:
    data = path.read_bytes()
    try:
        match path.suffix:
            case ".exr":
                ngpt.read_image(path)
            case ".safetensors":
                from safetensors import safe_open

                safe_open(path, framework="np")
            case ".json":
                json.loads(data)
            case ".onnx":
                import onnx

                onnx.load(path)
            case ".png":
                return data.endswith(b"IEND\xaeB`\x82")
            case ".svg" | ".html":
                return data.rstrip().endswith((b"</svg>", b"</html>"))
            case ".md" | ".csv":
                return data.endswith(b"\n")
            case _:
                # Logs: they grow.
                return path.name == "log.jsonl" or path.parent.name == "tensorboard"
    except Exception:
        return False
    return True


def one_error(stderr: str) -> bool:
    """Whether one line names the error, and there is nothing but progress beside it.

    Of several stacks each that fails has its line, and then they are counted; of an evaluation each scene that fails.
    """
    lines = stderr.strip().splitlines()
    errors = [line for line in lines if ": error: " in line and ": error: scene: " not in line]
    failed = re.search(r"error: (\d+) of \d+ stacks were not reconstructed", stderr)
    expected = int(failed[1]) + 1 if failed else 1
    return len(errors) == expected and "Traceback" not in stderr and "Exception ignored" not in stderr


def left_in_home(home: Path, *command, **environment: str) -> list[str]:
    """The files in a fresh home after a program has ended."""
    known = {name: value for name, value in os.environ.items() if name != "ORT_DISABLE_TELEMETRY"}
    known |= {"HOME": str(home), "USERPROFILE": str(home), "XDG_CACHE_HOME": str(home / ".cache")}
    subprocess.run(
        [str(word) for word in command], env=known | environment, check=True, timeout=300, stdout=subprocess.DEVNULL
    )
    return sorted(str(file.relative_to(home)) for file in home.rglob("*") if file.is_file())
