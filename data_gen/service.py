"""The renderer for ngpt: this module is a ``ngpt.renderer.Renderer``, which documents each function."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

from data_gen import code as source
from data_gen.backend import use_variant
from data_gen.code import code as code
from data_gen.samplers import FRAME_SAMPLERS, SAMPLERS, by_standing, find
from ngpt.renderer import Options
from ngpt.stack import GradientStack
from ngpt.subpixels import choice

if TYPE_CHECKING:
    import mitsuba as mi

# Wall-clock time, or processor time of this process on all processors, which other work hardly changes; in seconds
CLOCKS: dict[str, Callable[[], float]] = {"wall": time.perf_counter, "processor": time.process_time}


def load(source: str, size: tuple[int, int]) -> mi.Scene:
    use_variant()
    from data_gen.scenes.load import load_scene

    return load_scene(source, size)


def render(scene: mi.Scene, options: Options, spp: int | None, seed: int, *, seconds: float | None) -> GradientStack:
    from data_gen.render import render_stack

    # References and compared renders are unbiased, unless a row's options name tails=shared.
    return render_stack(scene, spp, seed, **{"seconds": seconds, "unbiased": True, "gradients": True, **options})


def warm_up(scene: mi.Scene, options: Options) -> GradientStack:
    stack = render(scene, options, 1, 0, seconds=None)
    # Kernels do not depend on the number of samples, except that with "auto" this number decides about subpixels.
    if options.get("subpixels") == "auto" and (k := find(options["sampler"]).subpixels("auto", None)) > 1:
        render(scene, {**options, "subpixels": k}, 1, 0, seconds=None)
    return stack


def timed(scene: mi.Scene, options: Options, spp: int, seed: int, clock: str) -> tuple[GradientStack, float]:
    start = CLOCKS[clock]()
    stack = render(scene, options, spp, seed, seconds=None)
    return stack, CLOCKS[clock]() - start


def measure(
    scene: mi.Scene, renders: Mapping[str, Options], spp: int, repeats: int, *, clock: str
) -> tuple[dict[str, list[float]], GradientStack]:
    seconds: dict[str, list[float]] = {name: [] for name in renders}
    for options in renders.values():
        warm_up(scene, options)
    stacks = {}
    # The renders take turns, so that a busy moment of the machine affects all of them alike.
    for seed in range(repeats):
        for name, options in renders.items():
            stacks[name], duration = timed(scene, options, spp, seed, clock)
            seconds[name].append(duration / spp)
    return seconds, stacks[next(iter(renders))]


def batch(sampler: str) -> int:
    return SAMPLERS[sampler].batch


def gradients(sampler: str) -> bool:
    return sampler not in SAMPLERS or SAMPLERS[sampler].gradients


def unusual(sampler: str, options: Options) -> str:
    entry, own = find(sampler), dict(options)
    kept = choice(own.pop("subpixels", 1))
    entry.subpixels(kept, None)  # raises WrongUse if the sampler cannot keep them
    given = entry.unusual(entry.settings(own))
    return ", ".join(filter(None, (given, "" if kept == 1 else f"subpixels={kept}")))


def scene_code(name: str) -> str:
    use_variant()
    from data_gen.scenes.builtin import SCENES, no_scene

    if name not in SCENES:
        raise no_scene(name)
    return source.scene_code(name)


def overview() -> dict[str, Any]:
    use_variant()
    from data_gen.scenes.builtin import SCENES

    SAMPLERS.load(), FRAME_SAMPLERS.load()
    titles = {"samplers": "use", "samplers for some scenes": "niche", "samplers to compare with": "study"}
    found = {title: {n: entry.summary for n, entry in by_standing(kind).items()} for title, kind in titles.items()}
    return found | {"built-in scenes": {name: (make.__doc__ or "").split("\n")[0] for name, make in SCENES.items()}}


def describe_sampler(name: str) -> dict[str, Any]:
    entry = SAMPLERS.get(name) or FRAME_SAMPLERS.get(name)
    if entry is None:
        return {}
    options = {option: str(value) for option, value in entry.options.items()}
    return {"sampler": name, "summary": entry.summary, "standing": entry.standing, "options": options}


def inspect(name: str, parameters: dict[str, str]) -> dict[str, Any]:
    use_variant()
    from data_gen.inspect import inspect_scene

    return inspect_scene(name, parameters)
