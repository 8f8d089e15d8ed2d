"""Times the classical reconstructions, their parts, and the solvers that they replace.

    python -m bench.reconstruction --out bench/results/reconstruction.json

Per size, on synthetic stacks of three float32 channels:

    dct pair   one forward and inverse cosine transform of the three channels, the floor of any exact solver
    l2, l1, cv, wcv, wl2   as anyone calls them, from (H, W, 3) arrays to an (H, W, 3) array
    cg         l2 by plain conjugate gradients, to the residual that l2 itself has
    irls       l1 by the reference schedule: 20 reweightings of 50 conjugate gradient steps (once; it is long)

cg and irls use the same threaded stencils as ours. The energies of l1 and irls are relative to the minimum, which a
long run of ADMM gives.
"""

import argparse
import time

import numpy as np
from scipy.fft import dctn, idctn

from bench.common import measure, metadata, save
from ngpt.classical.arrays import by_rows, empty
from ngpt.classical.controlvariates import cv, wcv
from ngpt.classical.gradients import adjoint_by_rows, differences, forward_differences
from ngpt.classical.leastsquares import Equations, sum_of, total_of
from ngpt.classical.poisson import DEFAULT_ALPHA, l1, l2, least_norms
from ngpt.classical.weighted import wl2

SIZES = ("1280x720", "1920x1080")


def synthetic(width: int, height: int) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """(primal, dx, dy) and their variances: shading with edges, noise that varies tenfold, fireflies, all seeded."""
    random = np.random.default_rng(0)
    y, x = (np.mgrid[:height, :width] / height).astype(np.float32)
    boxes = sum(((x - a) % 0.31 < 0.13) * ((y - b) % 0.23 < 0.1) for a, b in ((0, 0), (0.1, 0.05), (0.2, 0.15)))
    truth = np.stack([0.1 + 0.3 * y + 0.2 * boxes * (1 + 0.3 * np.sin(7 * x + c)) for c in range(3)], -1)
    layers, variances = [], []
    for image, share in ((truth, 0.7), *((d, 0.1) for d in forward_differences(truth))):
        deviation = share * truth.mean(-1, keepdims=True) * random.gamma(1, 1, (height, width, 1))
        deviation *= 1 + 20 * (random.random((height, width, 1)) < 0.003)
        layers.append((image + deviation * random.standard_normal(image.shape)).astype(np.float32))
        variances.append((deviation**2 * random.gamma(4, 0.25, image.shape)).astype(np.float32))
    return layers, variances


def dct_pair(planes: np.ndarray) -> np.ndarray:
    transform = dctn(planes, axes=(1, 2), norm="ortho", workers=-1)
    return idctn(transform, axes=(1, 2), norm="ortho", workers=-1, overwrite_x=True)


def conjugate_gradients(u, r, weights, alpha, steps, goal=0.0):
    """``steps`` for Kᵀ W K u = Kᵀ W (0, r), from u; weights (3, 1, H, W) or 1. Stops at a residual of ``goal``."""
    rows = (lambda k, i, j: 1.0) if weights is None else (lambda k, i, j: weights[k][:, i:j])

    def apply(v, right=None):
        def band(i, j):
            dx, dy = differences(v, i, j)
            x, y, own = rows(1, i, j) * dx, rows(2, i, j) * dy, alpha**2 * rows(0, i, j) * v[:, i:j]
            energy = sum_of(x * dx + y * dy + own * v[:, i:j])
            if right is not None:
                own, x, y = -own, rows(1, i, j) * r[0, :, i:j] - x, rows(2, i, j) * r[1, :, i:j] - y
            return own, x, y, energy

        result, energies = adjoint_by_rows(band, empty(v, 3))
        return result, total_of(energies)

    residual, _ = apply(u, right=r)
    direction, size = residual.copy(), float(np.vdot(residual, residual))
    for step in range(steps):
        if size <= goal**2:
            return u, step
        image, energy = apply(direction)
        u, _ = plus(u, size / energy, direction, u)
        residual, new_size = plus(residual, -size / energy, image, residual)
        direction, _ = plus(residual, new_size / size, direction, direction)
        size = new_size
    return u, steps


def plus(a, factor, b, out):
    """a + factor b, and its square."""

    def band(i, j):
        result = a[:, i:j] + factor * b[:, i:j]
        return result, sum_of(result * result)

    result, squares = by_rows(band, out)
    return result, total_of(squares)


