"""Where each method does worst beside the others: the pictures of docs/methods/classical.md.

    python eval.py --config configs/eval-classical.toml --out out/classical
    python -m bench.fails out/classical -o docs/images                  # METHOD-fails.png for each method

Left the method, in the middle the best other one, right the reference, four times as large. The cell is the one with
the largest ratio of errors of an evaluation's first seed; the place is where the capped squared errors differ most.
"""

import argparse
import json
from pathlib import Path

import numpy as np

from bench import panels
from ngpt.image.display import auto_exposure, to_srgb8
from ngpt.io.exr import read_image
from ngpt.measure.metrics import relative_squared_error

CROP, SCALE = 48, 4  # pixels, and how many times as large they are shown


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="of the evaluation")
    parser.add_argument("-o", "--output", type=Path, default=Path("docs/images"))
    args = parser.parse_args()
    results = json.loads((args.folder / "results.json").read_text())
    cells = {
        (cell["scene"], cell["spp"], cell["method"]): cell
        for cell in results["cells"]
        if cell["image"] and not cell["absent"] and results["methods"][cell["method"]]["method"] != "primal"
    }

    def error(key: tuple[str, int, str]) -> float:
        return cells[key]["metrics"][results["primary"]]

    for method in dict.fromkeys(method for *_, method in cells):
        best_other = {
            key: min((k for k in cells if k[:2] == key[:2] and k[2] != method), key=error)
            for key in cells
            if key[2] == method
        }
        worst = max(best_other, key=lambda key: error(key) / error(best_other[key]))
        reference = results["scenes"][worst[0]]["reference"]["image"]
        files = (cells[worst]["image"], cells[best_other[worst]]["image"], reference)
        images = [read_image(args.folder / file) for file in files]
        x, y = place(*images)
        crops = [image[y : y + CROP, x : x + CROP] for image in images]
        shown = [to_srgb8(crop, auto_exposure(crops[-1])) for crop in crops]
        panels.save(args.output / f"{method}-fails.png", np.kron(np.concatenate(shown, 1), np.ones((SCALE, SCALE, 1))))
        print(f"{method}-fails.png: {worst[0]}, {worst[1]} spp, beside {best_other[worst][2]}, at ({x}, {y})")


def place(image: np.ndarray, other: np.ndarray, reference: np.ndarray) -> tuple[int, int]:
    """The corner (x, y) of the window in which ``image`` (H, W, 3) is worst beside the ``other``."""
    errors = [relative_squared_error(one, reference).mean(axis=-1) for one in (image, other)]
    # Capped, so that a place with many bad pixels wins over a single firefly.
    excess = np.minimum(errors[0], 1) - np.minimum(errors[1], 1)
    sums = panels.windows(excess, CROP, CROP)
    y, x = np.unravel_index(np.argmax(sums), sums.shape)
    return int(x), int(y)


if __name__ == "__main__":
    main()
