"""Does a network gain more by samples that are shared out, once it was trained on such?

    python -m bench.adaptive --by wcv --scenes SCENE.xml ... --cache out/adaptive       # renders the stacks
    python -m bench.uneven --cache out/adaptive EVEN.safetensors UNEVEN.safetensors ...

For each file of weights, and each scene in the cache: trimmed relMSE of its image of even samples and of adaptive ones,
and their ratio; geometric means over scenes. docs/use/adaptive.md says how the files were trained.
"""

import argparse
from pathlib import Path

from bench.adaptive import mean_log
from ngpt.io.exr import read
from ngpt.measure.metrics import relmse_trimmed
from ngpt.methods import reconstruct


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("weights", nargs="+", type=Path)
    parser.add_argument("--cache", type=Path, default=Path("out/adaptive"))
    args = parser.parse_args()
    folders = [folder for folder in sorted(args.cache.iterdir()) if list(folder.glob("oracle-*.exr"))]
    names = [path.stem if path.stem != "weights" else path.parent.name for path in args.weights]
    print("| scene | " + " | ".join(f"{name}: even, adaptive, ratio" for name in names) + " |")
    print("|---|" + "--:|" * len(names))
    found: list[list[tuple[float, float]]] = [[] for _ in names]
    for folder in folders:
        halves = [read(path)["primal"] for path in sorted(folder.glob("reference-*.exr"))]
        for rows, path in zip(found, args.weights, strict=True):
            even, adaptive = (
                mean_log([error(stack, path, halves) for stack in sorted(folder.glob(f"{kind}-*.exr"))])
                for kind in ("even", "adaptive")
            )
            rows.append((even, adaptive))
        # The folder's name goes on with size, samples and method.
        scene = folder.name.rsplit("-", 3)[0]
        print(f"| {scene} | " + " | ".join(cell(*rows[-1]) for rows in found) + " |", flush=True)
    print("| mean | " + " | ".join(cell(*map(mean_log, zip(*rows, strict=True))) for rows in found) + " |")


def error(stack: Path, weights: Path, halves: list) -> float:
    # Above 0: of the halves' noise more may be taken off than there is.
    return max(relmse_trimmed(reconstruct(read(stack), "ngpt", weights=weights).image, *halves), 1e-9)


def cell(even: float, adaptive: float) -> str:
    return f"{even:.4f}, {adaptive:.4f}, {adaptive / even:.2f}"


if __name__ == "__main__":
    main()
