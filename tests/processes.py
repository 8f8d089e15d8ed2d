"""The commands as processes of their own: small work for each, what it leaves, and ways to end it before its time."""

import gc
import json
import multiprocessing
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import pytest
from full_stack import full_stack

import ngpt

ROOT = Path(__file__).parents[1]
ENVIRONMENT = os.environ | {"PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1", "PYTHONDONTWRITEBYTECODE": "1"}
NGPT = (sys.executable, "-m", "ngpt")
SIGNALS = {"Ctrl-C": signal.SIGINT, "SIGTERM": signal.SIGTERM}

needs_forks = pytest.mark.skipif("fork" not in multiprocessing.get_all_start_methods(), reason="no fork here")
no_warning_of_forks = pytest.mark.filterwarnings("ignore:.*fork.*:DeprecationWarning")


# --- starting and ending --------------------------------------------------------------------------------------------


def start(arguments, **options) -> subprocess.Popen:
    """A process at the root of the project, its errors in a pipe; it hears Ctrl-C even if we run where nobody does."""
    options = {"stdout": subprocess.DEVNULL, "stderr": subprocess.PIPE, "text": True, "cwd": ROOT} | options
    options["preexec_fn"] = _hear_interrupts
    return subprocess.Popen([str(a) for a in arguments], env=ENVIRONMENT, **options)


def _hear_interrupts() -> None:
    signal.signal(signal.SIGINT, signal.SIG_DFL)


def complete(arguments, **options) -> subprocess.CompletedProcess:
    options = {"capture_output": True, "text": True, "cwd": ROOT, "timeout": 300, "env": ENVIRONMENT} | options
    if os.name == "posix":
        options.setdefault("preexec_fn", _hear_interrupts)
    return subprocess.run([str(a) for a in arguments], check=False, **options)


def shell(line, *arguments):
    """Runs a line of shell in which "$@" is a command."""
    return complete(["bash", "-c", f"set -o pipefail; {line}", "bash", *arguments])


def in_a_child(work, i=0, seconds=60):
    """What ``work(i)`` returns in a forked child, as bytes; fails where the child takes longer.

    The child's collector leaves what earlier tests dropped: to destroy a session of ONNX Runtime that one of them had
    made, the child would wait for ever for threads that it does not have.
    """
    ours, theirs = multiprocessing.Pipe(duplex=False)
    child = multiprocessing.get_context("fork").Process(target=lambda: theirs.send_bytes(work(i).tobytes()))
    gc.freeze()
    try:
        child.start()
        assert ours.poll(seconds), "the child hangs"
        return ours.recv_bytes()
    finally:
        gc.unfreeze()
        child.kill()
        child.join()


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


def one_error(stderr: str) -> bool:
    """Whether one line names the error, and there is nothing but progress beside it.

    Of several stacks each that fails has its line, and then they are counted; of an evaluation each scene that fails.
    """
    lines = stderr.strip().splitlines()
    errors = [line for line in lines if ": error: " in line and ": error: scene: " not in line]
    failed = re.search(r"error: (\d+) of \d+ stacks were not reconstructed", stderr)
    expected = int(failed[1]) + 1 if failed else 1
    return len(errors) == expected and "Traceback" not in stderr and "Exception ignored" not in stderr


# --- what is left ---------------------------------------------------------------------------------------------------


def temporary_files(folder: Path) -> list[Path]:
    return [path for path in folder.rglob(".ngpt-*") if path.is_file()]


def visible(folder: Path) -> list[Path]:
    return sorted(path for path in folder.rglob("*") if path.is_file() and not path.name.startswith("."))


