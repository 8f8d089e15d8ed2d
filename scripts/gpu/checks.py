"""What runs on a GPU, each against the same on processors: renderer, solvers, networks, training, ONNX.

    python -m scripts.gpu.checks solvers --recipe window -o solvers.json

Each check runs in a process of its own, since what crashes, hangs or lacks memory must not take the others with it. It
ends by itself with numbers, or says why it cannot be made here.
"""

import argparse
import dataclasses
import subprocess
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from bench.common import metadata
from ngpt.errors import NgptError
from ngpt.system.writing import write_json
from scripts.gpu.recipe import Recipe, read_recipe

ROOT = Path(__file__).parents[2]
PASSED, FAILED, UNAVAILABLE = "passed", "failed", "not available"
PACKAGES = (
    *("torch", "numpy", "scipy", "safetensors", "onnxruntime", "onnxruntime-gpu", "OpenEXR", "filelock", "rich"),
    *("mitsuba", "drjit", "mitsuba-oidn"),
)
# For renders: image size, samples per pixel, renders on each side (`z_test` asks for eight)
SIZE, SPP, RENDERS = (32, 24), 16, 8
# Paths share their tails where there are this many.
SHARING = (80, 60)


class Unavailable(Exception):
    """Something that this machine lacks."""


def names() -> list[str]:
    """All checks, the renderer's one by one."""
    from data_gen.samplers import SAMPLERS

    return [*CHECKS, *(f"renderer {sampler}" for sampler in SAMPLERS)]


def check(name: str, recipe: Recipe) -> dict[str, Any]:
    """The record of one check: name, status, seconds, and numbers or the error."""
    start = time.perf_counter()
    try:
        kind, _, sampler = name.partition(" ")
        detail = renderer(recipe, sampler) if kind == "renderer" else CHECKS[name](recipe)
        result = {"status": PASSED if detail.pop("passed", True) else FAILED, "detail": detail}
    except Unavailable as error:
        result = {"status": UNAVAILABLE, "error": str(error)}
    except ImportError as error:
        result = {"status": UNAVAILABLE, "error": one_line(error)}
    except Exception as error:
        result = {"status": FAILED, "error": f"{type(error).__name__}: {one_line(error)}"}
    return {"check": name, **_writable(result), "seconds": round(time.perf_counter() - start, 2)}


def machine(recipe: Recipe) -> dict[str, Any]:
    """What there is: GPU and driver as they call themselves, versions of all packages."""
    query = ["nvidia-smi", "--query-gpu=name,memory.total,driver_version", "--format=csv,noheader"]
    try:
        told = subprocess.run(query, capture_output=True, text=True, check=True, timeout=60).stdout.strip()
    except (OSError, subprocess.SubprocessError) as error:
        told = f"nvidia-smi: {one_line(error)}"
    return {"gpu": told, **metadata(*PACKAGES)}


def pytorch(recipe: Recipe) -> dict[str, Any]:
    """A product of matrices in both precisions that networks use."""
    torch = _torch(recipe)
    a, b = (torch.from_numpy(np.random.default_rng(i).random((512, 512), np.float32)) for i in range(2))
    told: dict[str, Any] = {"float32": _differ(_there(a, recipe) @ _there(b, recipe), a @ b)}
    low = _there(a, recipe).bfloat16() @ _there(b, recipe).bfloat16()
    told |= {"bfloat16": _differ(low.float(), a @ b), "device": str(low.device)}
    if recipe.device == "cuda":
        told |= {"name": torch.cuda.get_device_name(), "memory MiB": torch.cuda.mem_get_info()[1] >> 20}
    return told | {"passed": told["float32"] < 1e-3 and told["bfloat16"] < 2e-2}


