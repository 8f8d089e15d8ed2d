"""What a sampler says of itself, and how it is found by that: entries, their typed options, and the registry.

Nothing here imports Mitsuba: a sampler's module, whose classes belong to a variant of Mitsuba, is imported when the
sampler is made.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from importlib import import_module
from typing import TYPE_CHECKING, Any

from data_gen.budget import LANE_BYTES
from ngpt.errors import NgptError, WrongUse, did_you_mean
from ngpt.options import STANDINGS, Option, as_text, settings, unusual
from ngpt.system.parts import Registry

if TYPE_CHECKING:
    from data_gen.scenes.facts import Facts

# Why a scene of these facts cannot be rendered by the sampler of a name; "" where it can
Rule = Callable[["Facts", str], str]


def _of_no_module(*args: Any, **options: Any) -> Any:
    raise NotImplementedError


def _anything(facts: Facts) -> str:
    return ""


def _nothing_to_note(facts: Facts) -> list[str]:
    return []


def integrator_of(module: str) -> Any:
    """The class of the Mitsuba integrator that a module defines; None where it has a function ``make`` instead."""
    found = import_module(module)
    own = (value for value in vars(found).values() if getattr(value, "__module__", "") == module)
    return None if hasattr(found, "make") else next(value for value in own if hasattr(value, "like_path"))


# What every sampler of single images takes beside its own options; ``data_gen.render`` sees to it, and not ``make``.
COMMON = {
    "points": Option(
        "sobol",
        "of random numbers: Sobol's, in rounds where --spp does not say how many, or independent ones (more noise)",
        choices=("sobol", "rounds", "independent"),
    ),
    "lamps": Option(
        "power",
        "how often each is chosen, where the scene leaves that open: by what it brings, or all alike",
        choices=("power", "uniform"),
    ),
}


@dataclass(frozen=True)
class Entry:
    """What all samplers have.

    ``name``      as users call it
    ``summary``   one line for the user
    ``module``    where its Mitsuba integrator is, a ``data_gen.samplers.common.GradientIntegrator``; or a function
                  ``make``. It is imported when the sampler is made, since its classes belong to a variant of Mitsuba
    ``make``      what makes it, where there is no ``module``
    ``standing``  one of ``STANDINGS``: which samplers help shows first, and which laws run in `make test`
    ``options``   name -> ``Option``; ``make`` takes all of them, except the options in ``COMMON``
    ``refuses``   facts about a scene -> why the sampler cannot render it, "" if it can
    ``refusals``  the same as rules that several samplers share; the first that gives a reason counts
    ``notes``     facts about a scene -> what the user should know about rendering it, a line each
    """

    name: str
    summary: str
    module: str = ""
    make: Callable[..., Any] = field(default=_of_no_module, kw_only=True)
    standing: str = field(default="niche", kw_only=True)
    options: Mapping[str, Option] = field(default_factory=dict, kw_only=True)
    refuses: Callable[[Facts], str] = field(default=_anything, kw_only=True)
    refusals: tuple[Rule, ...] = field(default=(), kw_only=True)
    notes: Callable[[Facts], list[str]] = field(default=_nothing_to_note, kw_only=True)

    def __post_init__(self) -> None:
        if self.standing not in STANDINGS:
            raise NgptError(f"sampler '{self.name}': standing '{self.standing}' is none of {', '.join(STANDINGS)}")
        if self.refusals:
            object.__setattr__(self, "refuses", self._first_refusal)
        if self.module:
            object.__setattr__(self, "make", self._make)

    def _make(self, *args: Any, **options: Any) -> Any:
        return import_module(self.module).make(*args, **options)

    def _first_refusal(self, facts: Facts) -> str:
        return next(filter(None, (rule(facts, self.name) for rule in self.refusals)), "")

    def settings(self, given: Mapping[str, Any]) -> dict[str, Any]:
        """All options, those ``given``, which may be texts, and the others' defaults.

        Raises NgptError for options that do not exist, and for values that are not allowed.
        """
        return settings(f"sampler '{self.name}'", self.options, given)

    def unusual(self, settings: Mapping[str, Any]) -> str:
        """The ``settings`` that are not defaults, as ``-O`` takes them, separated by commas."""
        return as_text(unusual(self.options, settings))

    def made(self, *args: Any, **options: Any) -> Any:
        """What ``make`` makes, with ``options`` that may be texts, and the others' defaults; raises NgptError."""
        return self.make(*args, **own(self.settings(options)))


