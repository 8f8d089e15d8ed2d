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

# (facts of a scene, name of a sampler) -> why that sampler cannot render the scene, or "" if it can
Rule = Callable[["Facts", str], str]


def integrator_of(module: str) -> Any:
    """Returns the class of the Mitsuba integrator that a module defines, or None if it has a function ``make``
    instead.
    """
    found = import_module(module)
    own = (value for value in vars(found).values() if getattr(value, "__module__", "") == module)
    return None if hasattr(found, "make") else next(value for value in own if hasattr(value, "like_path"))


# Options of every sampler of single images, besides its own. ``data_gen.render`` handles them; ``make`` does not.
COMMON = {
    "points": Option(
        "sobol",
        "random numbers: Sobol points in a single round of --spp samples, in rounds from 16 on, or independent ones",
        choices=("sobol", "rounds", "independent"),
    ),
    "lamps": Option(
        "power",
        "how often each lamp is chosen, if the scene does not say: by the light it brings, or all equally",
        choices=("power", "uniform"),
    ),
}


@dataclass(frozen=True)
class Entry:
    name: str  # the name that users give
    summary: str  # one line for the user
    # The module with its Mitsuba integrator, a ``data_gen.samplers.common.GradientIntegrator``, or with a function
    # ``make``. It is imported when the sampler is made, since its classes belong to a variant of Mitsuba. Instead of a
    # module, the function itself may be given
    module: str | Callable[..., Any]
    standing: str = field(default="niche", kw_only=True)  # one of ``STANDINGS``: order in the help, tests
    # The options by name. ``make`` gets all of them, except the options in ``COMMON``.
    options: Mapping[str, Option] = field(default_factory=dict, kw_only=True)
    refusals: tuple[Rule, ...] = field(default=(), kw_only=True)  # the first rule that gives a reason counts
    # Notes for the user by subject: "transport" and "noise"; "mirrors" and "media", shown if a scene has them
    notes: Mapping[str, str] = field(default_factory=dict, kw_only=True)
    loses: str = field(default="", kw_only=True)  # which light of lamps without size is lost at holes; "": none
    # Whether it uses Mitsuba's densities for lamps; these are wrong for bent lamps (``BentLamps``)
    leaves_lamps: bool = field(default=False, kw_only=True)

    def __post_init__(self) -> None:
        if self.standing not in STANDINGS:
            raise NgptError(f"sampler '{self.name}': standing '{self.standing}' is none of {', '.join(STANDINGS)}")

    def make(self, *args: Any, **options: Any) -> Any:
        """Returns the object that the module makes. Raises NgptError for a scene that cannot be rendered."""
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
        """Returns the ``settings`` that are not defaults, in the form of ``-O``, separated by commas."""
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

    Its ``make`` (scene, options) returns a function that takes the samples of a pass (``data_gen.passes.SamplePass``).
    """

    _: KW_ONLY
    gradients: bool = True  # whether it renders dx and dy
    rank: int = 0  # "auto" takes the sampler of least rank that can render the scene; 0: never
    # Whether the pilot of "auto" (small test renders) tries this sampler in scenes that it can render. This is set if
    # measurements have shown that the pilot chooses the sampler where it is best (``data_gen.choosing.plans``)
    tried: bool = False
    compiles: float = 2.0  # seconds that a core takes to compile its kernels; used if ``tried``
    # Kinds of light that it finds, and that paths from the camera hardly find: "caustics" (seen in mirrors or through
    # glass), "hidden lamps" (whose light comes indirectly), "grids" (light in media of varying density, by photons)
    finds: tuple[str, ...] = ()
    diagnoses: bool = False  # whether it counts failed shifts (--diagnostics): ``make`` takes ``diagnostics=True``
    # 0 if all samples are independent. If samples of a pass depend on each other, or add light to other pixels (splat),
    # this is the number of samples per pixel in a pass, and variances are computed over passes
    batch: int = 0
    together: bool = False  # whether pixels share paths: a pass needs all pixels, with equally many samples
    lane_bytes: int = LANE_BYTES  # memory of a lane, which is one sample of one pixel, in a pass
    by_place: bool = False  # whether it can choose lamps by place: ``make`` takes ``places``
    gathers: bool = False  # whether its layer ``caustic`` is light of photons (``ngpt.layers.GATHERED``)
    biased: bool = False  # whether its expected image approaches Mitsuba's only as the number of samples grows
    counts: bool = False  # whether it needs independent random numbers, one by one: then it has no option ``points``

    def __post_init__(self) -> None:
        super().__post_init__()
        common = {name: option for name, option in COMMON.items() if name != "points" or not self.counts}
        object.__setattr__(self, "options", {**self.options, **common})

    @property
    def plugin(self) -> str:
        return plugin_of(self.name)

    def integrator(self, scene: Any, **options: Any) -> Any:
        """Returns its integrator, with the parameters of the scene's own ``path`` and checked ``options``."""
        return integrator_of(self.module).like_path(scene, self.plugin, **options)

    def make(self, scene: Any, **options: Any) -> Any:
        if callable(self.module) or integrator_of(self.module) is None:
            return super().make(scene, **options)
        return self.integrator(scene, **options).prepare(scene)

    @property
    def film_of_gradients(self) -> bool:
        """Whether its film may need room for more than colour and features. A study may put any layer on its film."""
        return self.gradients or bool(self.batch) or self.standing == "study"

    @property
    def even(self) -> bool:
        """Whether all pixels must have the same number of samples."""
        return bool(self.batch) or self.together

    def subpixels(self, asked: int | str, spp: int | None) -> int:
        """K of the K x K subpixels that a render keeps: ``asked``, or for "auto" the best K for ``spp`` samples.

        Raises WrongUse if the sampler cannot keep subpixels.
        """
        k = choice(asked)
        if not self.batch:
            # Networks for gradients were trained without subpixels.
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
    """A sampler of shots (frame sequences). It renders frames in order, since it reuses earlier frames. It renders no
    single images.

    Its ``make`` (scene, seed, samples per pixel, memory in MiB, options) returns an object with

    ``film(index, motion, depth, changed)``  the film of frame number ``index`` of the shot. ``motion`` (H, W, 2) and
                                             ``depth`` (H, W) are as in ``data_gen.frames.motion``. ``changed`` is None
                                             if only the camera moves. If more moves, it is the frame's scene and its
                                             shapes
    ``confidence``                           the mean number of frames that a pixel of the last film counts for
    """

    _: KW_ONLY
    spp: int  # samples per pixel of a frame, where the user gives none
    warm_up: int  # number of earlier frames that it renders again when a shot is continued, so that it can reuse them
    alone: str  # the reason why it renders no single images, as part of a message


