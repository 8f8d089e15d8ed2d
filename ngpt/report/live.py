"""The page of a running render, from a small web server that only this machine can reach (the loopback address).

    GET  /         the page with the newest images: a report with a script that requests newer ones
    GET  /status   {"number": of the newest images, "text": progress of the render, "ended": whether it is over}
    POST /enough   ends the render like Ctrl-C; accepted only from the page itself

The server answers no other requests, and stores nothing that a browser sends. Other sites learn nothing through a
browser, because requests under another host name, and ``enough`` from another origin, are refused.
"""

import json
import os
import socket
import threading
import time
from contextlib import suppress
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

from ngpt.errors import NgptError
from ngpt.report.page import auto_exposure, page_text
from ngpt.report.preview import Preview
from ngpt.system.text import markup, printable
from ngpt.version import __version__

ADDRESS, PORT = "127.0.0.1", 8642
# Seconds without a request after which a viewer counts as gone; seconds of waiting for viewers at the end
_GONE, _FAREWELL = 5.0, 2.5
# The largest number of connections, each with its own thread. A browser opens up to six.
MOST = 32
# The largest number of seconds for a request and its answer: a large page may pass through a slow tunnel.
_LONGEST = 60.0
_FIRST = """<!DOCTYPE html><html lang="en"><meta charset="utf-8"><meta http-equiv="refresh" content="1">
<meta name="viewport" content="width=device-width, initial-scale=1"><meta name="color-scheme" content="dark">
<title>{title}</title><body style="margin: 2em; font: 15px/1.5 sans-serif; background: #191919; color: #e0e0e0">
<h1 style="font-size: 1.3em">{title}</h1><p><strong>{line}</strong></p>
<p>The first image comes after the first passes. Kernels are compiled before them, which takes some
seconds.</p><p><code>{command}</code></p></body></html>"""
_HEADERS = {
    "Cache-Control": "no-store",
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",  # so that no page can lay itself over the button
    "Cross-Origin-Resource-Policy": "same-origin",
}


class LivePage:
    """Serves the page until ``close`` is called. ``enough`` is True once a viewer has pressed the button.

    Listens on ``port``, or on any free port if that one is in use. Raises NgptError if no port is free.
    """

    def __init__(self, title: str, command: str, port: int = PORT):
        self.title, self.command = title, command
        self.enough, self.ended = False, False
        self.number, self.text, self.line = 0, "", "rendering"
        self.exposure: float | None = None
        self._asked, self._told_end = -_GONE, threading.Event()
        try:
            self.server = _listening(port, self)
        except OSError as error:
            raise NgptError(f"--live: no port of {ADDRESS} can be had for it ({error.strerror})") from None
        self.thread = threading.Thread(target=self.server.serve_forever, kwargs={"poll_interval": 0.1}, daemon=True)
        self.thread.start()

    @property
    def url(self) -> str:
        return f"http://{ADDRESS}:{self.server.server_port}/"

    @property
    def watched(self) -> bool:
        """Whether a browser has sent a request in the last seconds."""
        return time.monotonic() - self._asked < _GONE

    def show(self, preview: Preview, caption: str) -> None:
        """Replaces the images of the page. All previews are shown at the exposure of the first preview."""
        scene = preview.scene("newest", caption)
        if self.exposure is None:
            self.exposure = auto_exposure(scene)
        number, footer = self.number + 1, {"ngpt": __version__}
        text = page_text(self.title, [scene], [self.exposure], command=self.command, footer=footer, live=number)
        self.text, self.number = text, number

    def tell(self, line: str) -> None:
        """Sets the line about the progress of the render."""
        self.line = line

    def close(self, line: str) -> None:
        """Shows the final ``line`` to open pages, and stops serving."""
        self.line, self.ended = line, True
        if self.watched:
            self._told_end.wait(_FAREWELL)
            time.sleep(0.2)  # for pages that now request the last images
        self.server.shutdown()
        self.server.server_close()

    def answer(self, path: str) -> tuple[str, str] | None:
        """The content type and the text of the page at ``path``; None if there is no such page."""
        if path == "/":
            self._asked = time.monotonic()
            first = {"title": self.title, "line": self.line, "command": self.command}
            return "text/html", self.text or _FIRST.format(**{name: markup(text) for name, text in first.items()})
        if path == "/status":
            self._asked = time.monotonic()
            news = {"number": self.number, "text": printable(self.line), "ended": self.ended}
            if self.ended:
                self._told_end.set()
            return "application/json", json.dumps(news)
        return None


