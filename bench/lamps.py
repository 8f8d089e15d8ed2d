"""What the choice of lamps is worth: variance and time by place, and uniform, relative to weights of the whole scene.

    python -m bench.lamps hall-100 hall-25 bistro-chalice/scene.xml

prints, scene by scene, the variance over seeds of pixels of the primal (without the layer `caustic`) and of means over
8x8 pixels, and both for `dx`; then the processor time of a sample, without the pilot. The noisiest 1 % of pixels and
3 % of blocks, over all ways together, are left out, since few seeds cannot measure them. The promise is the pilot's
estimate for direct light: lamps are chosen by place where it is below `data_gen.scenes.lamps.PROMISE`. ``hall-N`` is a
hall of N small lamps of very different powers, made here.
"""

import argparse
import os
import re
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

from bench.common import blocks, renderer
from ngpt.evaluation.config import scene_name

# By place where the pilot promises less than so much of the variance, and the option that goes with it
WAYS = {"whole": (0.0, "power"), "place": (np.inf, "power"), "alike": (0.0, "uniform")}
# Of the hall, in metres
BAYS, WIDE, DEEP, AISLE, HEIGHT = 6, 4.0, 4.5, 3.0, 3.5
LENGTH, HALF = BAYS * WIDE, AISLE / 2 + DEEP

HEAD = """<scene version="3.0.0">
    <integrator type="path">
        <integer name="max_depth" value="6"/>
    </integrator>
    <sensor type="perspective">
        <float name="fov" value="75"/>
        <transform name="to_world">
            <lookat origin="0.3, 2.2, 0.3" target="-0.6, 1.4, 8" up="0, 1, 0"/>
        </transform>
        <film type="hdrfilm">
            <integer name="width" value="640"/>
            <integer name="height" value="360"/>
            <rfilter type="box"/>
        </film>
    </sensor>
    <bsdf type="twosided" id="plaster">
        <bsdf type="diffuse"><rgb name="reflectance" value="0.7, 0.68, 0.64"/></bsdf>
    </bsdf>
    <bsdf type="diffuse" id="floor">
        <rgb name="reflectance" value="0.4, 0.33, 0.27"/>
    </bsdf>
"""


def cube(low, high, material: str = "plaster") -> str:
    """A box between two corners."""
    size, middle = np.subtract(high, low) / 2, np.add(low, high) / 2
    place = f'<scale value="{_row(size)}"/><translate value="{_row(middle)}"/>'
    transform = f'<transform name="to_world">{place}</transform>'
    return f'    <shape type="cube">{transform}<ref id="{material}"/></shape>\n'


def lamp(number: int, at, side: float, radiance: float) -> str:
    """A square that shines downward."""
    place = f'<rotate x="1" angle="90"/><scale value="{side / 2:.3f}"/><translate value="{_row(at)}"/>'
    emitter = f'<emitter type="area"><rgb name="radiance" value="{radiance:.3g}"/></emitter>'
    transform = f'<transform name="to_world">{place}</transform>'
    return f'    <shape type="rectangle" id="lamp_{number}">{transform}{emitter}</shape>\n'


def _row(values) -> str:
    return ", ".join(f"{value:.3f}" for value in values)


