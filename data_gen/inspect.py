"""Describes a scene and how it would be rendered, without loading its meshes and textures."""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import mitsuba as mi

from data_gen.samplers import FRAME_SAMPLERS, SAMPLERS, SIMPLE, by_standing, described, tried
from data_gen.scenes.builtin import SCENES, no_scene
from data_gen.scenes.facts import Facts, colours, scene_facts
from data_gen.scenes.integrators import AROUND, lack, same_image
from data_gen.scenes.load import complaint
from data_gen.scenes.lost import behind_sharp, bent_lamp, has_holes, without_size
from ngpt.errors import NgptError
from ngpt.methods import METHODS

_LOG = logging.getLogger(f"ngpt.{__name__}")

_KINDS = ("Integrator", "Sensor", "Film", "Shape", "BSDF", "Emitter", "Medium", "Texture")
_MIRRORS = ("conductor", "dielectric", "thindielectric")
_POINTS = ("point", "spot", "directional", "projector")
# Materials that refract and focus light, so that no connection finds the light behind them
_LENSES = ("dielectric", "roughdielectric")
_SHARP = ("conductor", "dielectric")
# Notes on depth of field, for samplers with gradients (True) and without
_LENS_NOTES = {
    True: "base and offset paths share their lens samples",
    False: "images are made without albedo and normal where the lens blurs them",
}


