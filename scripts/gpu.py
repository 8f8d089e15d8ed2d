"""A window of minutes on a lent GPU: checks, then crops, then training. Run again, it goes on where it ended.

    python -m scripts.gpu --work rehearsal --small              before, on processors: small, six minutes
    python -m scripts.gpu --work work --data sets/*             on the machine: nine minutes
    python -m scripts.gpu --work work --check "renderer gpt"    one check, in this process

What is missing, fails, crashes or hangs is in WORK/report.md, and the rest runs. It ends with 1 where nothing was
trained. docs/train/gpu.md says what is compared with what.
"""

import argparse
import contextlib
import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from types import SimpleNamespace

import numpy as np

from bench.common import metadata
from ngpt.errors import NgptError
from ngpt.network.training_log import entries_of
from ngpt.system import configs
from ngpt.system.limits import processors
from ngpt.system.writing import write_json, write_text
from ngpt.training.dataset import read_manifest
from ngpt.training.run_summary import summary

ROOT = Path(__file__).parents[1]
# Of each training: its share, and changes of its configuration. How long it will be need not be known: the learning
# rate stays what it is once it has warmed up, and weights are averages over a thousand steps.
ENDLESS = ["run.steps=10000000", "run.log=50", "run.save=200", "run.validate=500", "optimizer.warmup=500"]
ENDLESS += ["optimizer.flat=10000000"]
PAPER = ["run.precision='bfloat16'", "optimizer.clip=1.0", "optimizer.ema=0.999"]
RUNS = {"paper": (0.65, PAPER), "large": (0.35, ["data.workers=6", "optimizer.schedule='paper'"])}
LARGE = SimpleNamespace(variant="cuda_ad_rgb", device="cuda", minutes=9.0, dataset="data-gpu", changes=[])
SMALL = SimpleNamespace(variant="llvm_ad_rgb", device="cpu", minutes=6.0, dataset="data-tiny", changes=[])
SMALL.changes += ["run.log=1", "run.save=1", "run.validate=2", "run.views=2", "run.batch=1", "data.crop=48"]
SMALL.changes += ["data.workers=0", "optimizer.warmup=5", "run.precision='float32'"]
# Shares of a window; scenes that no network is trained on; seconds that a training needs to start and to save.
CHECKS, CROPS, APART, LEAST = 0.25, 0.15, "made-00000", 15.0


def run_for(seconds: float, log: Path, *arguments: object) -> tuple[float, int | None, str]:
    """``python ARGUMENTS`` for so many seconds at most: seconds, status (None: it was ended), last words.

    What goes wrong stays there. It is asked to end, so that a training saves its state, and made to 20 s later.
    """
    log.parent.mkdir(parents=True, exist_ok=True)
    path, begun = os.pathsep.join(filter(None, (str(ROOT), os.environ.get("PYTHONPATH")))), time.monotonic()
    with open(log, "ab") as out:
        words = [sys.executable, *map(str, arguments)]
        known = os.environ | {"PYTHONPATH": path}
        process = subprocess.Popen(words, stdout=out, stderr=out, process_group=0, env=known)
    status: int | None = None
    try:
        with contextlib.suppress(subprocess.TimeoutExpired):
            status = process.wait(max(seconds, 1))
    finally:  # also where this process is ended itself
        if status is None:
            process.terminate()
            with contextlib.suppress(subprocess.TimeoutExpired):
                process.wait(20)
        with contextlib.suppress(ProcessLookupError):  # what it started may outlive it
            os.killpg(process.pid, signal.SIGKILL)
        process.wait()
    lines = [line.strip() for line in log.read_text(errors="replace").splitlines() if line.strip()]
    return time.monotonic() - begun, status, " | ".join(lines[-2:])[:400]


