"""An ONVIF camera: WS-Discovery over UDP and the device and media services over HTTP."""

import base64
import datetime as dt
import hashlib
import re
import socket
import struct
import threading
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

USER, PASSWORD = "operator", "quiet&word"  # pragma: allowlist secret
_ENVELOPE = """<?xml version="1.0" encoding="UTF-8"?>
<SOAP-ENV:Envelope xmlns:SOAP-ENV="http://www.w3.org/2003/05/soap-envelope" xmlns:tt="http://www.onvif.org/ver10/schema"
 xmlns:tds="http://www.onvif.org/ver10/device/wsdl" xmlns:trt="http://www.onvif.org/ver10/media/wsdl"
 xmlns:wsa="http://schemas.xmlsoap.org/ws/2004/08/addressing" xmlns:d="http://schemas.xmlsoap.org/ws/2005/04/discovery">
<SOAP-ENV:Header>{header}</SOAP-ENV:Header><SOAP-ENV:Body>{body}</SOAP-ENV:Body></SOAP-ENV:Envelope>"""
_MATCH = """<d:ProbeMatches><d:ProbeMatch><wsa:EndpointReference><wsa:Address>urn:uuid:1</wsa:Address>
</wsa:EndpointReference><d:Types>dn:NetworkVideoTransmitter</d:Types><d:Scopes>{scopes}</d:Scopes>
<d:XAddrs>{addresses}</d:XAddrs><d:MetadataVersion>1</d:MetadataVersion></d:ProbeMatch></d:ProbeMatches>"""
_TIME = """<tds:GetSystemDateAndTimeResponse><tds:SystemDateAndTime><tt:DateTimeType>Manual</tt:DateTimeType>
<tt:UTCDateTime><tt:Time><tt:Hour>{now.hour}</tt:Hour><tt:Minute>{now.minute}</tt:Minute>
<tt:Second>{now.second}</tt:Second></tt:Time><tt:Date><tt:Year>{now.year}</tt:Year><tt:Month>{now.month}</tt:Month>
<tt:Day>{now.day}</tt:Day></tt:Date></tt:UTCDateTime></tds:SystemDateAndTime></tds:GetSystemDateAndTimeResponse>"""
_CAPABILITIES = """<tds:GetCapabilitiesResponse><tds:Capabilities><tt:Media><tt:XAddr>{media}</tt:XAddr></tt:Media>
</tds:Capabilities></tds:GetCapabilitiesResponse>"""
_PROFILE = """<trt:Profiles token="{token}" fixed="true"><tt:Name>{name}</tt:Name>
<tt:VideoEncoderConfiguration token="e">
<tt:Name>e</tt:Name><tt:Encoding>H264</tt:Encoding><tt:Resolution><tt:Width>{width}</tt:Width>
<tt:Height>{height}</tt:Height></tt:Resolution></tt:VideoEncoderConfiguration></trt:Profiles>"""
_STREAM = """<trt:GetStreamUriResponse><trt:MediaUri><tt:Uri>{uri}</tt:Uri>
<tt:InvalidAfterConnect>false</tt:InvalidAfterConnect></trt:MediaUri></trt:GetStreamUriResponse>"""