def inspect_scene(name: str, parameters: dict[str, str] | None = None) -> dict:
    """Counts a scene's plugins by kind and says how it would be sampled; arguments are as in ``load_scene``.

    Returns {"plugins": {kind: {plugin: count}}, "sensors": a line for each, "size": (width, height) or None where the
    scene leaves it to Mitsuba, "media": names, "lens": whether there is depth of field, "shutter": seconds it is open,
    "sampler": name, "method": name or "auto", "plan": lines of text}.
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
    plugins: dict[str, Counter] = {kind: Counter() for kind in _KINDS}
    shutter, media = 0.0, []
    sensors = [_Camera.of(nodes, node) for node in _children(nodes, nodes[0], mi.ObjectType.Sensor)]
    taken = sensors[0] if sensors else _Camera()
    for node in nodes:
        kind, props = node.type.name, node.props
        if kind in plugins:
            plugins[kind][props.plugin_name()] += 1
        if kind == "Sensor":
            shutter = float(props.get("shutter_close", 0.0)) - float(props.get("shutter_open", 0.0))
        if kind == "Medium":
            media.append(props.id() or props.plugin_name())
    integrator, followed, unable, hides = _transport(nodes)
    lens = "thinlens" in plugins["Sensor"]
    mirrors = any(name in plugins["BSDF"] for name in _MIRRORS)
    facts = Facts(
        followed,
        tuple(sorted(media)),
        mirrors=mirrors,
        grids="heterogeneous" in plugins["Medium"],
        camera=taken.plugin,
        hair="hair" in plugins["BSDF"],
        hides=hides,
        **colours(),
    )
    sampler, method, reason = described(facts)
    tries = any(each.finds for each in tried(facts))
    still = f"Mitsuba {mi.__version__} has no animation"
    return {
        "plugins": {kind.lower(): dict(counts.most_common()) for kind, counts in plugins.items() if counts},
        "sensors": [camera.text(number, camera is taken) for number, camera in enumerate(sensors)],
        "size": taken.size,
        "media": media,
        "lens": lens,
        "shutter": shutter,
        "sampler": sampler,
        "method": method or "auto",
        "plan": [
            f"{sampler}: {SAMPLERS[sampler].summary}",
            f"because {reason}",
            *(["in a long render a pilot tries samplers for hidden lamps"] * ((sampler, method) == SIMPLE and tries)),
            *([unable] if unable else SAMPLERS[sampler].notes_on(facts)),
            *([f"integrator '{integrator}': the image of '{followed}' is rendered"] * (integrator != followed)),
            *_contents(plugins, facts),
            *([f"depth of field: {_LENS_NOTES[SAMPLERS[sampler].gradients]}"] * lens),
            *([f"shutter: open for {shutter:g} s and sampled, but nothing moves: {still}"] * (shutter > 0)),
        ],
    }


@dataclass(frozen=True)
class _Camera:
    """A sensor of a scene file: its id, its plugin, and (width, height) if the file gives them."""

    id: str = ""
    plugin: str = "perspective"
    size: tuple[int, int] | None = None

    @classmethod
    def of(cls, nodes: Sequence, sensor) -> _Camera:
        films = [film.props for film in _children(nodes, sensor, mi.ObjectType.Film)]
        sizes = [(int(film["width"]), int(film["height"])) for film in films if "width" in film and "height" in film]
        return cls(sensor.props.id(), sensor.props.plugin_name(), next(iter(sizes), None))

    def text(self, number: int, taken: bool) -> str:
        name, size = f" '{self.id}'" if self.id else "", "{}x{}".format(*self.size) if self.size else "size not given"
        return f"{number}{name}: {self.plugin}, {size}" + ", the one that is rendered" * taken


def _children(nodes: Sequence, node, kind: mi.ObjectType) -> list:
    parts = [part.index() for _, part in node.props.items() if isinstance(part, mi.Properties.ResolvedReference)]
    return [nodes[part] for part in parts if nodes[part].type == kind]


def _transport(nodes: Sequence) -> tuple[str, str, str, bool]:
    """Returns the plugin of a scene's integrator, the plugin whose image is rendered instead, the reason why this is
    impossible (or ""), and whether lamps are hidden from the camera."""
    found = _children(nodes, nodes[0], mi.ObjectType.Integrator)
    if not found:
        return "path", "path", "", False
    outer = inner = found[0]
    while True:
        nested, plugin = _children(nodes, inner, mi.ObjectType.Integrator), inner.props.plugin_name()
        if plugin not in AROUND or len(nested) != 1:
            break
        inner = nested[0]
    hides = bool(inner.props.get("hide_emitters", False))
    return outer.props.plugin_name(), same_image(plugin, hides), lack(plugin, len(nested)), hides


def _contents(plugins: dict[str, Counter], facts: Facts) -> list[str]:
    """Notes on camera, materials, lights and media that hold for all samplers, one line each."""
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
            how = "by photons alone for lights without size" if points else "best by photons"
            lines.append(
                f"glass: the light behind it, if it is seen in mirrors or through glass, is found {how}: {able}"
            )
        if able := _finding(facts, "caustics", and_hidden_lamps=True):
            lines.append(
                f"glass where other light is hard to find, too: photons and paths from both ends in one: {able}"
            )
    lines += _of_tiny_lamps(plugins, facts)
    if facts.grids and (able := _finding(facts, "grids")):
        lines.append(f"media whose density varies: photons are gathered in them by {able}")
    if facts.media and points and not SAMPLERS["primal"].refuses(facts):
        lines.append("small lights in media: the paths of the default find their beams with less noise than photons")
    if any(name in plugins["BSDF"] for name in ("mask", "null")):
        lines.append("holes: features belong to what is seen through them")
    if any(name in plugins["BSDF"] for name in ("bumpmap", "normalmap")):
        lines.append("bump or normal maps: in the normals, except where they are inside another material")
    if any(name not in _POINTS for name in plugins["Emitter"]):
        lines.append("lights: where the camera sees one, its emission goes into the 'direct' layer")
    if not plugins["Emitter"]:
        lines.append("lights: none, so the image will be black")
    return lines


def _of_tiny_lamps(plugins: dict[str, Counter], facts: Facts) -> list[str]:
    tiny = any(name in _POINTS or "sunsky" in name for name in plugins["Emitter"])
    if not (tiny and any(name in plugins["BSDF"] for name in _SHARP)):
        return []
    able = _finding(facts, "caustics", and_hidden_lamps=True)
    what = "caustics of lamps without size, or of a sun, at smooth glass or mirrors"
    if not able:
        return [f"{what} are found by no sampler that renders this scene"]
    return [f"{what} need {able}; `ngpt render` says how much light they are"]


def _finding(facts: Facts, light: str, and_hidden_lamps: bool = False) -> str:
    """The arguments ``--sampler NAME`` of all samplers that can render the scene and find this kind of ``light``.

    Studies are left out. With ``and_hidden_lamps`` they are the samplers that also find hidden lamps, without it those
    that do not.
    """
    able = {name: s for name, s in SAMPLERS.items() if s.standing != "study" and not s.refuses(facts)}
    found = [n for n, s in able.items() if light in s.finds and ("hidden lamps" in s.finds) == and_hidden_lamps]
    return ", ".join(f"`--sampler {name}`" for name in found)


def _how_much(scene: mi.Scene) -> str:
    """Part of a message: which share of the light is caustics of the lamps in ``behind_sharp()``; "" if it cannot be
    measured."""
    from data_gen.caustics import share_of_caustics  # .1 s to import, and few scenes need it

    share = share_of_caustics(scene)
    if share is None:
        return ""
    amount = f"about {share:.0%}" if share >= 0.01 else "less than 1%"
    return f", {amount} of the light on what the camera sees directly"


def warn_of_lost_light(scene: mi.Scene, sampler: str) -> None:
    """Warns before a render if the sampler misses some light of the scene, and names a sampler that finds it."""
    facts = scene_facts(scene)
    if facts.integrator not in ("path", "volpath", "volpathmis"):
        return
    sampler = described(facts)[0] if sampler == "auto" else sampler
    entry = FRAME_SAMPLERS.get(sampler) or SAMPLERS[sampler]
    if not getattr(entry, "finds", ()) and (lamps := behind_sharp(scene)):
        able = _finding(facts, "caustics", and_hidden_lamps=True).replace("`", "").split(", ")[0]
        remedy = f"{able} finds them" if able else "no sampler that renders this scene finds them"
        what = f"{lamps} at smooth glass or mirrors{_how_much(scene)}"
        _LOG.warning("'%s' hardly finds the caustics of %s; %s", sampler, what, remedy)
    if facts.integrator == "path" and entry.loses and without_size(scene) and has_holes(scene):
        remedy = "--sampler gpt, or primal, finds it"
        _LOG.warning("'%s' loses light of lamps without size %s; %s", sampler, entry.loses, remedy)
    if entry.leaves_lamps and (lamp := bent_lamp(scene)):
        _LOG.warning(
            "'%s' leaves lamp%s, which has few faces and smooth normals, to Mitsuba %s, which weighs it by the wrong "
            "normal: light beside it is wrong by up to 4 %%; --sampler gpt, or primal, is right",
            sampler,
            f" '{lamp.id()}'" if lamp.id() else "",
            mi.__version__,
        )
