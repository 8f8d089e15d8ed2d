"""Stacks, references and costs of one scene: rendered once, then taken from the cache.

The cache has a folder for each scene, NAME-HASH, named by what the pictures depend on: the contents of the scene's
files, the size, the code that renders, and Mitsuba's version. In it are RENDER-SPP-SEED.exr, where RENDER is a kind of
stack ("gradients"), followed by the sampler where it is not the usual one and its options where there are some
("gradients-gpt-shift=manifold"), and SPP the number of samples that were rendered; the two halves of references,
reference-*-a.exr and -b.exr; and cost-*.json. A folder of stacks of one's own looks the same, without the costs; its
reference may be one image.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

from ngpt.errors import NgptError
from ngpt.evaluation.averages import summary
from ngpt.evaluation.config import Config
from ngpt.evaluation.keys import renderer_hash, scene_hash
from ngpt.evaluation.references import HALVES, Reference, find_reference, read_reference
from ngpt.evaluation.renders import DEFAULTS, Render
from ngpt.io.exr import read, write
from ngpt.stack import GradientStack
from ngpt.system.machine import version
from ngpt.system.writing import write_json
from ngpt.version import __version__

# Of the first half; far from the seeds 0, 1 ... of what is judged.
REFERENCE_SEED = 1 << 20

USUAL = DEFAULTS[0]
Costs = dict[str, dict[str, Any]]


class SceneStacks:
    """What one scene's cells are made of.

    ``lacks``  why a render's columns are absent on this scene, by the render's name; filled by ``costs``
    """

    def __init__(self, name: str, source: str, config: Config, cache: Path, say: Callable[[str], None]):
        self.name, self.source, self.config, self.say = name, source, config, say
        self.given = Path(source).is_dir()
        self.lacks: dict[str, str] = {}
        self._auto = ""
        self._scene: Any = None
        self._warm: dict[str, GradientStack] = {}
        if self.given:
            self.folder = Path(source)
            return
        parts = [scene_hash(source), list(config.size), renderer_hash(), __version__, version("mitsuba")]
        self.key = hashlib.sha256(json.dumps(parts).encode()).hexdigest()
        self.folder = cache / f"{name}-{self.key[:12]}"
        self.folder.mkdir(parents=True, exist_ok=True)

    def reference(self) -> Reference:
        """The reference that the configuration names, or the folder holds; else two halves, of half the budget each.

        Raises NgptError where there is none.
        """
        config = self.config
        if self.name in config.references:
            named = config.references[self.name]
            return read_reference([named] if isinstance(named, str) else named)
        if self.given:
            return find_reference(self.folder)
        limit = f"{config.reference_spp}spp" if config.reference_spp else f"{config.reference_seconds:g}s"
        render = config.render("features", config.reference_sampler)
        name = "-".join(["reference", *render.by.split(), limit])
        paths = [self.folder / f"{name}{half}.exr" for half in HALVES]
        for i, path in enumerate(paths):
            if not path.exists():
                self.say(f"{self.name}: rendering the reference, half {i + 1} of {limit}")
                scene = self.load()
                from data_gen.render import render_stack

                spp = math.ceil(config.reference_spp / 2) or None
                seconds = None if spp else config.reference_seconds / 2
                write(path, render_stack(scene, spp, REFERENCE_SEED + i, seconds=seconds, **render.options))
        return read_reference(paths)

    def costs(self, renders: Iterable[Render] = ()) -> Costs:
        """Seconds per sample of the whole image for the usual renders, the clock and ``renders``, by name.

        ``median`` and quartiles ``low`` and ``high`` of alternating renders, kernels compiled, and the ``sampler`` that
        rendered. What is not in the cache is measured in turn with the clock, and put into the unit of the clock's time
        there: more samplers do not move the others. Empty for a folder of stacks that were rendered elsewhere.
        """
        if self.given:
            return {}
        spp, repeats = self.config.timing_spp, self.config.timing_repeats
        clock = "" if self.config.time == "wall" else f"{self.config.time}-"
        path = self.folder / f"cost-{clock}{spp}-{repeats}.json"
        known: Costs = json.loads(path.read_text()) if path.exists() else {}
        self._auto = known[USUAL.name]["sampler"] if known else _sampler(self._warm_up(USUAL))
        unit_of = self.clock
        new = {r.name: r for r in map(self.resolve, (unit_of, *DEFAULTS, *renders)) if r.name not in known}
        new = {name: render for name, render in new.items() if self._can(render)}
        if unit_of.name in self.lacks:
            raise NgptError(f"the clock, sampler '{unit_of.sampler}', cannot be measured: {self.lacks[unit_of.name]}")
        if new:
            self.say(f"{self.name}: measuring what samples cost")
            scene = self.load()
            from data_gen.choosing.costs import measure

            timed = {unit_of.name: unit_of} | new
            seconds, _ = measure(
                scene, {name: r.options for name, r in timed.items()}, spp, repeats, clock=self.config.time
            )
            found = {name: summary(values) for name, values in seconds.items()}
            unit = known[unit_of.name]["median"] / found[unit_of.name]["median"] if unit_of.name in known else 1.0
            for name in new:
                known[name] = {key: value * unit for key, value in found[name].items()}
                known[name]["sampler"] = _sampler(self._warm[name])
            write_json(path, known)
        return known

    @property
    def clock(self) -> Render:
        """The render whose samples the nominal numbers count."""
        return self.resolve(self.config.render(USUAL.kind, self.config.clock))

    def resolve(self, render: Render) -> Render:
        """``render``, or the usual one where "auto" stands for its sampler on this scene; after ``costs``."""
        return USUAL if render == Render(USUAL.kind, self._auto) else render

    def samples(self, render: Render, spp: int, costs: Costs) -> int:
        """How many samples the time of ``spp`` of the clock's buys; two at least, or two batches, for a variance."""
        if render == self.clock or not costs:
            return spp
        from data_gen.samplers import SAMPLERS

        least = 2 * max(1, SAMPLERS[costs[render.name]["sampler"]].batch)
        return max(least, round(spp * costs[self.clock.name]["median"] / costs[render.name]["median"]))

    def stack(self, render: Render, spp: int, seed: int) -> GradientStack:
        """A stack with its time in the attribute ``ngpt:seconds``, without the compilation of kernels."""
        path = self._path(render, spp, seed)
        if not path.exists():
            if self.given:
                raise NgptError(f"{path}: no such stack")
            scene = self.load()
            from data_gen.choosing.costs import timed

            self._warm_up(render)
            stack, seconds = timed(scene, render.options, spp, seed, self.config.time)
            stack.attributes["ngpt:seconds"] = seconds
            write(path, stack)
        # Without gradients beside it the reader takes this name for direct light, not for emission seen directly.
        return read(path, {"direct": "direct"} if render.kind == "features" and not self.given else None)

    def stack_key(self, render: Render, spp: int, seed: int) -> list:
        """What the stack depends on, without rendering it."""
        if not self.given:
            return [self.key, render.name, spp, seed]
        path = self._path(render, spp, seed)
        return [str(path), path.stat().st_mtime_ns if path.exists() else 0]

    def load(self) -> Any:
        if self._scene is None:
            from data_gen.backend import use_variant

            use_variant()
            from data_gen.scenes.load import load_scene

            self._scene = load_scene(self.source, self.config.size)
        return self._scene

    def _path(self, render: Render, spp: int, seed: int) -> Path:
        return self.folder / f"{render.name.replace(' ', '-')}-{spp}-{seed}.exr"

    def _warm_up(self, render: Render) -> GradientStack:
        """Has the kernels compiled, and returns the stack of one sample."""
        scene = self.load()
        from data_gen.choosing.costs import warm_up

        if render.name not in self._warm:
            self._warm[render.name] = warm_up(scene, render.options)
        return self._warm[render.name]

    def _can(self, render: Render) -> bool:
        """Whether the sampler can render this scene, and renders that kind of stack; if not, ``lacks`` says why."""
        try:
            stack = self._warm_up(render)
        except NgptError as error:
            self.lacks[render.name] = str(error)
            return False
        if ("dx" in stack) != (render.kind == "gradients"):
            what, entry = ("no gradients", "rivals") if render.kind == "gradients" else ("gradients", "samplers")
            self.lacks[render.name] = f"sampler '{render.sampler}' renders {what}: list it under {entry}"
            return False
        return True


def _sampler(stack: GradientStack) -> str:
    return str(stack.attributes["ngpt:sampler"])
