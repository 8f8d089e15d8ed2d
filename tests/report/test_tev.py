"""Images that are sent to tev, against a server that reads packets as tev's own does."""

import socket
import struct
import threading

import numpy as np
import pytest

from ngpt.errors import NgptError, WrongUse
from ngpt.report.tev import PORT, Tev


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


def test_images_arrive_and_are_brought_up_to_date(rng):
    viewer = Viewer()
    tev = Tev(f"127.0.0.1:{viewer.port}", "a scene")
    images = [rng.random((5, 7, 3), np.float32) for _ in range(2)]
    tev.show({"noisy": images[0], "wcv": images[1]})
    tev.show({"noisy": images[1]})
    tev.show({"wcv": images[0][:3]})
    tev.close()
    viewer.thread.join(10)
    noisy, wcv = "a scene/noisy", "a scene/wcv"
    assert viewer.packets == [(4, noisy), (6, noisy), (4, wcv), (6, wcv), (6, noisy), (2, wcv), (4, wcv), (6, wcv)]
    assert np.array_equal(viewer.images[noisy], images[1]) and np.array_equal(viewer.images[wcv], images[0][:3])


def test_without_a_viewer_there_is_one_line():
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
    with pytest.raises(NgptError, match=rf"--view 127.0.0.1:{port}: no viewer there \(.*refused\); start tev first"):
        Tev(f"127.0.0.1:{port}", "s")
    for wrong in (":14158", "host:", "host:70000", "host:port"):
        with pytest.raises(WrongUse, match=f"is no HOST:PORT; tev listens on 127.0.0.1:{PORT}"):
            Tev(wrong, "s")


def test_a_viewer_that_goes_away_is_told_of():
    with socket.create_server(("127.0.0.1", 0)) as listening:
        tev = Tev(f"127.0.0.1:{listening.getsockname()[1]}", "s")
        connection, _ = listening.accept()
        connection.close()
        with pytest.raises(NgptError, match="the viewer went away"):
            for _ in range(20):
                tev.show({"noisy": np.zeros((64, 64, 3), np.float32)})
