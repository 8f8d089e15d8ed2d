"""Paths reused from frame to frame compared to new ones: cost, noise, and reconstructions at equal time.

    python -m bench.restir --folder SCENES --scenes diffuse glossy cornell-box --out OUT

The camera goes sideways, or a shape or a lamp moves, as in ``bench.shots``. Rivals:

    restir       reservoirs of pixels and of pairs
    after        reservoirs of pixels; differences are computed from the paths they keep: the paper's baseline
    gpt          new samples in each frame

``cost`` is the wall-clock and processor time of a frame relative to a sample of ``gpt``, the median of ``--repeats``
frames of all rivals in turn, with as many chains as samples. ``noise`` is the variance of primal, dx and dy (without
the worst 1 % of the pixels) in the last frame, also times the cost, relative to ``gpt``: below 1, a frame is worth more
than it costs. Then all rivals render for the time of ``--chains`` chains of ``restir``, and their frames after
``--skip`` are reconstructed; + temporal: as `ngpt denoise --temporal` does. relMSE and flicker are as in
``bench.shots``.
"""

import argparse
import statistics
import time
from pathlib import Path

import numpy as np

import ngpt
from bench.common import metadata, renderer, save
from bench.shots import SPEEDS, measured, shot_of
from ngpt.sequence.history import Temporal