def content(path: Path) -> object:
    """What is in a file, equal for equal results: no times. Fails for a file that is not whole."""
    data = path.read_bytes()
    match path.suffix:
        case ".exr":
            stack = ngpt.read(path)
            told = {name: str(value) for name, value in stack.attributes.items() if "econds" not in name}
            return {name: stack[name].tobytes() for name in stack.names} | told
        case ".safetensors":
            from safetensors import safe_open

            with safe_open(path, framework="np") as file:
                header = json.loads((file.metadata() or {}).get("ngpt", "{}"))
                step = header.get("step") or header.get("training", {}).get("step")
                return step, {name: file.get_tensor(name).tobytes() for name in file.keys()}  # noqa: SIM118
        case ".json" if path.name == "manifest.json":
            # It grows, and never lists what is not there.
            assert all((path.parent / entry["file"]).exists() for entry in json.loads(data)["shards"])
            return None
        case ".json":
            return json.loads(data)
        case ".jsonl":
            return [json.loads(line) | {"seconds": 0} for line in data.decode().splitlines()]
        case ".onnx":
            import onnx

            return onnx.load(path)
        case ".png":
            assert data.endswith(b"IEND\xaeB`\x82")
            return data
    if path.parent.name != "tensorboard":  # logs that grow
        end = {".svg": b"</svg>", ".html": b"</html>", ".md": b"\n", ".csv": b"\n"}[path.suffix]
        assert (data if end == b"\n" else data.rstrip()).endswith(end)
    return None


def contents(folder: Path) -> dict[str, object]:
    return {path.relative_to(folder).as_posix(): content(path) for path in visible(folder)}


def half_written(folder: Path) -> list[Path]:
    """Files under a final name that cannot be read as what they are called."""

    def whole(path: Path) -> bool:
        try:
            content(path)
        except Exception:
            return False
        return True

    return [path for path in visible(folder) if path.suffix != ".jsonl" and not whole(path)]  # logs grow


# --- work -----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Work:
    """One command on something small; run again into the same folder it goes on.

    ``arguments``  its command line, of the folder that it writes to
    ``is_part``    whether what a killed run shows is what one may see on the way to the whole
    ``results``    what is to be seen in the folder, as values that are equal if it is
    """

    name: str
    arguments: Callable[..., list]
    is_part: Callable[[dict, dict], bool] = lambda seen, whole: seen.items() <= whole.items()
    results: Callable[[Path], dict] = contents


def _denoise(inputs: Path) -> Work:
    for i in range(4):
        ngpt.write(inputs / f"{i}.exr", full_stack(48 + 8 * i, 64, seed=i))
    return Work("ngpt denoise", lambda out: [*NGPT, "denoise", inputs, "-o", f"{out}/", "--force"])


def _data_gen(inputs: Path) -> Work:
    command = [sys.executable, "-m", "data_gen", "--config", "configs/data-tiny.toml", "--out"]
    return Work("python -m data_gen", lambda out: [*command, out])


def _train(inputs: Path) -> Work:
    for i in range(2):
        (inputs / f"view{i}").mkdir()
        ngpt.write(inputs / f"view{i}" / "reference.exr", full_stack(40, 40, seed=i)["primal"])
        ngpt.write(inputs / f"view{i}" / "few.exr", full_stack(40, 40, seed=10 + i))
    settings = {"data.folders": [str(inputs)], "data.validation": ["view1"], "data.crop": 32, "run.batch": 1}
    settings |= {"model.channels": [4, 4], "model.units": [1, 1]}
    settings |= {"run.steps": 20, "run.log": 5, "run.save": 2, "run.validate": 10}

    def arguments(out, **changes):
        words = [word for name, value in (settings | changes).items() for word in ("--set", f"{name}={value!r}")]
        return [sys.executable, "train.py", "--config", "configs/tiny.toml", "--out", out, *words]

    def is_part(seen, whole):
        # The checkpoint comes first: whatever weights one finds, training continues from there or later.
        weights, checkpoint, last = (
            found.get(f"{name}.safetensors", (0,))[0]
            for found, name in ((seen, "weights"), (seen, "checkpoint"), (whole, "checkpoint"))
        )
        return weights <= checkpoint <= last

    return Work("train.py", arguments, is_part)