def own(settings: Mapping[str, Any]) -> dict[str, Any]:
    """The ``settings`` that are a sampler's own."""
    return {name: value for name, value in settings.items() if name not in COMMON}


@dataclass(frozen=True)
class Sampler(Entry):
    """What renders the layers of a gradient stack. It has its own options, and the options in ``COMMON``.

    ``make``        (scene, options) -> what takes the samples of a pass (``data_gen.passes.SamplePass``); raises
                    NgptError for a scene it cannot render
    ``gradients``   whether it renders dx and dy
    ``rank``        "auto" takes the sampler of least rank that can render the scene; 0: never
    ``tried``       whether the pilot of "auto" compares it with others, where it can render the scene. True for
                    samplers that were seen to be chosen where they are best (``data_gen.choosing.plans``)
    ``compiles``    seconds that a core takes to compile its kernels, of most scenes; given where ``tried`` is true
    ``finds``       what light it finds that paths from the camera hardly find: "caustics" (seen in mirrors or through
                    glass after glass has focussed it on something rough), "hidden lamps" (hidden from what they light),
                    "grids" (light in media whose density varies, by photons)
    ``diagnoses``   whether it counts failed shifts, which ``--diagnostics`` writes: ``make`` takes ``diagnostics=True``
    ``batch``       0 if all samples are independent. Else samples per pixel that depend on each other, or splat: a pass
                    has so many, and variances are over passes
    ``together``    whether pixels share paths, so that a pass has all of them, with as many samples each
    ``lane_bytes``  memory that a lane, one sample of one pixel, takes in a pass
    ``counts``      whether it replays numbers one by one, so that they must be independent: it takes no ``points``
    ``by_place``    whether it can choose lamps by place: ``make`` takes ``places``
    ``biased``      whether its mean approaches the mean of Mitsuba's integrator only as the number of samples grows
    """

    gradients: bool = field(default=True, kw_only=True)
    rank: int = field(default=0, kw_only=True)
    tried: bool = field(default=False, kw_only=True)
    compiles: float = field(default=2.0, kw_only=True)
    finds: tuple[str, ...] = field(default=(), kw_only=True)
    diagnoses: bool = field(default=False, kw_only=True)
    batch: int = field(default=0, kw_only=True)
    together: bool = field(default=False, kw_only=True)
    lane_bytes: int = field(default=LANE_BYTES, kw_only=True)
    by_place: bool = field(default=False, kw_only=True)
    biased: bool = field(default=False, kw_only=True)
    counts: bool = field(default=False, kw_only=True)

    def __post_init__(self) -> None:
        super().__post_init__()
        common = {name: option for name, option in COMMON.items() if name != "points" or not self.counts}
        object.__setattr__(self, "options", {**self.options, **common})

    @property
    def plugin(self) -> str:
        """What Mitsuba calls its integrator."""
        return self.name.replace("-", "_")

    def integrator(self, scene: Any, **options: Any) -> Any:
        """Its integrator with the parameters of the scene's own ``path``, and ``options`` that are checked."""
        return integrator_of(self.module).like_path(scene, self.plugin, **options)

    def _make(self, scene: Any, **options: Any) -> Any:
        if integrator_of(self.module) is None:
            return super()._make(scene, **options)
        return self.integrator(scene, **options).prepare(scene)

    @property
    def even(self) -> bool:
        """Whether all pixels must have as many samples."""
        return bool(self.batch) or self.together


@dataclass(frozen=True)
class FrameSampler(Entry):
    """What renders the frames of a shot one after the other, for it remembers those before; no single images.

    ``make``     (scene, seed, samples per pixel, memory in MiB, options) -> an object whose ``film(index, motion,
                 depth)`` is the film of a frame, numbered in the shot; raises NgptError for what it cannot render
    ``spp``      samples per pixel of a frame, where the user gives none
    ``warm_up``  frames before, that are rendered where a shot is gone on with: its history
    ``alone``    why it renders no single images
    """

    spp: int = field(kw_only=True)
    warm_up: int = field(kw_only=True)
    alone: str = field(kw_only=True)