RIVALS = {
    "restir": {"sampler": "restir"},
    "after": {"sampler": "restir", "gradients": "after"},
    "gpt": {"sampler": "gpt"},
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--folder", type=Path, help="folder of scenes: NAME/scene.xml")
    parser.add_argument("--scenes", nargs="*", default=["diffuse", "glossy"])
    parser.add_argument("--shots", nargs="*", default=["slow"], choices=[*SPEEDS, "object", "light"])
    parser.add_argument("--methods", nargs="*", default=["wcv", "ngpt-fast", "oidn"])
    parser.add_argument("--frames", type=int, default=16)
    parser.add_argument("--skip", type=int, default=8)
    parser.add_argument("--size", default="96x54")
    parser.add_argument("--chains", type=int, default=4)
    parser.add_argument("--cost-size", default="256x144")
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--reference-spp", type=int, default=2048)
    parser.add_argument("--out", type=Path, required=True)
    args = parser.parse_args()
    renderer()
    result: dict = {"metadata": metadata("mitsuba-oidn"), "scenes": []}
    for scene in args.scenes:
        known = {}
        for shot in args.shots:
            # The cost of a moving camera is the same at all speeds.
            changes = shot not in SPEEDS
            cost = known[changes] = known.get(changes) or costs(args, scene, shot if changes else "slow")
            print(
                scene, shot, {name: {k: round(v, 2) for k, v in row.items()} for name, row in cost.items()}, flush=True
            )
            found = {"scene": scene, "shot": shot, "cost": cost} | compare(args, scene, shot, cost)
            result["scenes"].append(found)
            save(args.out / "restir.json", result)


def costs(args: argparse.Namespace, scene: str, shot: str) -> dict[str, dict[str, float]]:
    """Wall-clock and processor time of a frame in units of a gpt sample, and how many kernels it launches."""
    import drjit as dr

    from data_gen.budget import Budget
    from data_gen.passes import render_passes
    from data_gen.samplers import FRAME_SAMPLERS, SAMPLERS

    moving = shot_of(args.folder, scene, shot, args.cost_size)
    changes = shot not in SPEEDS
    turns = [moving, moving.twin()] if changes else [moving]
    loaded = moving.at(0)
    rivals = {
        name: FRAME_SAMPLERS["restir"].made(loaded, 1, args.chains, 6144, gradients=gradients)
        for name, gradients in (("restir", "pairs"), ("after", "after"))
    }
    gpt = SAMPLERS["gpt"].made(loaded)
    # The motion of the slow shot in every pixel, only to measure its time.
    width, height = map(int, args.cost_size.split("x"))
    motion = np.full((height, width, 2), (0.5, 0.0))
    clock: dict[str, list[float]] = {}
    processor: dict[str, list[float]] = {}
    launches: dict[str, int] = {}
    dr.set_flag(dr.JitFlag.KernelHistory, True)
    for frame in range(args.repeats + 2):
        turn = turns[frame % len(turns)]
        now, shapes = turn.at(frame), turn.snapshot(frame).shapes
        for name in (*rivals, "gpt"):
            dr.kernel_history_clear()
            start, work = time.perf_counter(), time.process_time()
            if name == "gpt":
                render_passes(gpt, loaded.sensors()[0], frame, Budget(args.chains))
            else:
                rivals[name].film(frame, motion, None, (now, shapes) if changes else None)
            dr.sync_thread()
            seconds, work = time.perf_counter() - start, time.process_time() - work
            history = dr.kernel_history()
            if frame >= 2:
                clock.setdefault(name, []).append(seconds)
                processor.setdefault(name, []).append(work)
                launches[name] = sum(entry["type"] == dr.KernelType.JIT for entry in history)
    dr.set_flag(dr.JitFlag.KernelHistory, False)
    clock_of, processor_of = ({n: statistics.median(v) for n, v in values.items()} for values in (clock, processor))
    return {
        name: {
            "clock": clock_of[name] / clock_of["gpt"],
            "processor": processor_of[name] / processor_of["gpt"],
            "launches": launches[name],
        }
        for name in clock_of
    }


def compare(args: argparse.Namespace, scene: str, shot: str, cost: dict) -> dict:
    """Noise of a frame, and errors of reconstructions at equal processor time."""
    from data_gen.session import render_frames

    camera = shot_of(args.folder, scene, shot, args.size)
    reference = {"sampler": "primal", "features": False, "unbiased": True, "subpixels": 1}
    wanted = range(args.skip, args.frames)
    references = [
        stack
        for _, stack in render_frames(
            camera, range(args.frames), args.reference_spp, 2, skip=lambda frame: frame not in wanted, **reference
        )
    ]
    stacks, noise = {}, {}
    for name, options in RIVALS.items():
        spp = max(2, round(args.chains * cost["restir"]["processor"] / cost[name]["processor"]))
        stacks[name] = [
            stack for _, stack in render_frames(camera, range(args.frames), spp, 1, unbiased=True, **options)
        ]
        last = stacks[name][-1]
        if name == "gpt":
            # Elsewhere caustics are in the differences.
            *_, (_, last) = render_frames(
                camera,
                range(args.frames),
                64,
                5,
                skip=lambda f: f != args.frames - 1,
                sampler="gpt",
                caustic=False,
                unbiased=True,
            )
        noise[name] = {"spp": spp} | {n: spread(last, n) * last.attributes["ngpt:spp"] for n in ("primal", "dx", "dy")}
    for name, row in noise.items():
        ratio = cost[name]["processor"]
        row["at equal time"] = {n: row[n] * ratio / noise["gpt"][n] for n in ("primal", "dx", "dy")}
        print(scene, shot, name, row["spp"], {n: round(v, 3) for n, v in row["at equal time"].items()}, flush=True)
    rows = []
    for name, frames in stacks.items():
        for method in args.methods:
            results = [ngpt.reconstruct(stack, method).image for stack in frames]
            temporal = Temporal()
            blended = [temporal.next(stack, image) for stack, image in zip(frames, results, strict=True)]
            images = {method: results[args.skip :], f"{method} + temporal": blended[args.skip :]}
            for row in measured(frames[args.skip :], references, images):
                rows.append({"rival": name} | row)
                print(f"| {scene} | {shot} | {name} | {row['method']} | {row['relMSE']:.5f} | {row['flicker']:.5f} |")
    return {"noise": noise, "rows": rows}


def spread(stack, name: str) -> float:
    """The variance of a layer, of the mean over all samples; without the worst 1 % of the pixels."""
    values = np.sort(np.asarray(stack[f"{name}_var"], np.float64).mean(axis=-1).ravel())
    return float(values[: -max(1, len(values) // 100)].mean())


if __name__ == "__main__":
    main()
