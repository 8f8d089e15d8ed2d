"""Writes the report: one HTML file that shows all methods on all scenes.

The page needs no network and no other file. Its pictures are scene-linear numbers (:mod:`ngpt.report.pixelcodec`), so
that readers can change the exposure and see errors of radiance. The page states the error that this storage adds.
``report.html`` is the template with style and script. Without JavaScript, tables and thumbnails are still shown.
"""

import base64
import json
import os
import re
from importlib.resources import files as package_files
from pathlib import Path
from typing import Any

import numpy as np

from ngpt.errors import NgptError
from ngpt.image import display
from ngpt.report import pixelcodec
from ngpt.report.content import REFERENCE, Overview, Scene
from ngpt.report.document import source_hash
from ngpt.report.markup import overview_html, section
from ngpt.system.text import markup, printable
from ngpt.system.writing import write_text

_SOURCES = ("report.html", "live.js")
PAGE_LIMIT = 40e6  # the largest size in bytes that mail and browsers accept


def write_report(
    path: str | os.PathLike,
    title: str,
    scenes: list[Scene],
    *,
    command: str,
    footer: dict[str, str],
    overview: Overview | None = None,
    overwrite: bool = False,
    shot: bool = False,
) -> Path:
    """Writes the page to ``path`` and returns the path. The same arguments give the same bytes.

    ``command``  the command line that made the pictures
    ``footer``   further facts: versions, device, seed, date
    ``shot``     whether the scenes are the frames of a shot, which the page then plays at one exposure

    Pictures are stored with a relative error of at most 0.14 %. If the page would exceed PAGE_LIMIT bytes, some
    pictures are stored more coarsely, beginning with the noisiest. The page states the largest error of each picture.
    Raises NgptError for scenes without pictures, and for images of different sizes or equal names in a scene.
    """
    path = Path(path)
    if not scenes:
        raise NgptError(f"{path}: a report needs at least one scene")
    for scene in scenes:
        _check(path, scene)
    exposures = [auto_exposure(scene) for scene in scenes]
    if shot:
        exposures = [float(np.median(exposures))] * len(scenes)
    text = page_text(title, scenes, exposures, command=command, footer=footer, overview=overview, shot=shot)
    write_text(path, text, overwrite)
    return path


def auto_exposure(scene: Scene) -> float:
    """The exposure for the pictures of a scene, in stops, from its reference, or else from its first picture."""
    return display.auto_exposure(scene.entries[0].image if scene.reference is None else scene.reference)


def page_text(
    title: str,
    scenes: list[Scene],
    exposures: list[float],
    *,
    command: str,
    footer: dict[str, str],
    overview: Overview | None = None,
    shot: bool = False,
    live: int = 0,
) -> str:
    """The HTML of the page; for other arguments see ``write_report``.

    ``exposures``  the exposure of each scene, in stops
    ``live``       the number of a page of ``ngpt.report.live``, from 1 on, whose script requests newer pages; 0 for a
                   report
    """
    sections = [section(number, scene, exposures[number]) for number, scene in enumerate(scenes)]
    after = overview_html(overview or Overview())
    taken = len(after) + sum(map(len, sections)) + 60_000  # with the template, and a margin for the estimates below
    pixels, steps = _pixels(scenes, exposures, 0.99 * 0.75 * (PAGE_LIMIT - taken))  # base64 adds a third
    facts = [_facts(*each) for each in zip(scenes, exposures, steps, strict=True)]
    table = base64.b64encode(display.heat_table().tobytes()).decode()
    page = {
        "scenes": facts,
        "shot": shot,
        "heat": table,
        "signs": base64.b64encode(display.sign_table().tobytes()).decode(),
        "epsilon": display.ERROR_EPSILON,
        "range": display.ERROR_RANGE,
        "toe": pixelcodec.TOE,
    }
    page |= {"live": live} if live else {}
    notes = "".join(f"<div><dt>{markup(key)}</dt><dd>{markup(value)}</dd></div>" for key, value in footer.items())
    return _filled(
        live=bool(live),
        TITLE=markup(title),
        COMMAND=markup(command),
        OVERVIEW=after,
        SCENES="\n".join(sections),
        FOOTER=notes,
        # '<' as an escape: a name that contains '</script>' must stay a name.
        PAGE=json.dumps(_printable(page), separators=(",", ":"), allow_nan=False).replace("<", "\\u003c"),
        PIXELS="\n".join(pixels),
    )


