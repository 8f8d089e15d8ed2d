"""Display colours against published values, and the PNG files against a decoder that is not ours."""

import numpy as np
import pytest

from ngpt.image import display


def constant(*rgb: float) -> np.ndarray:
    return np.full((2, 3, 3), rgb, dtype=np.float32)


def shown(*rgb: float, stops: float = 0.0) -> tuple[int, ...]:
    return tuple(int(v) for v in display.to_srgb8(constant(*rgb), stops)[0, 0])


def test_srgb_matches_published_values():
    assert shown(0.0, 1.0, 0.5) == (0, 255, 188)
    assert shown(0.18, 0.21404114, 0.0031308) == (118, 128, 10)  # middle grey; half of the code range; the toe's end
    assert shown(0.001, 0.002, 0.003) == (3, 7, 10)  # the straight toe, 12.92 x


def test_every_code_survives_decoding_and_encoding():
    code = np.arange(256) / 255.0
    linear = np.where(code <= 0.04045, code / 12.92, ((code + 0.055) / 1.055) ** 2.4)
    image = np.repeat(linear[None, :, None], 3, axis=2)
    assert np.array_equal(display.to_srgb8(image)[0, :, 0], np.arange(256))


def test_exposure_is_in_stops():
    assert shown(0.05, 0.1, 0.2, stops=2) == shown(0.2, 0.4, 0.8)
    assert shown(4.0, 0.0, 1e12, stops=-3) == (*shown(0.5, 0, 0)[:2], 255)


@pytest.mark.parametrize("stops", [-30.0, 0.0, 30.0])
def test_non_finite_and_negative_pixels_have_their_own_look(stops):
    assert shown(np.nan, 0.5, 0.5, stops=stops) == display.MAGENTA
    assert shown(np.inf, 0.0, 0.0, stops=stops) == (255, 255, 255)
    assert shown(np.nan, np.inf, 0.0, stops=stops) == display.MAGENTA
    assert shown(-1.0, -np.inf, 0.0, stops=stops) == (0, 0, 0)


def test_auto_exposure_brings_the_average_to_middle_grey():
    assert display.auto_exposure(constant(0.18, 0.18, 0.18)) == pytest.approx(0.0, abs=1e-6)
    image = np.random.default_rng(0).gamma(2.0, 0.3, (40, 50, 3))
    stops = display.auto_exposure(image)
    for gain in (2.0**-10, 2.0**10):
        assert display.auto_exposure(gain * image) == pytest.approx(stops - np.log2(gain))


def test_heat_table_grows_lighter_all_the_way():
    linear = (display.heat_table() / 255.0) ** 2.2
    assert np.all(np.diff(linear @ display.LUMINANCE) > 0)


def test_signed_map_is_grey_at_zero_and_opposite_on_both_sides():
    assert tuple(display.signed_map(constant(0, 0, 0))[0, 0]) == (119, 119, 119)
    gradient = np.linspace(-2.0, 2.0, 101)[None, :, None].repeat(3, axis=2)
    red, _, blue = display.signed_map(gradient)[0].astype(int).T
    assert np.all((blue - red)[:45] > 20) and np.all((red - blue)[-45:] > 20)
    lone = np.zeros((50, 50, 3))
    lone[7, 7] = 1e-6  # far fewer than one pixel in a hundred
    assert tuple(display.signed_map(lone)[7, 7]) == (255, 208, 154)
    lone[8, 8] = np.nan
    assert tuple(display.signed_map(lone)[8, 8]) == display.MAGENTA
