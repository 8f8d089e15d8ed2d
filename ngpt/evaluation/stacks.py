"""Stacks, references and costs (seconds per sample) of a scene, which are rendered once and then taken from the cache.

The cache has folders NAME-HASH for each scene. The hash depends on the contents of the scene's files, the size, the
version of Mitsuba, and the code of the sampler. A folder holds

    RENDER-SPP-SEED.exr         stacks. RENDER is a kind of stack ("gradients"), with the sampler if it is not the usual
                                one, and its options ("gradients-gpt-reuse=true"). SPP is the number of samples
    reference-*-a.exr, -b.exr   the two halves of references
    cost-*.json                 seconds per sample

A user's folder of stacks has the same form, without costs. Its reference may be one image.
"""

import hashlib
import json
import math
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

from ngpt.errors import NgptError
from ngpt.evaluation.config import EvaluationConfig
from ngpt.evaluation.keys import scene_hash
from ngpt.evaluation.references import HALVES, Reference, find_reference, read_reference
from ngpt.evaluation.renders import DEFAULTS, Render
from ngpt.io.exr import read, write
from ngpt.measure.averages import summary
from ngpt.renderer import Renderer
from ngpt.stack import GradientStack
from ngpt.system.files import save
from ngpt.system.machine import version
from ngpt.system.writing import write_json
from ngpt.version import __version__

# The seed of the first half of a reference, far from the seeds 0, 1 ... of stacks.
REFERENCE_SEED = 1 << 20

USUAL = DEFAULTS[0]
Costs = dict[str, dict[str, Any]]


