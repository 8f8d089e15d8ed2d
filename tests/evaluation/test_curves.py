"""Curves of errors over samples or seconds, read in both directions."""

import pytest

from bench.curves import REACH, error_at, first_at

LAW = [(t, 0.3 * t**-0.7) for t in (8, 32, 128)]


@pytest.mark.parametrize(
    ("x", "mark"), [(8, ""), (20, ""), (32, ""), (128, ""), (200, "~"), (127 * REACH, "~"), (4, "~"), (2.1, "~")]
)
def test_a_power_law_is_read_exactly_in_both_directions(x, mark):
    error = 0.3 * x**-0.7
    for (found, how), expected in ((first_at(error, LAW), x), (error_at(x, LAW), error)):
        assert found == pytest.approx(expected, rel=1e-6)
        assert how == mark or x in (8, 128)  # the ends, up to rounding


def test_far_outside_a_curve_it_is_read_at_the_factor():
    assert error_at(1e6, LAW) == (pytest.approx(0.3 * (128 * REACH) ** -0.7), ">")
    assert error_at(1e-6, LAW) == (pytest.approx(0.3 * (8 / REACH) ** -0.7), "<")
    assert error_at(8, LAW[:1]) is None


def test_a_curve_that_rises_has_the_error_it_had_before():
    # Noise put the second point above the first: more samples do no harm, so the first crossing counts.
    points = [(1, 1.0), (4, 2.0), (16, 0.25)]
    assert first_at(0.5, points) == (pytest.approx(8), "")
    # It stays at 0.25 until 64 at least: what comes below is sought from there on, by the last slope that falls.
    assert first_at(0.125, [*points, (64, 0.3)]) == (pytest.approx(64 * 2), "~")
    assert first_at(0.2, [(1, 0.5), (4, 0.6)]) is None and first_at(0.2, [(1, 0.5)]) is None and first_at(1, []) is None
    # A rival whose error only rises has this one from its first point on: it must not be left out.
    assert first_at(0.55, [(3, 0.5), (4, 0.6)]) == first_at(0.5, [(3, 0.5)]) == (pytest.approx(3), "<")
    points = [(1, 1.0), (4, 0.25), (16, 0.5)]
    assert error_at(8, points) == (pytest.approx(0.25), "") and error_at(32, points) == (pytest.approx(0.125), "~")


def test_two_renders_of_nearly_the_same_time_say_little_of_later_ones():
    """Short renders take what recording takes: the slope between them is no law, outside it is at most 1/x."""
    points = [(1.0, 1.0), (1.01, 0.5)]
    assert error_at(2.02, points) == (pytest.approx(0.25), "~") and error_at(0.5, points) == (pytest.approx(2), "~")
    assert first_at(0.25, points) == (pytest.approx(2.02), "~")
