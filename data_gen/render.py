"""From a scene to a gradient stack, by any sampler of the registry."""

from __future__ import annotations

import logging
import time
from collections.abc import Mapping
from dataclasses import replace
from types import MappingProxyType
from typing import Any

import mitsuba as mi

from data_gen.adaptive import Adaptive, check_adaptive, render_adaptive
from data_gen.begun import Unfinished
from data_gen.budget import Progress, Watch
from data_gen.film import GradientFilm
from data_gen.passes import render_passes, rounds_of
from data_gen.request import RenderRequest, asked
from data_gen.samplers import described, find
from data_gen.samplers.registry import Entry, own
from data_gen.samplers.reused import Made
from data_gen.samplers.sharing import sharing_of
from data_gen.scenes.cameras import place_of
from data_gen.scenes.facts import scene_facts
from data_gen.scenes.lamps import weighed
from data_gen.scenes.load import check_scene
from ngpt.errors import WrongUse, stop_if_interrupted
from ngpt.io.exr import with_channels
from ngpt.layers import GATHERED
from ngpt.merging import UNFINISHED
from ngpt.shared import CUT, TAILS
from ngpt.stack import GradientStack
from ngpt.subpixels import SUBPIXELS, best
from ngpt.version import __version__

_LOG = logging.getLogger(f"ngpt.{__name__}")

# A message reports the light that was cut from the cache if its share exceeds this.
_MUCH_CUT = 0.01


def render_stack(
    scene: mi.Scene | RenderRequest,
    spp: int | None = None,
    seed: int = 0,
    sampler: str = "auto",
    progress: Progress = lambda done, total: None,
    *,
    made: Made | None = None,
    tails_seed: int | None = None,
    with_features: bool = True,
    adaptive: Adaptive | bool | None = None,
    **given: Any,
) -> GradientStack:
    """Renders a stack from the first sensor of a loaded scene.

    ``given`` is as for ``data_gen.render_scene``; a request may be given in place of the scene. Here sampler "auto" is
    chosen by the scene's description, without a pilot, and the default of ``subpixels`` is 1.

    ``with_features``  False is the option ``features=False`` of sampler "primal": the stack holds only the primal
    ``adaptive``       may contain error and method; ``ngpt:spp`` is then the mean over pixels, and the layer
                       ``samples`` holds the number of samples of each pixel
    ``made``           renders of one scene with the same object share their samplers, where possible
    ``tails_seed``     the seed of the cache of tails, by default ``seed``; frames with the same ``tails_seed`` have
                       the same noise of the cache
    """
    if isinstance(adaptive, Adaptive):
        given |= {"error": adaptive.error, "method": adaptive.method}
    if not isinstance(scene, RenderRequest):
        given = {"subpixels": 1, **given}
    given = {"adaptive": bool(adaptive), **given} | ({} if with_features else {"features": False})
    named = {"spp": spp, "seed": seed, "sampler": sampler, "progress": progress}
    request, watch = asked(scene, named | given)
    return render(check_scene(request.scene), request, watch, made=made, tails_seed=tails_seed)


