"""Chooses the sampler, the number of samples and the reconstruction method by a *pilot*.

The pilot consists of small renders by each sampler that could render the scene. ``plan`` is for a render whose time is
given and whose image is made by a method. It chooses the sampler and the method that leave the least error.
``plan_sampler`` is for ``--sampler auto`` if the method is not known. It compares samplers with even samples and one
simple method for each sampler, and chooses the sampler that leaves the least error. It chooses photons where they are
clearly better, but not in scenes whose light only photons can find. A pilot cannot notice light that none of the
samplers has found.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import mitsuba as mi

from data_gen import samplers
from data_gen.budget import DEFAULT_MEMORY
from data_gen.choosing.look import features_pay
from data_gen.choosing.pipelines import Pipeline, choose, measure, methods_for
from data_gen.choosing.trials import PIXELS, Pilot, Trial, candidates, try_all
from data_gen.passes import film_within
from data_gen.request import RenderRequest
from data_gen.samplers import SAMPLERS
from data_gen.scenes.facts import scene_facts
from data_gen.scenes.load import at_most
from ngpt.errors import NgptError
from ngpt.methods import METHODS, runnable
from ngpt.system.console import brief

# The share of the time that a pilot may take, and the part of the pilot's time for trials of samplers if it also tries
# methods
SHARE, _TRIALS = 0.1, 2 / 3
# There is no pilot in renders of fewer seconds than this, or of fewer paths if the number of samples is given. A tenth
# of the render must suffice to compile the kernels of other samplers and to try them. One or two cores trace a million
# paths per second. Two trials on the smallest images take 3.0 to 13.5 processor seconds, and their methods about 4
# seconds more.
LEAST_SECONDS, _LEAST_PATHS = 100.0, 10**8
# Seconds that `ngpt render` and `ngpt denoise` take besides rendering and the method: the time to start a process, and
# the time per million pixels to write the stack, to read the stack and to write the image
_BEGINS, _FILES = 0.8, 3.7
# The time of methods grows by this power of the number of pixels. From 4,080 to 230,400 pixels, the power was 0.84
# (ngpt-combine), 0.86 (oidn, ngpt-primal) and 0.96 (ngpt-fast), and from 57,600 pixels on 0.89 to 1.1. On small images
# each call also takes some time that does not depend on the size.
_GROWS = 0.9
# Seconds that methods take for a million pixels on two cores, used if no pilot has measured them. The last number is
# for methods that are not listed.
_METHOD_SECONDS, _OTHERS = {"auto": 18.0, "ngpt-combine": 18.0, "ngpt-primal": 14.0, "oidn": 13.0}, 3.0
# In renders of at least LONG seconds the images of a pilot have PIXELS pixels. In shorter renders they have fewer, but
# at least the share LEAST_PIXELS of that number.
LONG, LEAST_PIXELS = 400.0, 1 / 16
# Another sampler than the suggested one is chosen only if its error is smaller by the first factor, since smaller
# differences could be chance. The second factor is for images by networks and denoisers. Predictions of their errors
# are less reliable: in one choice they were wrong by a factor of 1.6.
_MARGIN, _MARGIN_OF_IMAGES = 1.1, 1.6
# Photons are taken if at least this share of the light is found only by them, and if this number of samples per pixel
# fits into the time. On two cores, photons take _CAUSTIC_BEGINS, and _CAUSTIC_SECONDS more for each million samples.
_CAUSTIC_SHARE, _CAUSTIC_SPP = 0.02, 16
_CAUSTIC_SECONDS, _CAUSTIC_BEGINS = 10.0, 8.0


@dataclass(frozen=True)
class Plan:
    sampler: str
    method: str  # the method for which the sampler was chosen; "" if the method is not known
    shared: bool  # whether samples are adaptive
    render: float | None  # seconds for the render, without pilot and method; None: as long as it takes
    reason: str  # a line for the user
    options: Mapping[str, Any] = field(default_factory=dict)  # the sampler's options that differ from its defaults


def explore(
    scene: mi.Scene,
    seconds: float = LONG,
    method: str = "auto",
    memory: int = DEFAULT_MEMORY,
    pilot: Pilot = Pilot(),  # noqa: B008 - it is frozen
    *,
    patient: bool = False,
) -> list[Pipeline]:
    """The pipelines of a scene, for an image of its size. ``plan`` chooses among them.

    The list is empty if no trial fits into its share of the ``seconds``. If ``patient``, the first sampler has a trial
    and a method however long they take, and the sampler for gradients is also tried. ``memory`` is in MiB. The seconds
    ``after`` of a pipeline include everything that follows the render: writing the stack's file, starting a process
    that reads this file, the method, and writing the image's file.
    """
    start = pilot.clock()
    able = _able(scene, method, gradients_too=patient)
    _check_memory(scene, able[0], None, memory)
    pixels = round(PIXELS * min(1.0, max((seconds / LONG) ** 2, LEAST_PIXELS)))
    with at_most(scene, pixels) as scale:
        share = SHARE * _TRIALS * seconds
        trials = try_all(scene, able, lambda _: share, math.inf if patient else share, pilot)
    if not trials or pilot.stop():
        return []
    found = measure(
        trials,
        pilot.clock,
        lambda sampler: methods_for(sampler, method),
        goes_on=lambda: pilot.clock() - start < SHARE * seconds and not pilot.stop(),
    )
    grows = scale**_GROWS
    return [
        replace(p, seconds=p.seconds * scale, after=p.after * grows + _beside(scene), choosing=p.choosing * grows)
        for p in found
    ]


def _beside(scene: mi.Scene) -> float:
    """The seconds that starting a process, and reading and writing files, take besides the method."""
    return _BEGINS + _FILES * _pixels(scene) / 1e6


def _able(scene: mi.Scene, method: str, gradients_too: bool = False) -> list[str]:
    """The samplers to try, whose stacks the method can use.

    The first is the sampler that the scene's description suggests. ``gradients_too`` adds the sampler that the
    description suggests if gradients are requested.
    """
    needs_gradients = method != "auto" and "dx" in runnable(method).needs
    names = candidates(scene, gradients=needs_gradients)
    names += candidates(scene, gradients=True) if gradients_too else []
    able = [name for name in dict.fromkeys(names) if methods_for(name, method)]
    if not able:
        raise NgptError(f"method '{method}' cannot use what the samplers of this scene render; name another, or auto")
    return able


def plan(
    scene: mi.Scene,
    request: RenderRequest,
    pilot: Pilot = Pilot(),  # noqa: B008 - it is frozen
) -> Plan:
    """How to use the time of a ``request`` for a loaded ``scene``. The time includes the pilot and the method.

    Only the requested method is considered, unless it is "auto". The pilot first tries the sampler that the scene's
    description suggests. Then it tries the other unbiased samplers that ``--sampler auto`` compares, as far as they fit
    into a tenth of the time, including compilation and methods. The pilot's images are smaller if there is less time.
    Another sampler than the suggested one is chosen only if it is expected to leave clearly less error. If there is no
    time for a pilot, or if the pilot finds that nothing fits, the description decides, and the render takes the
    remaining time. A sampler that gathers photons is taken without a pilot if a quick measurement finds much light that
    only photons find, and if there is time for photons. The measurements change from run to run, so plans may too.

    Raises NgptError for a method that does not run here or cannot use any of the stacks.
    """
    start, method = pilot.clock(), request.method or "auto"
    seconds, memory = request.budget.seconds, request.budget.memory
    assert seconds is not None
    able = _able(scene, method)
    if for_caustics := _for_caustics(scene, seconds, method, start, pilot):
        return for_caustics
    whole: list[Pipeline] = []
    if seconds >= LEAST_SECONDS and not pilot.stop():
        whole = explore(scene, seconds, method, memory, pilot)
    left = seconds - (pilot.clock() - start)
    if ranked := choose(whole, left):
        first = best_image(ranked, able[0], left)
        ranked.sort(key=lambda p: p is not first)
        return Plan(first.sampler, first.method, first.shared, left - first.after, _why(ranked, left))
    facts = scene_facts(scene)
    sampler, its_method, why = samplers.described(facts, SAMPLERS[able[0]].gradients)
    if method == "auto":
        method = its_method or "auto"
    after = _beside(scene) + _METHOD_SECONDS.get(method, _OTHERS) * _pixels(scene) / 1e6
    # Even if the method is slow, half of the time is left for the render.
    return Plan(sampler, method, False, max(left - after, left / 2, 1e-3), f"{why}; there is no time for a pilot")


def _for_caustics(scene: mi.Scene, seconds: float, method: str, start: float, pilot: Pilot) -> Plan | None:
    """The plan for a scene with much light that paths from the camera hardly find.

    Returns None if there is little of this light, or not enough time for photons.
    """
    facts = scene_facts(scene)
    able = [name for name, entry in SAMPLERS.items() if entry.gathers and not entry.refuses(facts)]
    if not able or not (methods := methods_for(able[0], method)) or pilot.stop():
        return None
    after = _beside(scene) + _METHOD_SECONDS.get(methods[0], _OTHERS) * _pixels(scene) / 1e6
    left = seconds - after
    if left < _CAUSTIC_BEGINS + _CAUSTIC_SPP * _CAUSTIC_SECONDS * _pixels(scene) / 1e6:
        return None
    from data_gen.caustics import share_of_caustics  # .1 s to import, and few scenes come this far

    share = share_of_caustics(scene)
    if share is None or share < _CAUSTIC_SHARE:
        return None
    why = f"about {share:.0%} of the light is caustics of lamps that are tiny or have no size"
    # Even if the measurement took all the time, the render begins.
    return Plan(able[0], methods[0], False, max(left - (pilot.clock() - start), 1e-3), why)


def plan_sampler(
    scene: mi.Scene,
    request: RenderRequest,
    pilot: Pilot = Pilot(),  # noqa: B008 - it is frozen
) -> Plan:
    """The sampler for the ``request`` of a loaded ``scene``. The render is limited by samples, by time or by both.

    If only one sampler can render the scene, or if the render is too short for a pilot, the scene's description decides
    and nothing is tried. If gradients are requested, only samplers that render gradients are considered. The
    measurements of a pilot change from run to run, but its choice hardly ever changes. The render itself gives the same
    bits as with ``--sampler NAME``.

    Raises NgptError if gradients are requested and no sampler can render them in this scene. Also raises NgptError,
    before anything is tried, if the image does not fit into the memory.
    """
    start, spp, seconds = pilot.clock(), request.budget.spp, request.budget.seconds
    sampler, method, reason = samplers.described(scene_facts(scene), request.gradients)
    described = Plan(sampler, method, False, seconds, reason)
    names = candidates(scene, biased=True, gradients=request.gradients)
    if len(names) == 1:
        return described
    short = spp is not None and spp * _pixels(scene) < _LEAST_PATHS
    if short or (seconds is not None and seconds < LEAST_SECONDS):
        return replace(described, reason=f"{reason}; the render is too short to try others")
    _check_memory(scene, sampler, spp, request.budget.memory)
    longest = math.inf if seconds is None else seconds
    with at_most(scene, PIXELS) as scale:

        def whole(trials: dict[str, Trial]) -> float:
            """Seconds of the render with the suggested sampler; 0 if this sampler has no trial."""
            if sampler not in trials:
                return 0.0
            return min(math.inf if spp is None else trials[sampler].seconds * spp * scale, longest)

        budget = lambda trials: SHARE * whole(trials)  # noqa: E731
        trials = try_all(scene, names, budget, SHARE * longest, pilot)
    found = (sampler, reason)
    if sampler in trials and not pilot.stop():
        found = best_of(measure(trials, methods=lambda name: [simple(name)], shared=False), whole(trials) / scale)
    # Even if the pilot took all the time, the render begins.
    left = None if seconds is None else max(seconds - (pilot.clock() - start), 1e-3)
    method = method if found[0] == sampler else ""
    return replace(described, sampler=found[0], method=method, reason=found[1], render=left)


def plan_adaptive(scene: mi.Scene, request: RenderRequest) -> Plan:
    """The plan for adaptive samples. The scene's description decides, or the ``request``'s method if it names one."""
    named = "" if request.method in (None, "auto") else str(request.method)
    gradients = request.gradients or bool(named and "dx" in runnable(named).needs)
    sampler, method, reason = samplers.described(scene_facts(scene), gradients)
    return Plan(sampler, named or method, True, request.budget.seconds, reason)


def without_features(scene: mi.Scene, plan: Plan) -> Plan:
    """The ``plan`` for an image whose stack nobody else uses. Albedo and normals are rendered only if they pay."""
    if (plan.sampler, plan.method) != samplers.SIMPLE or features_pay(scene):
        return plan
    why = "the lens blurs albedo and normal, which are left out"
    return replace(plan, options={"features": False}, reason=f"{plan.reason}; {why}")


def _pixels(scene: mi.Scene) -> int:
    return math.prod(int(n) for n in scene.sensors()[0].film().crop_size())


def _check_memory(scene: mi.Scene, sampler: str, spp: int | None, memory: int) -> None:
    """Raises NgptError if the image, which is larger than the pilot's images, does not fit into ``memory`` (MiB)."""
    entry = SAMPLERS[sampler]
    film_within(
        memory, scene.sensors()[0], spp or 1 << 31, entry.lane_bytes, entry.batch, gradients=entry.film_of_gradients
    )


