"""Tails in fog against whole paths: seconds, errors and light, `primal`, isotropic fog, 96x54.

    python studies/fog_tails.py SCENE [SEEDS] [REFERENCE_SPP]

SCENE is `haze` (with g = 0) or `diffuse` (filled with fog of extinction .3 and albedo .95). Renders have no cache in
media. This study turns that rule off, for isotropic media only: the cache does not ask for the phase function.
"""

import os
import sys
import time

import mitsuba as mi
import numpy as np

mi.set_variant("llvm_ad_rgb")

import ngpt  # noqa: E402
from data_gen import render as renders  # noqa: E402
from data_gen.scenes import builtin  # noqa: E402

SIZE = (192, 108)


def described(name):
    name, _, g = name.partition(":")
    g = float(g or 0)
    scene = getattr(builtin, name)()
    if name == "haze" and g:
        scene["air"]["phase"]["g"] = g
    if scene["integrator"]["type"] == "path":
        fog = {"type": "homogeneous", "id": "air", "albedo": 0.95, "sigma_t": 0.3, "phase": {"type": "hg", "g": g}}
        scene = {"type": "scene", "air": fog} | {k: v for k, v in scene.items() if k != "type"}
        scene["integrator"] = {"type": "volpath", "max_depth": 12, "rr_depth": 5}
        scene["sensor"] = scene["sensor"] | {"medium": {"type": "ref", "id": "air"}}
    scene["sensor"]["film"] = {"type": "hdrfilm", "width": SIZE[0], "height": SIZE[1], "rfilter": {"type": "box"}}
    return mi.load_dict(scene)


SAMPLER = os.environ.get("SAMPLER", "primal")


def render(scene, spp, seed, tails, sampler=SAMPLER):
    start = time.process_time()
    stack = renders.render_stack(scene, spp, seed, sampler, unbiased=True, tails=tails, subpixels=1)
    return stack, time.process_time() - start


def relmse(image, a, b):
    """Free of the noise of the halves ``a`` and ``b`` of the reference."""
    reference = (a + b) / 2
    error = (image - a) * (image - b) / (reference**2 + 1e-2 * reference.mean() ** 2)
    each = np.sort(error.mean(-1).ravel())
    return each[: int(0.999 * len(each))].mean()


def main(name, seeds="8", reference_spp="2048"):
    scene = described(name)
    cache = f"/tmp/m/fog-{name}-{reference_spp}-{SIZE[0]}.npy"
    halves = (
        list(np.load(cache))
        if os.path.exists(cache)
        else [
            render(scene, int(reference_spp), 1000 + i, "paths", "primal")[0]["primal"].astype(float) for i in range(2)
        ]
    )
    np.save(cache, halves)
    truth = (halves[0] + halves[1]) / 2
    print(
        "reference halves (a quarter of it is in each error below)",
        relmse((halves[0] + halves[1]) / 2, halves[0], halves[0]),
        halves[0].mean() / halves[1].mean(),
        flush=True,
    )
    for tails in ("paths", "shared"):
        render(scene, 16, 99, tails)
    for spp in (16, 64):
        means = {}
        for tails in ("paths", "shared"):
            rows, images = [], []
            for seed in range(int(seeds)):
                stack, seconds = render(scene, spp, seed, tails)
                image = stack["primal"].astype(float)
                clean = np.asarray(ngpt.denoise(stack, "oidn"), float)
                rows.append((seconds, relmse(image, *halves), relmse(clean, *halves), image.mean() / truth.mean()))
                images.append(image)
            rows = np.array(rows)
            # Bias of blocks by the two halves of the seeds: products of errors that share no noise with each other
            b = lambda i: i[:96].reshape(6, 16, 12, 16, 3).mean(axis=(1, 3, 4))  # noqa: E731
            n = len(images) // 2
            e1 = b(np.mean(images[:n], 0)) / b(halves[0]) - 1
            e2 = b(np.mean(images[n:], 0)) / b(halves[1]) - 1
            light = rows[:, 3]
            means[tails] = np.median(rows[:, 0]), rows[:, 1].mean(), rows[:, 2].mean()
            said = stack.attributes.get("ngpt:tails", "")
            print(
                f"{name} {spp} {tails:6}: {np.median(rows[:, 0]):.2f} s, relMSE {rows[:, 1].mean():.5f}, OIDN "
                f"{rows[:, 2].mean():.5f} (worst {rows[:, 2].max():.5f}), light {light.mean():.4f} +- "
                f"{light.std(ddof=1) / len(light) ** 0.5:.4f}, bias^2 of blocks {np.mean(e1 * e2):.2e} {said}",
                flush=True,
            )
        p, s = means["paths"], means["shared"]
        print(f"  shared / paths: time {s[0] / p[0]:.2f}, relMSE {s[1] / p[1]:.2f}, OIDN {s[2] / p[2]:.2f}", flush=True)


if __name__ == "__main__":
    main(*sys.argv[1:])
