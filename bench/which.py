"""The picture of docs/start/which-sampler.md: scenes by path tracing and by the sampler that suits them.

    python -m bench.which --folder SCENES --seconds 12 --cache out/which

SCENES has veach-bidir, after Bitterli's resources.

Each row shows one scene at equal rendering time: path tracing, the same denoised by OIDN, and the stack of the suitable
sampler by the best method for it. Renders are kept in the cache.
"""

import argparse
from pathlib import Path

import numpy as np

import ngpt
from bench import panels
from bench.common import kept
from ngpt.image.display import auto_exposure, to_srgb8
from ngpt.stack import GradientStack

# Scene, suitable sampler, method for its stack
CASES = (
    ("diffuse", "gpt", "auto"),
    ("veach-bidir/scene.xml", "gbdpt", "auto"),
    ("bench/scenes/mirror-caustic/scene.xml", "vcm", "oidn"),
    ("haze", "gpt", "auto"),
)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--folder", type=Path, required=True, help="of the scenes that are files")
    parser.add_argument("--seconds", type=float, default=12, help="of each render")
    parser.add_argument("--size", type=int, nargs=2, default=(320, 180), metavar=("WIDTH", "HEIGHT"))
    parser.add_argument("--cache", type=Path, required=True, help="folder for what is rendered")
    parser.add_argument("--picture", type=Path, default=Path("docs/images/which-sampler.jpg"))
    args = parser.parse_args()
    rows = [row(args, *case) for case in CASES]
    lines = [["Path tracing"], ["Path tracing, OIDN"], ["The sampler of this row, denoised"]]
    panels.save(args.picture, panels.columns(lines, [list(tiles) for tiles in zip(*rows, strict=True)]))


def row(args: argparse.Namespace, scene: str, sampler: str, method: str) -> list[np.ndarray]:
    """Three tiles, (H, W, 3) uint8, of one exposure."""
    path, stack = rendered(args, scene, "primal"), rendered(args, scene, sampler)
    images = [path["primal"], ngpt.denoise(path, "oidn"), ngpt.denoise(stack, method)]
    exposure = auto_exposure(images[-1])
    return [to_srgb8(image, exposure) for image in images]


def rendered(args: argparse.Namespace, scene: str, sampler: str) -> GradientStack:
    name = Path(scene).parent.name or scene
    file = args.cache / f"{name}-{sampler}-{args.seconds:g}s.exr"

    def make() -> GradientStack:
        import data_gen

        path = args.folder / scene if (args.folder / scene).exists() else scene
        return data_gen.render_scene(path, sampler=sampler, seconds=args.seconds, size=tuple(args.size))[0]

    # Without gradients beside it the reader takes the name "direct" for direct light.
    return kept(file, make, {"direct": "direct"} if sampler in ("primal", "vcm") else None)


if __name__ == "__main__":
    main()