def solvers(recipe: Recipe) -> dict[str, Any]:
    """The classical reconstructions of tensors there, against NumPy here."""
    from ngpt.classical import controlvariates, poisson, weighted

    torch = _torch(recipe)
    stack = made_stack(96, seed=0)
    gradients = [stack[name] for name in ("primal", "dx", "dy")]
    everything = gradients + [stack[f"{name}_var"] for name in ("primal", "dx", "dy")]
    calls: dict[str, tuple[Callable, list]] = {"l2": (poisson.l2, gradients), "l1": (poisson.l1, gradients)}
    calls |= {"cv": (controlvariates.cv, gradients), "wcv": (controlvariates.wcv, everything)}
    calls |= {"wl2": (weighted.wl2, everything)}
    told: dict[str, Any] = {}
    for name, (solve, arrays) in calls.items():
        arrays = [np.ascontiguousarray(a, np.float64) for a in arrays]
        there = solve(*(_there(torch.from_numpy(a), recipe) for a in arrays))
        told[name] = _differ(there, torch.from_numpy(np.asarray(solve(*arrays))))
    return told | {"passed": max(told.values()) < 1e-4}


def arrays(recipe: Recipe) -> dict[str, Any]:
    """``ngpt.denoise`` of tensors on the device: the result is there too, and equals the result of NumPy arrays."""
    import ngpt

    torch = _torch(recipe)
    stack = made_stack(64, seed=1)
    layers = {name: stack[name] for name in stack.names}
    image = layers.pop("primal")
    told: dict[str, Any] = {}
    for method in ("l2", "ngpt-fast"):
        beside = {name: layers[name] for name in ngpt.METHODS[method].needs if name != "primal"}
        here = ngpt.denoise(image, method, **beside)
        tensors = {name: _there(torch.from_numpy(layer), recipe) for name, layer in beside.items()}
        there = ngpt.denoise(_there(torch.from_numpy(image), recipe), method, **tensors)
        if there.device.type != recipe.device:
            raise NgptError(f"{method}: the result lies on {there.device}, the image on {recipe.device}")
        told[method] = _differ(there, torch.from_numpy(here))
    return told | {"passed": max(told.values()) < 1e-5}


def networks(recipe: Recipe) -> dict[str, Any]:
    """The shipped networks in PyTorch, there and here."""
    from ngpt.network import run_torch
    from ngpt.repair import repair

    torch = _torch(recipe)
    stack = made_stack(64, seed=2)
    told: dict[str, Any] = {}
    for path in sorted((ROOT / "export" / "weights").glob("ngpt-*.safetensors")):
        data = repair(stack, run_torch.config_of(path, "cpu").reads_gradients)
        try:
            here, there = (run_torch.run(data, path, device) for device in ("cpu", recipe.device))
        except NgptError as error:
            if "OIDN" not in str(error):
                raise
            told[path.stem] = one_line(error)
        else:
            told[path.stem] = _differ(torch.from_numpy(there), torch.from_numpy(here))
    measured = [value for value in told.values() if isinstance(value, float)]
    return told | {"passed": bool(measured) and max(measured) < 1e-2}


def onnx(recipe: Recipe) -> dict[str, Any]:
    """The shipped networks in ONNX Runtime, by its provider for the device and by that for processors."""
    from ngpt.network import shipped
    from ngpt.network.inputs import gather
    from ngpt.network.run_onnx import DEVICES, Network, runtime
    from ngpt.repair import repair

    if DEVICES[recipe.device] not in runtime().get_available_providers():
        have = ", ".join(runtime().get_available_providers())
        raise Unavailable(f"this build of ONNX Runtime has only {have}: onnxruntime-gpu has the other")
    stack, told = made_stack(64, seed=3), {}
    for name in ("ngpt-fast",):
        networks = [Network(shipped.WEIGHTS / f"{name}.onnx", device) for device in ("cpu", recipe.device)]
        first = networks[0]
        inputs = (*first.inputs, "base") if first.base else first.inputs
        layers = gather(repair(stack, "dx" in first.inputs or bool(first.base)), inputs, first.base)
        here, there = (network.reconstruct(layers) for network in networks)
        told[name] = _largest(there - here, here)
    return told | {"passed": max(told.values()) < 1e-2}


