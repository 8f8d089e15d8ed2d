"""How the statistical tests render and compare: stacks of one of our samplers against Mitsuba's own integrator."""

import numpy as np

from ngpt.classical.gradients import forward_differences
from ngpt.testing import z_test


def load(mi, scene, size):
    """A built-in scene by name, or one that a function describes, at (width, height) pixels."""
    from data_gen.scenes.builtin import SCENES
    from data_gen.scenes.load import set_film_size

    scene = mi.load_dict(SCENES[scene]() if isinstance(scene, str) else scene())
    set_film_size(scene, size)
    return scene


def render_ours(scene, sampler, batches=16, spp=64, **options):
    """Layers of independent stacks."""
    from data_gen.render import render_stack

    return [render_stack(scene, spp, seed, sampler, **options).layers for seed in range(batches)]


def render_references(mi, scene, batches=24, spp=256):
    """Independent images, (batches, H, W, 3)."""
    return np.stack([np.array(mi.render(scene, spp=spp, seed=1000 + i)) for i in range(batches)])


def gradient_tests(stacks, references, level=0.01):
    """(name, z-test) of the primal and of any gradients, those of the light apart included; each at ``level``."""
    yield "primal", z_test(np.stack([stack["primal"] for stack in stacks]), references, level=level)
    if "dx" not in stacks[0]:
        return
    slopes = [forward_differences(reference) for reference in references]
    for axis, name in enumerate(("dx", "dy")):
        # The contract keeps some light out of dx and dy; its own differences put it back.
        ours = np.stack([stack[name] + differences_apart(stack)[axis] for stack in stacks])
        yield name, z_test(ours, np.stack([slope[axis] for slope in slopes]), level=level)


def differences_apart(stack):
    """Differences of the light that dx and dy do not hold: of the layers ``direct`` and ``caustic``."""
    return forward_differences(stack["primal"] - light_of_gradients(stack))


def light_of_gradients(stack):
    """The image whose differences dx and dy are."""
    return stack["primal"] - sum(stack[name] for name in ("direct", "caustic") if name in stack)
