"""Decides whether the paths of a render share their tails, that is, may end in a cache of light from other paths.

``render_stack`` and our plugins use the same rule.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any, NamedTuple

import mitsuba as mi

from data_gen.budget import Budget
from data_gen.film import GradientFilm
from data_gen.film.gradient_film import bytes_of_shared
from data_gen.passes import block_of_samples, least_memory
from data_gen.paths.camera import bytes_of_rays
from data_gen.paths.streams import first_round
from data_gen.samplers.registry import Sampler
from data_gen.samplers.shared import PATHS, why_not_shared
from data_gen.scenes.facts import Facts
from data_gen.tails.cache import LEAST_MIB, MIB
from data_gen.tails.schedule import enough


class Sharing(NamedTuple):
    """Whether paths can share their tails, and whether they should.

    ``never``    why paths with these options cannot share their tails in this scene, "" if they can
    ``not_now``  why the paths of this render should not or cannot share them, "" if they should
    ``rest``     the budget without the memory of the cache
    """

    never: str
    not_now: str
    rest: Budget


def sharing_of(sensor: mi.Sensor, entry: Sampler, facts: Facts, settings: Mapping[str, Any], budget: Budget) -> Sharing:
    """Whether the paths of a render may share their tails. The sampler must have the option ``tails``.

    More memory must never make a render fail: paths share only if film and paths fit into memory beside the cache.
    """
    never = why_not_shared(settings, mi.variant())
    if facts.integrator not in PATHS:
        never = f"the integrator is '{facts.integrator}', and only paths of {', '.join(map(repr, PATHS))} can"
    net = first_round(settings.get("points", "independent"), budget.spp)
    film = GradientFilm(*(int(n) for n in sensor.film().crop_size()), net=net, gradients=entry.film_of_gradients)
    own = MIB + bytes_of_shared(film.pixels) // 2**20
    lanes = film.pixels * min(block_of_samples(film.pixels), budget.spp or 1 << 31)
    needed = max(LEAST_MIB, own + least_memory(film, lanes, entry.lane_bytes + bytes_of_rays(sensor)))
    not_now = never
    if not enough(film.pixels, budget.spp):
        not_now = not_now or "there are few paths"
    if budget.memory < needed:
        not_now = not_now or f"it needs --memory {needed}"
    # If the user insists on the cache, and memory is too small for it beside film and paths, the cache comes on top of
    # the budget.
    beside = 0 if budget.memory < needed else own
    return Sharing(never, not_now, replace(budget, memory=budget.memory - beside))
