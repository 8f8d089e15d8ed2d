"""What light the studies of photons bring: along edges, by shifts of nothing, and as the radius goes to 0."""

import numpy as np
import pytest
from test_photon_light import assert_bias_goes_to_zero, assert_no_light_is_lost_along_edges, open_square
from unbiased import far_shifts, load

from data_gen.film import SHIFTS, GradientFilm
from data_gen.film.statistics import statistics
from data_gen.paths.camera import CameraSamples
from data_gen.samplers import find


@pytest.mark.slow
def test_no_light_is_lost_along_edges(renderer):
    """And an evenly lit square has no differences within it."""
    stacks = assert_no_light_is_lost_along_edges(renderer, "gpm")
    slopes = np.mean([stack["dx"] for stack in stacks], axis=(0, 1, 3)) / (0.5 / np.pi)
    assert np.abs(slopes).max() < 0.15, slopes


def test_shifts_by_nothing_find_no_difference(renderer):
    """Along edges either: the copy of a path through its own pixel is the path. In layers both directions cancel."""
    scene, film = load(renderer, open_square, (16, 16)), GradientFilm(16, 16, batches=True)
    with far_shifts(0):
        find("gpm").made(scene, radius=4.0)(CameraSamples(scene.sensors()[0], 0, 1), film)
        film.end_pass(1)
    means = {name: statistics(film.moments[name], 1, 1)[1] for name in ("primal", *SHIFTS)}
    assert means.pop("primal").mean() > 0.1 and not any(mean.any() for mean in means.values())


# Light paths for each pixel, and whether there is fog
CASES = {
    "gpm": (8, False),
    "gvcm": (None, False),
    "vpm": (64, True),
    "gvpm": (8, True),
    "gbre": (8, True),
    "beams": (4, True),
    "gbeams": (2, True),
    "planes": (4, True),
    "gplanes": (2, True),
}


@pytest.mark.slow
@pytest.mark.parametrize("sampler", CASES)
def test_bias_goes_to_zero_with_the_radius(renderer, sampler):
    assert_bias_goes_to_zero(renderer, sampler, *CASES[sampler])
