"""Differences between pixels that are not neighbours: whether they are worth their price (survey, section 6.1).

    python -m bench.survey.graph --scenes diffuse SCENE.xml ...

Samplers shift paths by any number of pixels, and least squares take a graph: an edge for each pair of pixels, weighted
by the variance of its difference. For distances of 2, 4 and 8 pixels, at equal numbers of shifted paths:

    split    n samples with neighbours and n with pixels that far apart, against 2 n with neighbours
    both     n samples with both, at 3/2 of the time of n with neighbours if a shift costs 1/4 of a base path;
             against as many more samples with neighbours
    tile     n samples with distances 1, 2 and 4, at twice that time, against 2 n with neighbours

Errors are trimmed relMSE, those of the image of twice as many samples over it; below 1 farther pixels pay. Also the
variance of a difference over that of a pixel, medians over all pairs, and over those alike in their features.
"""

import argparse
import json
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.linalg import splu

from bench.common import metadata, save
from ngpt.classical.energy import keep_energy
from ngpt.classical.variances import FLOOR, smoothed
from ngpt.denoisers import caustic
from ngpt.evaluation.config import scene_name
from ngpt.io.exr import read_image
from ngpt.measure.metrics import relmse_trimmed
from ngpt.merging import merge
from ngpt.repair import Repaired, repair
from ngpt.stack import GradientStack

DISTANCES = (2, 4, 8)
_REFERENCE_SEED = 1 << 20


@dataclass(frozen=True)
class Edges:
    """Differences I[end] - I[start] of pixels by their numbers: (E, C), and the weights of these, (E)."""

    start: np.ndarray
    end: np.ndarray
    difference: np.ndarray
    weight: np.ndarray


def least_squares(image: np.ndarray, screen: np.ndarray, edges: Sequence[Edges]) -> np.ndarray:
    """The I that minimises Σ screen |I - image|² + Σ weight |I_end - I_start - difference|², by a direct solver.

    ``image`` and I are (H, W, C), ``screen`` is (H, W), above 0.
    """
    pixels = screen.size
    right = screen.reshape(-1, 1) * image.reshape(pixels, -1).astype(np.float64)
    rows, columns, values = [np.arange(pixels)], [np.arange(pixels)], [screen.ravel()]
    for e in edges:
        rows += [e.start, e.end, e.start, e.end]
        columns += [e.start, e.end, e.end, e.start]
        values += [e.weight, e.weight, -e.weight, -e.weight]
        flux = e.weight[:, None] * e.difference
        np.add.at(right, e.end, flux)
        np.add.at(right, e.start, -flux)
    where = np.concatenate(rows), np.concatenate(columns)
    matrix = coo_matrix((np.concatenate(values), where), (pixels, pixels))
    return splu(matrix.tocsc()).solve(right).reshape(image.shape)


def reconstructed(data: Repaired, farther: Sequence[tuple[int, Repaired]]) -> np.ndarray:
    """The image by differences of neighbours, those of ``data``, and others with their distances, as of ``wl2``."""
    primal = smoothed(data.variances[0])
    floor = FLOOR * float(np.mean(primal))
    edges = list(_edges(data, 1, floor))
    for distance, far in farther:
        edges += _edges(far, distance, floor)
    image = least_squares(data.image, 1 / (primal + floor), edges).astype(np.float32)
    return np.asarray(keep_energy(image, data.image))


def _edges(data: Repaired, distance: int, floor: float) -> Iterator[Edges]:
    number = np.arange(data.image.shape[0] * data.image.shape[1]).reshape(data.image.shape[:2])
    for layer, variance, y, x in ((data.dx, data.variances[1], 0, distance), (data.dy, data.variances[2], distance, 0)):
        start = np.s_[: number.shape[0] - y, : number.shape[1] - x]
        weight = 1 / (smoothed(variance[start], True) + floor)
        difference = layer[start].reshape(-1, 3).astype(np.float64)
        yield Edges(number[start].ravel(), number[y:, x:].ravel(), difference, weight.ravel())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", nargs="+", required=True)
    parser.add_argument("--spp", nargs="+", type=int, default=[16, 64])
    parser.add_argument("--size", type=int, nargs=2, default=(160, 90), metavar=("WIDTH", "HEIGHT"))
    parser.add_argument("--references", type=Path, help="folder of references in two halves")
    parser.add_argument("--reference-spp", type=int, default=1024, help="of each half")
    parser.add_argument("-o", "--output", type=Path, default=Path("bench/results/graph.json"))
    args = parser.parse_args()

    from data_gen.backend import use_variant
    from data_gen.scenes.load import load_scene

    use_variant()
    result: dict = {"benchmark": "graph", "size": list(args.size), "scenes": {}}
    if args.output.exists():
        result["scenes"] = json.loads(args.output.read_text())["scenes"]
    for path in args.scenes:
        scene = load_scene(path, tuple(args.size))
        halves = references(path, scene, args)
        cells = result["scenes"].setdefault(scene_name(path), {})
        for spp in args.spp:
            cells[str(spp)] = bench(scene, spp, halves)
            print(scene_name(path), spp, cells[str(spp)], flush=True)
            save(args.output, result | {"metadata": metadata("mitsuba")})


