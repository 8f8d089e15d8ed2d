"""Crops per hour by scene, where the time goes, and how far that is from the ideal.

    python -m bench.dataset --config configs/data-cpu.toml --scenes 4 -o bench/results/dataset.json

The ideal renders the samples of a crop, inputs and reference, at the sampler's own rate on that very view, with kernels
that are compiled already. What a training set pays beside that: scenes, kernels, cameras, reconstruction, files.
"""

import argparse
import tempfile
import time
from pathlib import Path

from bench.common import metadata, save


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--config", type=Path, default=Path("configs/data-cpu.toml"))
    parser.add_argument("--scenes", type=int, default=4, help="jobs to run, evenly taken from the configuration's")
    parser.add_argument("-o", "--output", required=True)
    args = parser.parse_args()

    from data_gen.backend import use_variant
    from data_gen.dataset.config import read_config

    use_variant()
    config = read_config(args.config)
    plan = config.plan()
    jobs = [plan[i * len(plan) // args.scenes] for i in range(min(args.scenes, len(plan)))]
    rows = {job.file: measure(config, job) for job in jobs}
    seconds = sum(row["seconds"] for row in rows.values())
    total = {
        "crops per hour": 3600 * sum(row["crops"] for row in rows.values()) / seconds,
        "seconds over ideal": seconds / sum(row["ideal seconds"] for row in rows.values()),
        "share of references": sum(row["reference seconds"] for row in rows.values()) / seconds,
    }
    print(total)
    save(args.output, {"benchmark": "dataset", "jobs": rows, "total": total, "metadata": metadata("mitsuba", "drjit")})


def measure(config, job) -> dict:
    """Makes the shard of one job and renders its views again, for the rate of the renderer alone."""
    import mitsuba as mi

    from data_gen.dataset.cameras import View
    from data_gen.dataset.crops import made_scene, make_shard
    from data_gen.render import render_stack
    from data_gen.scenes.load import load_scene
    from ngpt.training.shards import Shard

    with tempfile.TemporaryDirectory() as folder:
        (Path(folder) / "shards").mkdir()
        start = time.perf_counter()
        name = make_shard(config, job, folder, mi.variant())
        seconds = time.perf_counter() - start
        record = Shard(Path(folder) / name).record
    ideal = 0.0
    with tempfile.TemporaryDirectory() as folder:
        path = job.path or str(made_scene(config, job.scene, Path(folder)))
        scene = load_scene(path, None, job.parameters, merged=config.frames == 1)
    for crop in record["crops"]:
        View(**crop["view"]).apply(scene)
        start = time.perf_counter()
        render_stack(scene, config.reference_spp)
        per_sample = (time.perf_counter() - start) / config.reference_spp
        ideal += per_sample * (sum(crop["spp"]) + config.reference_spp)
    row = {
        "crops": len(record["crops"]),
        "failures": record["failures"],
        "spp": [crop["spp"] for crop in record["crops"]],
        "seconds": seconds,
        "ideal seconds": ideal,
        "scene seconds": record["scene_seconds"],
        "camera seconds": sum(crop["seconds"]["camera"] for crop in record["crops"]),
        "input seconds": sum(crop["seconds"]["inputs"] for crop in record["crops"]),
        "reference seconds": sum(crop["seconds"]["reference"] for crop in record["crops"]),
    }
    print(job.file, {k: round(v, 2) for k, v in row.items() if isinstance(v, float)}, flush=True)
    return row


if __name__ == "__main__":
    main()