class OnvifCamera:
    """A camera on loopback, until ``close``.

    Attributes:
        scopes: Scopes of its probe matches.
        addresses: Its device services in probe matches; ``None`` for the real one.
        media: Its media service; ``None`` for the real one.
        uri: Address of the stream; ``{token}`` is replaced.
        clock_offset: Error of its clock.
        raw: Response to every probe, instead of the real one.
        raw_response: Response to every HTTP request, instead of the real one.
        requests: Bodies of all HTTP requests.
    """

    def __init__(self, group: str = "") -> None:
        self.scopes = "onvif://www.onvif.org/name/Door%20Camera onvif://www.onvif.org/hardware/DC-7"
        self.addresses: str | None = None
        self.media: str | None = None
        self.uri = "rtsp://127.0.0.1:554/{token}?a=1&amp;b=2"
        self.clock_offset = dt.timedelta(days=-400)
        self.raw: bytes | None = None
        self.raw_response: bytes | None = None
        self.requests: list[bytes] = []
        self._udp = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._udp.bind((group or "127.0.0.1", 0))
        if group:
            member = struct.pack("4s4s", socket.inet_aton(group), socket.inet_aton("127.0.0.1"))
            self._udp.setsockopt(socket.IPPROTO_IP, socket.IP_ADD_MEMBERSHIP, member)
        self.port = self._udp.getsockname()[1]
        self._http = ThreadingHTTPServer(("127.0.0.1", 0), _Handler)
        self._http.daemon_threads = True
        self._http.camera = self  # type: ignore[attr-defined]
        self.service = f"http://127.0.0.1:{self._http.server_address[1]}/onvif/device_service"
        self._threads = [
            threading.Thread(target=self._http.serve_forever, args=(0.02,), daemon=True),
            threading.Thread(target=self._answer_probes, daemon=True),
        ]
        for thread in self._threads:
            thread.start()

    def close(self) -> None:
        self._http.shutdown()
        self._http.server_close()
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
            sender.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_IF, socket.inet_aton("127.0.0.1"))
            sender.sendto(b"", self._udp.getsockname())
        for thread in self._threads:
            thread.join()
        self._udp.close()

    def _answer_probes(self) -> None:
        reply = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        reply.bind(("127.0.0.1", 0))
        with reply:
            while True:
                content, sender = self._udp.recvfrom(65_535)
                if not content:
                    return
                (message,) = re.findall(rb"MessageID>([^<]+)<", content)
                header = f"<wsa:RelatesTo>{message.decode()}</wsa:RelatesTo>"
                match = _MATCH.format(scopes=self.scopes, addresses=self.addresses or self.service)
                reply.sendto(self.raw or _ENVELOPE.format(header=header, body=match).encode(), sender)

    def respond(self, request: bytes) -> tuple[int, bytes]:
        self.requests.append(request)
        if self.raw_response is not None:
            return 200, self.raw_response
        (operation,) = re.findall(rb"Body><(\w+)", request)
        if operation != b"GetSystemDateAndTime" and not self._signed(request):
            return 400, _ENVELOPE.format(header="", body="<SOAP-ENV:Fault/>").encode()
        return 200, _ENVELOPE.format(header="", body=self._body(operation.decode(), request)).encode()

    def _body(self, operation: str, request: bytes) -> str:
        match operation:
            case "GetSystemDateAndTime":
                return _TIME.format(now=self._now())
            case "GetCapabilities":
                return _CAPABILITIES.format(media=self.media or self.service.replace("device", "media"))
            case "GetProfiles":
                sizes = (("main", 1920, 1080), ("sub", 704, 576), ("small", 352, 288))
                found = "".join(
                    _PROFILE.format(token=f"{name}&amp;1", name=name, width=width, height=height)
                    for name, width, height in sizes
                )
                return f"<trt:GetProfilesResponse>{found}</trt:GetProfilesResponse>"
        (token,) = re.findall(rb"ProfileToken>([^<]+)<", request)
        return _STREAM.format(uri=self.uri.format(token=token.decode()))

    def _now(self) -> dt.datetime:
        return dt.datetime.now(dt.UTC) + self.clock_offset

    def _signed(self, request: bytes) -> bool:
        """WS-UsernameToken with a digest that is at most a minute old."""
        fields = {name: re.findall(rb"\b" + name + rb"\b[^>]*>([^<]+)<", request) for name in _TOKEN}
        if not all(fields.values()):
            return False
        user, digest, nonce, created = (fields[name][0] for name in _TOKEN)
        expected = hashlib.sha1(base64.b64decode(nonce) + created + PASSWORD.encode(), usedforsecurity=False).digest()
        time = dt.datetime.fromisoformat(created.decode())
        fresh = abs(time - self._now()) < dt.timedelta(minutes=1)
        return fresh and user == USER.encode() and base64.b64decode(digest) == expected


_TOKEN = (b"Username", b"Password", b"Nonce", b"Created")


class _Handler(BaseHTTPRequestHandler):
    def log_message(self, *_: object) -> None:
        pass

    def do_POST(self) -> None:
        request = self.rfile.read(int(self.headers["Content-Length"]))
        status, content = self.server.camera.respond(request)  # type: ignore[attr-defined]
        self.send_response(status)
        self.send_header("Content-Type", "application/soap+xml")
        self.send_header("Content-Length", str(len(content)))
        self.end_headers()
        self.wfile.write(content)
