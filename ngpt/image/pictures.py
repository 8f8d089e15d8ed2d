"""Writes pictures and films of 8-bit sRGB: PNG with ``ngpt.image.png``, JPEG and WebP with Pillow, MP4 with FFmpeg.

A film is a lossless animated WebP, or an MP4 (H.264 if FFmpeg has it). FFmpeg is the installed program, or the one in
the package imageio-ffmpeg.
"""

import os
import shutil
import subprocess
from collections.abc import Iterable, Iterator
from importlib.util import find_spec
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np

from ngpt.errors import NgptError
from ngpt.image.png import encode_png
from ngpt.system.files import atomic_output
from ngpt.system.install import package_command

PICTURES = (".png", ".jpg", ".jpeg", ".webp")
SHOTS = (".webp", ".mp4")
# The longest side of a picture in pixels, where the format has a limit
_LONGEST = {".jpg": 65500, ".jpeg": 65500, ".webp": 16383}
_QUALITY = 95  # of JPEG; colour is stored at full resolution


def check_kind(path: Path, kinds: tuple[str, ...]) -> None:
    """Raises NgptError if a file is not of one of these kinds, or if a package for its kind is not installed."""
    kind = path.suffix.lower()
    if kind not in kinds:
        raise NgptError(f"{path}: ngpt cannot write this kind of file; let the name end in one of {' '.join(kinds)}")
    if kind not in (".png", ".mp4") and find_spec("PIL") is None:
        raise NgptError(f"{path}: JPEG and WebP need Pillow: {package_command('pillow')}")
    if kind == ".mp4":
        _ffmpeg(path)


def check_size(path: Path, width: int, height: int) -> None:
    """Raises NgptError if an image is too large for its format."""
    most = _LONGEST.get(path.suffix.lower(), max(width, height))
    if max(width, height) > most:
        kind = path.suffix
        raise NgptError(f"{path}: {width}x{height} pixels are too many for {kind}, which has {most} a side; write .exr")


def write_picture(path: Path, pixels: np.ndarray, overwrite: bool = False) -> None:
    """Writes sRGB pixels (H, W, 3) uint8 as PNG, JPEG or lossless WebP, by the ending of the name."""
    check_kind(path, PICTURES)
    check_size(path, pixels.shape[1], pixels.shape[0])
    with atomic_output(path, overwrite) as temporary:
        if path.suffix.lower() == ".png":
            temporary.write_bytes(encode_png(pixels))
            return
        from PIL import Image

        webp: dict[str, Any] = {"lossless": True}
        jpeg: dict[str, Any] = {"quality": _QUALITY, "subsampling": 0}
        Image.fromarray(pixels).save(temporary, **(webp if path.suffix.lower() == ".webp" else jpeg))


def write_shot(path: Path, frames: Iterable[np.ndarray], fps: float, overwrite: bool = False) -> None:
    """Writes sRGB frames (H, W, 3) uint8 of one size as animated WebP or MP4, by the ending of the name."""
    check_kind(path, SHOTS)
    one_size = _of_one_size(path, frames)
    first = next(one_size)
    check_size(path, first.shape[1], first.shape[0])
    with atomic_output(path, overwrite) as temporary:
        if path.suffix.lower() == ".mp4":
            _write_mp4(path, temporary, chain([first], one_size), first.shape[1::-1], fps)
            return
        from PIL import Image

        rest = (Image.fromarray(frame) for frame in one_size)
        # Durations are whole milliseconds.
        options: dict[str, Any] = {"save_all": True, "lossless": True, "duration": max(round(1000 / fps), 1), "loop": 0}
        Image.fromarray(first).save(temporary, append_images=rest, **options)


def _of_one_size(path: Path, frames: Iterable[np.ndarray]) -> Iterator[np.ndarray]:
    shape = None
    for number, frame in enumerate(frames):
        shape = shape or frame.shape
        if frame.shape != shape:
            sizes = [f"{width}x{height}" for height, width, _ in (frame.shape, shape)]
            raise NgptError(f"{path}: frame {number} is {sizes[0]} and the first {sizes[1]}; all must be of one size")
        yield frame


def _ffmpeg(path: Path) -> str:
    if found := shutil.which("ffmpeg"):
        return found
    if find_spec("imageio_ffmpeg"):
        import imageio_ffmpeg

        return imageio_ffmpeg.get_ffmpeg_exe()
    raise NgptError(f"{path}: MP4 needs FFmpeg: {package_command('imageio-ffmpeg')}; or take .webp")


def _write_mp4(path: Path, temporary: Path, frames: Iterable[np.ndarray], size: tuple[int, int], fps: float) -> None:
    command = [_ffmpeg(path), "-loglevel", "error", "-nostdin", "-y", "-f", "rawvideo", "-pix_fmt", "rgb24"]
    command += ["-s", f"{size[0]}x{size[1]}", "-r", f"{fps:g}", "-i", "-", "-an"]
    # Players need even sides, and tags for the colour space.
    command += ["-vf", "pad=ceil(iw/2)*2:ceil(ih/2)*2,scale=out_color_matrix=bt709:out_range=tv", "-pix_fmt", "yuv420p"]
    command += ["-colorspace", "bt709", "-color_primaries", "bt709", "-color_trc", "iec61966-2-1", "-f", "mp4"]
    # With "file:", a name that begins with a dash, or looks like a protocol, still names a file.
    command += ["-q:v", "2", "-movflags", "+faststart", f"file:{os.path.abspath(temporary)}"]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        assert process.stdin is not None and process.stderr is not None
        try:
            for frame in frames:
                process.stdin.write(np.ascontiguousarray(frame).tobytes())
            process.stdin.close()
        except BrokenPipeError:
            pass  # the message of FFmpeg is read below
        except BaseException:
            process.kill()
            raise
        messages = process.stderr.read().decode(errors="replace").strip().splitlines()
    if process.returncode:
        raise NgptError(f"{path}: FFmpeg failed: {messages[-1] if messages else f'status {process.returncode}'}")
