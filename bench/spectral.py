"""Spectra with and without steps between wavelengths, at equal time: docs/samplers/spectral.md.

    python -m bench.spectral [--samples 2 8 32] [--picture docs/images/prism.png]

The scene is a prism and a ball of flint glass before stripes (data_gen/samplers/studies/spectral/scene.py). Time is
processor time, kernels compiled: the render without steps has as many samples as take the time of the one with them.
Errors are relMSE, trimmed, of the RGB image, and of the light of single bins, against two halves of
--reference-samples.
"""

import argparse
import time
from pathlib import Path

import numpy as np

from bench.common import metadata, save
from ngpt.measure.metrics import relmse_trimmed
from ngpt.report.display import auto_exposure, to_srgb8
from ngpt.report.png import encode_png
from ngpt.system.files import atomic_output

_REFERENCE_SEED = 1 << 20


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--samples", nargs="+", type=int, default=[2, 8, 32], help="of a bin, with steps")
    parser.add_argument("--bins", type=int, default=16)
    parser.add_argument("--size", type=int, nargs=2, default=(96, 64), metavar=("WIDTH", "HEIGHT"))
    parser.add_argument("--reference-samples", type=int, default=512, help="of a bin, of each half")
    parser.add_argument("--seeds", type=int, default=2)
    parser.add_argument("--picture", type=Path)
    parser.add_argument("-o", "--output", type=Path, default=Path("bench/results/spectral.json"))
    args = parser.parse_args()

    from data_gen.backend import use_variant

    use_variant("llvm_ad_spectral")

    import mitsuba as mi

    from data_gen.samplers.studies.spectral.glass import register
    from data_gen.samplers.studies.spectral.render import Spectra, render_spectra
    from data_gen.samplers.studies.spectral.scene import prism
    from data_gen.samplers.studies.spectral.solve import reconstructed, to_rgb
    from data_gen.scenes.load import set_film_size

    register()
    scene = mi.load_dict(prism())
    set_film_size(scene, tuple(args.size))

    def timed(samples: int, seed: int, steps: bool) -> tuple[float, Spectra]:
        start = time.process_time()
        spectra = render_spectra(scene, args.bins, samples, seed, steps)
        return time.process_time() - start, spectra

    halves = [render_spectra(scene, args.bins, args.reference_samples, _REFERENCE_SEED + i, False) for i in range(2)]
    edges = halves[0].edges
    colours = [to_rgb(half.light, edges) for half in halves]
    rows, images = {}, []
    for samples in args.samples:
        for steps in (True, False):
            timed(2, 0, steps)
        cost = [min(timed(samples, 9, steps)[0] for _ in range(3)) for steps in (True, False)]
        more = max(2, round(samples * cost[0] / cost[1]))
        found: dict[str, list[float]] = {}
        for seed in range(1, args.seeds + 1):
            with_steps, without = timed(samples, seed, True)[1], timed(more, seed, False)[1]
            for name, values in (("steps", reconstructed(with_steps)), ("none", without.light)):
                image = to_rgb(values, edges)
                found.setdefault(f"{name}, RGB", []).append(relmse_trimmed(image, *colours))
                bins = [
                    relmse_trimmed(*(v[..., b : b + 3] for v in (values, *(h.light for h in halves))))
                    for b in range(2, args.bins - 4, 3)
                ]
                found.setdefault(f"{name}, bins", []).append(float(np.mean(bins)))
                if seed == 1 and samples == args.samples[0]:
                    images.append(image)
        rows[samples] = {name: float(np.mean(values)) for name, values in found.items()} | {
            "cost": cost[0] / cost[1],
            "samples without": more,
        }
        print(samples, rows[samples], flush=True)
    save(
        args.output,
        {
            "benchmark": "spectral",
            "bins": args.bins,
            "size": list(args.size),
            "rows": rows,
            "metadata": metadata("mitsuba"),
        },
    )
    if args.picture:
        images.append((colours[0] + colours[1]) / 2)
        stop = auto_exposure(images[-1])
        tiles = [np.kron(to_srgb8(image, stop), np.ones((3, 3, 1), np.uint8)) for image in images]
        with atomic_output(args.picture, overwrite=True) as temporary:
            temporary.write_bytes(encode_png(np.ascontiguousarray(np.concatenate(tiles, axis=1))))


if __name__ == "__main__":
    main()