def window(scale: SimpleNamespace, data: list[Path], work: Path, minutes: float) -> None:
    """Notes each part at once, in ``work``/parts.jsonl and report.md: what ends this early finds it written."""
    end = time.monotonic() + 60 * minutes - min(20, 6 * minutes)

    def left() -> float:
        return end - time.monotonic()

    def note(part: str, seconds: float, status: int | None, told: str) -> None:
        told = f"status {status}: {told}" if status else told
        with open(work / "parts.jsonl", "a", encoding="utf-8") as file:
            print(json.dumps({"part": part, "seconds": round(seconds, 1), "told": told}), file=file)
        write_report(work)
        print(f"{part}: {seconds:.0f} s: {told}", flush=True)

    note("machine", 0, 0, json.dumps(metadata("torch", "mitsuba", "drjit", "onnxruntime-gpu")))
    last = left() - 60 * minutes * CHECKS
    for name in names():
        path = work / "checks" / f"{name.replace(' ', '-')}.json"
        if not path.exists() and left() - last > 5:
            small = ["--small"] if scale is SMALL else []
            command = ["-m", "scripts.gpu", "--work", work, "--check", name, *small]
            seconds, status, told = run_for(left() - last, work / "logs" / f"check-{path.stem}.txt", *command)
            if status is not None and not path.exists():
                write_json(path, {"check": name, "status": "failed", "seconds": round(seconds), "told": told})
    # Wrong crops would be worse than none: where the GPU has not been found to render well, processors do.
    gpu = work / "checks" / "renderer-gpt.json"
    passed = gpu.exists() and json.loads(gpu.read_text())["status"] == "passed"
    variant = scale.variant if passed else SMALL.variant
    command = ["-m", "data_gen", "--config", scale.dataset, "--out", work / "data", "--variant", variant]
    command += ["--workers", max(1, processors() - 2)]
    # Without other sets to learn from, half of what is left.
    seconds = 60 * minutes * CROPS if data else left() / 2
    seconds, status, told = run_for(seconds, work / "logs" / "crops.txt", *command)
    note("crops", seconds, status, f"by {variant}, {len(crops(work / 'data'))} in all: {told}")
    folders = [str(folder) for folder in (*data, work / "data") if crops(folder)]
    apart = [APART] if any(not scene.startswith(APART) for folder in folders for scene in crops(Path(folder))) else []
    sets = [f"data.folders={json.dumps(folders)}", f"data.validation={json.dumps(apart)}"]
    for number, (name, (share, changes)) in enumerate(RUNS.items()):
        seconds = left() * share / sum(share for share, _ in [*RUNS.values()][number:])
        if not folders or seconds < LEAST:
            note(name, 0, 0, f"{seconds:.0f} s are too few to start in" if folders else "no crops")
            continue
        words = [word for change in (*ENDLESS, *changes, *scale.changes, *sets) for word in ("--set", change)]
        command = [ROOT / "train.py", "--config", name, "--out", work / "runs" / name, *words]
        note(name, *run_for(seconds, work / "logs" / f"run-{name}.txt", *command))


def crops(folder: Path) -> list[str]:
    """The scene of each crop that is there."""
    try:
        return [entry["scene"] for entry in read_manifest(folder)["shards"] for _ in entry["crops"]]
    except NgptError:
        return []


def steps(work: Path) -> int:
    """How many steps all runs together have trained, by their checkpoints."""
    runs = [run for run in work.glob("runs/*") if (run / "checkpoint.safetensors").exists()]
    return sum(summary(run)["checkpoint at step"] for run in runs)


def write_report(work: Path) -> None:
    """``work``/report.md: the checks, the parts of all windows, and the last score and the speed of each run."""
    checks = [json.loads(path.read_text()) for path in sorted(work.glob("checks/*.json"))]
    rows = [(check["check"], check["status"], check["seconds"], check["told"]) for check in checks]
    parts = [json.loads(line) for line in (work / "parts.jsonl").read_text().splitlines()]
    rows += [(part["part"], "", part["seconds"], part["told"]) for part in parts]
    for run in sorted(work.glob("runs/*/log.jsonl")):
        entries = entries_of(run)
        timed = [entry for entry in entries if "seconds" in entry]
        took = timed[-1]["seconds"] - timed[0]["seconds"] if timed else 0
        rate = f"{(timed[-1]['step'] - timed[0]['step']) / took:.2f} steps/s" if took else ""
        scores = [f"{key} {value:.5f}" for key, value in entries[-1].items() if key.startswith("relMSE")]
        rows.append((run.parent.name, f"step {entries[-1]['step']}", round(took, 1), ", ".join([rate, *scores])))
    cells = [[str(cell).replace("|", "/").replace("\n", " ") for cell in row] for row in rows]
    text = "\n".join(f"| {' | '.join(row)} |" for row in [["part", "", "seconds", ""], ["---"] * 4, *cells])
    write_text(work / "report.md", f"# Windows on a GPU\n\n{text}\n")


# --- checks: by name the largest difference, relative to the largest value, and what is allowed -----------------------


def difference(there, here) -> float:
    there, here = (np.asarray(x.double().cpu() if hasattr(x, "cpu") else x, np.float64) for x in (there, here))
    return float(np.abs(there - here).max() / np.abs(here).max())


