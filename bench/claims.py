"""Compares the variances that stacks claim with the variances over seeds.

    python -m bench.claims coffee.xml staircase.xml --spp 16 64
    python -m bench.claims glossy diffuse coffee.xml --every 5 130 --size 64 40 --points rounds
    python -m bench.claims diffuse --sampler ppm --spp 5 9 17 --size 64 40

prints, scene by scene, the real variance over the one that the stack claims: of pixels, and of means over 8x8 pixels,
`primal` (without the layer `caustic`), `caustic`, `dx` and `dy`. The noisiest 1 % of pixels and 3 % of blocks are left
out, since few seeds cannot measure them. Blocks of `dx` and `dy` are below 1 even with independent samples, because
pixels share paths. `--every FIRST LAST` measures all numbers of samples in that range, from one render. It also prints
the relative squared error of `wcv`, without the reference's noise, and its largest rise from one number of samples to
the next.
"""

import argparse
import os
from collections.abc import Iterator
from copy import copy
from itertools import pairwise
from typing import Any

import numpy as np

from bench.common import blocks, renderer
from ngpt.evaluation.config import scene_name

LAYERS = ("primal", "caustic", "dx", "dy")
SEEDS = 10


def ratio(real: np.ndarray, claimed: np.ndarray, quiet: float) -> float:
    """The sum of real over the sum of claimed variances, of the ``quiet`` share of values (H, W, C)."""
    total = claimed.sum(axis=-1)
    among = total <= np.quantile(total, quiet)
    return float(real[among].sum() / claimed[among].sum())


def real_over_claimed(stacks: list[dict[str, np.ndarray]]) -> dict[str, tuple[float, float]]:
    """Layer -> real over claimed variance (of pixels, of blocks). ``stacks`` of many seeds map layers to (H, W, C)."""
    found = {}
    for layer in LAYERS:
        if f"{layer}_var" not in stacks[0]:
            continue
        images = np.array([stack[layer] for stack in stacks], np.float64)
        if layer == "primal" and "caustic" in stacks[0]:
            images -= np.array([stack["caustic"] for stack in stacks])
        claimed = np.mean([stack[f"{layer}_var"] for stack in stacks], axis=0, dtype=np.float64)
        pixels = ratio(images.var(axis=0, ddof=1), claimed, 0.99)
        found[layer] = pixels, ratio(blocks(images).var(axis=0, ddof=1), blocks(claimed) / 64, 0.97)
    return found


def samples_of(scene: Any, spp: int, seed: int, sampler: str, **options: Any) -> dict[str, np.ndarray]:
    """All samples of a render, (pixels, spp, C) for each name that the film knows."""
    from data_gen import passes
    from data_gen.film import GradientFilm
    from data_gen.render import render_stack

    parts: dict[str, list[np.ndarray]] = {}

    class Recorded(GradientFilm):
        def end_pass(self, block=None, some=None):
            for name, (components, active) in self._pass.items():
                there = np.ones(1, bool) if active is True else np.array(active)
                # (blocks, pixels, samples of a block, C); what does not exist is NaN, which the film leaves out, too.
                lanes = np.where(there[:, None], np.stack([np.array(each) for each in components], axis=-1), np.nan)
                lanes = lanes.reshape(-1, self.pixels, block, len(components))
                parts.setdefault(name, []).append(lanes.transpose(1, 0, 2, 3).reshape(self.pixels, -1, len(components)))
            super().end_pass(block, some)

    before, passes.GradientFilm = passes.GradientFilm, Recorded
    try:
        render_stack(scene, spp, seed, sampler, unbiased=True, **options)
    finally:
        passes.GradientFilm = before
    return {name: np.concatenate(each, axis=1) for name, each in parts.items()}


def stacks_of(
    samples: dict[str, np.ndarray], size: tuple[int, int], net: int, numbers: list[int]
) -> Iterator[dict[str, np.ndarray]]:
    """The layers that the film makes of the first n samples, for each n of the ascending ``numbers``."""
    import mitsuba as mi

    from data_gen.film import GradientFilm
    from data_gen.passes import PACKET

    def add(film: GradientFilm, begin: int, end: int) -> None:
        for name, each in samples.items():
            channels = [mi.Float(channel) for channel in each[:, begin:end].reshape(-1, each.shape[-1]).T]
            film.put(name, channels[0] if len(channels) == 1 else mi.Color3f(*channels))
        film.end_pass(end - begin)

    film = GradientFilm(*size, net=net)
    for n in numbers:
        while film.samples + PACKET <= n:
            add(film, film.samples, film.samples + PACKET)
        whole = copy(film)
        whole.moments, whole._pass = dict(film.moments), {}
        if n > film.samples:
            add(whole, film.samples, n)
        yield whole.develop()


