"""What ngpt asks of a renderer: this module is a ``ngpt.renderer.Renderer``, which says more of each function."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from data_gen.backend import use_variant
from data_gen.code import code as code
from data_gen.code import scene_code as scene_code
from data_gen.samplers import FRAME_SAMPLERS, SAMPLERS, by_standing, find
from ngpt.renderer import Options
from ngpt.stack import GradientStack

if TYPE_CHECKING:
    import mitsuba as mi


def load(source: str, size: tuple[int, int]) -> mi.Scene:
    use_variant()
    from data_gen.scenes.load import load_scene

    return load_scene(source, size)


def render(scene: mi.Scene, options: Options, spp: int | None, seed: int, *, seconds: float | None) -> GradientStack:
    from data_gen.render import render_stack

    return render_stack(scene, spp, seed, seconds=seconds, **options)


def warm_up(scene: mi.Scene, options: Options) -> GradientStack:
    from data_gen.choosing import costs

    return costs.warm_up(scene, options)


def timed(scene: mi.Scene, options: Options, spp: int, seed: int, clock: str) -> tuple[GradientStack, float]:
    from data_gen.choosing import costs

    return costs.timed(scene, options, spp, seed, clock)


def measure(
    scene: mi.Scene, renders: Mapping[str, Options], spp: int, repeats: int, *, clock: str
) -> tuple[dict[str, list[float]], GradientStack]:
    from data_gen.choosing import costs

    return costs.measure(scene, renders, spp, repeats, clock=clock)


def batch(sampler: str) -> int:
    return SAMPLERS[sampler].batch


def gradients(sampler: str) -> bool:
    return sampler not in SAMPLERS or SAMPLERS[sampler].gradients


def unusual(sampler: str, options: Options) -> str:
    entry = find(sampler)
    return entry.unusual(entry.settings(options))


def overview() -> dict[str, Any]:
    use_variant()
    from data_gen.scenes.builtin import SCENES

    SAMPLERS.load()
    titles = {"samplers": "use", "samplers for some scenes": "niche", "samplers to compare with": "study"}
    found = {
        title: {name: entry.summary for name, entry in by_standing(standing).items()}
        for title, standing in titles.items()
    }
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


@contextmanager
def stream(config: Path, kept: str = "") -> Iterator[Any]:
    from data_gen.dataset.config import read_config
    from data_gen.dataset.jobs import Pool
    from data_gen.dataset.stream import Stream

    # Training that is interrupted finishes its step, and may still ask for crops.
    with Pool(1, interruptible=False) as worker, Stream(read_config(config), worker, kept=kept) as data:
        try:
            yield data
        finally:
            # What it is at would take minutes, and nobody is going to see it.
            worker.end()
