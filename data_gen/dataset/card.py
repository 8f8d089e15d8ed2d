"""Writes README.md and a contact sheet of a training set, from the set itself."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import numpy as np

from ngpt.image.display import auto_exposure, to_srgb8
from ngpt.image.png import encode_png
from ngpt.system.console import Console
from ngpt.system.files import atomic_output
from ngpt.training.dataset import Dataset, ShardCrop, summary

CELLS = 24  # crops on the contact sheet, evenly spaced in the set
COLUMNS = 4  # cells in a row; each cell shows the noisiest input of a crop beside its reference


def write_card(folder: Path) -> None:
    """Writes README.md and contact.png into the training set at ``folder``."""
    data = Dataset(folder)
    facts = summary(folder)
    if len(data):
        with atomic_output(folder / "contact.png", overwrite=True) as path:
            path.write_bytes(encode_png(contact_sheet(data)))
    with atomic_output(folder / "README.md", overwrite=True) as path:
        path.write_text(card(data, facts))
    for problem in facts["problems"]:
        Console().say(problem)


def contact_sheet(data: Dataset) -> np.ndarray:
    """(H, W, 3) uint8: two images of each of some crops, see ``shown``, with the automatic exposure of the second."""
    pairs = []
    for index in np.unique(np.linspace(0, len(data) - 1, min(CELLS, len(data))).astype(int)):
        images = shown(data[int(index)])
        stops = auto_exposure(images[1])
        pair = [to_srgb8(image, stops) for image in images]
        pairs.append(np.pad(np.hstack(pair), ((0, 4), (0, 4), (0, 0)), constant_values=32))
    while len(pairs) % COLUMNS:
        pairs.append(np.full_like(pairs[0], 32))
    return np.vstack([np.hstack(pairs[i : i + COLUMNS]) for i in range(0, len(pairs), COLUMNS)])


def shown(crop: ShardCrop) -> tuple[np.ndarray, np.ndarray]:
    """The noisiest input and the reference, or the two halves of a pair, (H, W, 3) each."""
    return crop.stack(0)["primal"], crop.stack(1)["primal"] if crop.paired else crop.reference


def card(data: Dataset, facts: dict) -> str:
    config = data.manifest["config"]
    records = [crop for entry in data.manifest["shards"] for crop in entry["crops"]]
    failures = [(entry["scene"], failure) for entry in data.manifest["shards"] for failure in entry["failures"]]
    counts = np.array([n for crop in records for n in crop["spp"]])
    edges = 2 ** np.arange(int(np.log2(config["spp"][0])), int(np.log2(config["spp"][1])) + 2)
    exposures = np.array([-auto_exposure(shown(crop)[1]) for crop in data])
    shots = f"{facts['shots']} shots of up to {config['frames']} frames: " if "shots" in facts else ""
    k = facts.get("subpixels", 1)
    fine = f", with {k}x{k} subpixels" if k > 1 else ""
    sampler = config.get("sampler", "gpt")
    if config["reference_spp"]:
        what = "the noisiest input and the reference"
        how = (
            f"References: {sampler} at {config['reference_spp']} samples per pixel, reconstructed by "
            f"{config['reference_method']}."
        )
    else:
        what, how = (
            "halves",
            f"No references: each of the two inputs of a crop, rendered by {sampler}, is the target of the other.",
        )
    lines = [
        "# Training set",
        "",
        f"{shots}{facts['crops']} crops of {config['size']}x{config['size']} pixels from {facts['scenes']} scenes "
        f"({facts['planned']} planned, {facts['failed']} failed), {config['inputs']} inputs each{fine}; "
        f"{facts['megabytes']} MB in {facts['shards']} shards. Verify it by `ngpt info DIR`.",
        "",
        f"{how} Seed {config['seed']}.",
        "",
        f"![Pairs of {what}](contact.png)",
        "",
        "| samples per pixel | inputs |",
        "|---|---|",
    ]
    lines += [f"| {a} to {b - 1} | {np.sum((counts >= a) & (counts < b))} |" for a, b in pairwise(edges)]
    lines += ["", "| log-average luminance, stops from middle grey | crops |", "|---|---|"]
    for low in range(-12, 12, 2):
        if within := int(np.sum((exposures >= low) & (exposures < low + 2))):
            lines.append(f"| {low} to {low + 2} | {within} |")
    lines += ["", "| seconds | all | per crop |", "|---|---|---|"]
    lines += [f"| {part} | {value:.0f} | {value / max(len(data), 1):.2f} |" for part, value in facts["seconds"].items()]
    if failures:
        lines += ["", "Failures:", ""] + [f"- {scene}, crop {one['crop']}: {one['error']}" for scene, one in failures]
    return "\n".join(lines) + "\n"