def hall(lamps: int) -> str:
    """A hall with bays on both sides of an aisle, in Mitsuba's XML, the same each time.

    Each place is lit by a few lamps near by; partitions hide the others.
    """
    rng = np.random.default_rng(1)
    parts = [HEAD]
    parts.append(cube((-HALF, -0.1, -1), (HALF, 0, LENGTH), "floor"))
    parts.append(cube((-HALF, HEIGHT, -1), (HALF, HEIGHT + 0.1, LENGTH)))
    for x in (-HALF - 0.1, HALF):
        parts.append(cube((x, 0, -1), (x + 0.1, HEIGHT, LENGTH)))
    for z in (-1.1, LENGTH):
        parts.append(cube((-HALF, 0, z), (HALF, HEIGHT, z + 0.1)))
    for bay in range(1, BAYS):
        for side in (-1, 1):
            x = sorted((side * AISLE / 2, side * HALF))
            parts.append(cube((x[0], 0, bay * WIDE - 0.05), (x[1], 2.8, bay * WIDE + 0.05)))
    for _ in range(24):
        x, z = rng.choice((-1, 1)) * rng.uniform(AISLE / 2 + 0.5, HALF - 0.5), rng.uniform(0.5, LENGTH - 0.5)
        high = rng.uniform(0.4, 1.1)
        parts.append(cube((x - 0.4, 0, z - 0.3), (x + 0.4, high, z + 0.3)))
    for number in range(lamps):
        at = rng.uniform(-HALF + 0.3, HALF - 0.3), rng.uniform(1.7, 2.7), rng.uniform(0.3, LENGTH - 0.3)
        # Powers span three decades; most lamps are weak.
        parts.append(lamp(number, at, rng.uniform(0.08, 0.3), 10 ** rng.uniform(0, 2.5)))
    return "".join(parts) + "</scene>\n"


def variances(stacks: list) -> dict[str, np.ndarray]:
    """Variances of pixels and of blocks over seeds, summed over the colour channels."""
    found = {}
    for layer in ("primal", "dx"):
        if layer not in stacks[0].names:
            continue
        images = np.array([stack[layer] for stack in stacks], np.float64)
        if layer == "primal" and "caustic" in stacks[0].names:
            images -= np.array([stack["caustic"] for stack in stacks])
        found[layer] = images.var(axis=0, ddof=1).sum(axis=-1)
        found[f"{layer}, blocks"] = blocks(images).var(axis=0, ddof=1).sum(axis=-1)
    return found


def loaded(name: str, size: tuple[int, int]) -> Any:
    """The scene of a file, a built-in one, or a hall."""
    from data_gen.scenes.load import load_scene

    if not (found := re.fullmatch(r"hall-(\d+)", name)):
        return load_scene(name, size)
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / f"{name}.xml"
        file.write_text(hall(int(found[1])))
        return load_scene(os.fspath(file), size)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", nargs="+")
    parser.add_argument("--samplers", nargs="+", default=["gpt", "primal"])
    parser.add_argument("--spp", type=int, default=16)
    parser.add_argument("--seeds", type=int, default=8)
    parser.add_argument("--size", type=int, nargs=2, default=(96, 64))
    args = parser.parse_args()
    _, render_stack = renderer()
    from data_gen.scenes import lamps

    lamps.MANY = 2
    print("| scene, sampler | lamps | promise | by place | time | alike |\n|---|--:|--:|--:|--:|--:|")
    for name in args.scenes:
        scene = loaded(name, tuple(args.size))
        promise = f"{lamps.promised(scene, lamps.lamp_weights(scene))[0]:.2f}"
        for sampler in args.samplers:
            found, seconds = {}, {}
            for way, (lamps.PROMISE, option) in WAYS.items():
                stacks, took = [], []
                for seed in range(args.seeds + 1):
                    passes: list[float] = []
                    report = lambda *_, passes=passes: passes.append(time.process_time())  # noqa: E731
                    stacks.append(render_stack(scene, args.spp, seed, sampler, report, lamps=option))
                    took.append(passes[-1] - passes[0])
                # The first one compiles.
                found[way], seconds[way] = variances(stacks[1:]), min(took[1:])
            ratios = {}
            for layer in found["whole"]:
                total = sum(each[layer] for each in found.values())
                quiet = total <= np.quantile(total, 0.97 if "blocks" in layer else 0.99)
                sums = {way: each[layer][quiet].sum() for way, each in found.items()}
                for way, value in sums.items():
                    ratios.setdefault(way, []).append(f"{value / sums['whole']:.2f}")
            more = f"{seconds['place'] / seconds['whole']:.2f}"
            cells = [str(len(scene.emitters())), promise, ", ".join(ratios["place"]), more, ", ".join(ratios["alike"])]
            print(f"| `{scene_name(name)}`, `{sampler}` | {' | '.join(cells)} |", flush=True)


if __name__ == "__main__":
    main()