def training(recipe: Recipe, precision: str, kind: str) -> dict[str, Any]:
    """Three steps of a small network there and here: losses and gradients."""
    import json

    from ngpt.system import configs
    from ngpt.training.distributed import Processes
    from ngpt.training.loss import make_loss
    from ngpt.training.settings import read_settings
    from ngpt.training.trainer import Trainer

    torch = _torch(recipe)
    changes = ["run.steps=3", "run.log=1", f"run.precision={precision}", "data.crop=48", "run.batch=4"]
    settings = read_settings(configs.find_config("tiny", configs.TRAINING), [*changes, f"loss.kind={kind}"])
    logs = {}
    for device in ("cpu", recipe.device):
        with tempfile.TemporaryDirectory() as folder:
            processes = Processes()
            processes.device = torch.device(device)
            Trainer(
                *(settings, [MadeCrop(seed) for seed in range(4)], [], make_loss(settings.loss), folder),
                processes=processes,
                say=lambda text: None,
            ).run()
            logs[device] = [json.loads(line) for line in (Path(folder) / "log.jsonl").read_text().splitlines()]
    told: dict[str, Any] = {}
    for name in ("loss", "gradient norm"):
        here, there = ([entry[name] for entry in logs[device]] for device in ("cpu", recipe.device))
        told |= {f"{name}, processors": here, f"{name}, there": there}
        told[name] = max(abs(b - a) / abs(a) for a, b in zip(here, there, strict=True))
    # The perceptual loss draws its transforms at random, others on each device.
    allowed = {"float32": 0.02, "bfloat16": 0.2}[precision] if kind == "l1" else 2.0
    return told | {"passed": bool(told["loss"] < allowed and np.isfinite(told["gradient norm"]))}


def renderer(recipe: Recipe, sampler: str, size: tuple[int, int] = SIZE, **options: Any) -> dict[str, Any]:
    """Renders of a built-in scene by the variant, and by the one for processors: whether they have the same mean."""
    from data_gen.backend import DEFAULT_VARIANT
    from ngpt.testing import z_test

    sides, failed = {}, {}
    # Both are tried: that one of them runs is worth knowing.
    for side, variant in (("there", recipe.variant), ("here", DEFAULT_VARIANT)):
        try:
            sides[side] = _renders(variant, sampler, 0 if side == "here" else 1000, size, options)
        except NgptError as error:
            failed[side] = one_line(error)
    if "there" in failed:
        raise Unavailable(failed["there"])
    scene, seconds, there = sides["there"]
    told: dict[str, Any] = {"scene": scene, "seconds for all renders": round(seconds, 2)}
    if "here" in failed:
        raise Unavailable(f"{recipe.variant} renders, with nothing to compare it with: {failed['here']}")
    here = sides["here"][2]
    told |= {"seconds by processors": round(sides["here"][1], 2)}
    # Light that is not there is exactly 0 by one variant, and rounding by the other.
    wrong, scale = [], float(np.abs(here[0]["primal"]).max())
    for name in here[0].names:
        ours, theirs = (np.stack([stack[name] for stack in stacks]) for stacks in (there, here))
        if name.endswith("_var") or name == "alpha":
            continue
        if name in ("albedo", "normal", "depth"):
            told[name] = _largest(ours.mean(axis=0) - theirs.mean(axis=0), theirs) / 2
            right = told[name] < 0.25 and np.abs(ours.mean() - theirs.mean()) < 5e-3 * np.abs(theirs).max()
        else:
            test = z_test(ours, theirs, level=1e-3, scale=scale)
            told[name], right = str(test), test.passed
        wrong += [] if right else [name]
    return told | {"wrong": wrong, "passed": not wrong}


def _renders(
    variant: str, sampler: str, first: int, size: tuple[int, int], options: dict[str, Any]
) -> tuple[str, float, list]:
    """The first built-in scene that the sampler renders, seconds, and its stacks."""
    from data_gen.backend import use_variant

    use_variant(variant)
    from data_gen.render import render_stack
    from data_gen.samplers import find
    from data_gen.scenes.builtin import SCENES
    from data_gen.scenes.facts import scene_facts
    from data_gen.scenes.load import load_scene

    refusal = None
    for name in SCENES:
        scene = load_scene(name, size)
        try:
            find(sampler, scene_facts(scene))
        except NgptError as error:
            refusal = error
            continue
        start = time.perf_counter()
        stacks = [render_stack(scene, SPP, first + seed, sampler, **options) for seed in range(RENDERS)]
        return name, time.perf_counter() - start, stacks
    raise NgptError(f"no built-in scene will do: {refusal}")


