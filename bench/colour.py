"""Errors of what denoises any image, with features and of colour alone: the tables of docs/methods/ngpt-colour.md.

    python -m bench.colour --cache /tmp/stacks

Path-traced stacks of the built-in scenes at 192x108 pixels, kept in the cache folder; geometric means of the trimmed
relMSE over the scenes, as Markdown.
"""

import argparse
from pathlib import Path

import numpy as np

from bench.common import cached
from ngpt.measure.metrics import relmse_trimmed
from ngpt.methods import METHODS, reconstruct
from ngpt.stack import GradientStack

SCENES, SPP = ("diffuse", "glossy", "environment", "lens"), (4, 16, 64)
LAYERS = {
    "features and variance": ("primal", "direct", "albedo", "normal", "depth", "primal_var"),
    "albedo and normal": ("primal", "albedo", "normal"),
    "colour alone": ("primal",),
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cache", type=Path, required=True, help="folder for the rendered stacks and references")
    parser.add_argument("--reference-spp", type=int, default=2048)
    args = parser.parse_args()
    args.size = (192, 108)

    from data_gen.backend import use_variant

    use_variant()
    args.cache.mkdir(parents=True, exist_ok=True)
    references = {scene: cached(scene, args.reference_spp, "primal", 1, args)["primal"] for scene in SCENES}
    stacks = {(scene, spp): cached(scene, spp, "primal", 0, args) for scene in SCENES for spp in SPP}
    print(f"| layers | method | {' | '.join(f'{spp} spp' for spp in SPP)} |\n|---|---|{'--:|' * 3}")
    for title, names in LAYERS.items():
        for method in ("primal", "ngpt-colour", "nfor", "oidn"):
            if METHODS[method].missing() or not set(METHODS[method].needs) <= set(names):
                continue
            errors = {}
            for (scene, spp), stack in stacks.items():
                part = GradientStack({name: stack[name] for name in names if name in stack})
                errors[scene, spp] = relmse_trimmed(reconstruct(part, method).image, references[scene])
            means = [np.exp(np.mean([np.log(errors[scene, spp]) for scene in SCENES])) for spp in SPP]
            cells = " | ".join(f"{mean:.4f}" for mean in means)
            print(f"| {title} | `{method}` | {cells} |", flush=True)


if __name__ == "__main__":
    main()
