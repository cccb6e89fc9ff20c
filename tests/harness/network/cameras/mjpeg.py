"""An MJPEG camera: ``/stream``, ``/picture.jpg``, and a path for each fault."""

import contextlib
import hashlib
import itertools
import re
import socket
import ssl
import struct
import threading
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

from tests.harness.network.cameras.pictures import jpeg

USER, PASSWORD, REALM, NONCE = "viewer", "se/cret@1", "camera", "5f2b8c"  # pragma: allowlist secret
PERIOD_S = 0.02
BOUNDARY = "frame-of-the-camera"
_GIANT_BYTES = 64 * 1024 * 1024


class MjpegCamera(ThreadingHTTPServer):
    """Serves in a thread until ``close``.

    Attributes:
        authentication: Required authentication: ``basic``, ``digest``, ``malformed``, or empty for none.
        requests: Path and ``Authorization`` header of each request.
        frozen: Whether the stream sends no further pictures; the connection stays open.
        sent_bytes: Number of bytes of giant responses that the client has accepted.
    """

    daemon_threads = True

    def __init__(self, certificate: tuple[Path, Path] | None = None) -> None:
        super().__init__(("127.0.0.1", 0), _Handler)
        self.authentication = ""
        self.requests: list[tuple[str, str]] = []
        self.frozen = threading.Event()
        self.closed = threading.Event()
        self.sent_bytes = 0
        self.numbers = itertools.count()
        self.scheme = "http"
        if certificate is not None:
            context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
            context.load_cert_chain(*certificate)
            self.socket = context.wrap_socket(self.socket, server_side=True)
            self.scheme = "https"
        self._thread = threading.Thread(target=self.serve_forever, args=(0.02,), daemon=True)
        self._thread.start()

    def url(self, path: str = "/stream") -> str:
        return f"{self.scheme}://127.0.0.1:{self.server_address[1]}{path}"

    def close(self) -> None:
        self.closed.set()
        self.shutdown()
        self.server_close()
        self._thread.join()

    def handle_error(self, request: object, client_address: object) -> None:
        """Clients disconnect whenever they like."""


