"""Functions of benchmarks that render: command line, file of cells, scenes, references, errors and seconds."""

import argparse
import gc
import json
import resource
import tempfile
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

import ngpt
from bench.common import kept, metadata, renderer, save
from ngpt.cli.arguments import size as pixels
from ngpt.evaluation.config import scene_name
from ngpt.evaluation.references import HALVES, Reference, read_reference
from ngpt.measure.metrics import EPSILON, scores, squared_error, trimmed_mean

# Options that make our samplers use Mitsuba's own points and lamps.
RIVAL = {"points": "independent", "lamps": "uniform"}
# The seed of the first half of a reference, far from the seeds of images.
REFERENCE_SEED = 1 << 20
# With this number of samples a render has two rounds, so all its kernels are compiled.
WARM_SPP = 9


def command(doc: str | None, name: str, size: str, spp: Sequence[int]) -> argparse.ArgumentParser:
    """A parser of the arguments that benchmarks of scenes share; ``doc`` is its description."""
    parser = argparse.ArgumentParser(description=doc, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", nargs="*", metavar="SCENE", help="file or built-in name; none: only print the tables")
    parser.add_argument("--references", type=Path, metavar="FOLDER")
    parser.add_argument("--reference-spp", type=int, default=256, help="samples of each half that is rendered")
    parser.add_argument("--size", default=size)
    parser.add_argument("--spp", type=int, nargs="+", default=list(spp))
    parser.add_argument("-o", "--output", type=Path, default=Path(f"bench/results/{name}.json"))
    return parser


def parsed(parser: argparse.ArgumentParser) -> argparse.Namespace:
    args = parser.parse_args()
    if args.scenes and not args.references:
        parser.error("give the folder of --references")
    args.pixels = pixels(args.size)
    return args


class Cells(list[dict[str, Any]]):
    """The measured cells in a file. The entries named by ``key`` identify a cell."""

    def __init__(self, path: Path, name: str, key: Sequence[str]):
        super().__init__(json.loads(path.read_text())["cells"] if path.exists() else [])
        self.path, self.name, self.key = path, name, key

    def place(self, cell: dict[str, Any]) -> tuple:
        return tuple(cell[name] for name in self.key)

    def measure(self, scenes: Iterable[str], measured: Callable[[str, set[tuple]], Iterator[dict[str, Any]]]) -> None:
        """Adds the cells that ``measured(scene, known)`` yields for each scene; writes and prints each cell at once.

        ``known`` holds the places of the cells in the file. A new cell replaces an old one at the same place.
        """
        about = metadata("mitsuba", "drjit", "mitsuba-oidn", "onnxruntime")
        for scene in scenes:
            for cell in measured(scene, set(map(self.place, self))):
                self[:] = [old for old in self if self.place(old) != self.place(cell)] + [cell]
                save(self.path, {"benchmark": self.name, "metadata": about, "cells": self})
                seconds = cell["seconds"] if "seconds" in cell else min(w["seconds"] for w in cell["ways"].values())
                print(*self.place(cell), f"{seconds:.2f} s", flush=True)


@contextmanager
def opened(scene: str) -> Iterator[tuple[str, str]]:
    """The name of a scene in tables and files, and the file or built-in name to load.

    ``scene`` is a file, a built-in name, or generator:SEED:SIGHT. The last is a generated scene with one sight of
    ``data_gen.scenes.procedural.variety.SHARES``; its file exists only within the context.
    """
    kind, *parts = scene.split(":")
    if kind != "generator" or len(parts) != 2:
        yield scene_name(scene), scene
        return
    from data_gen.scenes.procedural.scenes import make_scene
    from data_gen.scenes.procedural.variety import SHARES

    seed, sight = parts
    with tempfile.TemporaryDirectory(prefix="ngpt-scene-") as folder:
        shares = dict.fromkeys(SHARES, 0.0) | {sight: 1.0}
        yield f"generator-{seed}-{sight}", str(make_scene(int(seed), Path(folder), shares))


class Judge:
    """Errors relative to a reference of two halves: NAME-WxH-a.exr and NAME-WxH-b.exr in a folder.

    Files that do not exist are rendered with whole paths and ``spp`` samples per pixel, and written there.
    """

    def __init__(self, loaded: Any, name: str, folder: Path, size: str, spp: int):
        files = [folder / f"{name}-{size}{half}.exr" for half in HALVES]
        for i, file in enumerate(files):
            kept(file, lambda seed=REFERENCE_SEED + i: _whole_paths(loaded, spp, seed))
        self.reference: Reference = read_reference(files)
        # The denoised reference, in double precision.
        halves = [ngpt.reconstruct(half, "oidn").image for half in self.reference.stacks]
        self.clean = np.mean(halves, axis=0, dtype=np.float64)

    def steady(self, image: np.ndarray) -> float:
        """relMSE by both halves, relative to the denoised reference, without the worst 0.1 % of the pixels.

        The worst pixels are those that differ most from the denoised reference. Most pixels of a noisy reference are
        too dark, so an error relative to it would favour dark images.
        """
        each = (squared_error(image, *h) / (self.clean**2 + EPSILON) for h in (self.reference.images, (self.clean,)))
        return trimmed_mean(*each, share=0.001)

    def scores(self, image: np.ndarray, *names: str) -> dict[str, float]:
        """Metrics by name. FLIP compares the image to the mean of the halves."""
        return scores(names, image, *self.reference.images)

    def light(self, image: np.ndarray) -> float:
        """The mean of the image divided by the mean of the reference."""
        return float(image.mean(dtype=np.float64) / self.reference.mean.mean(dtype=np.float64))

    def values(self, image: np.ndarray) -> dict[str, float]:
        return {"error": self.steady(image), **self.scores(image, "FLIP")}


def open_judged(scene: str, size: str, folder: Path, spp: int) -> tuple[str, Any, Judge]:
    """The name of a scene, the loaded scene, and the judge of its images.

    ``scene`` is as for ``opened``, ``size`` is "WIDTHxHEIGHT", ``folder`` and ``spp`` are as for ``Judge``.
    """
    load_scene, _ = renderer()
    # A kernel contains the shapes of all scenes in memory, so scenes of earlier benchmarks are removed.
    gc.collect()
    with opened(scene) as (name, file):
        loaded = load_scene(file, pixels(size))
    return name, loaded, Judge(loaded, name, folder, size, spp)


def _whole_paths(loaded: Any, spp: int, seed: int) -> ngpt.GradientStack:
    from data_gen.render import render_stack  # after the variant is set

    return render_stack(loaded, spp, seed, "primal", tails="paths")


def processor_seconds() -> float:
    """The processor time of this process, of all threads."""
    used = resource.getrusage(resource.RUSAGE_SELF)
    return used.ru_utime + used.ru_stime


def timed(call: Callable[[], Any]) -> tuple[Any, float]:
    """The result of a call, and its processor seconds."""
    start = processor_seconds()
    return call(), processor_seconds() - start