def made_stack(size: int, seed: int):
    """A smooth image with noise, less noisy differences, and features: all layers of a gradient stack."""
    from ngpt.classical.gradients import forward_differences
    from ngpt.stack import GradientStack

    rng = np.random.default_rng(seed)
    y, x = np.mgrid[:size, :size] / size
    image = 0.5 + 0.4 * np.sin(6 * rng.random() * x + 5 * y)[..., None] * rng.random(3)
    layers = {"primal": image, **dict(zip(("dx", "dy"), forward_differences(image), strict=True))}
    for name, noise in (("primal", 0.2), ("dx", 0.04), ("dy", 0.04)):
        layers |= {name: layers[name] + noise * rng.normal(size=image.shape), f"{name}_var": 0 * image + noise**2}
    layers["dx"][:, -1] = layers["dy"][-1] = 0
    return GradientStack.from_arrays(**layers, albedo=image, normal=0 * image + [0, 0, 1], depth=1 + x[..., None])


def on(scale, array):
    import torch

    if scale.device == "cuda" and not torch.cuda.is_available():
        raise ImportError(f"PyTorch {torch.__version__} sees no GPU")
    return torch.from_numpy(np.ascontiguousarray(array)).to(scale.device)


def arrays(scale) -> dict[str, tuple[float, float]]:
    """``ngpt.denoise`` of tensors on the device, where the result lies too, and of NumPy's arrays."""
    import ngpt

    stack, found = made_stack(64, seed=1), {}
    for method in ("l2", "l1", "cv", "wcv", "wl2", "ngpt-fast"):
        entry = ngpt.METHODS[method]
        layers = {name: stack[name] for name in stack.names if name in (*entry.needs, *entry.uses)}
        image = layers.pop("primal")
        there = ngpt.denoise(on(scale, image), method, **{name: on(scale, layer) for name, layer in layers.items()})
        assert there.device.type == scale.device, there.device
        found[method] = difference(there, ngpt.denoise(image, method, **layers)), 1e-4
    return found


def networks(scale) -> dict[str, tuple[float, float]]:
    """The shipped networks in PyTorch, and one in ONNX Runtime where that has a provider for the device."""
    from ngpt.network import run_onnx, run_torch, shipped
    from ngpt.network.inputs import gather
    from ngpt.repair import repair

    stack, found = made_stack(64, seed=2), {}
    for path in sorted((ROOT / "export" / "weights").glob("ngpt-*.safetensors")):
        data = repair(stack, run_torch.config_of(path, "cpu").reads_gradients)
        with contextlib.suppress(NgptError):  # those with a base need OIDN
            found[path.stem] = difference(*(run_torch.run(data, path, place) for place in (scale.device, "cpu"))), 1e-2
    if run_onnx.DEVICES[scale.device] in run_onnx.runtime().get_available_providers():
        sides = [run_onnx.Network(shipped.WEIGHTS / "ngpt-fast.onnx", device) for device in (scale.device, "cpu")]
        layers = gather(repair(stack, True), (*sides[0].inputs, "base"), sides[0].base)
        found["ONNX Runtime"] = difference(*(side.reconstruct(layers) for side in sides)), 1e-2
    return found


class Crop(SimpleNamespace):
    """A training set's crop, made of nothing."""

    __hash__ = object.__hash__  # by which trainings keep them


def training(scale, precision: str) -> dict[str, tuple[float, float]]:
    """The losses of three steps of a small network."""
    from ngpt.training.distributed import Processes
    from ngpt.training.images import Images
    from ngpt.training.loss import make_loss
    from ngpt.training.settings import read_settings
    from ngpt.training.trainer import Trainer

    device, losses = on(scale, np.zeros(1)).device, []
    stacks = [made_stack(48, seed) for seed in range(4)]
    black = np.zeros((48, 48, 3), np.float32)
    crop = {"scene": "made", "spp": (4,), "inputs": 1, "paired": False, "reference_halves": ()}
    crop |= {"reference_direct": black, "reference_caustic": black}
    data = [Crop(**crop, stack=lambda k, s=s: s, reference=s["albedo"]) for s in stacks]
    changes = ["run.steps=3", "run.log=1", f"run.precision='{precision}'", "data.crop=48", "loss.kind='l1'"]
    settings = read_settings(configs.find_config("tiny", configs.TRAINING), changes)
    for place in (device, "cpu"):
        with tempfile.TemporaryDirectory() as folder:
            taken = Processes()
            taken.device = type(device)(place)
            task = Images(settings, data, [], make_loss(settings.loss))
            Trainer(settings, task, Path(folder), taken, say=lambda text: None).run()
            losses.append([entry["loss"] for entry in entries_of(Path(folder) / "log.jsonl")])
    return {precision: (difference(*losses), 0.02 if precision == "float32" else 0.2)}