def _printable(value: Any) -> Any:
    """The value with all texts made printable, as they are in the markup: the script searches it for these names."""
    if isinstance(value, dict):
        return {printable(key): _printable(each) for key, each in value.items()}
    if isinstance(value, list | tuple):
        return [_printable(each) for each in value]
    return printable(value) if isinstance(value, str) else value


def oversize(path: str | os.PathLike) -> str:
    """The message about a page that is larger than PAGE_LIMIT; "" for smaller pages."""
    size = os.path.getsize(path)
    if size <= PAGE_LIMIT:
        return ""
    sizes = f"{size / 1e6:.3g} MB, more than the {PAGE_LIMIT / 1e6:.3g} MB that mail and browsers accept"
    return f"{path}: {sizes}; show fewer pictures, or smaller ones"


def _filled(live: bool, **parts: str) -> str:
    """The template with its marks replaced by ``parts``, in one pass, so that marks inside parts stay as they are."""
    text, more = ((package_files("ngpt.report") / name).read_text(encoding="utf-8") for name in _SOURCES)
    # The policy allows only our styles and scripts, by their hashes, so that a script in a name cannot run.
    for tag in ("style", "script"):
        parts[tag.upper() + "_HASH"] = source_hash(text.split(f"<{tag}>")[1].split(f"</{tag}>")[0])
    parts["MORE_POLICY"] = f" {source_hash(more)}; connect-src 'self'" if live else ""
    parts["MORE_SCRIPT"] = f"<script>{more}</script>" if live else ""
    return re.sub(r"\{\{([A-Z_]+)\}\}", lambda mark: parts[mark.group(1)], text)


def _check(path: Path, scene: Scene) -> None:
    """Raises NgptError for a scene without pictures, with pictures of different sizes, or with equal names."""
    if not scene.entries:
        raise NgptError(f"{path}: scene '{scene.name}' has no entry; give it at least one method")
    pictures = scene.pictures
    size = pictures[0][1].shape[:2]
    for name, image in pictures:
        if image.shape != (*size, 3) or image.size == 0:
            raise NgptError(f"{path}: scene '{scene.name}', '{name}' is {image.shape}, expected {(*size, 3)}")
    for entry in scene.entries:
        for name, values in entry.maps.items():
            if values.shape != size:
                where = f"scene '{scene.name}', map '{name}' of '{entry.name}'"
                raise NgptError(f"{path}: {where} is {values.shape}, expected {size}")
    for name, layer in scene.layers.items():
        if layer.shape not in (size, (*size, 1), (*size, 3)):
            raise NgptError(f"{path}: scene '{scene.name}', layer '{name}' is {layer.shape}, expected {size} pixels")
    names = [name for name, _ in pictures] + list(scene.layers)
    for name in names:
        if names.count(name) > 1:
            raise NgptError(f"{path}: scene '{scene.name}' has two pictures named '{name}'; rename one")


def _facts(scene: Scene, stops: float, steps: list[int]) -> dict:
    """The facts about a scene that the script needs in addition to the pixels."""
    best = scene.best(next(iter(scene.entries[0].metrics), ""))
    names = [entry.name for entry in scene.entries]
    first = scene.baseline.name
    other = names[0] if first != names[0] else names[-1]
    second = names[best] if best is not None else (REFERENCE if scene.reference is not None else other)
    return {
        "width": scene.entries[0].image.shape[1],
        "height": scene.entries[0].image.shape[0],
        "stops": stops,
        "steps": steps,
        "pictures": [name for name, _ in scene.pictures],
        "layers": list(scene.layers),
        "reference": scene.reference is not None,
        "maps": list(dict.fromkeys(name for entry in scene.entries for name in entry.maps)),
        "meanings": scene.meanings,
        "a": first,
        "b": second if second != first else names[-1],
    }


def _pixels(scenes: list[Scene], exposures: list[float], room: float) -> tuple[list[str], list[list[int]]]:
    """The script elements of all pictures, in about ``room`` bytes; and the steps per stop of each scene's pictures."""
    exposed = [
        [image.astype(np.float64) * 2.0 ** round(stops) for _, image in scene.pictures]
        for scene, stops in zip(scenes, exposures, strict=True)
    ]
    chosen = iter(pixelcodec.fitting_steps([image for images in exposed for image in images], room))
    steps = [[next(chosen) for _ in images] for images in exposed]
    elements = []
    for number, images in enumerate(exposed):
        for place, image in enumerate(images):
            packed = base64.b64encode(pixelcodec.encode(image, steps[number][place])).decode()
            elements.append(f'<script type="text/plain" id="pixels-{number}-{place}">{packed}</script>')
    return elements, steps