class _Handler(BaseHTTPRequestHandler):
    server: MjpegCamera

    def log_message(self, *_: object) -> None:
        pass

    def do_GET(self) -> None:
        authorization = self.headers.get("Authorization", "")
        self.server.requests.append((self.path, authorization))
        if not self._accepts(authorization):
            self._challenge()
            return
        with contextlib.suppress(OSError):
            getattr(self, "serve_" + re.sub(r"\W", "_", self.path.split("?")[0].strip("/")), self._missing)()

    # ------------------------------------------------------------ healthy

    def serve_stream(self) -> None:
        self._stream_head(f"multipart/x-mixed-replace; boundary={BOUNDARY}")
        for picture in self._pictures():
            self._part(picture)

    def serve_without_lengths(self) -> None:
        """Parts without a length, and a boundary that is named with its dashes, as by some cameras."""
        self._stream_head(f'multipart/x-mixed-replace;boundary="--{BOUNDARY}"')
        for picture in self._pictures():
            self.wfile.write(f"--{BOUNDARY}\r\nContent-Type: image/jpeg\r\n\r\n".encode() + picture + b"\r\n")

    def serve_picture_jpg(self) -> None:
        self._respond(200, "image/jpeg", jpeg(next(self.server.numbers)))

    def serve_moved(self) -> None:
        self.send_response(302)
        self.send_header("Location", "/stream")
        self.end_headers()

    # ------------------------------------------------------------ faults

    def serve_stall(self) -> None:
        """One picture, then half of one, then nothing."""
        self._stream_head(f"multipart/x-mixed-replace; boundary={BOUNDARY}")
        pictures = self._pictures()
        self._part(next(pictures))
        picture = next(pictures)
        self.wfile.write(self._part_head(len(picture)) + picture[: len(picture) // 2])
        self.server.closed.wait()

    def serve_wrong_boundary(self) -> None:
        self._stream_head("multipart/x-mixed-replace; boundary=another")
        for picture in self._pictures(0):
            self._part(picture)

    def serve_no_boundary(self) -> None:
        self._stream_head("multipart/x-mixed-replace")

    def serve_giant_length(self) -> None:
        self._stream_head(f"multipart/x-mixed-replace; boundary={BOUNDARY}")
        self.wfile.write(self._part_head(_GIANT_BYTES))
        self._send_much()

    def serve_giant_part(self) -> None:
        self._stream_head(f"multipart/x-mixed-replace; boundary={BOUNDARY}")
        self.wfile.write(f"--{BOUNDARY}\r\n\r\n".encode())
        self._send_much()

    def serve_giant_header(self) -> None:
        self._stream_head(f"multipart/x-mixed-replace; boundary={BOUNDARY}")
        self.wfile.write(f"--{BOUNDARY}\r\nX: ".encode())
        self._send_much()

    def serve_giant_picture(self) -> None:
        self.send_response(200)
        self.send_header("Content-Type", "image/jpeg")
        self.end_headers()
        self._send_much()

    def serve_giant_refusal(self) -> None:
        self.send_response(403)
        self.end_headers()
        self._send_much()

    def serve_drip(self) -> None:
        """A response whose header never ends, one byte at a time."""
        self.wfile.write(b"HTTP/1.1 200 OK\r\nX: ")
        while not self.server.closed.wait(PERIOD_S):
            self.wfile.write(b"a")

    def serve_page(self) -> None:
        self._respond(200, "text/html", b"<html>Log in</html>")

    def serve_reset(self) -> None:
        """Two pictures, then a reset connection."""
        self._stream_head(f"multipart/x-mixed-replace; boundary={BOUNDARY}")
        pictures = self._pictures()
        for _ in range(2):
            self._part(next(pictures))
        self.connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
        self.connection.close()

    def serve_elsewhere(self) -> None:
        target = self.path.partition("?")[2]
        self.send_response(302)
        self.send_header("Location", target)
        self.end_headers()

    def serve_circle(self) -> None:
        self.send_response(302)
        self.send_header("Location", "/circle")
        self.end_headers()

    def _missing(self) -> None:
        self._respond(404, "text/plain", b"")

    # ------------------------------------------------------------ parts

    def _pictures(self, period_s: float = PERIOD_S) -> Iterator[bytes]:
        while not self.server.closed.wait(period_s):
            if not self.server.frozen.is_set():
                yield jpeg(next(self.server.numbers))
            elif period_s == 0:
                return

    def _stream_head(self, content_type: str) -> None:
        self.send_response(200)
        self.send_header("Content-Type", content_type)
        self.end_headers()

    def _part(self, picture: bytes) -> None:
        self.wfile.write(self._part_head(len(picture)) + picture + b"\r\n")

    def _part_head(self, length: int) -> bytes:
        return f"--{BOUNDARY}\r\nContent-Type: image/jpeg\r\nContent-Length: {length}\r\n\r\n".encode()

    def _respond(self, status: int, media_type: str, content: bytes) -> None:
        self.send_response(status)
        self.send_header("Content-Type", media_type)
        self.send_header("Content-Length", str(len(content)))
        self.end_headers()
        self.wfile.write(content)

    def _send_much(self) -> None:
        block = bytes(64 * 1024)
        for _ in range(_GIANT_BYTES // len(block)):
            self.wfile.write(block)
            self.server.sent_bytes += len(block)

    # ------------------------------------------------------------ authentication

    def _challenge(self) -> None:
        self.send_response(401)
        challenges = {
            "basic": f'Basic realm="{REALM}"',
            "digest": f'Digest realm="{REALM}", nonce="{NONCE}", qop="auth"',
            "malformed": f'Digest realm=, nonce="{NONCE}"',
        }
        self.send_header("WWW-Authenticate", challenges[self.server.authentication])
        self.end_headers()
        with contextlib.suppress(OSError):
            self._send_much()

    def _accepts(self, authorization: str) -> bool:
        match self.server.authentication:
            case "basic":
                return authorization == "Basic dmlld2VyOnNlL2NyZXRAMQ=="  # pragma: allowlist secret
            case "digest":
                return _digest_is_valid(authorization, self.command)
            case "malformed":
                return False
        return True


def _digest_is_valid(authorization: str, method: str) -> bool:
    """RFC 7616 with MD5 and ``qop=auth``."""
    fields = dict(re.findall(r'(\w+)="?([^",]+)"?', authorization))
    if not authorization.startswith("Digest ") or fields.get("nonce") != NONCE:
        return False
    first = _md5(f"{USER}:{REALM}:{PASSWORD}")
    second = _md5(f"{method}:{fields['uri']}")
    expected = _md5(f"{first}:{NONCE}:{fields['nc']}:{fields['cnonce']}:{fields['qop']}:{second}")
    return (fields["username"], fields["response"]) == (USER, expected)


def _md5(text: str) -> str:
    return hashlib.md5(text.encode(), usedforsecurity=False).hexdigest()
