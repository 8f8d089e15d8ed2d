"""Whether two checkouts render the same bits.

    python -m scripts.same_bits OTHER [-o FILE] [--samplers NAME ...]

OTHER is the folder of another checkout. Both render small images by every installed sampler, with its defaults and with
each other value of its options that are choices, of four built-in scenes, and two frames of a shot. Prints each render
that differs or that only one of them has, and writes all hashes to FILE; the exit status is 1 if any hash differs. A
sampler that refuses a scene says so instead of a hash. Two checkouts take about half an hour on one core.
"""

import argparse
import hashlib
import json
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[1]
SCENES = ("diffuse", "glossy", "lens", "haze")
SIZE, SEED = (16, 12), 3


def renders(samplers: list[str]) -> Iterator[tuple[str, str, dict[str, Any]]]:
    """(scene, sampler, options) of all renders of single images."""
    from data_gen.samplers import SAMPLERS
    from data_gen.samplers.registry import own

    SAMPLERS.load()
    for name in samplers or SAMPLERS:
        entry, changed = SAMPLERS[name], [{}]
        for option, about in own(entry.options).items():
            values = (True, False) if isinstance(about.default, bool) else about.choices
            changed += [{option: value} for value in values if value != about.default]
        for scene in SCENES:
            yield from ((scene, name, options) for options in changed)


def hashes(samplers: list[str]) -> dict[str, str]:
    """SHA-256 of the layers of each render by the packages that this process imports."""
    import data_gen
    from data_gen.render import render_stack
    from data_gen.samplers import FRAME_SAMPLERS, SAMPLERS
    from ngpt.errors import NgptError

    data_gen.use_variant()
    FRAME_SAMPLERS.load()
    found = {}
    scenes = {name: data_gen.load_scene(name, SIZE) for name in SCENES}
    for scene, sampler, options in renders(samplers):
        words = [scene, sampler, *(f"{name}={value}" for name, value in options.items())]
        spp = max(8, 2 * SAMPLERS[sampler].batch)
        try:
            stack = render_stack(scenes[scene], spp, SEED, sampler, unbiased=True, **options)
            found[" ".join(words)] = digest(stack)
        except NgptError:
            found[" ".join(words)] = "refused"
        print(*words, file=sys.stderr)
    for sampler in () if samplers else ("gpt", *FRAME_SAMPLERS):
        frames = data_gen.render_frames("diffuse", range(2), 2, SEED, sampler, size=SIZE, unbiased=True)
        found |= {f"frame {number} {sampler}": digest(stack) for number, stack in frames}
    return found


def digest(stack: Any) -> str:
    found = hashlib.sha256()
    for name in stack.names:
        found.update(name.encode() + stack[name].tobytes())
    return found.hexdigest()


def hashes_of(checkout: Path, samplers: list[str]) -> dict[str, str]:
    """``hashes`` by the packages of a checkout, in a process of its own."""
    environment = os.environ | {"PYTHONPATH": f"{checkout}:{checkout / 'studies'}"}
    command = [sys.executable, __file__, "--here", *samplers]
    return json.loads(subprocess.run(command, env=environment, stdout=subprocess.PIPE, check=True, cwd=checkout).stdout)


def differences(ours: dict[str, str], theirs: dict[str, str]) -> list[str]:
    """A line for each render whose hashes differ, or that is only in one of the two."""
    lines = []
    for name in sorted(ours.keys() | theirs.keys()):
        if ours.get(name) != theirs.get(name):
            only = "only here" if name not in theirs else "only there" if name not in ours else "differs"
            lines.append(f"{only}: {name}")
    return lines


def main() -> int:
    if sys.argv[1:2] == ["--here"]:
        print(json.dumps(hashes(sys.argv[2:])))
        return 0
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("other", type=Path, metavar="OTHER")
    parser.add_argument("-o", type=Path, dest="file", metavar="FILE")
    parser.add_argument("--samplers", nargs="+", default=[], metavar="NAME", help="these only, and no shot")
    args = parser.parse_args()
    ours, theirs = (hashes_of(folder, args.samplers) for folder in (ROOT, args.other.resolve()))
    if args.file:
        args.file.write_text(json.dumps({"here": ours, "there": theirs}, indent=1))
    lines = differences(ours, theirs)
    rendered = sum(value != "refused" for value in ours.values())
    print(*lines, f"{rendered} renders, {len(lines)} differences", sep="\n")
    return int(any(line.startswith("differs") for line in lines))


if __name__ == "__main__":
    sys.exit(main())
