"""Tails in fog against whole paths: seconds, errors and light, `primal`, isotropic fog, 96x54.

    python studies/fog_tails.py SCENE [SEEDS] [REFERENCE_SPP]

SCENE is `haze` (with g = 0) or `diffuse` (filled with fog of extinction .3 and albedo .95). Renders have no cache in
media. This study turns that rule off, for isotropic media only: the cache does not ask for the phase function.
"""

import sys
import time
from dataclasses import replace

import mitsuba as mi
import numpy as np

mi.set_variant("llvm_ad_rgb")

import ngpt  # noqa: E402
from data_gen import render as renders  # noqa: E402
from data_gen.samplers.gpt import integrator  # noqa: E402
from data_gen.scenes import builtin  # noqa: E402

SIZE = (96, 54)

rule = renders.sharing_of


def allowed(sensor, entry, facts, settings, budget):
    return rule(sensor, entry, replace(facts, integrator="path", media=()), settings, budget)


renders.sharing_of = allowed
integrator.why_not_shared = lambda *_: ""


def described(name):
    scene = getattr(builtin, name)()
    if name == "haze":
        scene["air"]["phase"] = {"type": "isotropic"}
    else:
        fog = {"type": "homogeneous", "id": "air", "albedo": 0.95, "sigma_t": 0.3}
        scene = {"type": "scene", "air": fog} | {k: v for k, v in scene.items() if k != "type"}
        scene["integrator"] = {"type": "volpath", "max_depth": 12, "rr_depth": 5}
        scene["sensor"] = scene["sensor"] | {"medium": {"type": "ref", "id": "air"}}
    scene["sensor"]["film"] = {"type": "hdrfilm", "width": SIZE[0], "height": SIZE[1], "rfilter": {"type": "box"}}
    return mi.load_dict(scene)


def render(scene, spp, seed, tails):
    start = time.process_time()
    stack = renders.render_stack(scene, spp, seed, "primal", unbiased=True, tails=tails, subpixels=1)
    return stack, time.process_time() - start


def relmse(image, reference):
    error = (image - reference) ** 2 / (reference**2 + 1e-2 * reference.mean() ** 2)
    each = np.sort(error.mean(-1).ravel())
    return each[: int(0.999 * len(each))].mean()


def main(name, seeds="8", reference_spp="2048"):
    scene = described(name)
    halves = [render(scene, int(reference_spp), 1000 + i, "paths")[0]["primal"].astype(float) for i in range(2)]
    truth = (halves[0] + halves[1]) / 2
    print(
        "reference halves (a quarter of it is in each error below)",
        relmse(*halves),
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
                rows.append((seconds, relmse(image, truth), relmse(clean, truth), image.mean() / truth.mean()))
                images.append(image)
            rows = np.array(rows)
            # Bias of blocks by the two halves of the seeds: products of errors that share no noise with each other
            b = lambda i: i[:48].reshape(6, 8, 12, 8, 3).mean(axis=(1, 3, 4))  # noqa: E731
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