class SceneStacks:
    """The stacks, the reference and the costs of a scene.

    ``lacks``  name of a render -> why its columns are absent on this scene; known after ``costs``
    """

    def __init__(
        self,
        name: str,
        source: str,
        config: EvaluationConfig,
        cache: Path,
        renderer: Renderer,
        *,
        say: Callable[[str], None] = lambda text: None,
    ):
        self.name, self.source, self.config, self.cache = name, source, config, cache
        self.renderer, self.say = renderer, say
        self.given = Path(source).is_dir()
        self.lacks: dict[str, str] = {}
        self._auto = ""
        self._scene: Any = None
        self._warm: dict[str, GradientStack] = {}
        self._parts: list[Any] = []
        self._keys: dict[str, str] = {}
        if not self.given:
            scene = scene_hash(source) if Path(source).is_file() else renderer.scene_code(source)
            self._parts = [scene, list(config.size), __version__, version("mitsuba")]

    def key(self, sampler: str) -> str:
        """A hash of everything that the images of a sampler depend on."""
        if sampler not in self._keys:
            parts = json.dumps([*self._parts, self.renderer.code(sampler)])
            self._keys[sampler] = hashlib.sha256(parts.encode()).hexdigest()
        return self._keys[sampler]

    def folder(self, sampler: str) -> Path:
        if self.given:
            return Path(self.source)
        return self.cache / f"{self.name}-{self.key(sampler)[:12]}"

    def reference(self) -> Reference:
        """The reference from the configuration, from a user's folder, or rendered here.

        Rendering makes two halves, each with half of the budget. Raises NgptError if a folder has no reference.
        """
        config = self.config
        if self.name in config.references:
            named = config.references[self.name]
            return read_reference([named] if isinstance(named, str) else named)
        if self.given:
            return find_reference(Path(self.source))
        limit = f"{config.reference_spp}spp" if config.reference_spp else f"{config.reference_seconds:g}s"
        render = config.render("features", config.reference_sampler)
        name = "-".join(["reference", *render.by.split(), limit])
        folder = self.folder(render.sampler)
        paths = [folder / f"{name}{half}.exr" for half in HALVES]
        for i, path in enumerate(paths):
            if not path.exists():
                self.say(f"{self.name}: rendering the reference, half {i + 1} of {limit}")
                scene = self.load()
                spp = math.ceil(config.reference_spp / 2) or None
                seconds = None if spp else config.reference_seconds / 2
                _keep(path, self.renderer.render(scene, render.options, spp, REFERENCE_SEED + i, seconds=seconds))
        return read_reference(paths)

    def costs(self, renders: Iterable[Render] = ()) -> Costs:
        """The cost of each render, by name, for the usual renders, the ``clock`` and ``renders``.

        A cost has seconds per sample of the whole image, without the compilation of kernels: ``median`` and quartiles
        ``low`` and ``high`` over several renders. It also has the ``sampler`` that rendered. Costs that are not in the
        cache are measured in alternation with the clock, and scaled to the cached cost of the clock. The result is
        empty for a user's folder of stacks.
        """
        if self.given:
            return {}
        usual = self._costs_in(USUAL)
        self._auto = usual[USUAL.name]["sampler"] if USUAL.name in usual else _sampler(self._warm_up(USUAL))
        unit_of = self.clock
        wanted = {render.name: render for render in map(self.resolve, (unit_of, *DEFAULTS, *renders))}
        found = {name: self._costs_in(render).get(name) for name, render in wanted.items()}
        known: Costs = {name: cost for name, cost in found.items() if cost is not None}
        new = {name: render for name, render in wanted.items() if name not in known and self._can(render)}
        if unit_of.name in self.lacks:
            raise NgptError(f"the clock, sampler '{unit_of.sampler}', cannot be measured: {self.lacks[unit_of.name]}")
        if new:
            self.say(f"{self.name}: measuring what samples cost")
            timed = {name: render.options for name, render in ({unit_of.name: unit_of} | new).items()}
            spp, repeats = self.config.timing_spp, self.config.timing_repeats
            seconds, _ = self.renderer.measure(self.load(), timed, spp, repeats, clock=self.config.time)
            summaries = {name: summary(values) for name, values in seconds.items()}
            unit = known[unit_of.name]["median"] / summaries[unit_of.name]["median"] if unit_of.name in known else 1.0
            for name, render in new.items():
                known[name] = {key: value * unit for key, value in summaries[name].items()}
                known[name]["sampler"] = _sampler(self._warm[name])
                file = self._cost_file(render)
                file.parent.mkdir(parents=True, exist_ok=True)
                write_json(file, self._costs_in(render) | {name: known[name]})
        return known

    def _cost_file(self, render: Render) -> Path:
        clock = "" if self.config.time == "wall" else f"{self.config.time}-"
        name = f"cost-{clock}{self.config.timing_spp}-{self.config.timing_repeats}.json"
        return self.folder(render.sampler) / name

    def _costs_in(self, render: Render) -> Costs:
        """The cached costs, which were measured with the present code of the render's sampler."""
        path = self._cost_file(render)
        return json.loads(path.read_text()) if path.exists() else {}

    @property
    def clock(self) -> Render:
        """The render whose samples per pixel are the nominal ones, ``spp`` in the configuration."""
        return self.resolve(self.config.render(USUAL.kind, self.config.clock))

    def resolve(self, render: Render) -> Render:
        """``render``, or the usual one if "auto" chooses this sampler on this scene; known after ``costs``."""
        return USUAL if render == Render(USUAL.kind, self._auto) else render

    def samples(self, render: Render, spp: int, costs: Costs) -> int:
        """The samples that take the time of ``spp`` samples of the clock; at least two (or two batches)."""
        if render == self.clock or not costs:
            return spp
        least = 2 * max(1, self.renderer.batch(costs[render.name]["sampler"]))
        return max(least, round(spp * costs[self.clock.name]["median"] / costs[render.name]["median"]))

    def stack(self, render: Render, spp: int, seed: int) -> GradientStack:
        """A stack. Its attribute ``ngpt:seconds`` is the time of the render, without compilation of kernels."""
        path = self._path(render, spp, seed)
        if not path.exists():
            if self.given:
                raise NgptError(f"{path}: no such stack")
            self._warm_up(render)
            stack, seconds = self.renderer.timed(self.load(), render.options, spp, seed, self.config.time)
            stack.attributes["ngpt:seconds"] = seconds
            _keep(path, stack)
        # Without gradients, the reader would take the layer "direct" for direct light, not for visible emission.
        return read(path, {"direct": "direct"} if render.kind == "features" and not self.given else None)

    def stack_key(self, render: Render, spp: int, seed: int) -> list:
        """The key of a stack in the cache of cells. The stack need not be rendered for it."""
        if not self.given:
            return [self.key(render.sampler), render.name, spp, seed]
        path = self._path(render, spp, seed)
        return [str(path), path.stat().st_mtime_ns if path.exists() else 0]

    def load(self) -> Any:
        if self._scene is None:
            self._scene = self.renderer.load(self.source, self.config.size)
        return self._scene

    def _path(self, render: Render, spp: int, seed: int) -> Path:
        return self.folder(render.sampler) / f"{render.name.replace(' ', '-')}-{spp}-{seed}.exr"

    def _warm_up(self, render: Render) -> GradientStack:
        """Compiles the kernels, and returns a stack of one sample."""
        if render.name not in self._warm:
            self._warm[render.name] = self.renderer.warm_up(self.load(), render.options)
        return self._warm[render.name]

    def _can(self, render: Render) -> bool:
        """Whether the sampler can render this scene as this kind of stack. If not, ``lacks`` gets the reason."""
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


def _keep(path: Path, stack: GradientStack) -> None:
    """Puts a stack into the cache, unless another process was faster."""
    path.parent.mkdir(parents=True, exist_ok=True)
    save(path, lambda path, overwrite: write(path, stack, overwrite=overwrite), alike=True)


def _sampler(stack: GradientStack) -> str:
    return str(stack.attributes["ngpt:sampler"])
