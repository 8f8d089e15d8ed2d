"""A contact sheet for the eye, in blind order: python -m bench.sheet EVALUATION --methods oidn ngpt-combine -o out/

Each row is one crop of one scene and number of samples of an evaluation whose images were kept (``images = "first"``):
the reference, then the methods in a random order, named A, B, C. Scene, samples and place depend only on --seed;
nobody chooses them. Write down which one you prefer, then open key.json: it says what A, B and C are, and gives the
errors (FLIP and trimmed relMSE) of each crop. ``python -m bench.sheet EVALUATION --answers "BCA A..." -o out/`` counts
the answers by the key in that folder: one letter per row, - for none.
"""

import argparse
import json
from collections import Counter
from pathlib import Path

import numpy as np

from bench import panels
from ngpt.errors import NgptError
from ngpt.image.display import to_srgb8
from ngpt.io.exr import read_image
from ngpt.measure.flip import flip
from ngpt.measure.metrics import relmse_trimmed
from ngpt.system.writing import write_json

LETTERS = "ABCDEFGH"
TILE = 288  # pixels of the sheet to a side of a crop


def draw(results: dict, methods: list[str], rows: int, size: int, seed: int) -> list[dict]:
    """``rows`` crops: scene, spp, their corner (left, top), and the order of the methods."""
    images: dict[tuple[str, int], dict[str, str]] = {}
    for cell in results["cells"]:
        if cell["image"] and cell["seed"] == 0 and cell["method"] in methods:
            images.setdefault((cell["scene"], cell["spp"]), {})[cell["method"]] = cell["image"]
    whole = sorted(key for key, have in images.items() if len(have) == len(methods))
    if not whole:
        raise NgptError(f"no scene has kept images of all of {', '.join(methods)}; evaluate with images = 'first'")
    rng = np.random.default_rng(seed)
    drawn = []
    order = rng.permutation(len(whole))
    for row in range(rows):
        scene, spp = whole[order[row % len(whole)]]
        width, height = results["scenes"][scene]["size"]
        corner = [int(rng.integers(max(1, n - size + 1))) for n in (width, height)]
        letters = [methods[i] for i in rng.permutation(len(methods))]
        drawn.append({"scene": scene, "spp": spp, "corner": corner, "order": letters, "images": images[scene, spp]})
    return drawn


def crops(folder: Path, results: dict, row: dict, size: int) -> tuple[list[np.ndarray], dict]:
    """The tiles of a row, reference first; and the errors of its methods."""
    entry, (left, top) = results["scenes"][row["scene"]], row["corner"]

    def crop(path: str) -> np.ndarray:
        return read_image(folder / path)[top : top + size, left : left + size]

    reference = crop(entry["reference"]["image"])
    halves = tuple(crop(path) for path in entry["reference"]["images of halves"]) or (reference,)
    found = {method: crop(row["images"][method]) for method in row["order"]}
    errors = {
        method: {"FLIP": float(flip(image, reference)[0]), "relMSE trimmed": float(relmse_trimmed(image, *halves))}
        for method, image in found.items()
    }
    tiles = [to_srgb8(image, entry["exposure"]) for image in (reference, *found.values())]
    return [panels.scaled(tile, (TILE, TILE * tile.shape[0] // tile.shape[1])) for tile in tiles], errors


def count(key: list[dict], answers: str) -> Counter:
    """How often each method was preferred, over the rows of the key; ``-`` counts for none."""
    letters = [letter for letter in answers.upper() if not letter.isspace()]
    if len(letters) != len(key):
        raise NgptError(f"{len(letters)} answers to {len(key)} rows; one letter for each row, - for none")
    for number, (letter, row) in enumerate(zip(letters, key, strict=True), 1):
        if letter != "-" and letter not in LETTERS[: len(row["order"])]:
            raise NgptError(f"answer {number} is {letter!r}; the row has {LETTERS[: len(row['order'])]}, or - for none")
    return Counter(
        row["order"][LETTERS.index(letter)] if letter != "-" else "none"
        for letter, row in zip(letters, key, strict=True)
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("evaluation", type=Path, help="folder that ngpt evaluate wrote")
    parser.add_argument("--methods", nargs="+", default=["path", "oidn", "ngpt-combine"])
    parser.add_argument("--rows", type=int, default=12)
    parser.add_argument("--size", type=int, default=96, help="pixels to a side of a crop")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--answers", help="letters, one for each row: counts against the key that is there")
    parser.add_argument("-o", "--out", type=Path, required=True, help="folder of sheet.png and key.json")
    args = parser.parse_args()
    if args.answers:
        for method, times in count(json.loads((args.out / "key.json").read_text()), args.answers).most_common():
            print(f"{method:16} {times}")
        return
    results = json.loads((args.evaluation / "results.json").read_text())
    rows = draw(results, args.methods, args.rows, args.size, args.seed)
    tiles = []
    for row in rows:
        pictures, row["errors"] = crops(args.evaluation, results, row, args.size)
        tiles.append(pictures)
    headings = [["reference"], *([letter] for letter in LETTERS[: len(args.methods)])]
    panels.save(args.out / "sheet.png", panels.columns(headings, list(zip(*tiles, strict=True))))
    write_json(args.out / "key.json", rows)


if __name__ == "__main__":
    main()