def _listening(port: int, page: LivePage) -> ThreadingHTTPServer:
    handler = type("Handler", (_PageHandler,), {"page": page})
    try:
        return _Server((ADDRESS, port), handler)
    except OSError:
        return _Server((ADDRESS, 0), handler)


class _Server(ThreadingHTTPServer):
    """Answers each connection in a thread: at most ``MOST`` at once, and each for at most ``_LONGEST`` seconds.

    If ``MOST`` connections are open, a new one replaces the oldest. The oldest is hardly an ordinary request, because
    those last some milliseconds. So neither many nor slow connections can block the page, or use up the render's memory
    and file descriptors.
    """

    daemon_threads = True
    allow_reuse_address = os.name != "nt"  # On Windows two servers could listen on one port.
    request_queue_size = 128  # large, because a client that finds the queue full waits for seconds

    def __init__(self, *args):
        self._open: dict[socket.socket, float] = {}  # connection -> time when it began, oldest first
        self._changed = threading.Condition()
        super().__init__(*args)

    def process_request(self, request, client_address) -> None:
        with self._changed:
            if len(self._open) >= MOST:
                _hang_up(next(iter(self._open)))
                self._changed.wait_for(lambda: len(self._open) < MOST, timeout=1.0)
            free = len(self._open) < MOST
            if free:
                self._open[request] = time.monotonic()
        if free:
            super().process_request(request, client_address)
        else:
            self.shutdown_request(request)

    def shutdown_request(self, request) -> None:
        with self._changed:
            self._open.pop(request, None)
            self._changed.notify_all()
        super().shutdown_request(request)

    def service_actions(self) -> None:
        """Closes connections that have lasted too long. The server calls this regularly."""
        with self._changed:
            for connection, begun in self._open.items():
                if time.monotonic() - begun > _LONGEST:
                    _hang_up(connection)

    def handle_error(self, request, client_address) -> None:
        """Prints nothing about failed requests: the terminal belongs to the render."""


def _hang_up(connection: socket.socket) -> None:
    """Shuts a connection down, so that its thread ends."""
    with suppress(OSError):
        connection.shutdown(socket.SHUT_RDWR)


class _PageHandler(BaseHTTPRequestHandler):
    page: LivePage
    server: _Server
    timeout = 10

    def do_GET(self) -> None:
        if not self._meant():
            return self._send(HTTPStatus.FORBIDDEN)
        if self.path == "/favicon.ico":  # browsers request it, and complain if it is missing
            return self._send(HTTPStatus.NO_CONTENT)
        found = self.page.answer(self.path)
        return self._send(HTTPStatus.OK, *found) if found else self._send(HTTPStatus.NOT_FOUND)

    def do_POST(self) -> None:
        if not (self._meant() and self.headers.get("Origin") == f"http://{self.headers['Host']}"):
            return self._send(HTTPStatus.FORBIDDEN)
        if self.path != "/enough":
            return self._send(HTTPStatus.NOT_FOUND)
        self.page.enough = True
        return self._send(HTTPStatus.NO_CONTENT)

    def _meant(self) -> bool:
        """Whether the request is for our host name, and not for a foreign name that resolves to this address."""
        return self.headers.get("Host") in {f"{host}:{self.server.server_port}" for host in (ADDRESS, "localhost")}

    def _send(self, status: HTTPStatus, kind: str = "text/plain", text: str = "") -> None:
        data = text.encode()
        self.send_response(status)
        for name, value in {**_HEADERS, "Content-Type": f"{kind}; charset=utf-8"}.items():
            self.send_header(name, value)
        if status != HTTPStatus.NO_CONTENT:
            self.send_header("Content-Length", str(len(data)))
        self.end_headers()
        self.wfile.write(data)

    def log_message(self, format: str, *args) -> None:
        """Prints nothing: the terminal belongs to the render."""