def norms(u, r, alpha):
    """Colour norms of the residuals, (3, 1, H, W)."""

    def band(i, j):
        dx, dy = differences(u, i, j)
        e = np.stack([alpha * u[:, i:j], dx - r[0, :, i:j], dy - r[1, :, i:j]])
        return (np.sqrt((e * e).sum(1, keepdims=True)),)

    return by_rows(band, empty(u, 3, 1))[0]


def irls(r, alpha, scale, outer=20, inner=50):
    """The reference's L1D: weights 1 / (norm + 0.05 · 0.5ⁿ) of mean 1, in the units of the image."""
    u, weights = np.zeros_like(r[0]), None
    for n in range(outer):
        if n:
            weights = 1 / (norms(u, r, alpha) + 0.05 * 0.5 ** (n - 1) / scale)
            weights /= weights.mean()
        u, _ = conjugate_gradients(u, r, weights, alpha, inner)
    return u


def bench(width: int, height: int, repeats: int) -> dict:
    (primal, dx, dy), (vp, vx, vy) = synthetic(width, height)
    alpha = DEFAULT_ALPHA
    planes = np.ascontiguousarray(np.moveaxis(primal, -1, 0))
    r, scale = Equations(primal, dx, dy).scaled_residual()

    def normal_residual(u):
        b, _ = adjoint_by_rows(lambda i, j: (None, *r[..., i:j, :]), empty(r, 3))
        flux, _ = adjoint_by_rows(lambda i, j: (alpha**2 * u[:, i:j], *differences(u, i, j)), empty(r, 3))
        return float(np.linalg.norm(b - flux)), float(np.linalg.norm(b))

    solution = np.moveaxis((l2(primal, dx, dy, alpha).astype(np.float64) - primal) / scale, -1, 0)
    goal, start = normal_residual(np.ascontiguousarray(solution, np.float32))
    _, cg_steps = conjugate_gradients(np.zeros_like(r[0]), r, None, alpha, 1000, goal)
    seconds = measure(
        {
            "dct pair": lambda: dct_pair(planes),
            "l2": lambda: l2(primal, dx, dy, alpha),
            "cg": lambda: conjugate_gradients(np.zeros_like(r[0]), r, None, alpha, cg_steps),
            "l1": lambda: l1(primal, dx, dy, alpha),
            "cv": lambda: cv(primal, dx, dy),
            "wcv": lambda: wcv(primal, dx, dy, vp, vx, vy),
            "wl2": lambda: wl2(primal, dx, dy, vp, vx, vy),
        },
        repeats,
    )
    begin = time.perf_counter()
    reweighted = irls(r, alpha, scale)
    seconds["irls"] = {"median": time.perf_counter() - begin, "runs": 1}
    u, energies = least_norms(r, alpha, None, 1e-5, 400)
    lowest = norms(u, r, alpha).sum(dtype=np.float64)
    ours = np.moveaxis((l1(primal, dx, dy, alpha) - primal) / np.float32(scale), -1, 0)
    pair, ours_l1 = seconds["dct pair"]["median"], seconds["l1"]["median"]
    return {
        "seconds": seconds,
        "ratios": {
            "l2 / dct pair": seconds["l2"]["median"] / pair,
            "cg / l2": seconds["cg"]["median"] / seconds["l2"]["median"],
            "l1 / dct pair": ours_l1 / pair,
            "irls / l1": seconds["irls"]["median"] / ours_l1,
            "wcv / l1": seconds["wcv"]["median"] / ours_l1,
            "wl2 / l1": seconds["wl2"]["median"] / ours_l1,
        },
        "cg steps": cg_steps,
        "l2 relative residual": goal / start,
        "l1 energy over the minimum": norms(ours, r, alpha).sum(dtype=np.float64) / lowest - 1,
        "irls energy over the minimum": norms(reweighted, r, alpha).sum(dtype=np.float64) / lowest - 1,
        "iterations for the minimum": len(energies),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sizes", nargs="+", default=SIZES, metavar="WxH")
    parser.add_argument("--repeats", type=int, default=9)
    parser.add_argument("-o", "--out", help="JSON file to write")
    args = parser.parse_args()
    result = metadata()
    for size in args.sizes:
        width, height = map(int, size.split("x"))
        result[size] = bench(width, height, args.repeats)
        print(size)
        for name, times in result[size]["seconds"].items():
            print(f"  {name:10s}{1e3 * times['median']:10.1f} ms")
        for name, value in result[size].items():
            if name not in ("seconds", "ratios"):
                print(f"  {name}: {value:.3g}")
        for name, ratio in result[size]["ratios"].items():
            print(f"  {name}: {ratio:.2f}")
    if args.out:
        save(args.out, result)


if __name__ == "__main__":
    main()
