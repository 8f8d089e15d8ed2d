"""Makes the wheel, and tries it as users will: each extra in a fresh environment.

    python -m scripts.wheel -o dist                  all of it: some 10 minutes and 4 GB of disk for a while
    python -m scripts.wheel -o dist --extra render   one extra; "" is the package without any

The environments take the versions of constraints.txt, as scripts/setup does, from the index that pip is set up with.
"""

import argparse
import subprocess
import sys
import tempfile
import venv
from pathlib import Path

from ngpt.version import __version__

ROOT = Path(__file__).parents[1]
# An extra -> what has to be importable, and a command of ngpt that uses it.
TRIALS: dict[str, tuple[str, str]] = {
    "": ("ngpt, data_gen, onnxruntime", "denoise noisy.exr -o clean.exr"),
    "render": ("mitsuba", "render diffuse --size 32x24 --spp 2 --sampler gpt -o stack.exr"),
    "peers": ("skimage", "diff noisy.exr noisy.exr"),
    "export": ("torch, onnx", "export --method l2 -o l2.onnx"),
    "cluster": ("distributed", "info noisy.exr"),
    "train": ("torch, mitsuba, tensorboard", "train --config tiny --dry-run"),
}
NOISY = """
import numpy as np, ngpt
rng = np.random.default_rng(0)
layers = {name: rng.gamma(1.0, 1.0, (24, 32, 3)) for name in ("primal", "primal_var", "dx", "dy", "albedo", "normal")}
ngpt.write("noisy.exr", ngpt.GradientStack.from_arrays(**layers, depth=np.ones((24, 32))))
"""


def run(*command: str | Path, folder: Path = ROOT) -> None:
    """Runs a command; ends everything where it fails."""
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
    if done.returncode:
        sys.exit(f"wheel: {' '.join(map(str, command))} failed:\n{done.stdout[-3000:]}\n{done.stderr[-3000:]}")


def make(out: Path) -> Path:
    run(sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", out)
    return out / f"ngpt_recon-{__version__}-py3-none-any.whl"


def try_extra(extra: str, wheel: Path, folder: Path) -> None:
    """Installs the wheel with an extra, imports what it brings, and runs a command, away from the repository."""
    modules, command = TRIALS[extra]
    venv.create(folder, with_pip=True)
    python = folder / ("Scripts" if sys.platform == "win32" else "bin") / "python"
    run(python, "-m", "pip", "install", "-q", "-c", ROOT / "constraints.txt", f"{wheel}[{extra}]" if extra else wheel)
    run(python, "-I", "-c", f"import {modules}\n{NOISY}", folder=folder)
    run(python, "-I", "-m", "ngpt", *command.split(), folder=folder)
    print(f"wheel: [{extra}]: import {modules}; ngpt {command}", flush=True)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", "--output", type=Path, default=ROOT / "dist", help="folder of the wheel")
    parser.add_argument("--extra", action="append", choices=TRIALS, help="try this one only; may be repeated")
    args = parser.parse_args()
    wheel = make(args.output.resolve())
    for extra in args.extra or TRIALS:
        with tempfile.TemporaryDirectory() as folder:
            try_extra(extra, wheel, Path(folder))
    print(f"wheel: {wheel}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
