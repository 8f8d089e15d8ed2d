"""The registry of samplers: their entries, and their typed options.

Nothing here imports Mitsuba. The classes of a sampler's module belong to a variant of Mitsuba, so the module is
imported when the sampler is made.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import KW_ONLY, dataclass, field
from importlib import import_module
from typing import TYPE_CHECKING, Any

from data_gen.budget import LANE_BYTES
from ngpt.errors import NgptError, WrongUse
from ngpt.methods import METHODS
from ngpt.options import STANDINGS, Option, as_text, settings, unusual
from ngpt.subpixels import best, choice
from ngpt.system.parts import Registry

if TYPE_CHECKING:
    from data_gen.scenes.facts import Facts

# Why a scene of these facts cannot be rendered by the sampler of a name; "" where it can
Rule = Callable[["Facts", str], str]


def integrator_of(module: str) -> Any:
    """Returns the class of the Mitsuba integrator that a module defines, or None if it has a function ``make``
    instead.
    """
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
    name: str  # as users call it
    summary: str  # one line for the user
    # Where its Mitsuba integrator is, a ``data_gen.samplers.common.GradientIntegrator``, or a function ``make``. It is
    # imported when the sampler is made, since its classes belong to a variant of Mitsuba. Or the function itself
    module: str | Callable[..., Any]
    standing: str = field(default="niche", kw_only=True)  # of ``STANDINGS``: what help shows first, and what is tested
    # All of them are given to ``make``, except the options in ``COMMON``.
    options: Mapping[str, Option] = field(default_factory=dict, kw_only=True)
    refusals: tuple[Rule, ...] = field(default=(), kw_only=True)  # the first that gives a reason counts
    # What the user should know about rendering, by subject: "transport" and "noise"; "mirrors" and "media" where a
    # scene has them
    notes: Mapping[str, str] = field(default_factory=dict, kw_only=True)
    loses: str = field(default="", kw_only=True)  # which light of lamps without size it loses at holes; "": none
    # Whether it leaves the densities of lamps to Mitsuba, which errs where these have vertex normals (``BentLamps``)
    leaves_lamps: bool = field(default=False, kw_only=True)

    def __post_init__(self) -> None:
        if self.standing not in STANDINGS:
            raise NgptError(f"sampler '{self.name}': standing '{self.standing}' is none of {', '.join(STANDINGS)}")

    def make(self, *args: Any, **options: Any) -> Any:
        """What the module makes; raises NgptError for a scene that cannot be rendered."""
        make = self.module if callable(self.module) else import_module(self.module).make
        return make(*args, **options)

    def refuses(self, facts: Facts) -> str:
        """Returns why the sampler cannot render a scene of these ``facts``, or "" if it can."""
        return next(filter(None, (rule(facts, self.name) for rule in self.refusals)), "")

    def notes_on(self, facts: Facts) -> list[str]:
        """Returns what the user should know about rendering a scene of these ``facts``, one line for each note."""
        heads = {"transport": f"transport: Mitsuba's '{facts.integrator}', ", "noise": "noise: "}
        heads |= {"mirrors": "mirrors or clear glass: "} if facts.mirrors else {}
        heads |= {"media": "media: "} if facts.media else {}
        return [heads[subject] + text for subject, text in self.notes.items() if subject in heads]

    def settings(self, given: Mapping[str, Any]) -> dict[str, Any]:
        """Returns all options: the ``given`` ones, whose values may be texts, and the defaults of the others. Raises
        NgptError for options that do not exist, and for values that are not allowed.
        """
        return settings(f"sampler '{self.name}'", self.options, given)

    def unusual(self, settings: Mapping[str, Any]) -> str:
        """The ``settings`` that are not defaults, as ``-O`` takes them, separated by commas."""
        return as_text(unusual(self.options, settings))

    def made(self, *args: Any, **options: Any) -> Any:
        """Returns what ``make`` makes with these ``options``, which may be texts, and the defaults of the others.
        Raises NgptError.
        """
        return self.make(*args, **own(self.settings(options)))


def own(settings: Mapping[str, Any]) -> dict[str, Any]:
    return {name: value for name, value in settings.items() if name not in COMMON}


@dataclass(frozen=True)
class Sampler(Entry):
    """A sampler that renders the layers of a gradient stack. It has its own options, and the options in ``COMMON``.

    Its ``make`` (scene, options) returns what takes the samples of a pass (``data_gen.passes.SamplePass``).
    """

    _: KW_ONLY
    gradients: bool = True  # whether it renders dx and dy
    rank: int = 0  # "auto" takes the sampler of least rank that can render the scene; 0: never
    # Whether the pilot of "auto" compares it with others, where it can render the scene: True for samplers that were
    # seen to be chosen where they are best (``data_gen.choosing.plans``)
    tried: bool = False
    compiles: float = 2.0  # seconds that a core takes to compile its kernels, given where it is ``tried``
    # Light that it finds and paths from the camera hardly find: "caustics" (seen in mirrors or glass after glass has
    # focussed it on something rough), "hidden lamps" (hidden from what they light), "grids" (light in media of varying
    # density, by photons)
    finds: tuple[str, ...] = ()
    diagnoses: bool = False  # whether it counts failed shifts (--diagnostics): ``make`` takes ``diagnostics=True``
    # 0 if all samples are independent. Else samples per pixel that depend on each other, or splat: a pass has this
    # number, and variances are over passes
    batch: int = 0
    together: bool = False  # whether pixels share paths, so that a pass has all of them, with as many samples each
    lane_bytes: int = LANE_BYTES  # memory that a lane, one sample of one pixel, takes in a pass
    by_place: bool = False  # whether it can choose lamps by place: ``make`` takes ``places``
    gathers: bool = False  # whether its layer ``caustic`` is what photons brought (``ngpt.layers.GATHERED``)
    biased: bool = False  # whether its mean approaches Mitsuba's only as the number of samples grows
    counts: bool = False  # whether it replays numbers one by one, which must be independent: it takes no ``points``

    def __post_init__(self) -> None:
        super().__post_init__()
        common = {name: option for name, option in COMMON.items() if name != "points" or not self.counts}
        object.__setattr__(self, "options", {**self.options, **common})

    @property
    def plugin(self) -> str:
        return plugin_of(self.name)

    def integrator(self, scene: Any, **options: Any) -> Any:
        """Returns its integrator with the parameters of the scene's own ``path`` and the ``options``, which are
        checked.
        """
        return integrator_of(self.module).like_path(scene, self.plugin, **options)

    def make(self, scene: Any, **options: Any) -> Any:
        if callable(self.module) or integrator_of(self.module) is None:
            return super().make(scene, **options)
        return self.integrator(scene, **options).prepare(scene)

    @property
    def film_of_gradients(self) -> bool:
        """Whether its film may need room for more than colour and features: studies put what they like."""
        return self.gradients or bool(self.batch) or self.standing == "study"

    @property
    def even(self) -> bool:
        """Whether all pixels must have as many samples."""
        return bool(self.batch) or self.together

    def subpixels(self, asked: int | str, spp: int | None) -> int:
        """K of the K x K subpixels that a render keeps: the number ``asked``, or for "auto" what suits ``spp`` samples.

        Raises WrongUse if it cannot keep the requested ones.
        """
        k = choice(asked)
        if not self.batch:
            # With gradients, networks combine images that they were trained to find without subpixels.
            return int(k) if k != "auto" else 1 if self.gradients else best(spp)
        if k in ("auto", 1):
            return 1
        able = ", ".join(name for name, other in SAMPLERS.items() if not other.batch)
        raise WrongUse(
            f"sampler '{self.name}' puts light on any pixel and has no subpixels: leave subpixels out, or name one of: "
            f"{able}"
        )


@dataclass(frozen=True)
class FrameSampler(Entry):
    """A sampler that renders the frames of a shot in order, since it reuses earlier frames. It renders no single
    images.

    Its ``make`` (scene, seed, samples per pixel, memory in MiB, options) returns an object whose ``film(index, motion,
    depth)`` is the film of a frame, numbered in the shot.
    """

    _: KW_ONLY
    spp: int  # samples per pixel of a frame, where the user gives none
    warm_up: int  # frames before, that are rendered where a shot is gone on with: its history
    alone: str  # why it renders no single images


FRAME_SAMPLERS: dict[str, FrameSampler] = {}
# Other packages add theirs by entry points.
SAMPLERS: Registry[Sampler] = Registry("ngpt.samplers", "sampler", Sampler, {}, FRAME_SAMPLERS)


def plugin_of(name: str) -> str:
    """Returns the name of a sampler's integrator in Mitsuba."""
    return name.replace("-", "_")