def simple(sampler: str) -> str:
    """The method that is used to compare a sampler with others if the method that will run is not known."""
    if SAMPLERS[sampler].gradients:
        return "wcv"
    able = not SAMPLERS[sampler].biased and not METHODS["oidn"].missing()
    return "oidn" if able else "primal"


def best_image(ranked: Sequence[Pipeline], default: str, seconds: float, margin: float = _MARGIN_OF_IMAGES) -> Pipeline:
    """The first of the ``ranked`` pipelines, or the best pipeline of sampler ``default``.

    The latter is returned if its error is less than ``margin`` times the error of the first.
    """
    own = next((p for p in ranked if p.sampler == default), ranked[0])
    errors = [p.expected(p.samples(seconds)) for p in (ranked[0], own)]
    return own if errors[1] < margin * errors[0] else ranked[0]


def best_of(pipelines: Sequence[Pipeline], seconds: float) -> tuple[str, str]:
    """The sampler for a render of this many ``seconds`` at the pilot's size, and the reason.

    The first of ``pipelines`` has the sampler that the scene's description suggests. This sampler is kept unless
    another sampler is expected to leave clearly less error.
    """
    own = pipelines[0].sampler
    ranked = choose(pipelines, seconds)
    if not ranked:
        return own, "chosen by the scene: a pilot found no sampler that would be done in time"
    best = best_image(ranked, own, seconds, _MARGIN)
    why = f"chosen by a pilot: {_why([best, *ranked], seconds)}"
    if unsure := [f"'{p.sampler}'" for p in pipelines if p.doubtful and p is not best]:
        why += f"; the others find too little of the light to judge {' and '.join(unsure)}"
    return best.sampler, why


def _why(ranked: Sequence[Pipeline], seconds: float) -> str:
    """A line with the expected error of the first pipeline, and of the best pipeline of each other sampler."""
    errors: dict[str, tuple[float, Pipeline]] = {}
    for p in ranked:
        errors.setdefault(p.sampler, (p.expected(p.samples(seconds)), p))
    (least, _), *others = errors.values()
    what = f"expected to leave an error of {brief(math.sqrt(least))}"
    rivals = [f"{brief(math.sqrt(e))} by sampler '{p.sampler}' and method '{p.method}'" for e, p in others]
    return f"{what}, and {', '.join(rivals)}" if rivals else what