def _merge(inputs: Path) -> Work:
    for seed in (1, 2):
        stack = full_stack(40, 60, seed=seed)
        stack.attributes |= {"ngpt:spp": 4, "ngpt:seed": seed}
        ngpt.write(inputs / f"{seed}.exr", stack)
    stacks = [inputs / "1.exr", inputs / "2.exr"]
    return Work("ngpt merge", lambda out: [*NGPT, "merge", *stacks, "-o", _made(out) / "merged.exr", "--force"])


def _render(inputs: Path) -> Work:
    words = ["diffuse", "--spp", 4, "--size", "48x32", "--force", "-o"]
    return Work("ngpt render", lambda out: [*NGPT, "render", *words, _made(out) / "s.exr"])


def _demo(inputs: Path) -> Work:
    words = ["--scene", "diffuse", "--spp", 4, "--reference-spp", 8, "--size", "48x32", "--force", "-o"]
    return Work("ngpt demo", lambda out: [*NGPT, "demo", *words, out])


def _export(inputs: Path) -> Work:
    command = [sys.executable, "-m", "export", "--method", "l2", "--force", "-o"]
    return Work("python -m export", lambda out: [*command, _made(out) / "l2.onnx"])


def _evaluation(inputs: Path) -> Work:
    folder, config = _made(inputs / "scene"), inputs / "e.toml"
    ngpt.write(folder / "reference.exr", full_stack(24, 32)["primal"])
    ngpt.write(folder / "gradients-4-0.exr", full_stack(24, 32, seed=1))
    settings = 'spp = [4]\nmethods = ["primal", "l2"]\nmetrics = ["relMSE"]\nprimary = "relMSE"\n'
    config.write_text(f'scenes = ["{folder}"]\n{settings}')
    return Work("eval.py", lambda out: [sys.executable, "eval.py", "--config", config, "--out", out])


# Renders of several passes, each of its own kind: what it adds to the command line.
RENDERS = {
    "adaptive": ("--adaptive", "--spp", 64, "--sampler", "gpt"),
    "error": ("--error", 0.06, "--for", "wcv", "--sampler", "gpt"),
    "photons": ("--sampler", "ppm", "--spp", 16),
    "time": ("--time", 3, "--sampler", "gpt"),
}


def _render_of(inputs: Path, what: str) -> Work:
    def arguments(out, words=RENDERS[what]):
        scene = ["diffuse", "-o", _made(out) / "s.exr", "--size", "96x64", "--memory", 512, "--force"]
        return [*NGPT, "render", *scene, *words]

    def gives_its_bits_again(out):
        """A timed render gives its bits again, by the options in its header."""
        for path in visible(out):
            told, again = ngpt.read(path).attributes, inputs / "again"
            options = [word for option in told["ngpt:samplerOptions"].split(", ") for word in ("-O", option)]
            run = complete(arguments(again, ["--spp", told["ngpt:spp"], "--sampler", "gpt", *options]))
            assert run.returncode == 0, run.stderr
            assert contents(again) == contents(out)
        return {path.name: True for path in visible(out)}

    results = gives_its_bits_again if what == "time" else contents
    return Work(f"ngpt render, {what}", arguments, results=results)


COMMANDS = {
    "denoise": _denoise,
    "merge": _merge,
    "render": _render,
    "demo": _demo,
    "export": _export,
    "train": _train,
    "data_gen": _data_gen,
    "eval": _evaluation,
}
NEEDS = {"render": "mitsuba", "demo": "mitsuba", "data_gen": "mitsuba", "train": "torch", "export": "onnx"}


def make_work(kind: str, folder: Path) -> Work:
    """One of ``COMMANDS`` or of ``RENDERS``, its inputs in ``folder``; skips where what it needs is not installed."""
    needed = "mitsuba" if kind in RENDERS else NEEDS.get(kind)
    if needed:
        pytest.importorskip(needed)
    inputs = _made(folder / "inputs")
    return _render_of(inputs, kind) if kind in RENDERS else COMMANDS[kind](inputs)


def _made(folder: Path) -> Path:
    folder.mkdir(exist_ok=True)
    return folder
