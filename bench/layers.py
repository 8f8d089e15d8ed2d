"""The method that `auto` chooses by the layers of a stack, and its error.

The tables are in docs/lab/RESULTS.md ("By the layers of a stack") and docs/use/from-your-renderer.md ("What auto
takes").

    python -m bench.layers --cache /tmp/stacks --scenes diffuse glossy environment lens SCENE.xml ...

renders stacks with gradients, and references, which are kept in the cache folder. It measures the method that `auto`
chooses for every choice of their layers, with OIDN and without, and for files with the layer names of each renderer. It
writes bench/results/layers.json and prints both tables as Markdown. Errors are geometric means of the trimmed relMSE
over the scenes.
"""

import argparse
import tempfile
from collections.abc import Callable, Container, Sequence
from functools import partial
from itertools import combinations
from pathlib import Path
from typing import NamedTuple

import numpy as np

from bench.common import kept, metadata, renderer
from ngpt.evaluation.config import scene_name
from ngpt.io.exr import read
from ngpt.io.openexr import ExrImage, ExrPart, write_exr
from ngpt.layers import LAYERS
from ngpt.measure.averages import geometric_mean
from ngpt.measure.metrics import relmse_trimmed
from ngpt.methods import METHODS, choose, reconstruct
from ngpt.repair import variance_of_primal
from ngpt.stack import GradientStack
from ngpt.system.writing import markdown_table, write_json

TABLE = Path(__file__).parent / "results" / "layers.json"
SPP, SIZE, REFERENCE_SPP = (4, 16, 64), (192, 108), 2048
# Groups of layers that a renderer writes together or not at all.
GROUPS = (("albedo",), ("normal",), ("depth",), ("primal_var",), ("dx", "dy"), ("dx_var", "dy_var"))
SAMPLER = "gpt"  # whose stacks have all layers
NEED_OIDN = ("ngpt-combine", "ngpt-primal", "oidn")
# Samples per pixel for the table of renderers.
RENDERER_SPP = 16

# Renderer -> layer -> the names of its channels: the prefix, and the letters after its dot.
RENDERERS: dict[str, dict[str, tuple[str, str]]] = {
    "Cycles": {
        "primal": ("ViewLayer.Noisy Image", "RGB"),
        "albedo": ("ViewLayer.Denoising Albedo", "RGB"),
        "normal": ("ViewLayer.Denoising Normal", "XYZ"),
        "depth": ("ViewLayer.Denoising Depth", "Z"),
    },
    "Arnold": {"primal": ("", "RGB"), "albedo": ("denoise_albedo", "RGB"), "normal": ("N", "XYZ"), "depth": ("", "Z")},
    "V-Ray": {"primal": ("", "RGB"), "albedo": ("VRayDiffuseFilter", "RGB"), "normal": ("VRayBumpNormals", "RGB")},
    "RenderMan": {
        "primal": ("Ci", "rgb"),
        "albedo": ("albedo", "rgb"),
        "normal": ("normal", "xyz"),
        "depth": ("zfiltered", ""),
    },
    "pbrt-v4": {"primal": ("", "RGB"), "albedo": ("Albedo", "RGB"), "normal": ("Ns", "XYZ")},
    "Mitsuba 3": {"primal": ("", "RGB"), "albedo": ("albedo", "RGB"), "normal": ("nn", "XYZ"), "depth": ("dd.y", "T")},
    "Redshift": {
        "primal": ("", "RGB"),
        "albedo": ("DiffuseFilter", "RGB"),
        "normal": ("BumpNormals", "RGB"),
        "depth": ("", "Z"),
    },
    "Karma": {"primal": ("C", "RGB"), "albedo": ("albedo", "RGB"), "normal": ("N", "XYZ")},
}
# Our own names of layers, which any renderer may use.
OWN = {name: (name, "".join(layer.channels)) for name, layer in LAYERS.items()}
FEATURES, GRADIENTS, VARIANCES = ("albedo", "normal", "depth"), ("dx", "dy"), ("primal_var", "dx_var", "dy_var")
CHOICES: tuple[tuple[str, ...], ...] = (
    (),
    ("albedo",),
    ("albedo", "normal"),
    FEATURES,
    (*FEATURES, "primal_var"),
    GRADIENTS,
    (*GRADIENTS, *VARIANCES),
    (*FEATURES, *GRADIENTS),
    (*FEATURES, *GRADIENTS, *VARIANCES),
)