def render(
    scene: mi.Scene,
    request: RenderRequest,
    watch: Watch = Watch(),  # noqa: B008 - it is frozen
    *,
    made: Made | None = None,
    tails_seed: int | None = None,
    more: Mapping[str, Any] = MappingProxyType({}),
) -> GradientStack:
    """Renders the stack of a request from the first sensor of its loaded ``scene``. ``more`` are further attributes of
    the header. For ``made`` and ``tails_seed`` see ``render_stack``.

    The scene's reconstruction filter is not used: the pixels of a stack, and so their differences, are box-filtered.
    With ``diagnostics`` the images of ``data_gen.film.GradientFilm.diagnose()`` are further channels. If the sampler
    has the option ``tails``, paths share the light that they find where this is possible and worthwhile
    (``data_gen.tails``), unless the request is ``unbiased``; ``ngpt:samplerOptions`` then contains ``tails=shared``.

    The same seed, options and number of samples give the same bits, however the render was ended. If the number of
    samples is not known beforehand, the option points=rounds is used and recorded in ``ngpt:samplerOptions``. A render
    that ``stop`` ended before it had all samples is marked by ``ngpt:unfinished``.

    Raises Unfinished, with the stack of the samples rendered before, if a pass after the first fails; and NgptError for
    a scene that the sampler cannot render.
    """
    spp, seed, budget = request.spp, request.seed, request.budget
    seconds, clock = budget.seconds, budget.clock
    facts = scene_facts(scene)
    sampler = described(facts, request.gradients)[0] if request.sampler == "auto" else request.sampler
    entry = find(sampler, facts)
    settings = entry.settings(request.options)
    said: dict[str, Any] = {}
    if "tails" in settings:
        sharing = sharing_of(scene.sensors()[0], entry, facts, settings, budget)
        if "tails" not in request.options and not request.unbiased:
            said = {TAILS: f"off: {sharing.not_now}"} if sharing.not_now else {}
            settings["tails"] = "paths" if sharing.not_now else "shared"
        if settings["tails"] == "shared":
            if sharing.never:
                raise WrongUse(f"sampler '{sampler}': tails=shared is not possible: {sharing.never}; leave it out")
            budget = sharing.rest
    adaptive = Adaptive(request.error, request.method or "auto") if request.shares else None
    if adaptive is not None:
        check_adaptive(adaptive, entry, settings, spp)
    kept = entry.subpixels(request.subpixels, spp)
    _LOG.info("sampler %s, options %s", sampler, options_as_attribute(entry, settings) or "as by default")
    start, begun = time.perf_counter(), clock()
    how_made = {"diagnostics": True} if request.diagnostics and entry.diagnoses else {}
    sensor = scene.sensors()[0]
    chosen: dict[str, Any] = {}
    known = {GATHERED: 1} if entry.gathers else {}
    whole: list[GradientFilm] = []  # the film after the last pass, if a pass is complete

    def look(film: GradientFilm) -> None:
        whole[:] = [film]
        watch.newest(lambda: stack_of(film, sensor, seed, sampler, start, known))

    looking = replace(watch, look=look)
    # If time may end the render, the number of samples is not known, except that it is at most ``spp``.
    if settings.get("points") == "sobol" and (spp is None or seconds is not None or adaptive is not None):
        settings["points"] = "rounds"
    how: dict[str, Any] = {"lane_bytes": entry.lane_bytes, "points": settings.get("points", "independent")}
    how |= {"gradients": entry.film_of_gradients, "subpixels": kept}
    with weighed(scene, settings["lamps"], entry.by_place) as places:
        how_made |= own(settings) | ({"places": places} if places else {})
        made = made or Made()
        sample = made.sampler(entry, scene, how_made)
        rounds_of(sample).seed = tails_seed
        # The render begins even if weighing the lamps took all the time.
        if seconds is not None:
            budget = replace(budget, seconds=max(seconds - (clock() - begun), 1e-3))
        failed = None
        try:
            if adaptive is None:
                film = render_passes(sample, sensor, seed, budget, looking, batch=entry.batch, **how)
            else:
                film, chosen = render_adaptive(sample, sensor, seed, adaptive, budget, looking, **how)
        except Exception as error:
            stop_if_interrupted(error)
            if not whole:
                raise
            film, failed = whole[0], error
            film.forget_pass()
        else:
            made.keep(entry, scene, how_made, sample)
    if settings.get("tails") == "shared":
        rounds = rounds_of(sample)
        settings["tails"], said = "shared" if rounds.shares else "paths", rounds.said
        if (cut := said.get(CUT, 0)) > _MUCH_CUT:
            what = "some paths were so bright that it would have been seen as spots; --unbiased keeps all light"
            _LOG.warning("the cache of tails has lost %.1f %% of its light: %s", 100 * cut, what)
    done = round(float(film.samples_each.mean()))
    chosen = chosen | dict(more) | known | said | {"ngpt:spp": done} | options_as_attribute(entry, settings)
    if failed or (watch.stop() and (spp is None or done < spp)):
        chosen[UNFINISHED] = "failed" if failed else "interrupted"
    stack = stack_of(film, sensor, seed, sampler, start, chosen, diagnostics=request.diagnostics)
    if request.subpixels == "auto" and best(done) == 1 and stack.fine:  # the render ended early
        stack = replace(stack, fine={})
        del stack.attributes[SUBPIXELS]
    if failed:
        raise Unfinished(str(failed) or type(failed).__name__, stack) from failed
    return stack


def options_as_attribute(entry: Entry, settings: dict[str, Any]) -> dict[str, str]:
    """The header's attribute with a sampler's options, if some differ from the defaults."""
    unusual = entry.unusual(settings)
    return {"ngpt:samplerOptions": unusual} if unusual else {}


def stack_of(
    film: GradientFilm,
    sensor: mi.Sensor,
    seed: int,
    sampler: str,
    start: float,
    more: dict[str, Any],
    *,
    diagnostics: bool = False,
) -> GradientStack:
    """The stack of a sensor's film, whose rendering began at ``start`` (time.perf_counter()), with ``more`` attributes.

    The stack covers the sensor's crop window, and records where this window lies in the whole picture.
    """
    attributes = {
        "ngpt:seed": str(seed),
        "ngpt:sampler": sampler,
        "ngpt:seconds": time.perf_counter() - start,
        "ngpt:discarded": film.discarded,
        "software": f"ngpt {__version__}, Mitsuba {mi.__version__} {mi.variant()}",
    }
    stack = film.stack(attributes | more, place_of(sensor))
    return with_channels(stack, film.diagnose()) if diagnostics else stack
