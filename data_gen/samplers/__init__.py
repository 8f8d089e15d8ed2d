"""The samplers: one registry, one way to call them.

A new sampler is a file and one more entry in ``SAMPLERS``. The command line, ``ngpt info``, the choice of "auto", the
refusals, the evaluation and the tests find it there. Nothing here imports Mitsuba: a sampler's module, whose classes
belong to a Mitsuba variant, is imported when the sampler is made.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from importlib import import_module
from typing import TYPE_CHECKING, Any

from ngpt.errors import NgptError

if TYPE_CHECKING:
    from data_gen.passes import SamplePass
    from data_gen.scenes.facts import Facts

# Bytes that a lane of a path tracer takes in a pass: the most that any was seen to take, 200, and some more.
PATH_BYTES = 256
# Of one that splats all four differences as well, which are kept per pixel: an eighth of it for a lane, of 8 a pass
# and the list of vertices that the camera sees, some of them for each lane
_GBDPT_BYTES = PATH_BYTES + 224
# And of nine vertices of the light path the light and the pixel, by which they are chosen for shifts
_ROULETTE_BYTES = 9 * 8
# Integrators that render media, of those that samplers of ours follow
VOLUMETRIC = ("volpath", "volpathmis")


@dataclass(frozen=True)
class Sampler:
    """What renders the layers of a gradient stack.

    ``name``        as users call it
    ``summary``     one line for the user
    ``make``        (scene, options) -> what takes the samples of a pass (``data_gen.passes.SamplePass``); raises
                    NgptError for a scene it cannot render
    ``refuses``     facts about a scene -> why the sampler cannot render it, "" if it can
    ``notes``       facts about a scene -> what the user should know about rendering it, a line each
    ``options``     the options that ``make`` takes: name -> what it does
    ``gradients``   whether it renders dx and dy
    ``rank``        "auto" takes the sampler of least rank that can render the scene; 0: never
    ``tried``       whether the pilot of "auto" tries it too, where it can render the scene
                    (``data_gen.choosing.pilot``)
    ``batch``       0 if all samples are independent. Else samples per pixel that depend on each other, or splat: a pass
                    has so many, and variances are over passes
    ``together``    whether pixels share paths, so that a pass has all of them, with as many samples each
    ``lane_bytes``  memory that a lane, one sample of one pixel, takes in a pass
    ``biased``      whether its mean is that of Mitsuba's integrator only as the number of samples grows
    ``module``      where its Mitsuba classes are, imported anew with each variant; "" if it has none
    """

    name: str
    summary: str
    make: Callable[..., SamplePass]
    refuses: Callable[[Facts], str] = lambda facts: ""
    notes: Callable[[Facts], list[str]] = lambda facts: []
    options: Mapping[str, str] = field(default_factory=dict)
    gradients: bool = True
    rank: int = 0
    tried: bool = True
    batch: int = 0
    together: bool = False
    lane_bytes: int = PATH_BYTES
    biased: bool = False
    module: str = ""

    @property
    def even(self) -> bool:
        """Whether all pixels must have as many samples."""
        return bool(self.batch) or self.together


@dataclass(frozen=True)
class FrameSampler:
    """What renders the frames of a shot one after the other, for it remembers those before; no single images.

    ``name``, ``summary``, ``refuses``, ``options``  as of a ``Sampler``
    ``make``     (scene, seed, samples per pixel, memory in MiB, options) -> an object whose ``film(index, motion,
                 depth)`` is the film of a frame, numbered in the shot; raises NgptError for what it cannot render
    ``spp``      samples per pixel of a frame, where the user gives none
    ``warm_up``  frames before, that are rendered where a shot is gone on with: its history
    ``alone``    why it renders no single images
    """

    name: str
    summary: str
    make: Callable[..., Any]
    refuses: Callable[[Facts], str]
    options: Mapping[str, str]
    spp: int
    warm_up: int
    alone: str


SAMPLERS: dict[str, Sampler] = {}
FRAME_SAMPLERS: dict[str, FrameSampler] = {}


def register(sampler: Sampler) -> None:
    """Adds a sampler, behind those there are. Raises NgptError if its name is taken."""
    if sampler.name in ("auto", *SAMPLERS):
        raise NgptError(f"there is a sampler '{sampler.name}' already")
    SAMPLERS[sampler.name] = sampler


def find(name: str, facts: Facts | None = None) -> Sampler:
    """The sampler of that name. Raises NgptError if there is none, or if it refuses a scene of these ``facts``."""
    if name in FRAME_SAMPLERS:
        raise NgptError(
            f"sampler '{name}' is for sequences (--frames): {FRAME_SAMPLERS[name].alone}; use --sampler gpt"
        )
    if name not in SAMPLERS:
        raise NgptError(f"unknown sampler '{name}'; choose one of: auto, {', '.join(SAMPLERS)}")
    sampler = SAMPLERS[name]
    if facts is not None and (reason := sampler.refuses(facts)):
        able = [other for other in SAMPLERS.values() if not other.refuses(facts)]
        names = [other.name if other.gradients else f"{other.name} (no gradients)" for other in able]
        raise NgptError(f"sampler '{name}' cannot render this scene: {reason}; use --sampler {', or '.join(names)}")
    return sampler


def choose(facts: Facts) -> tuple[str, str]:
    """The sampler that "auto" stands for by the description alone, and why."""
    reasons = []
    for sampler in sorted(SAMPLERS.values(), key=lambda sampler: sampler.rank):
        if not sampler.rank:
            continue
        reason = sampler.refuses(facts)
        if not reason:
            media = "there are media" if facts.media else "there are no media"
            return sampler.name, "; ".join(reasons) or f"the integrator is '{facts.integrator}' and {media}"
        reasons.append(reason)
    raise NgptError(f"no sampler can render this scene with gradients: {'; '.join(reasons)}; use --sampler primal")


def summaries() -> dict[str, str]:
    """Name -> summary, for help texts."""
    return {name: sampler.summary for name, sampler in (*SAMPLERS.items(), *FRAME_SAMPLERS.items())}


def _from_module(module: str) -> Callable[..., Any]:
    """The function ``make`` of a module, which is imported when it is first called."""
    return lambda scene, *args, **options: import_module(module).make(scene, *args, **options)


def _refused_by_gpt(facts: Facts) -> str:
    if facts.polarised:
        return f"variant '{facts.polarised}' is polarised, which 'gpt' does not follow"
    if facts.integrator not in ("path", *VOLUMETRIC):
        return f"the integrator is '{facts.integrator}', and 'gpt' knows only 'path', 'volpath' and 'volpathmis'"
    if facts.media and facts.integrator == "path":
        return f"there are media ({', '.join(facts.media)}), which the integrator 'path' does not render"
    return ""


def _refused_but_for_surfaces(facts: Facts, name: str) -> str:
    if facts.polarised:
        return f"variant '{facts.polarised}' is polarised, which '{name}' does not follow"
    if facts.integrator != "path":
        return f"the integrator is '{facts.integrator}', and '{name}' knows only 'path'"
    if facts.media:
        return f"there are media ({', '.join(facts.media)}), which '{name}' does not see"
    return ""


def _refused_but_for_media(facts: Facts, name: str) -> str:
    if facts.polarised:
        return f"variant '{facts.polarised}' is polarised, which '{name}' does not follow"
    if facts.integrator not in VOLUMETRIC:
        return f"the integrator is '{facts.integrator}', and '{name}' knows only 'volpath' and 'volpathmis'"
    if not facts.media:
        return "there are no media, and 'ppm' has the same image"
    return ""


def _refused_but_for_fog(facts: Facts, name: str) -> str:
    grids = f"there are media whose density varies, which '{name}' does not render" if facts.grids else ""
    return _refused_but_for_media(facts, name) or grids


def _refused_by_gpt_simple(facts: Facts) -> str:
    mirrors = "there are mirrors or clear glass, at which paths cannot be reconnected" if facts.mirrors else ""
    return _refused_but_for_surfaces(facts, "gpt-simple") or mirrors


def _notes_on_replay(facts: Facts) -> list[str]:
    lines = [f"transport: Mitsuba's '{facts.integrator}', replayed as a whole"]
    if facts.media:
        lines.append("media: replayed with everything else; albedo counts them, normal and depth do not")
    return lines


def _notes_on_tiles(facts: Facts) -> list[str]:
    lines = [
        f"transport: Mitsuba's '{facts.integrator}', paths are shared in tiles where materials are rough",
        "noise: correlated within tiles, which denoisers of independent noise do not expect",
    ]
    if facts.mirrors:
        lines.append("mirrors or clear glass: nothing is shared there, and gradients are as noisy as pixels")
    return lines


def _notes_on_gpt(facts: Facts) -> list[str]:
    lines = [f"transport: Mitsuba's '{facts.integrator}', offset paths join it where materials are rough"]
    if facts.mirrors:
        lines.append("mirrors or clear glass: shifted by replay, so gradients are noisier there")
    if facts.media:
        lines.append("media: offset paths join where light scatters; albedo counts them, normal and depth do not")
    return lines


def _notes_on_bdpt(facts: Facts) -> list[str]:
    lines = [f"transport: Mitsuba's '{facts.integrator}', found from both ends"]
    if facts.mirrors:
        lines.append("mirrors or clear glass: caustics seen in them are found from the camera alone, with much noise")
    return lines


def _notes_on_photons(facts: Facts) -> list[str]:
    lines = [f"transport: Mitsuba's '{facts.integrator}', found by photons; blurred, less with every sample"]
    if facts.mirrors:
        lines.append("mirrors or clear glass: followed from the camera and from the lights, caustics seen in them too")
    return lines


def _notes_on_vcm(facts: Facts) -> list[str]:
    lines = [
        f"transport: Mitsuba's '{facts.integrator}', found from both ends and by photons; blurred where by photons"
    ]
    if facts.mirrors:
        lines.append("mirrors or clear glass: followed from the camera and from the lights, caustics seen in them too")
    return lines


def _notes_on_gbdpt(facts: Facts) -> list[str]:
    lines = [f"transport: Mitsuba's '{facts.integrator}', found from both ends and shifted as a whole"]
    if facts.mirrors:
        lines.append(
            "mirrors or clear glass: shifted in front of the camera, and where light comes through them to what it sees"
        )
    return lines


def _notes_on_gmlt(facts: Facts) -> list[str]:
    return [
        f"transport: Mitsuba's '{facts.integrator}', by chains of paths that change little by little",
        "noise: correlated between pixels, which denoisers of independent noise do not expect",
    ]


(
    _GPT,
    _BASIC,
    _SIMPLE,
    _TILES,
    _BDPT,
    _GBDPT,
    _GMLT,
    _PPM,
    _GPM,
    _VPM,
    _GVPM,
    _BRE,
    _GBRE,
    _BEAMS,
    _GBEAMS,
    _PLANES,
    _GPLANES,
    _VCM,
    _GVCM,
    _PRIMAL,
    _SPLIT,
) = (
    f"data_gen.samplers.{name}"
    for name in (
        "gpt.integrator",
        "teaching.gpt_basic",
        "teaching.gpt_simple",
        "studies.gpt_tiles",
        "bdpt.integrator",
        "gbdpt.integrator",
        "studies.gmlt.integrator",
        "photons.surfaces.ppm",
        "photons.surfaces.gpm",
        "photons.media.vpm",
        "photons.media.gvpm",
        "photons.media.bre",
        "photons.media.gbre",
        "photons.media.beams",
        "photons.media.gbeams",
        "photons.media.planes",
        "photons.media.gplanes",
        "vcm.integrator",
        "vcm.gvcm",
        "primal",
        "studies.split",
    )
)

_PHOTON_OPTIONS = {
    "radius": "how far photons are gathered from in the first pass, in pixels where most is seen (3)",
    "photons": "light paths of a pass for each pixel (1)",
    "roughness_threshold": "the microfacet roughness above which photons are gathered at materials",
}
_PLANE_OPTIONS = {"planes": "light paths of a photon map that planes are swept from (64)"}

_VCM_OPTIONS = {
    "radius": "how far photons are gathered from in the first pass, in pixels where most is seen (2)",
    "joined_depth": "edges of a path, up to which it is found from both ends (17); longer ones from the camera",
    "roughness_threshold": "the microfacet roughness above which photons are gathered at materials",
}

for _sampler in (
    Sampler(
        "gpt",
        "gradients by shifted paths that join their base path (surfaces and media; the sampler to use)",
        _from_module(_GPT),
        _refused_by_gpt,
        _notes_on_gpt,
        {
            "shift": "before paths join: replay; half-vector, which copies that of smooth events; or manifold, which "
            "follows some of the light of 'caustic' to its lamps",
            "reuse": "true: the primal is the mean over base paths and the offset paths of neighbours",
            "roughness_threshold": "the microfacet roughness above which materials are connectable",
            "caustic": "false: light over rough surfaces and then mirrors or glass is in the gradients, as noise",
            "diagnostics": "true: rates of failed shifts",
        },
        rank=1,
        module=_GPT,
    ),
    Sampler(
        "gpt-basic",
        "gradients by random sequence replay (any transport; five paths per sample)",
        _from_module(_BASIC),
        notes=_notes_on_replay,
        rank=9,
        tried=False,
        module=_BASIC,
    ),
    Sampler(
        "gpt-simple",
        "gradients by reconnection alone (surfaces that scatter widely; the code to read before that of gpt)",
        _from_module(_SIMPLE),
        _refused_by_gpt_simple,
        lambda facts: [f"transport: Mitsuba's '{facts.integrator}', offset paths join it at the second vertex"],
        tried=False,
        module=_SIMPLE,
    ),
    Sampler(
        "gpt-tiles",
        "gradients of paths that the pixels of a tile share (matte rooms, images that are not denoised)",
        _from_module(_TILES),
        lambda facts: _refused_but_for_surfaces(facts, "gpt-tiles"),
        _notes_on_tiles,
        {
            "tile": "pixels along a side of a tile: 2 or 4 (2)",
            "roughness_threshold": "the microfacet roughness above which materials are connectable",
        },
        tried=False,
        together=True,
        module=_TILES,
    ),
    Sampler(
        "bdpt",
        "paths from the camera and from the lights, without gradients (hidden lamps, caustics seen directly)",
        _from_module(_BDPT),
        lambda facts: _refused_but_for_surfaces(facts, "bdpt"),
        _notes_on_bdpt,
        {"joined_depth": "edges of a path, up to which it is found from both ends (10); longer ones from the camera"},
        gradients=False,
        batch=4,
        module=_BDPT,
    ),
    Sampler(
        "gbdpt",
        "gradients of paths from the camera and from the lights (hidden lamps)",
        _from_module(_GBDPT),
        lambda facts: _refused_but_for_surfaces(facts, "gbdpt"),
        _notes_on_gbdpt,
        {
            "joined_depth": "edges of a path, up to which it is found from both ends (10); longer ones from the camera",
            "roughness_threshold": "the microfacet roughness above which materials are connectable",
        },
        batch=8,
        lane_bytes=_GBDPT_BYTES + _ROULETTE_BYTES,
        module=_GBDPT,
    ),
    Sampler(
        "gmlt",
        "gradients of chains of paths that stay where light was found (rooms lit through a slit)",
        _from_module(_GMLT),
        lambda facts: _refused_but_for_surfaces(facts, "gmlt"),
        _notes_on_gmlt,
        tried=False,
        batch=8,
        lane_bytes=_GBDPT_BYTES,
    ),
    Sampler(
        "ppm",
        "photons gathered within a shrinking radius, without gradients (caustics seen in mirrors and through glass)",
        _from_module(_PPM),
        lambda facts: _refused_but_for_surfaces(facts, "ppm"),
        _notes_on_photons,
        _PHOTON_OPTIONS,
        gradients=False,
        batch=1,
        biased=True,
        module=_PPM,
    ),
    Sampler(
        "gpm",
        "gradients of photons gathered within a shrinking radius (caustics seen in mirrors and through glass)",
        _from_module(_GPM),
        lambda facts: _refused_but_for_surfaces(facts, "gpm"),
        _notes_on_photons,
        _PHOTON_OPTIONS | {"diagnostics": "true: rates of failed shifts"},
        batch=1,
        biased=True,
        module=_GPM,
    ),
    Sampler(
        "vpm",
        "photons in media and on surfaces, without gradients (caustics in fog, beams of lamps in haze)",
        _from_module(_VPM),
        lambda facts: _refused_but_for_media(facts, "vpm"),
        _notes_on_photons,
        _PHOTON_OPTIONS,
        gradients=False,
        tried=False,
        batch=1,
        biased=True,
        module=_VPM,
    ),
    Sampler(
        "gvpm",
        "gradients of photons in media and on surfaces, gathered near to points (caustics in fog, beams of lamps)",
        _from_module(_GVPM),
        lambda facts: _refused_but_for_media(facts, "gvpm"),
        _notes_on_photons,
        _PHOTON_OPTIONS | {"diagnostics": "true: rates of failed shifts"},
        tried=False,
        batch=1,
        biased=True,
        module=_GVPM,
    ),
    Sampler(
        "bre",
        "photons in media gathered along whole rays, without gradients (caustics in fog, beams of lamps in haze)",
        _from_module(_BRE),
        lambda facts: _refused_but_for_media(facts, "bre"),
        _notes_on_photons,
        _PHOTON_OPTIONS,
        gradients=False,
        tried=False,
        batch=1,
        biased=True,
        module=_BRE,
    ),
    Sampler(
        "gbre",
        "gradients of photons in media gathered along whole rays (caustics in fog, beams of lamps in haze)",
        _from_module(_GBRE),
        lambda facts: _refused_but_for_fog(facts, "gbre"),
        _notes_on_photons,
        _PHOTON_OPTIONS | {"diagnostics": "true: rates of failed shifts"},
        tried=False,
        batch=1,
        biased=True,
        module=_GBRE,
    ),
    Sampler(
        "beams",
        "photon beams: light in media gathered from whole light paths, without gradients (thin fog, beams of lamps)",
        _from_module(_BEAMS),
        lambda facts: _refused_but_for_media(facts, "beams"),
        _notes_on_photons,
        _PHOTON_OPTIONS,
        gradients=False,
        tried=False,
        batch=1,
        biased=True,
        module=_BEAMS,
    ),
    Sampler(
        "gbeams",
        "gradients of photon beams (thin fog, beams of lamps)",
        _from_module(_GBEAMS),
        lambda facts: _refused_but_for_fog(facts, "gbeams"),
        _notes_on_photons,
        _PHOTON_OPTIONS | {"diagnostics": "true: rates of failed shifts"},
        tried=False,
        batch=1,
        biased=True,
        module=_GBEAMS,
    ),
    Sampler(
        "planes",
        "photon planes: light scattered in media again and again without blur, without gradients (thin fog)",
        _from_module(_PLANES),
        lambda facts: _refused_but_for_fog(facts, "planes"),
        _notes_on_photons,
        _PHOTON_OPTIONS | _PLANE_OPTIONS,
        gradients=False,
        tried=False,
        batch=1,
        biased=True,
        module=_PLANES,
    ),
    Sampler(
        "gplanes",
        "gradients of photon planes (thin fog)",
        _from_module(_GPLANES),
        lambda facts: _refused_but_for_fog(facts, "gplanes"),
        _notes_on_photons,
        _PHOTON_OPTIONS | _PLANE_OPTIONS | {"diagnostics": "true: rates of failed shifts"},
        tried=False,
        batch=1,
        biased=True,
        module=_GPLANES,
    ),
    Sampler(
        "vcm",
        "paths from both ends, joined and merged with photons, without gradients (hidden lamps and all caustics)",
        _from_module(_VCM),
        lambda facts: _refused_but_for_surfaces(facts, "vcm"),
        _notes_on_vcm,
        _VCM_OPTIONS,
        gradients=False,
        tried=False,
        batch=1,
        biased=True,
        module=_VCM,
    ),
    Sampler(
        "gvcm",
        "gradients of paths from both ends, joined and merged with photons (hidden lamps and all caustics)",
        _from_module(_GVCM),
        lambda facts: _refused_but_for_surfaces(facts, "gvcm"),
        _notes_on_vcm,
        _VCM_OPTIONS,
        tried=False,
        batch=1,
        biased=True,
        module=_GVCM,
    ),
    Sampler(
        "primal",
        "the scene's own integrator without gradients (references, primal denoisers)",
        _from_module(_PRIMAL),
        options={"features": "false: the primal alone"},
        gradients=False,
    ),
    Sampler(
        "split",
        "paths whose light is in two layers, diffuse and specular, without gradients (kernel-predicting networks)",
        _from_module(_SPLIT),
        lambda facts: _refused_but_for_surfaces(facts, "split"),
        lambda facts: [f"transport: Mitsuba's '{facts.integrator}', split by the lobe of the first scattering event"],
        gradients=False,
        tried=False,
    ),
):
    register(_sampler)

FRAME_SAMPLERS["restir"] = FrameSampler(
    "restir",
    "gradients of paths that are reused from frame to frame (sequences)",
    _from_module("data_gen.samplers.restir.sampler"),
    lambda facts: _refused_but_for_surfaces(facts, "restir"),
    {
        "history": "frames that a reservoir can count for (32)",
        "gradients": "pairs: of reservoirs of pairs of pixels; after: of the paths that pixels have kept",
        "roughness_threshold": "the microfacet roughness above which materials are connectable",
    },
    spp=2,
    warm_up=16,
    alone="without frames before, it takes 2 to 3 times as long as 'gpt' to the same error",
)
