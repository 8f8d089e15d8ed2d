"""Files in other primaries than those of Rec. 709: shown and compared in those, written in their own."""

import json

import numpy as np
import pytest

from ngpt.io.exr import read, read_image, write
from ngpt.io.primaries import ACES_AP0, ACES_AP1, REC709, REC2020, converted, inside_rec709, to_rec709
from ngpt.methods import METHODS, reconstruct
from ngpt.stack import GradientStack


def of(primaries, image, **layers):
    """A stack of an image of Rec. 709, told in other primaries."""
    there = converted(image, np.linalg.inv(to_rec709({"chromaticities": primaries})))
    return GradientStack.from_arrays(primal=there, **layers, attributes={"chromaticities": primaries})


@pytest.fixture
def image(rng):
    return rng.uniform(0.2, 1.0, (24, 32, 3)).astype(np.float32)


# Published matrices: ITU-R BT.2087, and those of ACES with its white adapted to D65 by Bradford's transform.
@pytest.mark.parametrize(
    ("primaries", "expected"),
    [
        (REC2020, [[1.6605, -0.5876, -0.0728], [-0.1246, 1.1329, -0.0083], [-0.0182, -0.1006, 1.1187]]),
        (ACES_AP0, [[2.5217, -1.1341, -0.3876], [-0.2765, 1.3727, -0.0962], [-0.0154, -0.1530, 1.1684]]),
        (ACES_AP1, [[1.7051, -0.6218, -0.0833], [-0.1303, 1.1408, -0.0105], [-0.0240, -0.1290, 1.1530]]),
    ],
)
def test_matrices_are_the_published_ones(primaries, expected):
    matrix = to_rec709({"chromaticities": primaries})
    np.testing.assert_allclose(matrix, expected, atol=2e-4)
    np.testing.assert_allclose(matrix.sum(axis=1), 1, atol=1e-6)  # white stays white


def test_what_says_nothing_or_nonsense_is_left_as_it_is(caplog):
    assert to_rec709({}) is None and to_rec709({"chromaticities": REC709}) is None
    assert to_rec709({"chromaticities": tuple(np.float32(REC709))}) is None
    assert not caplog.records
    flat = (0.64, 0.33, 0.3, 0.6, 0.15, 0.06, 0.3, 0.0)
    for wrong in ((1, 2, 3), "sRGB", (np.nan,) * 8, (0.3,) * 8, flat, (3e38,) * 8):
        assert to_rec709({"chromaticities": wrong}) is None
        assert "are ignored" in caplog.text
        caplog.clear()


def test_xyz_is_what_the_standard_says():
    matrix = to_rec709({"colorInteropID": "lin_ciexyzd65_scene"})
    expected = [[3.2410, -1.5374, -0.4986], [-0.9692, 1.8760, 0.0416], [0.0556, -0.2040, 1.0570]]  # IEC 61966-2-1
    np.testing.assert_allclose(matrix, expected, atol=5e-4)


@pytest.mark.parametrize(
    ("header", "expected"),
    [
        ({"colorInteropID": "lin_ap1_scene"}, ACES_AP1),
        ({"colorInteropID": "lin_ap1_scene", "chromaticities": REC2020}, ACES_AP1),
        ({"colorInteropID": "lin_rec709_scene", "chromaticities": REC2020}, REC709),
        ({"colorInteropID": "unknown", "chromaticities": REC2020}, REC2020),
        ({"acesImageContainerFlag": 1, "chromaticities": REC709}, ACES_AP0),
        ({"acesImageContainerFlag": 0}, REC709),
        ({"oiio:ColorSpace": "ACEScg"}, ACES_AP1),
        ({"oiio:ColorSpace": "Linear Rec.2020", "chromaticities": ACES_AP0}, ACES_AP0),
        ({"oiio:ColorSpace": "scene_linear"}, REC709),
    ],
)
def test_color_spaces_are_read_by_name(header, expected, caplog):
    found, right = to_rec709(header), to_rec709({"chromaticities": expected})
    assert (found is None) == (right is None) and (found is None or np.array_equal(found, right))
    assert not caplog.records


def test_names_of_spaces_that_are_unknown_are_said(tmp_path, image, caplog):
    header = {"colorInteropID": "srgb_rec709_scene", "oiio:ColorSpace": "my film"}
    write(tmp_path / "a.exr", GradientStack.from_arrays(primal=image, attributes=header))
    assert np.array_equal(read_image(tmp_path / "a.exr"), image)
    for name in header.values():
        assert f"'{name}' is ignored" in caplog.text


@pytest.mark.parametrize("primaries", [ACES_AP0, REC2020])
def test_a_result_is_in_the_primaries_of_its_file(tmp_path, image, primaries):
    write(tmp_path / "stack.exr", of(primaries, image, albedo=image))
    stack = read(tmp_path / "stack.exr")
    assert stack.attributes["chromaticities"] == pytest.approx(primaries, abs=1e-6)
    assert np.array_equal(stack["albedo"], image)
    np.testing.assert_allclose(read_image(tmp_path / "stack.exr"), image, atol=2e-6)
    write(tmp_path / "result.exr", reconstruct(stack, "primal").image, like=stack)
    again = read(tmp_path / "result.exr")
    assert again.attributes["chromaticities"] == stack.attributes["chromaticities"]
    assert np.array_equal(again["primal"], stack["primal"])
    np.testing.assert_allclose(read_image(tmp_path / "result.exr"), image, atol=2e-6)


@pytest.mark.parametrize("primaries", [ACES_AP0, REC2020])
def test_oidn_sees_rec709_and_gives_back_what_it_was_given(image, primaries):
    if METHODS["oidn"].missing():
        pytest.skip("OIDN is not installed")
    plain, other = GradientStack.from_arrays(primal=image), of(primaries, image)
    found = converted(reconstruct(other, "oidn").image, to_rec709(other.attributes))
    np.testing.assert_allclose(found, reconstruct(plain, "oidn").image, rtol=0.02, atol=1e-3)
    # Colours that Rec. 709 does not have stay: there they would have lost their negative component.
    saturated = np.zeros_like(image) + np.float32([0.0, 0.8, 0.0])
    beyond = GradientStack.from_arrays(primal=saturated, attributes={"chromaticities": primaries})
    assert inside_rec709(beyond) is None
    result = reconstruct(beyond, "oidn").image
    assert result[..., 1].mean() == pytest.approx(0.8, rel=0.02) and np.abs(result[..., [0, 2]]).max() < 0.02


def test_files_of_different_primaries_are_compared_by_their_light(tmp_path, image, command):
    write(tmp_path / "a.exr", of(ACES_AP0, image))
    write(tmp_path / "b.exr", image)
    command("diff a.exr b.exr")
    report = json.loads(command("denoise a.exr -m primal --ref b.exr -o c.exr --json").out)
    assert report["files"][0]["metrics"]["relMSE"] < 1e-9
    command("diff c.exr b.exr")
