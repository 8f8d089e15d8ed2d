"""Images in tev, the viewer of Müller (https://github.com/Tom94/tev), while they are made: by its protocol over TCP.

A packet is its length in bytes (4, itself among them), its type (1), and what that type holds: numbers little-endian,
texts with a zero at their end, booleans of one byte. Three types are used:

    2 CloseImage   name
    4 CreateImage  focus, name, width, height, number of channels, their names
    6 UpdateImage  focus, name, number of channels, their names, x, y, width, height, and for each channel where it
                   begins in the data and how far its pixels are apart (8 bytes each); then the data, float32

tev sends no answers.
"""

import socket
import struct
from collections.abc import Mapping

import numpy as np

from ngpt.errors import NgptError, WrongUse

PORT = 14158  # tev's default port
SECONDS = 5.0  # in which a viewer must take what it is sent
_CLOSE, _CREATE, _UPDATE = 2, 4, 6


class Tev:
    """A viewer at ``address``, HOST:PORT or HOST; its images are named ``prefix``/NAME.

    Raises WrongUse for what is no address, and NgptError where no viewer listens, and later where it went away.
    """

    def __init__(self, address: str, prefix: str):
        host, _, port = address.rpartition(":") if ":" in address else (address, "", str(PORT))
        if not (host and port.isdecimal() and 0 < int(port) < 65536):
            raise WrongUse(f"--view {address}: is no HOST:PORT; tev listens on 127.0.0.1:{PORT}")
        self.address, self.prefix = address, prefix
        self.sizes: dict[str, tuple[int, ...]] = {}
        try:
            self.socket = socket.create_connection((host, int(port)), SECONDS)
        except OSError as error:
            reason = error.strerror or error
            raise NgptError(f"--view {address}: no viewer there ({reason}); start tev first") from error

    def show(self, images: Mapping[str, np.ndarray]) -> None:
        """Shows images (H, W, 3), scene-linear; an image that is there with the same name and size is updated."""
        for name, image in images.items():
            if self.sizes.get(name) != image.shape:
                if name in self.sizes:
                    self._send(_CLOSE, self._name(name))
                self._send(_CREATE, b"\0", self._name(name), _numbers(image.shape[1], image.shape[0]), _CHANNELS)
                self.sizes[name] = image.shape
            self._send(
                _UPDATE,
                b"\0",
                self._name(name),
                _CHANNELS,
                _numbers(0, 0, image.shape[1], image.shape[0]),
                struct.pack("<6q", 0, 1, 2, 3, 3, 3),
                np.ascontiguousarray(image, "<f4").tobytes(),
            )

    def close(self) -> None:
        """Ends the connection; the images stay in the viewer."""
        self.socket.close()

    def _name(self, name: str) -> bytes:
        return _text(f"{self.prefix}/{name}")

    def _send(self, kind: int, *parts: bytes) -> None:
        body = b"".join([struct.pack("<b", kind), *parts])
        try:
            self.socket.sendall(struct.pack("<I", len(body) + 4) + body)
        except OSError as error:
            raise NgptError(f"--view {self.address}: the viewer went away ({error.strerror or error})") from error


def _text(text: str) -> bytes:
    return text.replace("\0", "").encode() + b"\0"


def _numbers(*numbers: int) -> bytes:
    return struct.pack(f"<{len(numbers)}i", *numbers)


_CHANNELS = _numbers(3) + b"".join(map(_text, "RGB"))
