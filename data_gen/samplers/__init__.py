"""The samplers: one registry, one way to call them.

A new sampler is a class and one entry. The entry is in the module ``about`` of the sampler's package, which a line here
imports. The command line, ``ngpt info``, the choice of "auto", the refusals, the configurations, the evaluation, the
docs and the tests read the entries. Reading them does not import Mitsuba.
"""
# ruff: noqa: F401 - what is imported registers itself

# The order is the one in which users see them.
# isort: off
import data_gen.samplers.gpt.about
import data_gen.samplers.teaching.about
import data_gen.samplers.bdpt.about
import data_gen.samplers.photons.about
import data_gen.samplers.vcm.about
import data_gen.samplers.primal.about
# isort: on

from data_gen.samplers.registry import (
    FRAME_SAMPLERS,
    SAMPLERS,
    SIMPLE,
    FrameSampler,
    Option,
    Sampler,
    by_standing,
    check_options,
    choose,
    described,
    find,
    register,
    tried,
)
