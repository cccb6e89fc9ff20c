"""An RTSP camera (RFC 2326) that sends RTP over the TCP connection, with digest or basic authentication."""

import base64
import contextlib
import hashlib
import itertools
import re
import socketserver
import struct
import threading

from tests.harness.network.cameras import rtp

USER, PASSWORD, REALM, NONCE = "viewer", "se/cret@1:x", "rtsp camera", "ab34cd"  # pragma: allowlist secret
PERIOD_S = 0.04
_SDP = """v=0
o=- 1 1 IN IP4 127.0.0.1
s=camera
c=IN IP4 0.0.0.0
t=0 0
m={media} 0 RTP/AVP {kind}
a=rtpmap:{kind} {codec}/90000
a=control:track
"""
_CODECS = {rtp.H264: "H264", rtp.JPEG: "JPEG"}


class RtspCamera(socketserver.ThreadingTCPServer):
    """Serves in a thread until ``close``.

    Attributes:
        kind: Payload type of the video.
        authentication: ``digest``, ``basic``, or empty for none.
        media: Medium of the description; ``audio`` for a stream without video.
        muted: Whether it accepts connections and requests but responds to none.
        frozen: Whether it sends no further pictures; the connection stays open.
        damaged: Whether the payloads are random data.
        requests: Method and ``Authorization`` of each request.
        connections: Number of connections.
    """

    allow_reuse_address = True
    daemon_threads = True

    def __init__(self, kind: int = rtp.H264) -> None:
        super().__init__(("127.0.0.1", 0), _Connection)
        self.kind = kind
        self.authentication = ""
        self.media = "video"
        self.muted = threading.Event()
        self.frozen = threading.Event()
        self.damaged = threading.Event()
        self.closed = threading.Event()
        self.requests: list[tuple[str, str]] = []
        self.connections = 0
        rtp.payloads(kind)
        self._thread = threading.Thread(target=self.serve_forever, args=(0.02,), daemon=True)
        self._thread.start()

    def url(self, path: str = "/live", login: str = "") -> str:
        return f"rtsp://{login}127.0.0.1:{self.server_address[1]}{path}"

    def close(self) -> None:
        self.closed.set()
        self.shutdown()
        self.server_close()
        self._thread.join()

    def handle_error(self, request: object, client_address: object) -> None:
        """Clients disconnect whenever they like."""


class _Connection(socketserver.StreamRequestHandler):
    server: RtspCamera

    def handle(self) -> None:
        self.server.connections += 1
        self._writing = threading.Lock()
        self._ended = threading.Event()
        try:
            while (request := self._request()) is not None:
                if self.server.muted.is_set():
                    self.server.closed.wait()
                    return
                self._respond(*request)
        finally:
            self._ended.set()

    def _request(self) -> tuple[str, str, dict[str, str]] | None:
        """Method, address and headers; frames that the client interleaves are skipped."""
        line = self.rfile.readline(4096)
        while line.startswith(b"$"):
            header = (line + self.rfile.read(4))[:4]
            self.rfile.read(struct.unpack("!H", header[2:])[0] + 4 - len(line))
            line = self.rfile.readline(4096)
        if not line:
            return None
        method, address, _ = line.decode().split()
        headers = {}
        while text := self.rfile.readline(4096).decode().strip():
            name, _, value = text.partition(":")
            headers[name.strip().lower()] = value.strip()
        return method, address, headers

    def _respond(self, method: str, address: str, headers: dict[str, str]) -> None:
        authorization = headers.get("authorization", "")
        self.server.requests.append((method, authorization))
        if method != "OPTIONS" and not _accepts(self.server.authentication, authorization, method):
            digest = f'Digest realm="{REALM}", nonce="{NONCE}"'
            challenge = digest if self.server.authentication == "digest" else f'Basic realm="{REALM}"'
            self._send(headers, "401 Unauthorized", {"WWW-Authenticate": challenge})
        elif not address.split("?", maxsplit=1)[0].rstrip("/").endswith(("/live", "/live/track")):
            self._send(headers, "404 Not Found")
        elif method == "OPTIONS":
            self._send(headers, "200 OK", {"Public": "OPTIONS, DESCRIBE, SETUP, PLAY, TEARDOWN, GET_PARAMETER"})
        elif method == "DESCRIBE":
            kind = self.server.kind
            sdp = _SDP.format(media=self.server.media, kind=kind, codec=_CODECS[kind]).replace("\n", "\r\n")
            self._send(headers, "200 OK", {"Content-Type": "application/sdp"}, sdp.encode())
        elif method == "SETUP":
            self._send(headers, "200 OK", {"Transport": "RTP/AVP/TCP;unicast;interleaved=0-1", "Session": "1"})
        else:
            self._send(headers, "200 OK", {"Session": "1"})
            if method == "PLAY":
                threading.Thread(target=self._play, daemon=True).start()

    def _send(
        self, request: dict[str, str], status: str, headers: dict[str, str] | None = None, body: bytes = b""
    ) -> None:
        lines = [f"RTSP/1.0 {status}", f"CSeq: {request.get('cseq', '0')}"]
        lines += [f"{name}: {value}" for name, value in (headers or {}).items()]
        lines += [f"Content-Length: {len(body)}"] if body else []
        with self._writing:
            self.wfile.write(("\r\n".join(lines) + "\r\n\r\n").encode() + body)

    def _play(self) -> None:
        sequence = itertools.count()
        with contextlib.suppress(OSError, ValueError):
            for number, payloads in enumerate(itertools.cycle(rtp.payloads(self.server.kind))):
                while self.server.frozen.is_set() and not self.server.closed.wait(PERIOD_S):
                    pass
                if self._ended.is_set() or self.server.closed.wait(PERIOD_S):
                    return
                timestamp = round(number * PERIOD_S * rtp.CLOCK_HZ)
                for payload in payloads:
                    content = payload[:1] + bytes(len(payload) - 1) if self.server.damaged.is_set() else payload
                    packet = rtp.packet(
                        self.server.kind, next(sequence), timestamp, content, last=payload is payloads[-1]
                    )
                    with self._writing:
                        self.wfile.write(struct.pack("!cBH", b"$", 0, len(packet)) + packet)


def _accepts(authentication: str, authorization: str, method: str) -> bool:
    match authentication:
        case "basic":
            expected = base64.b64encode(f"{USER}:{PASSWORD}".encode()).decode()
            return authorization == f"Basic {expected}"
        case "digest":
            fields = dict(re.findall(r'(\w+)="([^"]*)"', authorization))
            first = _md5(f"{USER}:{REALM}:{PASSWORD}")
            second = _md5(f"{method}:{fields.get('uri')}")
            return fields.get("response") == _md5(f"{first}:{NONCE}:{second}")
    return True


def _md5(text: str) -> str:
    return hashlib.md5(text.encode(), usedforsecurity=False).hexdigest()
