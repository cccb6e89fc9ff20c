"""HTTP client for cameras: credentials go to the configured host only, and no response can exhaust the memory.

The standard library's client follows no redirects, uses no proxies and decompresses nothing. So a hostile camera
cannot send the agent elsewhere, and each read has a size.
"""

import base64
import contextlib
import socket
import ssl
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from http.client import HTTPConnection, HTTPException, HTTPResponse, HTTPSConnection
from urllib.parse import SplitResult, urljoin, urlsplit
from urllib.request import AbstractDigestAuthHandler, HTTPPasswordMgr, Request, parse_http_list, parse_keqv_list

from device_agent.ports.sensor import SensorError
from device_agent.sensors.camera.options import Credentials, shown
from device_agent.sensors.camera.reader import RejectedError

_OK, _UNAUTHORIZED, _FORBIDDEN, _NOT_FOUND = 200, 401, 403, 404
_REDIRECTS = frozenset({301, 302, 303, 307, 308})
_MAX_REQUESTS = 4
"""Requests of one attempt: the first, with credentials, and redirects."""


@dataclass(frozen=True, slots=True)
class Body:
    """Body of a request and its content type."""

    media_type: str
    content: bytes


class CameraClient:
    """Sends requests to one camera, one at a time. ``abort`` may be called from any thread.

    Args:
        timeout_s: Maximum silence of the camera [s].
        tls: Creates the verification of https cameras; called with each connection.
        basic: Whether basic authentication, which sends the password itself, is allowed.
    """

    def __init__(self, *, timeout_s: float, tls: Callable[[], ssl.SSLContext], basic: bool = True) -> None:
        self._basic = basic
        self._timeout_s = timeout_s
        self._tls = tls
        self._connection: HTTPConnection | None = None
        self._response: HTTPResponse | None = None
        self._socket: socket.socket | None = None

    def open(self, address: SplitResult, credentials: Credentials | None, body: Body | None = None) -> HTTPResponse:
        """Request an address; the response has the status 200. The caller limits what it reads, and calls ``close``.

        Raises:
            SensorError: The camera cannot be reached, or does not deliver. The message contains no credentials.
            RejectedError: The camera requires other credentials.
        """
        authorization = ""
        for _ in range(_MAX_REQUESTS):
            response = self._request(address, authorization, body)
            if response.status == _OK:
                return response
            status, headers = response.status, response.headers
            self.close()
            if status == _UNAUTHORIZED and credentials is not None and not authorization:
                challenges = headers.get_all("WWW-Authenticate") or []
                authorization = self._authorization(
                    challenges, address, credentials, method="GET" if body is None else "POST"
                )
            elif status in _REDIRECTS:
                address = _redirect(address, headers.get("Location", ""))
                authorization = ""
            else:
                raise _refusal(address, status)
        raise SensorError(f"{shown(address)} redirects in a circle; check the path of the address")

    def close(self) -> None:
        """Close the connection."""
        opened = (self._response, self._connection)
        self._response = self._connection = self._socket = None
        for each in opened:
            if each is not None:
                each.close()

    def abort(self) -> None:
        """End a running request or response, which raises ``OSError`` in its thread or ends."""
        opened = self._socket
        if opened is not None:
            with contextlib.suppress(OSError):
                opened.shutdown(socket.SHUT_RDWR)

    def _authorization(
        self, challenges: list[str], address: SplitResult, credentials: Credentials, *, method: str
    ) -> str:
        """The header for the strongest supported challenge.

        Raises:
            SensorError: The camera supports neither digest nor basic authentication.
        """
        offered = [(scheme.lower(), rest) for scheme, _, rest in (text.strip().partition(" ") for text in challenges)]
        digests = [rest for scheme, rest in offered if scheme == "digest"]
        for challenge in digests:
            header = _digest(challenge, address, credentials, method)
            if header is not None:
                return header
        # A camera that offers digest never receives the password itself.
        if self._basic and not digests and any(scheme == "basic" for scheme, _ in offered):
            return "Basic " + base64.b64encode(f"{credentials.user}:{credentials.password}".encode()).decode()
        raise SensorError(
            f"{shown(address)} requires an unsupported kind of authentication; enable digest in the camera"
        )

    def _request(self, address: SplitResult, authorization: str, body: Body | None) -> HTTPResponse:
        host, port = address.hostname or "", address.port
        headers = {"Authorization": authorization} if authorization else {}
        if body is not None:
            headers["Content-Type"] = body.media_type
        connection = (
            HTTPSConnection(host, port, timeout=self._timeout_s, context=self._tls())
            if address.scheme == "https"
            else HTTPConnection(host, port, timeout=self._timeout_s)
        )
        self._connection = connection
        try:
            connection.connect()
            self._socket = connection.sock  # a response without length takes it from the connection; `abort` needs it
            content = None if body is None else body.content
            connection.request("GET" if body is None else "POST", _target(address), content, headers)
            self._response = connection.getresponse()
        except (OSError, HTTPException, ValueError) as error:
            self.close()
            raise failure(address, error) from error
        return self._response


def failure(address: SplitResult, error: Exception) -> SensorError:
    """The error for users after a connection to ``address`` has failed."""
    where = shown(address)
    match error:
        case ssl.SSLCertVerificationError():
            return SensorError(
                f"{where}: the certificate is not trusted ({error.verify_message}); name its authority in option 'ca'"
            )
        case ssl.SSLError():
            return SensorError(f"{where} does not speak TLS; check the address, or use http")
        case socket.gaierror():
            return SensorError(f"{where}: the name is unknown; check the address")
        case TimeoutError():
            return SensorError(f"{where} does not respond; check that the camera has power and is connected")
        case OSError() if error.strerror:
            return SensorError(f"{where}: {error.strerror}; check that the camera has power, and its address")
    return SensorError(f"{where} does not respond as an HTTP server; check the address")


def _target(address: SplitResult) -> str:
    return (address.path or "/") + (f"?{address.query}" if address.query else "")


def _redirect(address: SplitResult, location: str) -> SplitResult:
    try:
        target = urlsplit(urljoin(address.geturl(), location))
        same = _origin(target) == _origin(address)
    except ValueError:
        same = False
    if not same:
        raise SensorError(f"{shown(address)} redirects to another host; enter the final address in option 'url'")
    return target


def _origin(address: SplitResult) -> tuple[str, str | None, int]:
    return address.scheme, address.hostname, address.port or (443 if address.scheme == "https" else 80)


def _refusal(address: SplitResult, status: int) -> SensorError:
    where = shown(address)
    if status in (_UNAUTHORIZED, _FORBIDDEN):
        return RejectedError(f"{where} does not accept user and password; check the device's options")
    if status == _NOT_FOUND:
        return SensorError(f"{where} has no such path; check option 'url'")
    return SensorError(f"{where} responds with status {status}; check the address, and user and password")


def _digest(challenge: str, address: SplitResult, credentials: Credentials, method: str) -> str | None:
    url = f"{address.scheme}://{address.netloc.rpartition('@')[2]}{_target(address)}"
    passwords = HTTPPasswordMgr()
    try:
        parameters: Mapping[str, str] = parse_keqv_list(parse_http_list(challenge))
        passwords.add_password(parameters.get("realm", ""), url, credentials.user, credentials.password)
        request = Request(url, method=method)  # noqa: S310 (never opened; it only carries the address)
        header = AbstractDigestAuthHandler(passwords).get_authorization(request, parameters)
    except (ValueError, LookupError, OSError):
        return None
    return f"Digest {header}" if header else None