CHECKS: dict[str, Callable[[Recipe], dict[str, Any]]] = {
    "machine": machine,
    "pytorch": pytorch,
    "solvers": solvers,
    "arrays": arrays,
    "networks": networks,
    "onnx": onnx,
    "training float32": lambda recipe: training(recipe, "float32", "l1"),
    "training bfloat16": lambda recipe: training(recipe, "bfloat16", "l1"),
    "training perceptual": lambda recipe: training(recipe, "bfloat16", "structural"),
    "shared tails": lambda recipe: renderer(recipe, "gpt", SHARING, tails="shared"),
}


@dataclasses.dataclass(frozen=True)
class MadeCrop:
    """What a training set's crop offers, made of nothing but a seed."""

    seed: int
    scene = "made"
    spp = (4, 32)
    inputs = 2
    paired = False

    def stack(self, k: int):
        return made_stack(48, self.seed, k, self.spp[k])

    @property
    def reference(self) -> np.ndarray:
        return _clean(48, self.seed)

    @property
    def reference_direct(self) -> np.ndarray:
        return np.zeros_like(self.reference)

    reference_caustic = reference_direct


def _clean(size: int, seed: int) -> np.ndarray:
    """A smooth image with an edge, (size, size, 3) float32."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[:size, :size] / size
    image = 0.5 + 0.4 * np.sin(6 * rng.random() * x + 5 * rng.random() * y)[..., None] * rng.random(3)
    image[y + rng.random() * x > 0.8] *= rng.random(3) * 0.8 + 0.1
    return image.astype(np.float32)


def made_stack(size: int, seed: int, k: int = 0, spp: int = 16):
    """The image of ``_clean`` with noise, less noisy differences, and features: all layers of a gradient stack."""
    from ngpt.classical.gradients import forward_differences
    from ngpt.stack import GradientStack

    rng, image = np.random.default_rng((seed, k)), _clean(size, seed)
    noise = image / spp**0.5
    layers = {"primal": image + noise * rng.standard_normal(noise.shape), "primal_var": noise**2}
    for name, difference in zip(("dx", "dy"), forward_differences(image), strict=True):
        layers[name] = difference + 0.2 * noise * rng.standard_normal(noise.shape)
        layers[f"{name}_var"] = (0.2 * noise) ** 2
    layers["dx"][:, -1] = layers["dy"][-1] = 0
    depth = np.broadcast_to(1 + np.linspace(0, 1, size)[:, None, None], (size, size, 1))
    normal = np.broadcast_to(np.float32([0, 0, 1]), image.shape)
    return GradientStack.from_arrays(**layers, albedo=np.clip(image, 0, 1), normal=normal, depth=depth)


def _torch(recipe: Recipe) -> Any:
    """PyTorch, which has the device."""
    import torch

    if recipe.device == "cuda" and not torch.cuda.is_available():
        raise Unavailable(f"PyTorch {torch.__version__} sees no GPU")
    return torch


def _there(tensor: Any, recipe: Recipe) -> Any:
    return tensor.to(recipe.device)


def _differ(there: Any, here: Any) -> float:
    """The largest difference of two tensors over the largest value."""
    return _largest(there.double().cpu().numpy() - here.double().numpy(), here.numpy())


def _largest(difference: np.ndarray, values: np.ndarray) -> float:
    """The largest difference over the largest value; NaN, which no bound is above, where one is not finite."""
    return float(np.abs(difference).max() / np.abs(values).max())


def _writable(value: Any) -> Any:
    """The value for JSON, which has neither NaN nor infinity."""
    if isinstance(value, dict):
        return {name: _writable(item) for name, item in value.items()}
    if isinstance(value, list):
        return [_writable(item) for item in value]
    return str(value) if isinstance(value, float) and not np.isfinite(value) else value


def one_line(error: BaseException) -> str:
    return " ".join(str(error).split())[:500] or type(error).__name__


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("name", choices=names())
    parser.add_argument("--recipe", default="window")
    parser.add_argument("-o", "--output", type=Path, required=True)
    args = parser.parse_args()
    write_json(args.output, check(args.name, read_recipe(args.recipe)))


if __name__ == "__main__":
    main()
