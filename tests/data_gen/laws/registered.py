"""The samplers of the registry as parameters of laws, and a quick scene for each."""

import pytest
from data_gen_scenes import fog
from unbiased import load

from data_gen.samplers import SAMPLERS
from data_gen.scenes.facts import scene_facts

QUICK = ("diffuse", "glossy", fog)


def cases(dear=lambda entry: entry.batch, of=lambda entry: True):
    """(name, whether the law runs at full length) of every sampler that it is a law ``of``.

    Short for those that are ``dear``, at full length in the slow suite; studies run there alone.
    """
    found = []
    for name, entry in SAMPLERS.items():
        if of(entry):
            apart = entry.standing == "study"
            if not apart:
                found.append(pytest.param(name, not dear(entry), id=name))
            if apart or dear(entry):
                found.append(pytest.param(name, True, id=f"{name}-long", marks=pytest.mark.slow))
    return found


def quick(mi, name):
    """The first quick scene that the sampler can render."""
    for description in QUICK:
        if not SAMPLERS[name].refuses(scene_facts(load(mi, description, (4, 4)))):
            return description
    raise AssertionError(f"no scene here for sampler '{name}': add one")


def scene_for(mi, name, size):
    return load(mi, quick(mi, name), size)


def slow(*values, **more):
    return pytest.param(*values, marks=pytest.mark.slow, **more)
