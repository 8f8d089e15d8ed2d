"""Makes the files of a release, and tries them as users will: each extra in a fresh environment.

    python -m scripts.release -o dist                  all of it: some 10 minutes and 4 GB of disk for a while
    python -m scripts.release -o dist --extra render   one extra; "" is the package without any

The environments take the versions of constraints.txt, as scripts/setup does, from the index that pip is set up with.
"""

import argparse
import shutil
import subprocess
import sys
import tempfile
import venv
import zipfile
from pathlib import Path

from scripts.release.rules import ROOT, version

# An extra -> what has to be importable, and a command of ngpt that uses it. "render" comes before the extras
# that use its stack.
TRIALS: dict[str, tuple[str, list[str]]] = {
    "": ("ngpt, data_gen, onnxruntime", ["denoise", "noisy.exr", "-o", "clean.exr"]),
    "render": (
        "mitsuba",
        ["render", "diffuse", "--size", "32x24", "--spp", "2", "--sampler", "gpt", "-o", "stack.exr"],
    ),
    "peers": ("skimage", ["denoise", "noisy.exr", "-o", "nlm.exr", "-m", "nlm"]),
    "export": ("torch, onnx", ["export", "--method", "l2", "-o", "l2.onnx"]),
    "cluster": ("distributed", ["info", "noisy.exr"]),
    "train": ("torch, mitsuba, tensorboard", ["train", "--config", "tiny", "--dry-run"]),
}

NOISY = """
import numpy as np, ngpt
rng = np.random.default_rng(0)
layers = {name: rng.gamma(1.0, 1.0, (24, 32, 3)) for name in ("primal", "primal_var", "dx", "dy", "albedo", "normal")}
stack = ngpt.GradientStack.from_arrays(**layers, depth=np.ones((24, 32)))
ngpt.write("noisy.exr", stack)
"""


def say(text: str) -> None:
    print(f"release: {text}", flush=True)


def run(*command: str | Path, folder: Path = ROOT) -> None:
    """Runs a command; ends the release where it fails."""
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
    if done.returncode:
        sys.exit(f"release: {' '.join(map(str, command))} failed:\n{done.stdout[-3000:]}\n{done.stderr[-3000:]}")


def environment(folder: Path) -> Path:
    """A fresh virtual environment: its Python."""
    venv.create(folder, with_pip=True)
    return folder / ("Scripts" if sys.platform == "win32" else "bin") / "python"


def build(out: Path) -> tuple[Path, Path]:
    """The source archive and the wheel of it, in ``out``."""
    out.mkdir(parents=True, exist_ok=True)
    run(sys.executable, "-m", "hatchling", "build", "-t", "sdist", "-t", "wheel", "-d", out)
    stem = f"ngpt_recon-{version()}"
    return out / f"{stem}.tar.gz", out / f"{stem}-py3-none-any.whl"


def check_files(source: Path, wheel: Path, work: Path) -> None:
    """The index takes them, and who builds the archive gets the same wheel."""
    python = environment(work / "tools")
    run(python, "-m", "pip", "install", "-q", "twine")
    run(python, "-m", "twine", "check", "--strict", source, wheel)
    say("twine takes both files")
    run(python, "-m", "pip", "wheel", "-q", "--no-deps", "-w", work / "again", source)
    ours, again = (
        {e.filename: e.CRC for e in zipfile.ZipFile(f).infolist()} for f in (wheel, work / "again" / wheel.name)
    )
    if differ := sorted(name for name in ours | again if ours.get(name) != again.get(name)):
        sys.exit(f"release: the wheel of the source archive differs: {', '.join(differ[:5])}")
    say("the source archive makes the same wheel")


def try_extra(extra: str, wheel: Path, work: Path) -> None:
    """Installs the wheel with an extra, imports what it brings, and runs a command, away from the repository."""
    modules, command = TRIALS[extra]
    folder = work / f"extra-{extra}"
    python = environment(folder)
    run(python, "-m", "pip", "install", "-q", "-c", ROOT / "constraints.txt", f"{wheel}[{extra}]" if extra else wheel)
    run(python, "-I", "-c", f"import {modules}", folder=folder)
    run(python, "-I", "-c", NOISY, folder=folder)
    run(python, "-I", "-m", "ngpt", *command, folder=folder)
    say(f"[{extra}]: import {modules}; ngpt {' '.join(command)}")
    shutil.rmtree(folder)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", "--output", type=Path, default=ROOT / "dist", help="folder of the files")
    parser.add_argument("--extra", action="append", choices=TRIALS, help="try this one only; may be repeated")
    args = parser.parse_args()
    source, wheel = build(args.output.resolve())
    with tempfile.TemporaryDirectory() as folder:
        check_files(source, wheel, Path(folder))
        for extra in TRIALS if args.extra is None else args.extra:
            try_extra(extra, wheel, Path(folder))
    say(f"{source.name} and {wheel.name} are in {args.output}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
