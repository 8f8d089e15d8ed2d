"""Writes a scene of 100 small lamps of very different powers, in a hall with bays on both sides of an aisle.

    python -m bench.hall out/hall.xml
    python -m bench.hall out/hall-25.xml --lamps 25

Each place is lit by a few lamps near by; partitions hide the others. It is for choosing lamps by place.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

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


def hall(lamps: int = 100) -> str:
    """The scene in Mitsuba's XML, the same each time."""
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


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path, help="the file to write")
    parser.add_argument("--lamps", type=int, default=100)
    args = parser.parse_args()
    args.out.parent.mkdir(parents=True, exist_ok=True)
    args.out.write_text(hall(args.lamps))


if __name__ == "__main__":
    main()
