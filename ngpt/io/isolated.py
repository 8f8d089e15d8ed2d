"""Decodes untrusted images in another process, so that a file that crashes or stalls the decoder does no harm here.

The other process, which runs this module, reads the file and writes an uncompressed copy into a folder that only this
user can read. This process reads the copy. The time of the other process is limited, and on Linux also its memory.
"""

import json
import os
import signal
import subprocess
import sys
import tempfile
from pathlib import Path

import OpenEXR

from ngpt.errors import NgptError
from ngpt.io.foreign.files import file_headers, read_file, tell_conversion
from ngpt.io.openexr import ExrImage, read_exr, write_exr
from ngpt.system.limits import limit_address_space
from ngpt.system.reading import regular_file

# The other process may use three times the size of the pixels, and this number of bytes for Python, NumPy and the
# stacks of OpenEXR's threads.
_BASE = 2**31
_SECONDS = 30.0  # plus the time to read the file at 10 MB/s
_REFUSED = 3


def read_exr_isolated(path: str | os.PathLike) -> ExrImage:
    """Returns the same as ``read_file``, except that mipmaps have only one level in their headers.

    Raises NgptError as ``read_file`` does, and if the decoder crashes, runs out of memory or takes too long.
    """
    path = Path(path)
    with regular_file(path) as file:
        size = sum(header.bytes for header in file_headers(file, str(path)))
    with tempfile.TemporaryDirectory(prefix="ngpt-") as folder:
        copy = Path(folder) / "copy.exr"
        # -P keeps the current folder out of the module path: a folder of untrusted files may hold a numpy.py.
        command = [sys.executable, "-P", "-m", "ngpt.io.isolated", str(path), str(copy), str(_BASE + 3 * size)]
        environment = os.environ | {"PYTHONPATH": os.pathsep.join(p for p in map(os.path.abspath, sys.path) if p)}
        seconds = _SECONDS + size / 10e6
        try:
            done = subprocess.run(command, capture_output=True, env=environment, timeout=seconds)
        except subprocess.TimeoutExpired:
            raise NgptError(f"{path}: not decoded after {seconds:.0f} s; it may be damaged: copy it again") from None
        if done.returncode == _REFUSED:
            raise NgptError(done.stdout.decode(errors="surrogateescape"))
        if done.returncode:
            raise NgptError(f"{path}: decoding it failed ({_cause(done)}); it is damaged or an attack: do not use it")
        image = read_exr(copy)
        headers = json.loads(done.stdout)
    tell_conversion(path)
    for part, (compression, order) in zip(image.parts, headers, strict=True):
        part.header.update(compression=OpenEXR.Compression(compression), lineOrder=OpenEXR.LineOrder(order))
    return image


def _cause(done: subprocess.CompletedProcess) -> str:
    """The signal that ended the other process, or the last line of its messages."""
    if done.returncode < 0:
        return f"killed by {signal.Signals(-done.returncode).name}"
    lines = done.stderr.decode(errors="replace").strip().splitlines()
    return " ".join(lines[-1].split())[:200] if lines else f"exit status {done.returncode}"


def _main(path: str, copy: str, limit: str) -> int:
    """The other process: writes a copy of ``path``, using ``limit`` bytes of memory at most, and prints its headers."""
    limit_address_space(int(limit))
    try:
        image = read_file(path)
        headers = [(int(part.header["compression"]), int(part.header["lineOrder"])) for part in image.parts]
        for part in image.parts:
            part.header.update(compression=OpenEXR.NO_COMPRESSION, lineOrder=OpenEXR.INCREASING_Y)
        write_exr(copy, image)
    except NgptError as error:
        sys.stdout.buffer.write(os.fsencode(str(error).replace(copy, path)))
        return _REFUSED
    print(json.dumps(headers))
    return 0


if __name__ == "__main__":
    sys.exit(_main(*sys.argv[1:]))
