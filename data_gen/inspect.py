"""What a scene is made of, and what that means for rendering it, without loading meshes or textures."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import mitsuba as mi

from data_gen.samplers import SAMPLERS, by_standing, choose
from data_gen.scenes.builtin import SCENES, no_scene
from data_gen.scenes.facts import Facts, polarised
from data_gen.scenes.load import complaint
from ngpt.errors import NgptError
from ngpt.methods import METHODS

_KINDS = ("Integrator", "Sensor", "Film", "Shape", "BSDF", "Emitter", "Medium", "Texture")
_MIRRORS = ("conductor", "dielectric", "thindielectric")
_POINTS = ("point", "spot", "directional", "projector")
# What light goes through and is focussed by, so that no connection finds it behind
_LENSES = ("dielectric", "roughdielectric")


def inspect_scene(name: str, parameters: dict[str, str] | None = None) -> dict:
    """Counts a scene's plugins by kind and says how it would be sampled.

    ``name`` and ``parameters`` are those of ``load_scene``. Returns {"plugins": {kind: {plugin: count}}, "size":
    (width, height) or None where the scene leaves it to Mitsuba, "media": names, "lens": whether there is depth of
    field, "shutter": seconds it is open, "sampler": name, "plan": lines of text}.
    """
    config = mi.parser.ParserConfig(mi.variant())
    try:
        if Path(name).is_file():
            nodes = mi.parser.parse_file(config, name, **(parameters or {})).nodes
        elif name in SCENES:
            nodes = mi.parser.parse_dict(config, SCENES[name]()).nodes
        else:
            raise no_scene(name, [*METHODS, *SAMPLERS])
    except RuntimeError as error:
        raise NgptError(f"{name}: not a scene Mitsuba can read: {complaint(error)}") from error
    plugins = {kind: Counter() for kind in _KINDS}
    size, shutter, media, cameras = None, 0.0, [], []
    for node in nodes:
        kind, props = node.type.name, node.props
        if kind in plugins:
            plugins[kind][props.plugin_name()] += 1
        if kind == "Film" and "width" in props and "height" in props:
            size = (int(props["width"]), int(props["height"]))
        if kind == "Sensor":
            cameras.append(props.plugin_name())
            shutter = float(props.get("shutter_close", 0.0)) - float(props.get("shutter_open", 0.0))
        if kind == "Medium":
            media.append(props.id() or props.plugin_name())
    integrator = next(iter(plugins["Integrator"]), "path")
    lens = "thinlens" in plugins["Sensor"]
    mirrors = any(name in plugins["BSDF"] for name in _MIRRORS)
    facts = Facts(
        integrator,
        tuple(sorted(media)),
        polarised(),
        mirrors,
        grids="heterogeneous" in plugins["Medium"],
        camera=cameras[0] if cameras else "perspective",
        hair="hair" in plugins["BSDF"],
    )
    sampler, reason = choose(facts)
    return {
        "plugins": {kind.lower(): dict(counts.most_common()) for kind, counts in plugins.items() if counts},
        "size": size,
        "media": media,
        "lens": lens,
        "shutter": shutter,
        "sampler": sampler,
        "plan": [
            f"{sampler}: {SAMPLERS[sampler].summary}",
            f"because {reason}",
            *SAMPLERS[sampler].notes(facts),
            *_contents(plugins, facts),
            *_camera(lens, shutter),
        ],
    }


def _contents(plugins: dict[str, Counter], facts: Facts) -> list[str]:
    """What camera, materials, lights and media mean for a stack, whoever renders it, a line for each that matters."""
    refusals: dict[str, list[str]] = {}
    for name, sampler in by_standing("use").items():
        if reason := sampler.refuses(facts):
            refusals.setdefault(reason.replace(f"'{name}'", "the sampler"), []).append(name)
    lines = [f"refused by {', '.join(names)}: {reason}" for reason, names in refusals.items()]
    if facts.camera == "batch":
        lines.append("camera 'batch': no sampler renders it; take its cameras out of it, and render each on its own")
    if facts.media and not facts.integrator.startswith("vol"):
        lines.append(
            f"media are in the scene, but '{facts.integrator}' does not render them: use -D integrator=volpath or alike"
        )
    if facts.mirrors:
        lines.append("mirrors or clear glass: features are taken at the first surface behind them that scatters")
    points = any(name in _POINTS for name in plugins["Emitter"])
    if any(name in plugins["BSDF"] for name in _LENSES):
        if able := _finding(facts, "caustics"):
            lines.append(
                "glass: the light behind it, where that is seen in mirrors or through glass, "
                + ("is found by photons alone for lights without size: " if points else "is found best by photons: ")
                + able
            )
        if able := _finding(facts, "caustics", and_hidden_lamps=True):
            lines.append(
                f"glass where other light is hard to find, too: photons and paths from both ends in one: {able}"
            )
    if facts.grids and (able := _finding(facts, "grids")):
        lines.append(f"media whose density varies: photons are gathered in them by {able}")
    if facts.media and points and not SAMPLERS["gpt"].refuses(facts):
        lines.append("small lights in media: paths find their beams with less noise than photons: `--sampler gpt`")
    if any(name in plugins["BSDF"] for name in ("mask", "null")):
        lines.append("holes: features are those of what is seen through them")
    if any(name in plugins["BSDF"] for name in ("bumpmap", "normalmap")):
        lines.append("bump or normal maps: in the normals, except where they are inside another material")
    if any(name not in _POINTS for name in plugins["Emitter"]):
        lines.append("lights: where the camera sees one, its emission goes into the 'direct' layer")
    if not plugins["Emitter"]:
        lines.append("lights: none, so the image will be black")
    return lines


def _finding(facts: Facts, light: str, and_hidden_lamps: bool = False) -> str:
    """The arguments that name samplers, studies left out, which can render the scene and find such light."""
    found = [
        name
        for name, sampler in SAMPLERS.items()
        if sampler.standing != "study" and not sampler.refuses(facts)
        if light in sampler.finds and ("hidden lamps" in sampler.finds) == and_hidden_lamps
    ]
    return ", ".join(f"`--sampler {name}`" for name in found)


def _camera(lens: bool, shutter: float) -> list[str]:
    """What base and offset paths share beside random numbers."""
    lines = []
    if lens:
        lines.append("depth of field: base and offset paths share their lens samples")
    if shutter > 0:
        lines.append(
            f"shutter: open for {shutter:g} s and sampled, but nothing moves: Mitsuba {mi.__version__} has no animation"
        )
    return lines
