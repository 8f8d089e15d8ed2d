"""Pictures and films that people look at: what is in the files, and what view transforms make of light."""

import shutil
import subprocess
from importlib.util import find_spec

import numpy as np
import pytest
from exr_files import write_raw

from ngpt.cli import main
from ngpt.errors import NgptError
from ngpt.image import display
from ngpt.image.pictures import _ffmpeg, write_shot
from ngpt.image.transforms import TRANSFORMS, _aces, shown
from ngpt.io.exr import write
from ngpt.io.primaries import ACES_AP1, converted, to_rec709
from ngpt.stack import GradientStack


@pytest.mark.parametrize(("aspect", "size"), [(2.0, (52, 18)), (0.5, (26, 36)), (1e3, (26, 18)), (1.0, (26, 18))])
def test_pixels_that_are_not_square_are_shown_at_their_width(tmp_path, image, aspect, size, command):
    flat = np.full_like(image, 0.5)
    flat[:, :13] = 0.1
    write_raw(tmp_path / "a.exr", (dict.fromkeys("RGB", flat[..., 0]), {"pixelAspectRatio": aspect}))
    command("picture a.exr -o a.png")
    command("denoise a.exr -m primal -o b.png")
    command("denoise a.exr -m primal -o c.exr")
    command("picture c.exr -o c.png")
    with opened("a.png") as picture:
        pixels = np.asarray(picture)
        assert picture.size == size
    left, right = pixels[:, : size[0] // 2 - 1, 0], pixels[:, size[0] // 2 + 1 :, 0]
    assert np.ptp(left) == np.ptp(right) == 0 and left[0, 0] < right[0, 0]
    for other in ("b.png", "c.png"):
        with opened(other) as picture:
            assert np.array_equal(np.asarray(picture), pixels)


@pytest.fixture
def image(rng):
    return rng.gamma(2.0, 0.2, (18, 26, 3)).astype(np.float32)


def opened(path):
    return pytest.importorskip("PIL.Image").open(path)


def usable(name):
    if name == "aces":
        pytest.importorskip("PyOpenColorIO")
    return name


@pytest.mark.parametrize("name", TRANSFORMS)
def test_a_transform_keeps_grey_grey_and_brighter_things_brighter(name):
    grey = 0.18 * 2.0 ** np.linspace(-12, 8, 161)[None, :, None].repeat(3, axis=2)
    values = shown(grey, usable(name)).astype(int)
    assert np.ptp(values, axis=2).max() <= 1
    # The polynomial of AgX dips by one step near black.
    assert (np.diff(values, axis=1) >= -1).all() and values[0, 0].max() <= 2 and values[0, -1].min() >= 250
    # One stop more is the same as twice the light.
    assert np.array_equal(shown(grey, name, 1.0), shown(2 * grey, name))
    # Middle grey is at half of the display's values in AgX; in ACES at a tenth of the light, which is 0.35 of them.
    expected = {"standard": 118, "filmic": 0.497 * 255, "aces": 0.35 * 255}[name]
    assert shown(np.full((1, 1, 3), 0.18), name)[0, 0, 0] == pytest.approx(expected, abs=4 if name == "aces" else 1)


def test_filmic_highlights_lose_their_colour_slowly():
    red = np.array([[[k, 0.05 * k, 0.05 * k] for k in (0.2, 1.0, 4.0, 16.0)]])
    filmic, standard = shown(red, "filmic")[0].astype(int), shown(red)[0].astype(int)
    spread = filmic[:, 0] - filmic[:, 1]
    assert spread[0] > 40 and spread[-1] < spread.max() and (filmic[-1] > 180).all()
    assert (standard[1:, 0] == 255).all()


@pytest.mark.parametrize("name", TRANSFORMS)
def test_what_is_no_number_shows(name):
    odd = np.full((2, 2, 3), 0.2, np.float32)
    odd[0, 0], odd[0, 1], odd[1, 0] = np.nan, np.inf, -3
    values = shown(odd, usable(name), 100)
    assert tuple(values[0, 0]) == display.MAGENTA and (values[0, 1] == 255).all() and values[1, 0].max() <= 2


@pytest.mark.parametrize("kind", ["png", "jpg", "webp"])
def test_a_picture_of_an_image(tmp_path, image, kind):
    if kind != "png":
        pytest.importorskip("PIL")
    write(tmp_path / "a.exr", image)
    target = tmp_path / f"a.{kind}"
    words = ["picture", str(tmp_path / "a.exr"), "-o", str(target), "--exposure", "-0.5"]
    assert main([*words, "--transform", "filmic"]) == 0
    found, expected = np.asarray(opened(target).convert("RGB")).astype(int), shown(image, "filmic", -0.5)
    error = np.abs(found - expected)
    assert error.max() == 0 if kind != "jpg" else error.mean() < 4
    assert main(words) == 1 and main([*words, "--force"]) == 0  # not without


def test_a_picture_is_of_rec709_whatever_the_file(tmp_path, image):
    there = converted(image, np.linalg.inv(to_rec709({"chromaticities": ACES_AP1})))
    write(tmp_path / "a.exr", GradientStack.from_arrays(primal=there, attributes={"chromaticities": ACES_AP1}))
    for name, words in {"a": ["picture"], "b": ["denoise", "-m", "primal"]}.items():
        target = tmp_path / f"{name}.png"
        assert main([*words, str(tmp_path / "a.exr"), "-o", str(target), "--exposure", "auto"]) == 0
        expected = shown(image, "standard", display.auto_exposure(image)).astype(int)
        assert np.abs(np.asarray(opened(target)).astype(int) - expected).max() <= 1


@pytest.fixture
def frames(tmp_path, image):
    (tmp_path / "shot").mkdir()
    for number in range(3):
        write(tmp_path / "shot" / f"{number:04}.exr", image * np.float32(0.5 * (number + 1)))
    return tmp_path / "shot"


def test_a_film_of_a_shot(tmp_path, frames, image):
    film = tmp_path / "shot.webp"
    pytest.importorskip("PIL")
    assert main(["picture", str(frames), "-o", str(film), "--fps", "25", "--exposure", "auto"]) == 0
    with opened(film) as read:
        assert read.n_frames == 3
        stops = display.auto_exposure(image * 0.5)  # that of the first frame, for all
        for number in range(3):
            read.seek(number)
            expected = shown(image * (0.5 * (number + 1)), "standard", stops)
            assert np.array_equal(np.asarray(read.convert("RGB")), expected)
        assert read.info["duration"] == 40
    pictures = tmp_path / "pictures"
    assert main(["picture", str(frames), "-o", str(pictures)]) == 0
    assert sorted(path.name for path in pictures.iterdir()) == ["0000.png", "0001.png", "0002.png"]


@pytest.mark.skipif(not (shutil.which("ffmpeg") or find_spec("imageio_ffmpeg")), reason="needs FFmpeg")
def test_an_mp4_of_a_shot(tmp_path):
    levels, film = (40, 120, 200), tmp_path / "-film.mp4"
    write_shot(film, [np.full((25, 33, 3), level, np.uint8) for level in levels], 12.0)
    command = [_ffmpeg(film), "-loglevel", "error", "-i", f"file:{film}", "-f", "rawvideo", "-pix_fmt", "rgb24", "-"]
    raw = subprocess.run(command, check=True, capture_output=True).stdout
    found = np.frombuffer(raw, np.uint8).reshape(3, 26, 34, 3)[:, :20, :30].mean(axis=(1, 2, 3))
    assert np.abs(found - levels).max() < 4


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("a.exr -o a.jpg", "need Pillow: "),
        ("shot -o a.mp4", "needs FFmpeg: "),
        ("a.exr -o a.png --transform aces", "needs OpenColorIO: "),
    ],
)
def test_what_is_not_installed_is_named_in_one_line(tmp_path, frames, image, capfd, monkeypatch, words, message):
    monkeypatch.chdir(tmp_path)
    write(tmp_path / "a.exr", image)
    for module in ("image.pictures", "image.transforms"):
        monkeypatch.setattr(f"ngpt.{module}.find_spec", lambda name: None)
    monkeypatch.setattr("ngpt.image.pictures.shutil.which", lambda name: None)
    _aces.cache_clear()
    assert main(["picture", *words.split()]) == 1
    told = capfd.readouterr().err
    assert message in told and told.count("\n") == 1
    assert not list(tmp_path.glob("a.[jpwm]*"))


def test_frames_of_two_sizes_make_no_film(tmp_path):
    pytest.importorskip("PIL")
    with pytest.raises(NgptError, match="frame 1 is 5x4 and the first 3x2"):
        write_shot(tmp_path / "a.webp", [np.zeros((2, 3, 3), np.uint8), np.zeros((4, 5, 3), np.uint8)], 24)