Judged = tuple[GradientStack, np.ndarray]  # a stack and its reference


class Row(NamedTuple):
    """The result for a file with the layer names of a renderer, and with these ``layers`` in addition to the colour.

    ``oidn``     whether OIDN was available
    ``method``   the method that `auto` chose
    ``error``    its error; ``by_oidn`` is the error of `oidn` on the same file, None without OIDN; ``before`` is the
                 error of the input. All are means over the scenes
    """

    renderer: str
    layers: tuple[str, ...]
    oidn: bool
    method: str
    error: float
    by_oidn: float | None
    before: float


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cache", type=Path, required=True, help="folder for the rendered stacks and references")
    parser.add_argument("--scenes", nargs="+", default=["diffuse", "glossy", "environment", "lens"])
    parser.add_argument("--size", type=int, nargs=2, default=SIZE, metavar=("WIDTH", "HEIGHT"))
    args = parser.parse_args()
    load_scene, render_stack = renderer()

    def rendered(scene: str, spp: int, sampler: str, seed: int) -> GradientStack:
        file = "{}-{}-{}-{}-{}x{}.exr".format(scene_name(scene), sampler, spp, seed, *args.size)
        loaded = partial(load_scene, scene, tuple(args.size))
        return kept(args.cache / file, lambda: render_stack(loaded(), spp, seed, sampler, unbiased=True))

    truth = {s: rendered(s, REFERENCE_SPP, "primal", 1)["primal"] for s in args.scenes}
    stacks = {n: [(rendered(s, n, SAMPLER, 0), truth[s]) for s in args.scenes] for n in SPP}
    rows = [
        {"method": method, "layers": layers, "error": [error_of(stacks[n], method, layers) for n in SPP]}
        for method, layers in sorted({("primal", ("primal",)), *cases()}, key=lambda case: (len(case[1]), case))
    ]
    about = {"scenes": [scene_name(s) for s in args.scenes], "size": list(args.size), "spp": list(SPP)}
    write_json(TABLE, {**about, "rows": rows, "metadata": metadata("mitsuba", "mitsuba-oidn")})
    print(by_layers(rows) + "\n")
    with tempfile.TemporaryDirectory() as folder:
        print(by_renderer(renderers(stacks[RENDERER_SPP], Path(folder))))


def cases() -> dict[tuple[str, tuple[str, ...]], None]:
    """Each method that `auto` chooses for a choice of ``GROUPS``, and the layers that it uses; with OIDN or not."""
    found: dict[tuple[str, tuple[str, ...]], None] = {}
    for groups in (groups for size in range(len(GROUPS) + 1) for groups in combinations(GROUPS, size)):
        layers = {"primal", *(name for group in groups for name in group)}
        for oidn in (True, False):
            method = choose(layers, usable(oidn))
            found[method, used(method, layers)] = None
    return found


def usable(oidn: bool) -> Callable[[str], bool]:
    """The second argument of ``choose`` if all packages are installed, with OIDN or without."""
    return lambda name: oidn or name not in NEED_OIDN


def used(method: str, layers: Container[str]) -> tuple[str, ...]:
    """Returns the ``layers`` that a method uses, in the order of ``LAYERS``."""
    entry = METHODS[method]
    return tuple(name for name in LAYERS if name in layers and name in (*entry.needs, *entry.uses, *entry.estimates))


def error_of(scenes: Sequence[Judged], method: str, layers: Sequence[str] = ()) -> float:
    """The geometric mean over the scenes of a method's error; with only these ``layers``, unless they are empty."""
    given = ((part(stack, layers) if layers else stack, truth) for stack, truth in scenes)
    return geometric_mean(relmse_trimmed(reconstruct(stack, method).image, truth) for stack, truth in given)