# Other packages add samplers by entry points. ngpt has no sampler of shots itself.
SAMPLERS: Registry[Sampler] = Registry("ngpt.samplers", "sampler", Sampler, {})
FRAME_SAMPLERS: Registry[FrameSampler] = Registry("ngpt.frame_samplers", "sampler", FrameSampler, {}, SAMPLERS)


def plugin_of(name: str) -> str:
    """Returns the name of a sampler's integrator in Mitsuba."""
    return name.replace("-", "_")


def by_plugin(plugin: str) -> Sampler:
    return next(SAMPLERS[name] for name in SAMPLERS.names() if plugin_of(name) == plugin)


def register(entry: Sampler | FrameSampler) -> None:
    """Adds a sampler after the existing ones. Raises NgptError if its name is taken."""
    if entry.name in ("auto", *SAMPLERS, *FRAME_SAMPLERS):
        raise NgptError(f"there is a sampler '{entry.name}' already")
    if isinstance(entry, FrameSampler):
        FRAME_SAMPLERS[entry.name] = entry
    else:
        SAMPLERS[entry.name] = entry


def find(name: str, facts: Facts | None = None) -> Sampler:
    """The sampler called ``name``. Raises NgptError if there is none, or if it refuses a scene of these ``facts``."""
    if name in FRAME_SAMPLERS:
        raise WrongUse(f"sampler '{name}' is for shots (--frames): {FRAME_SAMPLERS[name].alone}; use --sampler gpt")
    if name not in SAMPLERS:
        names = ("auto", *SAMPLERS)
        raise SAMPLERS.unknown(name, names, ", ".join(names))
    sampler = SAMPLERS[name]
    if facts is not None and (reason := sampler.refuses(facts)):
        able = [other for other in SAMPLERS.values() if not other.refuses(facts)]
        names = [other.name if other.gradients else f"{other.name} (no gradients)" for other in able]
        raise NgptError(f"sampler '{name}' cannot render this scene: {reason}; use --sampler {', or '.join(names)}")
    return sampler


# The default sampler, without gradients, and the default reconstruction method. Samplers and methods that take longer
# to compile, to render or to explain replace the defaults only where measurements show that they are better.
SIMPLE = ("primal", "oidn")


def tried(facts: Facts) -> list[Sampler]:
    """Returns the samplers that a pilot may try in a scene of these ``facts``."""
    return [sampler for sampler in SAMPLERS.values() if sampler.tried and not sampler.refuses(facts)]


def described(facts: Facts, gradients: bool = False) -> tuple[str, str, str]:
    """Returns the sampler and the method for "auto" in `ngpt render`, chosen from the scene's description only, and the
    reason.

    Sampler and method are ``SIMPLE``, except in two cases: gradients are requested, or OIDN is missing (without OIDN,
    gradients give better images). In these cases the method is "", which means that the rendered layers decide.
    """
    sampler, reason = choose(facts)
    if gradients or METHODS[SIMPLE[1]].missing():
        return sampler, "", reason
    return *SIMPLE, "more samples pay more than gradients; --sampler gpt renders gradients"


def choose(facts: Facts) -> tuple[str, str]:
    """Returns the sampler with gradients for "auto", chosen from the scene's description only, and the reason."""
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
    """Raises WrongUse for options that the sampler lacks. "auto" has those of ``COMMON`` that all its samplers have."""
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
