"""Images that are sent to tev, against a server that reads packets as tev's own does."""

import socket

import numpy as np
import pytest
from tev_viewer import Viewer

from ngpt.errors import NgptError, WrongUse
from ngpt.report.tev import PORT, Tev


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
