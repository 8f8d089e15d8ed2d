"""What benchmarks that render share: command line, file of cells, scenes, references, errors and seconds."""

import argparse
import json
import resource
import tempfile
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

import ngpt
from bench.common import kept, metadata, save
from ngpt.cli.arguments import size as pixels
from ngpt.evaluation.config import scene_name
from ngpt.evaluation.references import HALVES, Reference, read_reference
from ngpt.measure.metrics import EPSILON, scores, squared_error, trimmed_mean

# Mitsuba as it is
RIVAL = {"points": "independent", "lamps": "uniform"}
# Far from the seeds of images
REFERENCE_SEED = 1 << 20
# With this number of samples a render reaches its second round, so that all kernels are compiled.
WARM_SPP = 9


def command(doc: str | None, name: str, size: str, spp: Sequence[int]) -> argparse.ArgumentParser:
    """The arguments of a benchmark of scenes; the description is ``doc``."""
    parser = argparse.ArgumentParser(description=doc, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", nargs="*", metavar="SCENE", help="files or built-in names; none: only the tables")
    parser.add_argument("--references", type=Path, metavar="FOLDER")
    parser.add_argument("--reference-spp", type=int, default=256, help="of each half that is made")
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
    """The cells of a file; ``key`` names what tells them apart."""

    def __init__(self, path: Path, name: str, key: Sequence[str]):
        super().__init__(json.loads(path.read_text())["cells"] if path.exists() else [])
        self.path, self.name, self.key = path, name, key

    def place(self, cell: dict[str, Any]) -> tuple:
        return tuple(cell[name] for name in self.key)

    def measure(self, scenes: Iterable[str], measured: Callable[[str, set[tuple]], Iterator[dict[str, Any]]]) -> None:
        """Adds what ``measured`` gives for a scene and the known places; writes and prints each cell at once."""
        about = metadata("mitsuba", "drjit", "mitsuba-oidn", "onnxruntime")
        for scene in scenes:
            for cell in measured(scene, set(map(self.place, self))):
                self[:] = [old for old in self if self.place(old) != self.place(cell)] + [cell]
                save(self.path, {"benchmark": self.name, "metadata": about, "cells": self})
                seconds = cell["seconds"] if "seconds" in cell else min(w["seconds"] for w in cell["ways"].values())
                print(*self.place(cell), f"{seconds:.2f} s", flush=True)


@contextmanager
def opened(scene: str) -> Iterator[tuple[str, str]]:
    """The name of a scene in tables and files, and the argument that loads it.

    A scene is a file, a built-in name, or generator:SEED:SIGHT: a made scene with one sight of
    ``data_gen.scenes.procedural.variety.SHARES``.
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
    """Errors by two halves of a reference: NAME-WxH-a.exr and -b.exr of a folder, rendered there where they are not."""

    def __init__(self, loaded: Any, name: str, folder: Path, size: str, spp: int):
        files = [folder / f"{name}-{size}{half}.exr" for half in HALVES]
        for i, file in enumerate(files):
            kept(file, lambda seed=REFERENCE_SEED + i: _whole_paths(loaded, spp, seed))
        self.reference: Reference = read_reference(files)
        # The denoised reference, in double precision
        halves = [ngpt.reconstruct(half, "oidn").image for half in self.reference.stacks]
        self.clean = np.mean(halves, axis=0, dtype=np.float64)

    def steady(self, image: np.ndarray) -> float:
        """relMSE by both halves, relative to the clean reference, without the 0.1 % that are worst by it.

        Most pixels of a noisy reference are too dark, so an error relative to it would favour dark images.
        """
        each = (squared_error(image, *h) / (self.clean**2 + EPSILON) for h in (self.reference.images, (self.clean,)))
        return trimmed_mean(*each, share=0.001)

    def scores(self, image: np.ndarray, *names: str) -> dict[str, float]:
        """Metrics by name; FLIP is over the mean of the halves."""
        return scores(names, image, *self.reference.images)

    def light(self, image: np.ndarray) -> float:
        """The mean of the image divided by the mean of the reference."""
        return float(image.mean(dtype=np.float64) / self.reference.mean.mean(dtype=np.float64))

    def values(self, image: np.ndarray) -> dict[str, float]:
        return {"error": self.steady(image), **self.scores(image, "FLIP")}


def _whole_paths(loaded: Any, spp: int, seed: int) -> ngpt.GradientStack:
    from data_gen.render import render_stack  # of the variant that is set

    return render_stack(loaded, spp, seed, "primal", tails="paths")


def processor_seconds() -> float:
    used = resource.getrusage(resource.RUSAGE_SELF)
    return used.ru_utime + used.ru_stime


def timed(call: Callable[[], Any]) -> tuple[Any, float]:
    """What a call returns, and its processor seconds."""
    start = processor_seconds()
    return call(), processor_seconds() - start
