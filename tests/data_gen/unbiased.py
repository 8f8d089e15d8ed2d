"""How the statistical tests render and compare: stacks of one of our samplers against stored ``references``.

Gradients are tested over one pixel, as users have them, and over ``FAR`` pixels: ``far_shifts`` moves the offset paths
of every sampler by that many, and dx[y, x] then estimates I[y, x + 8] - I[y, x]. Base and offset vertices lie further
apart, on other surfaces more often, so Jacobians, densities and rejected shifts are far from 1, and an error in one of
them stands out of the noise. Nothing of a sampler knows how far its shifts go: what is wrong there is wrong here.
"""

from contextlib import contextmanager

import numpy as np
from references import REFERENCES
from scipy.stats import chi2, norm

from ngpt.testing import z_test

FAR = 8
DISTANCES = (1, FAR)


def load(mi, scene, size=None):
    """A scene: a built-in one by name, or a description, or what a function describes; at (width, height) pixels.

    Its parts keep their order, and so do its lamps. Mitsuba's defaults order them by chance, and all draws with them.
    """
    from data_gen.scenes.builtin import SCENES
    from data_gen.scenes.load import set_film_size

    if isinstance(scene, str):
        scene = SCENES[scene]
    scene = mi.load_dict(scene() if callable(scene) else scene, parallel=False, optimize=False)
    if size:
        set_film_size(scene, size)
    return scene


@contextmanager
def far_shifts(pixels):
    """Samplers shift paths by so many pixels, and the film combines them so; the image must be larger than that."""
    from data_gen.film import SHIFTS

    # The one table that all samplers and the film share, changed in place.
    before = dict(SHIFTS)
    SHIFTS.update({name: (pixels * x, pixels * y) for name, (x, y) in before.items()})
    try:
        yield
    finally:
        SHIFTS.update(before)


def render_ours(scene, sampler, batches=16, spp=64, pixels=1, seed=0, **options):
    """Layers of independent stacks, of seeds from ``seed`` on, whose gradients are differences over so many pixels."""
    with far_shifts(pixels):
        return [stack.layers for stack in stacks_of(scene, sampler, batches, spp, seed, **options)]


class Once:
    """Makes the sampler of a scene once. ``data_gen.samplers.reused.Made`` does not keep samplers that have batches."""

    def sampler(self, entry, scene, options):
        if not hasattr(self, "made"):
            self.made = entry.make(scene, **options)
        return self.made

    def keep(self, *_):
        pass


def stacks_of(scene, sampler, batches, spp, seed=0, **options):
    """Independent unbiased stacks, of seeds from ``seed`` on. Their kernels are recorded once."""
    from data_gen.render import render_stack

    options |= {"unbiased": True, "made": Once()}
    return [render_stack(scene, spp, seed + i, sampler, **options) for i in range(batches)]


def render_references(mi, scene, batches=24, spp=256):
    """Independent images, (batches, H, W, 3), of files, and for ``references``."""
    integrator = right_integrator(mi, scene)
    return np.stack(
        [np.array(mi.render(scene, integrator=integrator, spp=spp, seed=REFERENCES + i)) for i in range(batches)]
    )


def right_integrator(mi, scene):
    """The scene's own, or another where ``path`` is wrong: where there are holes.

    ``path`` is black for paths that go through holes alone and then meet nothing, although emitters lit the material
    around the holes (docs/use/rendering.md). ``prb`` is as Mitsuba's authors differentiate it, and has no such rule.
    Neither finds what lamps without size send through holes: ``straight_on`` does.
    """
    import straight_on

    from data_gen.scenes.load import path_depths

    integrator = scene.integrator()
    holes = any(mi.has_flag(shape.bsdf().flags(), mi.BSDFFlags.Null) for shape in scene.shapes() if shape.bsdf())
    own = integrator.class_name() == "PathIntegrator" and not integrator.hide_emitters
    if holes and own and any(mi.has_flag(lamp.flags(), mi.EmitterFlags.Delta) for lamp in scene.emitters()):
        return straight_on.integrator(mi, **path_depths(integrator))
    if holes and own and scene.environment() is None:
        return mi.load_dict({"type": "prb", **path_depths(integrator)})
    return integrator


def slopes(stacks, references, pixels):
    """(name, ours, theirs) of dx and dy, the differences of the light apart included."""
    theirs = [differences(reference, pixels) for reference in references]
    for axis, name in enumerate(("dx", "dy")):
        # The contract keeps some light out of dx and dy; its own differences put it back.
        ours = np.stack([stack[name] + differences(light_apart(stack), pixels)[axis] for stack in stacks])
        yield name, ours, np.stack([slope[axis] for slope in theirs])


def gradient_tests(stacks, references, level=0.01, pixels=1):
    """(name, z-test) of the primal and of any gradients, each at ``level``."""
    yield "primal", z_test(np.stack([stack["primal"] for stack in stacks]), references, level=level)
    if "dx" in stacks[0]:
        for name, ours, theirs in slopes(stacks, references, pixels):
            yield name, z_test(ours, theirs, level=level)


def sum_of_squares(stacks, references, pixels, block=4):
    """The probability of so large a sum of z² over blocks of grey pixels of dx and dy: it sees errors everywhere."""
    total, count = 0.0, 0
    for _, *both in slopes(stacks, references, pixels):
        result = z_test(*(images.mean(axis=-1, keepdims=True) for images in both), block=block)
        z = norm.isf(result.p / 2)[result.z != 0]
        total, count = total + (z**2).sum(), count + z.size
    return chi2.sf(total, count)


def differences(image, pixels=1):
    """I[y, x + pixels] - I[y, x] and the same along y, image-sized: 0 where the other pixel is not in the image."""
    dx, dy = np.zeros((2, *image.shape), image.dtype)
    dx[:, :-pixels] = image[:, pixels:] - image[:, :-pixels]
    dy[:-pixels] = image[pixels:] - image[:-pixels]
    return dx, dy


def light_apart(stack):
    """The light that dx and dy do not hold: the layers ``direct`` and ``caustic``; one that is not there is 0.

    Where there are no dx and dy, ``caustic`` is the light of photons, and it is part of what others are compared with.
    """
    apart = ("direct", "caustic") if "dx" in stack else ("direct",)
    return sum((stack[name] for name in apart if name in stack), np.zeros_like(stack["primal"]))


def light_of_gradients(stack):
    """The image whose differences dx and dy are."""
    return stack["primal"] - light_apart(stack)


def failed_shifts(scene, name, spp=16):
    """The share of shifts that fail, 0 if the sampler does not count them."""
    from data_gen.render import render_stack
    from data_gen.samplers import SAMPLERS
    from ngpt.io.exr import pass_through

    if not SAMPLERS[name].diagnoses:
        return 0.0
    stack = render_stack(scene, spp, 0, name, diagnostics=True, unbiased=True)
    return float(pass_through(stack)["diagnostics.shiftFailures"].mean())


def assert_unbiased(stacks, references, level=0.01, pixels=1, about=""):
    """By ``gradient_tests``; black images agree all too well."""
    assert references.mean() > 0.01
    for layer, result in gradient_tests(stacks, references, level, pixels):
        assert result.passed, f"{about} {layer} over {pixels} pixels: {result}"


def same(a, b):
    """The bits of two stacks."""
    assert a.names == b.names
    for name in a.names:
        assert np.array_equal(a[name], b[name], equal_nan=True), name
