"""Speed of the networks in ONNX Runtime, and of OIDN: bench/results/onnx.json.

    python -m bench.onnx

Seconds for each size, on synthetic stacks with features and variances. All rows run in this process, in turn:

    ngpt-fast       as ngpt.reconstruct() runs it: repair, base (NumPy), network (ONNX Runtime)
    repair, base    only these first two steps
    network         only the network in ONNX Runtime, with the base as input
    float16         the network in half precision, which this provider computes in float32
    graph alone     the network and its base in one graph, as a host without ngpt runs it
    oidn high, oidn fast   Open Image Denoise with albedo and normal
    oidn prefiltered    oidn high with denoised features, as `--method oidn` runs it
    ngpt-combine    as ngpt.reconstruct() runs it: base, OIDN of the primal and of the base, network
"""

import argparse
import tempfile
from collections.abc import Callable
from pathlib import Path

import mitsuba_oidn
import numpy as np

from bench.common import measure, metadata, save
from ngpt.classical.gradients import forward_differences
from ngpt.export.network import network_model
from ngpt.methods import METHODS, reconstruct
from ngpt.network.run_onnx import Network, planes
from ngpt.network.shipped import WEIGHTS
from ngpt.repair import Repaired, repair
from ngpt.stack import GradientStack

SIZES = ("1280x720", "1920x1080")
FAST = WEIGHTS / "ngpt-fast.onnx"
# The weights that the network was exported from.
TWIN = Path(__file__).parents[1] / "export" / "weights" / "ngpt-fast.safetensors"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sizes", nargs="*", default=SIZES)
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("-o", "--output", type=Path, default=Path("bench/results/onnx.json"))
    args = parser.parse_args()
    about = metadata("onnxruntime", "mitsuba-oidn")
    result = {"benchmark": "onnx", "repeats": args.repeats, "sizes": {}, "metadata": about}
    with tempfile.TemporaryDirectory() as folder:
        half = half_precision(Path(folder))
        for size in args.sizes:
            width, height = map(int, size.split("x"))
            result["sizes"][size] = bench_size(stack_of(width, height), half, args.repeats)
            print(size, {name: round(row["median"], 3) for name, row in result["sizes"][size].items()}, flush=True)
        result["bytes"] = {"float32": FAST.stat().st_size, "float16": half.stat().st_size}
    save(args.output, result)


def synthetic(width: int, height: int) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """The layers (primal, dx, dy) of a picture with edges, noise and fireflies, and their variances."""
    random = np.random.default_rng(0)
    y, x = (np.mgrid[:height, :width] / height).astype(np.float32)
    boxes = sum(((x - a) % 0.31 < 0.13) * ((y - b) % 0.23 < 0.1) for a, b in ((0, 0), (0.1, 0.05), (0.2, 0.15)))
    truth = np.stack([0.1 + 0.3 * y + 0.2 * boxes * (1 + 0.3 * np.sin(7 * x + c)) for c in range(3)], -1)
    layers, variances = [], []
    for image, share in ((truth, 0.7), *((d, 0.1) for d in forward_differences(truth))):
        deviation = share * truth.mean(-1, keepdims=True) * random.gamma(1, 1, (height, width, 1))
        deviation *= 1 + 20 * (random.random((height, width, 1)) < 0.003)
        layers.append((image + deviation * random.standard_normal(image.shape)).astype(np.float32))
        variances.append((deviation**2 * random.gamma(4, 0.25, image.shape)).astype(np.float32))
    return layers, variances


def stack_of(width: int, height: int) -> GradientStack:
    (primal, dx, dy), (primal_var, dx_var, dy_var) = synthetic(width, height)
    random = np.random.default_rng(1)
    albedo = np.clip(primal, 0, 1)
    normal = random.normal(size=primal.shape).astype(np.float32)
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    variances = {"primal_var": primal_var, "dx_var": dx_var, "dy_var": dy_var}
    return GradientStack.from_arrays(
        primal=primal, dx=dx, dy=dy, albedo=albedo, normal=normal, depth=primal[..., :1], **variances
    )


def half_precision(folder: Path) -> Path:
    path = folder / "half.onnx"
    path.write_bytes(network_model(TWIN, "ngpt-fast", "float16").SerializeToString())
    return path


def bench_size(stack: GradientStack, half: Path, repeats: int) -> dict:
    data, network = repair(stack), Network(FAST)
    layers = {"primal": data.image, "dx": data.dx, "dy": data.dy, **data.features}
    layers |= dict(zip(("primal_var", "dx_var", "dy_var"), data.variances, strict=True))
    base = METHODS["wcv"].run(data)
    feed = {name: planes(layer)[None] for name, layer in layers.items()}
    # The graph has inputs that these stacks lack, such as ``caustic``.
    zero = np.zeros_like(feed["primal"])
    feed = {entry.name: zero for entry in network.session.get_inputs()} | feed
    in_half = Network(half)
    calls = {
        "ngpt-fast": lambda: reconstruct(stack, "ngpt-fast"),
        "repair": lambda: repair(stack),
        "base": lambda: METHODS["wcv"].run(data),
        "network": lambda: network.reconstruct(layers, base),
        "graph alone": lambda: network.session.run(None, feed),
        "float16": lambda: in_half.reconstruct(layers, base),
    }
    return measure(calls | oidn_calls(stack, data), repeats)


def oidn_calls(stack: GradientStack, data: Repaired) -> dict[str, Callable[[], object]]:
    features = {name: np.ascontiguousarray(data.features[name]) for name in ("albedo", "normal")}

    def run(quality: mitsuba_oidn.Quality) -> None:
        np.array(mitsuba_oidn.denoise(data.image, **features, hdr=True, quality=quality))

    return {
        "oidn high": lambda: run(mitsuba_oidn.Quality.High),
        "oidn fast": lambda: run(mitsuba_oidn.Quality.Fast),
        "oidn prefiltered": lambda: reconstruct(stack, "oidn"),
        "ngpt-combine": lambda: reconstruct(stack, "ngpt-combine"),
    }


if __name__ == "__main__":
    main()
