"""What a scene is made of, read from its description without loading meshes or textures."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import mitsuba as mi

from data_gen.builtin import SCENES
from data_gen.render import SAMPLERS, choose_sampler
from ngpt.errors import NgptError

_KINDS = ("Integrator", "Sensor", "Film", "Shape", "BSDF", "Emitter", "Medium", "Texture")


def inspect_scene(name: str, parameters: dict[str, str] | None = None) -> dict:
    """Counts a scene's plugins by kind and says how it would be sampled.

    ``name`` and ``parameters`` are those of ``load_scene``. Returns {"plugins": {kind: {plugin: count}}, "size":
    (width, height) or None where the scene leaves it to Mitsuba, "sampler": name, "plan": lines of text}.
    """
    config = mi.parser.ParserConfig(mi.variant())
    try:
        if Path(name).is_file():
            nodes = mi.parser.parse_file(config, name, **(parameters or {})).nodes
        elif name in SCENES:
            nodes = mi.parser.parse_dict(config, SCENES[name]()).nodes
        else:
            raise NgptError(f"{name}: no such file, nor a built-in scene; those are: {', '.join(SCENES)}")
    except RuntimeError as error:
        raise NgptError(f"{name}: not a scene Mitsuba can read: {' '.join(str(error).split())}") from error
    plugins = {kind: Counter() for kind in _KINDS}
    size = None
    for node in nodes:
        kind = node.type.name
        if kind in plugins:
            plugins[kind][node.props.plugin_name()] += 1
        if kind == "Film" and "width" in node.props and "height" in node.props:
            size = (int(node.props["width"]), int(node.props["height"]))
    integrator = next(iter(plugins["Integrator"]), "path")
    sampler, reason = choose_sampler(integrator, bool(plugins["Medium"]))
    return {
        "plugins": {kind.lower(): dict(counts.most_common()) for kind, counts in plugins.items() if counts},
        "size": size,
        "sampler": sampler,
        "plan": [f"{sampler}: {SAMPLERS[sampler]}", f"because {reason}", *_plan(plugins, integrator, sampler)],
    }


def _plan(plugins: dict[str, Counter], integrator: str, sampler: str) -> list[str]:
    """What the sampler will do about the scene, a line for each thing that matters to it."""
    how = "offset paths join it where materials are rough" if sampler == "gpt" else "replayed as a whole"
    lines = [f"transport: Mitsuba's '{integrator}', {how}"]
    if plugins["Medium"]:
        lines.append("media: replayed with everything else; features are those of the surfaces behind them")
    if plugins["Medium"] and not integrator.startswith("vol"):
        lines.append(
            f"media are in the scene, but '{integrator}' does not render them: use -D integrator=volpath or alike"
        )
    if "thinlens" in plugins["Sensor"]:
        lines.append("depth of field: base and offset paths share their lens samples")
    if any(name in plugins["BSDF"] for name in ("dielectric", "thindielectric", "conductor")):
        lines.append("mirrors or clear glass: features are taken at the first surface behind them that scatters")
        if sampler == "gpt":
            lines.append("mirrors or clear glass: shifted by replay, so gradients are noisier there")
    if plugins["Emitter"]:
        lines.append("lights: where the camera sees one, its emission goes into the 'direct' layer")
    return lines
