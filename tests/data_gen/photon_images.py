"""How images of photons are compared with those of paths: shared with the tests of studies."""

from dataclasses import dataclass, field, replace

import bdpt_scenes
import data_gen_scenes
import media_scenes
import numpy as np
import pytest
from photon_laws import assert_alike
from references import REFERENCES, references
from unbiased import light_of_gradients, load, render_ours

from data_gen.render import render_stack
from data_gen.scenes import builtin

# Rooms whose images are stored, (16, 16), and where no light is seen directly
STORED = ("haze", "colours", "forward", "dense", "nested", "fog")


def named(name, **integrator):
    """The scene of that name, on surfaces or in media, with other parameters of its integrator."""

    def described():
        rooms = (bdpt_scenes.SCENES, builtin.SCENES, vars(bdpt_scenes), vars(data_gen_scenes))
        if hasattr(media_scenes, name):
            scene = getattr(media_scenes, name)()
        else:
            found = next(room[name] for room in rooms if name in room)
            scene = (builtin.SCENES[found] if isinstance(found, str) else found)()
        return scene | {"integrator": {"type": scene["integrator"]["type"], **integrator}} if integrator else scene

    return described


def cases(quick, slow):
    return [*quick, *(pytest.param(*case, marks=pytest.mark.slow) for case in slow)]


@dataclass
class Image:
    """How first passes are compared with an image by Mitsuba, or ``by`` another sampler of ours, of so many spp."""

    radius: float = 0.4
    photons: int | None = 24
    block: int = 4
    batches: int = 6
    size: tuple = (16, 16)
    share: float = 0.03
    by: str = "primal"
    references: int = 128
    images: int = 12
    options: dict = field(default_factory=dict)

    def assert_alike(self, renderer, sampler, name, **integrator):
        description = named(name, **integrator)
        scene, options = load(renderer, description, self.size), {"radius": self.radius, **self.options}
        if self.photons:
            options["photons"] = self.photons
        # Points are not independent: few images of independent photons have tails that their variance does not know.
        ours = render_ours(scene, sampler, self.batches, 1, **options)
        if name in STORED and not integrator:
            theirs = references(renderer, getattr(media_scenes, name, data_gen_scenes.fog), self.size)
        else:
            theirs = render_ours(scene, self.by, self.images, self.references, seed=REFERENCES)
            # Light that is seen directly is its expectation in ours, and has its own edges.
            theirs = np.stack([light_of_gradients(stack) for stack in theirs])
        ours = np.stack([light_of_gradients(stack) for stack in ours])
        assert_alike(ours, theirs, self.block, self.share)


IN_MEDIA = Image(images=6)
BRE = replace(IN_MEDIA, photons=96)


def convergence(renderer, sampler, name, size, photons):
    """The exponent with which the squared error of the mean falls with passes."""
    scene = load(renderer, named(name), (size, size))
    if photons:
        options, counts = {"radius": 1.0, "photons": photons}, (2, 8, 32)
        known = {"diffuse": "diffuse", "fog": data_gen_scenes.fog}[name]
        reference = references(renderer, known, (size, size)).mean(axis=0)
    else:
        options, counts = {"radius": 2.0}, (4, 16, 64, 256)
        reference = render_stack(scene, 768, REFERENCES, "ppm", photons=4, radius=1.0, unbiased=True)["primal"]

    def error(n):
        x = render_stack(scene, n, 0, sampler, unbiased=True, **options)["primal"]
        return np.mean((x - reference) ** 2 / (reference**2 + 0.01))

    slope, _ = np.polyfit(np.log(counts), np.log([error(n) for n in counts]), 1)
    return slope
