"""HTTP servers of tests, in threads of this process."""

import contextlib
import json
import threading
from collections.abc import Iterable, Iterator
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from socketserver import BaseServer
from typing import Any

from tests.harness.network.brokers import HOST


class QuietHandler(BaseHTTPRequestHandler):
    """Handles all methods in ``handle_any``, and writes no log."""

    disable_nagle_algorithm = True

    def handle_any(self) -> None:
        raise NotImplementedError

    def _dispatch(self) -> None:
        self.handle_any()

    do_GET = do_PUT = do_POST = do_PATCH = do_DELETE = do_HEAD = do_OPTIONS = _dispatch  # noqa: N815

    def respond(self, status: int, headers: Iterable[tuple[str, str]], content: bytes) -> None:
        self.send_response_only(status)
        for name, value in headers:
            self.send_header(name, value)
        if status not in {HTTPStatus.NO_CONTENT, HTTPStatus.NOT_MODIFIED}:
            self.send_header("content-length", str(len(content)))
        self.end_headers()
        if self.command != "HEAD":
            self.wfile.write(content)

    def respond_json(self, value: Any, status: int = HTTPStatus.OK) -> None:
        self.respond(status, [("content-type", "application/json")], json.dumps(value).encode())

    def log_message(self, *_: object) -> None:
        """Discard the message."""


@contextlib.contextmanager
def running(server: BaseServer) -> Iterator[None]:
    """Run a server in a thread."""
    thread = threading.Thread(target=server.serve_forever, args=(0.02,))
    thread.start()
    try:
        yield
    finally:
        server.shutdown()
        thread.join()
        server.server_close()


@contextlib.contextmanager
def serve(handler: type[BaseHTTPRequestHandler]) -> Iterator[str]:
    """Serve HTTP on a free loopback port; yields the address."""
    server = ThreadingHTTPServer((HOST, 0), handler)
    server.daemon_threads = True
    with running(server):
        yield f"http://{HOST}:{server.server_port}"
