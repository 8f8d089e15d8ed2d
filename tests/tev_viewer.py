"""A stand-in for tev: takes packets as tev's own reader does (src/Ipc.cpp of github.com/Tom94/tev)."""

import socket
import struct
import threading

import numpy as np


class Viewer:
    """Listens, and decodes what comes, field by field."""

    def __init__(self):
        self.listening = socket.create_server(("127.0.0.1", 0))
        self.port = self.listening.getsockname()[1]
        self.packets, self.images = [], {}
        self.thread = threading.Thread(target=self.run, daemon=True)
        self.thread.start()

    def run(self):
        connection, _ = self.listening.accept()
        with connection, connection.makefile("rb") as stream:
            while head := stream.read(4):
                self.data, self.at = stream.read(struct.unpack("<I", head)[0] - 4), 0
                self.packet(self.take("b"))
                assert self.at == len(self.data)

    def take(self, kind, count=1):
        values = struct.unpack_from(f"<{count}{kind}", self.data, self.at)
        self.at += struct.calcsize(f"<{count}{kind}")
        return values if count > 1 else values[0]

    def text(self):
        end = self.data.index(b"\0", self.at)
        text, self.at = self.data[self.at : end].decode(), end + 1
        return text

    def packet(self, kind):
        assert kind in (2, 4, 6)
        focus = self.take("?") if kind != 2 else None
        name = self.text()
        self.packets.append((kind, name))
        if kind == 2:
            del self.images[name]
        elif kind == 4:
            width, height, channels = self.take("i", 3)
            assert [self.text() for _ in range(channels)] == ["R", "G", "B"] and focus is False
            self.images[name] = np.zeros((height, width, 3), np.float32)
        else:
            channels = self.take("i")
            assert [self.text() for _ in range(channels)] == ["R", "G", "B"]
            x, y, width, height = self.take("i", 4)
            offsets, strides = self.take("q", channels), self.take("q", channels)
            pixels = width * height
            data = np.frombuffer(self.data, "<f4", max(offsets) + (pixels - 1) * max(strides) + 1, self.at)
            self.at += data.nbytes
            for c in range(channels):
                plane = data[offsets[c] :: strides[c]][:pixels].reshape(height, width)
                self.images[name][y : y + height, x : x + width, c] = plane