def part(stack: GradientStack, layers: Sequence[str]) -> GradientStack:
    """The stack with only these layers. With gradients, it keeps the light that gradients exclude."""
    apart = [name for name in ("direct", "caustic", "caustic_var") if "dx" in layers and name in stack]
    whole = {"primal_var": variance_of_primal(stack)} if "primal_var" in layers and "dx" not in layers else {}
    return GradientStack({name: stack[name] for name in (*layers, *apart)} | whole)


def renderers(scenes: Sequence[Judged], folder: Path) -> list[Row]:
    """A row for each renderer and each of ``CHOICES`` that it can write, with OIDN and without."""
    rows, known = [], {}
    for name, names in {**RENDERERS, "any, by our names": OWN}.items():
        for layers in CHOICES:
            held = ("primal", *layers)
            # Layers that some renderer writes are measured only with its names.
            if not set(held) <= names.keys() or (names is OWN and "dx" not in layers and "primal_var" not in layers):
                continue
            files = [(written(folder / "stack.exr", stack, names, held), truth) for stack, truth in scenes]
            for oidn in (True, False):
                if oidn and METHODS["oidn"].missing():
                    continue
                key = held, oidn, tuple(stack.names for stack, _ in files)
                if key not in known:
                    known[key] = measured(files, oidn)
                rows.append(Row(name, layers, oidn, *known[key]))
    return rows


def written(
    path: Path, stack: GradientStack, names: dict[str, tuple[str, str]], layers: Sequence[str]
) -> GradientStack:
    """These layers, written to a file with a renderer's names, and read again."""
    channels, held = {}, part(stack, layers)
    for layer in held.names:
        prefix, suffixes = names[layer]
        keys = [".".join(filter(None, (prefix, suffix))) for suffix in suffixes or [""]]
        channels |= {key: np.ascontiguousarray(held[layer][..., i]) for i, key in enumerate(keys)}
    write_exr(path, ExrImage([ExrPart("", {}, channels)]), overwrite=True)
    return read(path)


def measured(files: Sequence[Judged], oidn: bool) -> tuple[str, float, float | None, float]:
    """The entries of a ``Row`` from ``method`` on."""
    method = choose(files[0][0], lambda name: not METHODS[name].missing() and (oidn or name not in NEED_OIDN))
    return method, error_of(files, method), error_of(files, "oidn") if oidn else None, error_of(files, "primal")


def by_layers(rows: list[dict]) -> str:
    """Markdown: each method with the fewest and with the most layers. ``rows`` are sorted by the number of layers."""
    heads = ["layers that it takes", "method", *(f"{n} spp" for n in SPP)]
    ends: dict[str, list[dict]] = {}
    for row in rows:
        ends.setdefault(row["method"], [row, row])[1] = row
    shown = [row for row in rows if row in ends[row["method"]]]
    cells = ([", ".join(r["layers"]), f"`{r['method']}`", *(f"{e:.4f}" for e in r["error"])] for r in shown)
    return "\n".join(markdown_table(heads, cells, 2))


def by_renderer(rows: list[Row]) -> str:
    """Markdown. Renderers with the same results share a line."""
    heads = ["layers beside colour", "with OIDN", "error", "of `oidn`", "without", "error", "of the input", "names of"]
    lines: dict[str, list[str]] = {}
    for row in (row for row in rows if not row.oidn):
        there = [r for r in rows if r.oidn and (r.renderer, r.layers) == (row.renderer, row.layers)]
        with_oidn = [(f"`{r.method}`", f"{r.error:.4f}", f"{r.by_oidn:.4f}") for r in there]
        cells = [", ".join(row.layers) or "none", *(with_oidn or [("", "", "")])[0], f"`{row.method}`"]
        lines.setdefault(" | ".join([*cells, f"{row.error:.4f}", f"{row.before:.4f}"]), []).append(row.renderer)
    table = [f"| {cells} | {', '.join(names)} |" for cells, names in lines.items()]
    return "\n".join([f"| {' | '.join(heads)} |", "|---|---|--:|--:|---|--:|--:|---|", *table])


if __name__ == "__main__":
    main()
