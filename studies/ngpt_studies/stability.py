"""Temporal stability: how much a method's image changes when only the noise changes.

    python -m ngpt_studies.stability DIR

DIR is a folder of results with pictures of all seeds (images = "all", configs/eval-stability.toml). A still scene
rendered with a new seed for each frame should not change; all change is flicker. Writes DIR/stability.json, a table
DIR/stability.md, and for each scene and method DIR/stability/SCENE-SPP-METHOD.png. In this picture, as with a rolling
shutter, each band of rows comes from another seed, so flicker shows as steps between bands; bias does not show.
"""

import argparse
import sys
from pathlib import Path
from typing import Any

import numpy as np

from ngpt.errors import NgptError
from ngpt.evaluation.config import file_part
from ngpt.evaluation.run import picture_path
from ngpt.image.display import auto_exposure, to_srgb8
from ngpt.image.png import encode_png
from ngpt.io.exr import read_image
from ngpt.measure.images import check_size, middle
from ngpt.measure.metrics import EPSILON, squared_error, trimmed_mean
from ngpt.report.evaluation import read_results
from ngpt.system.console import Console
from ngpt.system.writing import markdown_table, write_bytes, write_json, write_text


def flicker_and_bias(images: np.ndarray, *halves: np.ndarray, share: float = 0.001) -> dict[str, float]:
    """The two parts of the relMSE of ``images`` (N, H, W, 3) over seeds; their sum is the expected relMSE.

    ``flicker``  mean of v / (r² + 1e-3), v the sample variance over the N images
    ``bias``     mean of ((x - r)² - v / N) / (r² + 1e-3), x the mean image. v / N is what the noise of x adds to the
                 square, so the bias of an unbiased method is near 0, of either sign

    Both means leave out the ``share`` of pixels with the largest errors. With the two ``halves`` a, b of a reference,
    the square is (x - a)(x - b), and r is their mean. Raises NgptError for fewer than two images, and for a reference
    of another size.
    """
    if len(images) < 2:
        raise NgptError(f"stability needs images of at least 2 seeds; there is {len(images)}")
    for half in halves:
        check_size(images[0], half)
    reference = middle(tuple(half.astype(np.float64) for half in halves))
    scale = reference**2 + EPSILON
    mean, variance = images.mean(axis=0, dtype=np.float64), images.var(axis=0, ddof=1, dtype=np.float64)
    noise = variance / len(images)
    flicker, bias, size = variance, squared_error(mean, *halves) - noise, squared_error(mean, reference) - noise
    return {
        "flicker": trimmed_mean(flicker / scale, flicker / scale, share),
        "bias": trimmed_mean(bias / scale, size / scale, share),
    }


def rolling_shutter(images: np.ndarray) -> np.ndarray:
    """One image (H, W, 3) from N images (N, H, W, 3): N bands of rows from top to bottom, band i from image i."""
    height = images.shape[1]
    band = np.arange(height) * len(images) // height
    return images[band, np.arange(height)]


def study(out: Path) -> list[dict[str, Any]]:
    """Writes the files that the module's docstring lists, and returns the rows of stability.json.

    Raises NgptError for a picture that is missing.
    """
    results = read_results(out)
    seeds = range(results["settings"]["seeds"])
    rows = []
    (out / "stability").mkdir(exist_ok=True)
    for row in results["summary"]:
        scene, spp, method = row["scene"], row["spp"], row["method"]
        if scene is None:
            continue
        paths = [out / picture_path(scene, spp, method, seed) for seed in seeds]
        missing = next((path for path in paths if not path.is_file()), None)
        if missing:
            raise NgptError(f'{missing}: no such picture; set images = "all" in the configuration, and run it again')
        images = np.stack([read_image(path) for path in paths])
        entry = results["scenes"][scene]["reference"]
        reference = read_image(out / entry["image"])
        halves = [read_image(out / path) for path in entry["images of halves"]] or [reference]
        path = out / "stability" / f"{scene}-{spp}-{file_part(method)}.png"
        write_bytes(path, encode_png(to_srgb8(rolling_shutter(images), auto_exposure(reference))))
        rows.append({"scene": scene, "spp": spp, "method": method, **flicker_and_bias(images, *halves)})
    write_json(out / "stability.json", rows)
    write_text(out / "stability.md", table(rows, len(seeds)))
    return rows


def table(rows: list[dict[str, Any]], seeds: int) -> str:
    """A table in Markdown: flicker and bias of each method; the least flicker is bold."""
    methods = list(dict.fromkeys(row["method"] for row in rows))
    rows_of_text = []
    title = [f"Flicker / bias, the two parts of relMSE (trimmed), over {seeds} seeds; the steadiest in bold.", ""]
    cells = {(row["scene"], row["spp"], row["method"]): row for row in rows}
    for scene, spp in dict.fromkeys((row["scene"], row["spp"]) for row in rows):
        found = {m: cells[scene, spp, m] for m in methods if (scene, spp, m) in cells}
        least = min(row["flicker"] for row in found.values())
        texts = [scene, str(spp)]
        for method in methods:
            row = found.get(method)
            text = f"{row['flicker']:.4f} / {row['bias']:.4f}" if row else ""
            texts.append(f"**{text}**" if row and row["flicker"] == least else text)
        rows_of_text.append(texts)
    heads = ["scene", "spp", *(f"`{m}`" for m in methods)]
    return "\n".join([*title, *markdown_table(heads, rows_of_text)]) + "\n"


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, metavar="DIR")
    args = parser.parse_args()
    try:
        study(args.folder)
    except NgptError as error:
        Console().error(error)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