FRAME_SAMPLERS: dict[str, FrameSampler] = {}
# Other packages bring theirs by entry points.
SAMPLERS: Registry[Sampler] = Registry("ngpt.samplers", "sampler", Sampler, {}, FRAME_SAMPLERS)


def by_plugin(plugin: str) -> Sampler:
    """The sampler whose integrator Mitsuba calls so."""
    return next(entry for entry in SAMPLERS.values() if entry.plugin == plugin)


def register(entry: Sampler | FrameSampler) -> None:
    """Adds a sampler, behind those there are. Raises NgptError if its name is taken."""
    if entry.name in ("auto", *SAMPLERS, *FRAME_SAMPLERS):
        raise NgptError(f"there is a sampler '{entry.name}' already")
    if isinstance(entry, FrameSampler):
        FRAME_SAMPLERS[entry.name] = entry
    else:
        SAMPLERS[entry.name] = entry


def find(name: str, facts: Facts | None = None) -> Sampler:
    """The sampler of that name. Raises NgptError if there is none, or if it refuses a scene of these ``facts``."""
    if name in FRAME_SAMPLERS:
        raise WrongUse(f"sampler '{name}' is for shots (--frames): {FRAME_SAMPLERS[name].alone}; use --sampler gpt")
    if name not in SAMPLERS:
        meant = did_you_mean(name, ("auto", *SAMPLERS, *FRAME_SAMPLERS))
        shots = f"; for shots (--frames): {', '.join(FRAME_SAMPLERS)}"
        raise WrongUse(f"unknown sampler '{name}'; {meant}choose one of: auto, {', '.join(SAMPLERS)}{shots}")
    sampler = SAMPLERS[name]
    if facts is not None and (reason := sampler.refuses(facts)):
        able = [other for other in SAMPLERS.values() if not other.refuses(facts)]
        names = [other.name if other.gradients else f"{other.name} (no gradients)" for other in able]
        raise NgptError(f"sampler '{name}' cannot render this scene: {reason}; use --sampler {', or '.join(names)}")
    return sampler


def choose(facts: Facts) -> tuple[str, str]:
    """The sampler that "auto" stands for, from the description only, and why."""
    reasons: list[str] = []
    for sampler in sorted(SAMPLERS.values(), key=lambda sampler: sampler.rank):
        if not sampler.rank:
            continue
        reason = sampler.refuses(facts)
        if not reason:
            media = "there are media" if facts.media else "there are no media"
            return sampler.name, "; ".join(reasons) or f"the integrator is '{facts.integrator}' and {media}"
        reasons.append(reason)
    raise NgptError(f"no sampler can render this scene with gradients: {'; '.join(reasons)}; use --sampler primal")


def check_options(name: str, given: Mapping[str, Any]) -> None:
    """Raises WrongUse for options that the sampler of that name does not take, or not all that "auto" may stand for."""
    if name != "auto":
        (FRAME_SAMPLERS[name] if name in FRAME_SAMPLERS else find(name)).settings(given)
        return
    able = [sampler for sampler in SAMPLERS.values() if sampler.rank or sampler.tried]
    shared = {o: option for o, option in COMMON.items() if all(o in sampler.options for sampler in able)}
    for option in given:
        having = [entry.name for entry in (*SAMPLERS.values(), *FRAME_SAMPLERS.values()) if option in entry.options]
        if having and option not in shared:
            raise WrongUse(f"option '{option}' needs a sampler that has it, not 'auto': {', '.join(having)}")
    settings("sampler 'auto'", shared, given)


def by_standing(standing: str) -> dict[str, Sampler | FrameSampler]:
    """The samplers of a standing, by name."""
    entries: list[Sampler | FrameSampler] = [*SAMPLERS.values(), *FRAME_SAMPLERS.values()]
    return {entry.name: entry for entry in entries if entry.standing == standing}