def every(scene: Any, size: tuple[int, int], sampler: str, points: str, numbers: range, seeds: int) -> dict[int, dict]:
    """For each number of samples: real over claimed, and the error of `wcv` with its standard error."""
    from data_gen.paths.streams import first_round
    from data_gen.render import render_stack
    from ngpt import GradientStack, reconstruct

    references = [
        render_stack(scene, 1024, 900 + i, sampler, unbiased=True)["primal"].astype(np.float64) for i in (0, 1)
    ]
    scale = np.square(np.mean(references, axis=0)) + 1e-2
    found: dict[int, dict] = {}
    by_net: dict[int, list[int]] = {}
    for n in numbers:
        by_net.setdefault(first_round(points, n), []).append(n)
    for net, group in by_net.items():
        developed: dict[int, list] = {n: [] for n in group}
        for seed in range(seeds):
            samples = samples_of(scene, net if points == "sobol" else max(group), seed, sampler, points=points)
            for n, layers in zip(group, stacks_of(samples, size, net, group), strict=True):
                developed[n].append(layers)
        for n, stacks in developed.items():
            errors = []
            for layers in stacks:
                image = reconstruct(GradientStack(layers), "wcv").image
                squares = ((image - references[0]) * (image - references[1]) / scale).mean(axis=-1).ravel()
                kept = np.argsort(np.abs(squares))[: int(0.99 * squares.size)]
                errors.append(squares[kept].mean())
            error = float(np.mean(errors)), float(np.std(errors, ddof=1) / len(errors) ** 0.5)
            found[n] = real_over_claimed(stacks) | {"wcv": error}
    return found


def print_every(name: str, found: dict[int, dict]) -> None:
    numbers = sorted(found)
    for layer in LAYERS:
        if layer in found[numbers[0]]:
            pixels = {n: found[n][layer][0] for n in numbers}
            low, high = min(pixels, key=pixels.__getitem__), max(pixels, key=pixels.__getitem__)
            within = sum(0.8 <= each <= 1.25 for each in pixels.values())
            print(
                f"| `{name}`, `{layer}` | {pixels[low]:.2f} at {low} | {np.median(list(pixels.values())):.2f} | "
                f"{pixels[high]:.2f} at {high} | {within} of {len(numbers)} |",
                flush=True,
            )
    rises = {n: found[n]["wcv"][0] / found[before]["wcv"][0] for before, n in pairwise(numbers)}
    worst = max(rises, key=rises.__getitem__)
    print(
        f"`{name}`: error of `wcv` {found[numbers[0]]['wcv'][0]:.5f} at {numbers[0]} samples, "
        f"{found[numbers[-1]]['wcv'][0]:.5f} at {numbers[-1]}. Over the error with one sample "
        f"less it is at most {rises[worst]:.3f}, at {worst} samples "
        f"(standard error {found[worst]['wcv'][1] / found[worst]['wcv'][0]:.3f} of it)",
        flush=True,
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", nargs="+")
    parser.add_argument("--sampler", default="gpt")
    parser.add_argument("--points", default="sobol")
    parser.add_argument("--tails", default="paths", help="shared: paths end in a cache, docs/samplers/tails.md")
    parser.add_argument("--spp", type=int, nargs="+", default=[16, 64])
    parser.add_argument("--every", type=int, nargs=2, metavar=("FIRST", "LAST"))
    parser.add_argument("--seeds", type=int, default=SEEDS)
    parser.add_argument("--size", type=int, nargs=2, default=(160, 96))
    args = parser.parse_args()
    load_scene, render_stack = renderer()
    size = tuple(args.size)
    if args.every:
        print("| scene, layer | least | median | most | within .8 to 1.25 |\n|---|--:|--:|--:|--:|")
        numbers = range(args.every[0], args.every[1] + 1)
        for name in args.scenes:
            scene = load_scene(os.fspath(name), size)
            print_every(scene_name(name), every(scene, size, args.sampler, args.points, numbers, args.seeds))
        return
    print("| scene, spp | primal: pixels, blocks | caustic | dx | dy |\n|---|--:|--:|--:|--:|")
    for name in args.scenes:
        scene = load_scene(os.fspath(name), size)
        for spp in args.spp:
            options = {"points": args.points} | ({} if args.tails == "paths" else {"tails": args.tails})
            stacks = [render_stack(scene, spp, s, args.sampler, unbiased=True, **options) for s in range(args.seeds)]
            found = real_over_claimed([stack.layers for stack in stacks])
            texts = [f"{found[layer][0]:.2f}, {found[layer][1]:.2f}" if layer in found else "-" for layer in LAYERS]
            print(f"| `{scene_name(name)}`, {spp} | {' | '.join(texts)} |", flush=True)


if __name__ == "__main__":
    main()
