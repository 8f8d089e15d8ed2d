"""What it is worth that the albedo counts media: errors with it over those with the albedo of the surfaces behind.

    python -m bench.fog --scenes haze smoke cloud SCENE.xml ...

Path-traced stacks, the same samples in all; trimmed relMSE against a reference of two halves, geometric means over
--seeds and --spp. "none" has no features at all.
"""

import argparse
from unittest.mock import patch

import numpy as np

from bench.common import metadata, save
from ngpt.evaluation.config import scene_name
from ngpt.measure.metrics import relmse_trimmed
from ngpt.methods import denoise

FEATURES = ("albedo", "normal", "depth")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", nargs="+", default=["haze", "smoke", "cloud"])
    parser.add_argument("--size", type=int, nargs=2, default=(72, 48), metavar=("WIDTH", "HEIGHT"))
    parser.add_argument("--spp", type=int, nargs="+", default=(16, 64))
    parser.add_argument("--seeds", type=int, default=2)
    parser.add_argument("--reference-spp", type=int, default=1024)
    parser.add_argument("--methods", nargs="+", default=("oidn", "ngpt-primal"))
    parser.add_argument("-o", "--output", default="bench/results/fog.json")
    args = parser.parse_args()

    from data_gen.backend import use_variant

    use_variant()
    setup = {"size": list(args.size), "spp": list(args.spp), "seeds": args.seeds, "reference spp": args.reference_spp}
    result: dict = {"benchmark": "fog"} | setup | {"metadata": metadata("mitsuba"), "scenes": {}}
    for scene in args.scenes:
        row = result["scenes"][scene_name(scene)] = bench_scene(scene, args)
        save(args.output, result)
        for method, errors in row.items():
            print(f"{scene_name(scene):20} {method:12}", *(f"{name} {x:.2f}" for name, x in errors.items()), flush=True)


def bench_scene(path: str, args: argparse.Namespace) -> dict[str, dict[str, float]]:
    """Method -> choice of features -> error over that with the surfaces behind the media."""
    from data_gen.render import render_stack
    from data_gen.scenes.load import load_scene

    scene = load_scene(path, tuple(args.size))
    halves = [
        render_stack(scene, args.reference_spp // 2, 1 << 20 | i, "primal", with_features=False)["primal"]
        for i in range(2)
    ]
    logs: dict[str, dict[str, list[float]]] = {method: {"media": [], "none": []} for method in args.methods}
    for spp in args.spp:
        for seed in range(args.seeds):
            counted = render_stack(scene, spp, seed, "primal")
            with patch("data_gen.paths.features.in_media", lambda *_: (None, 0)):
                behind = render_stack(scene, spp, seed, "primal")
            none = counted.replace(**{name: np.zeros_like(counted[name]) for name in FEATURES})
            for method, row in logs.items():
                usual = error(behind, method, halves)
                for name, stack in {"media": counted, "none": none}.items():
                    row[name].append(float(np.log(error(stack, method, halves) / usual)))
    return {
        method: {name: round(float(np.exp(np.mean(values))), 4) for name, values in row.items()}
        for method, row in logs.items()
    }


def error(stack, method: str, halves) -> float:
    # Above 0: of the two halves' noise more may be taken off than there is, where hardly any error is left.
    return max(relmse_trimmed(denoise(stack, method), *halves), 1e-9)


if __name__ == "__main__":
    main()