def renderer(scale, sampler: str, size=(32, 24), **options) -> dict[str, tuple[float, float]]:
    """Means of eight renders of the first scene that the sampler takes, by the variant and by processors."""
    from data_gen.backend import DEFAULT_VARIANT, use_variant
    from ngpt.testing import z_test

    sides = []
    for variant, first in ((scale.variant, 1000), (DEFAULT_VARIANT, 0)):
        try:
            use_variant(variant)
        except NgptError as error:
            raise ImportError(str(error)) from error
        from data_gen.render import render_stack
        from data_gen.samplers import find
        from data_gen.scenes.builtin import SCENES
        from data_gen.scenes.facts import scene_facts
        from data_gen.scenes.load import load_scene

        for name in SCENES:
            try:
                scene = load_scene(name, size)
                find(sampler, scene_facts(scene))
            except NgptError:
                continue
            begun = time.perf_counter()
            sides.append(
                [render_stack(scene, 16, first + seed, sampler, unbiased=True, **options) for seed in range(8)]
            )
            print(f"{name} by {variant}: {time.perf_counter() - begun:.1f} s for 8 renders")
            break
    largest = float(np.abs(sides[1][0]["primal"]).max())
    found = {}
    for layer in sides[1][0].names:
        ours, theirs = (np.stack([stack[layer] for stack in side]) for side in sides)
        if layer in ("albedo", "normal", "depth"):
            found[layer] = difference(ours.mean(axis=0), theirs.mean(axis=0)), 0.5
        elif layer != "alpha" and not layer.endswith("_var"):
            # Light that is not there is exactly 0 by one variant, and rounding by the other.
            found[layer] = float(not z_test(ours, theirs, level=1e-3, scale=largest).passed), 0.5
    return found


CHECKS_MADE = {
    "arrays": arrays,
    "networks": networks,
    "training float32": lambda scale: training(scale, "float32"),
    "training bfloat16": lambda scale: training(scale, "bfloat16"),
    "shared tails": lambda scale: renderer(scale, "gpt", (80, 60), tails="shared"),
}


def names() -> list[str]:
    """All checks, the renderer's one by one, its first among them."""
    from data_gen.samplers import SAMPLERS

    rest = [f"renderer {sampler}" for sampler in SAMPLERS if sampler != "gpt"]
    return ["renderer gpt", *CHECKS_MADE, *rest]


def check(name: str, scale: SimpleNamespace) -> dict:
    """The record of one check: name, status, seconds, and differences or the error."""
    begun, (kind, _, sampler) = time.perf_counter(), name.partition(" ")
    try:
        found = renderer(scale, sampler) if kind == "renderer" else CHECKS_MADE[name](scale)
        status = "passed" if found and all(value < most for value, most in found.values()) else "failed"
        told = ", ".join(f"{what} {value:.2g} of {most:g}" for what, (value, most) in found.items())
    except Exception as error:
        status = "not available" if isinstance(error, ImportError) else "failed"
        told = f"{type(error).__name__}: {' '.join(str(error).split())[:400]}"
    return {"check": name, "status": status, "seconds": round(time.perf_counter() - begun, 1), "told": told}


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, nargs="*", default=[], metavar="SET", help="training sets to learn from")
    parser.add_argument("--work", type=Path, required=True, help="folder of all windows; the next one goes on from it")
    parser.add_argument("--minutes", type=float, help="of this window (default: 9, with --small 6)")
    parser.add_argument("--small", action="store_true", help="on processors, at a hundredth of the scale")
    parser.add_argument("--check", metavar="NAME", help="make one check, and nothing else")
    args = parser.parse_args(arguments)
    if args.minutes is not None and not 0 < args.minutes < 1e6:
        parser.error(f"--minutes {args.minutes:g}: give a number above 0")
    if args.check is not None and args.check not in names():
        parser.error(f"--check '{args.check}': there are {', '.join(names())}")
    scale, work = SMALL if args.small else LARGE, args.work.resolve()
    try:
        (work / "checks").mkdir(parents=True, exist_ok=True)
    except OSError as error:
        parser.error(f"--work {args.work}: no folder can be made there: {error.strerror}")
    if args.check:
        record = check(args.check, scale)
        write_json(work / "checks" / f"{args.check.replace(' ', '-')}.json", record)
        print(f"{args.check}: {record['status']}: {record['told']}")
        return int(record["status"] == "failed")
    if missing := [folder for folder in args.data if not (folder / "manifest.json").is_file()]:
        print(f"scripts.gpu: {missing[0]}: no training set there (manifest.json is missing)", file=sys.stderr)
        return 2
    before = steps(work)
    window(scale, [folder.resolve() for folder in args.data], work, args.minutes or scale.minutes)
    print((work / "report.md").read_text())
    if steps(work) <= before:
        print(f"scripts.gpu: nothing was trained: give it more time (--minutes) or training sets (--data); {work}/logs")
    return 0 if steps(work) > before else 1


if __name__ == "__main__":
    signal.signal(signal.SIGTERM, lambda number, frame: sys.exit(128 + number))
    sys.exit(main())