def references(path: str, scene, args: argparse.Namespace) -> list[np.ndarray]:
    from data_gen.render import render_stack

    files = [args.references / f"{scene_name(path)}-{half}.exr" for half in "ab"] if args.references else []
    if files and all(file.exists() for file in files):
        return [read_image(file) for file in files]
    return [render_stack(scene, args.reference_spp, _REFERENCE_SEED + i, "primal")["primal"] for i in range(2)]


def bench(scene, spp: int, halves: list[np.ndarray]) -> dict[str, float]:
    """Errors over those with neighbours alone; variances of differences over those of pixels."""
    near = [rendered(scene, spp, seed, 1) for seed in range(2)]
    far = {k: [rendered(scene, spp, seed, k) for seed in range(2)] for k in DISTANCES}

    def error(stack: GradientStack, *farther: tuple[int, GradientStack]) -> float:
        data = repair(stack)
        image = reconstructed(data, [(k, repair(other)) for k, other in farther]) + data.direct
        return relmse_trimmed(image if data.caustic is None else image + caustic.denoised(data), *halves)

    once, twice = (error(near[0]) + error(near[1])) / 2, error(merge(near))
    row = {"error of n": once, "error of 2 n": twice}
    for k in DISTANCES:
        # Neighbours from one render, others from another; the primal of both
        merged = merge([near[0], far[k][1]])
        halved = near[0].replace(primal=merged["primal"], primal_var=merged["primal_var"])
        apart = {name: merged[name] for name in ("direct", "caustic", "caustic_var") if name in merged}
        row[f"split, {k}"] = error(halved.replace(**apart), (k, far[k][1])) / twice
        both = np.mean([error(near[i], (k, far[k][i])) for i in range(2)])
        # Between n and 2 n errors follow a power of the number of samples.
        row[f"both, {k}"] = float(both / (once * (twice / once) ** np.log2(1.5)))
        row |= variances(near[0], far[k][0], k)
    tile = np.mean([error(near[i], *((k, far[k][i]) for k in DISTANCES[:2])) for i in range(2)])
    return row | {"tile": float(tile / twice)} | variances(near[0], near[0], 1)


def variances(near: GradientStack, far: GradientStack, k: int) -> dict[str, float]:
    """The median of var (I_p - I_q) / (var I_p + var I_q), of pairs along x; and of those alike in their features."""
    both = near["primal_var"].sum(-1)
    both = both[:, :-k] + both[:, k:]
    ratio = far["dx_var"][:, :-k].sum(-1) / np.maximum(both, 1e-30)
    apart = np.zeros(both.shape)
    for name in ("albedo", "normal"):
        apart += np.abs(near[name][:, k:] - near[name][:, :-k]).sum(-1)
    depth = near["depth"][..., 0]
    apart += np.abs(depth[:, k:] - depth[:, :-k]) / np.maximum(depth[:, :-k], 1e-6)
    alike = (apart < 0.1) & (both > 0)
    some = {f"variance, alike, {k}": float(np.median(ratio[alike]))} if alike.any() else {}
    return {f"variance, {k}": float(np.median(ratio[both > 0])), f"alike, {k}": float(alike.mean())} | some


def rendered(scene, spp: int, seed: int, distance: int) -> GradientStack:
    """A stack by `gpt` whose differences are of pixels ``distance`` apart."""
    from data_gen.render import render_stack

    with shifted_by(distance):
        return render_stack(scene, spp, seed, "gpt")


@contextmanager
def shifted_by(distance: int) -> Iterator[None]:
    """Samplers and film have one table of shifts."""
    from data_gen.film import SHIFTS

    before = dict(SHIFTS)
    SHIFTS.update({name: (distance * x, distance * y) for name, (x, y) in before.items()})
    try:
        yield
    finally:
        SHIFTS.update(before)


if __name__ == "__main__":
    main()