def by_plugin(plugin: str) -> Sampler:
    return next(SAMPLERS[name] for name in SAMPLERS.names() if plugin_of(name) == plugin)


def register(entry: Sampler | FrameSampler) -> None:
    """Adds a sampler behind the existing ones. Raises NgptError if its name is taken."""
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
        known = f"auto, {', '.join(SAMPLERS)}; for shots (--frames): {', '.join(FRAME_SAMPLERS)}"
        raise SAMPLERS.unknown(name, ("auto", *SAMPLERS, *FRAME_SAMPLERS), known)
    sampler = SAMPLERS[name]
    if facts is not None and (reason := sampler.refuses(facts)):
        able = [other for other in SAMPLERS.values() if not other.refuses(facts)]
        names = [other.name if other.gradients else f"{other.name} (no gradients)" for other in able]
        raise NgptError(f"sampler '{name}' cannot render this scene: {reason}; use --sampler {', or '.join(names)}")
    return sampler


# The default is samples without gradients, and OIDN. Anything that takes longer to compile, to render or to explain
# replaces it only if it was measured to be better.
SIMPLE = ("primal", "oidn")


def described(facts: Facts, gradients: bool = False) -> tuple[str, str, str]:
    """The sampler of "auto" in `ngpt render`, from the description only, the method for its stacks, and why.

    The method is "" where the layers decide. It is the simple way unless there are media, where gradients pay, unless
    they are asked for, and unless OIDN is missing, without which gradients clean better.
    """
    sampler, reason = choose(facts)
    if gradients or facts.media or METHODS[SIMPLE[1]].missing():
        return sampler, "", reason
    return *SIMPLE, "there are no media, so more samples pay more than gradients; --sampler gpt renders gradients"


def choose(facts: Facts) -> tuple[str, str]:
    """The sampler with gradients that "auto" stands for, from the description only, and why."""
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
    entries: list[Sampler | FrameSampler] = [*SAMPLERS.values(), *FRAME_SAMPLERS.values()]
    return {entry.name: entry for entry in entries if entry.standing == standing}
