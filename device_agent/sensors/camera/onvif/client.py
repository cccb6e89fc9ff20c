"""Asks one ONVIF camera for its streams."""

import datetime as dt
import secrets
from http.client import HTTPException
from typing import NamedTuple
from urllib.parse import SplitResult

from device_agent.ports.sensor import SensorError
from device_agent.sensors.camera.http_client import Body, CameraClient, failure
from device_agent.sensors.camera.onvif import messages
from device_agent.sensors.camera.onvif.messages import OnvifError, Profile
from device_agent.sensors.camera.options import Credentials, shown, split_address, tls_context

_MAX_BYTES = 256 * 1024
_TIMEOUT_S = 5.0
_MEDIA_TYPE = "application/soap+xml; charset=utf-8"


class Stream(NamedTuple):
    """A stream of a camera: its profile, and its address without user and password."""

    profile: Profile
    url: str


class OnvifClient:
    """Client of one camera.

    It sends digests of the password only, and only to the host of ``service``.

    Args:
        service: Address of the device service.
        credentials: User and password, or ``None``.
        ca: File of the authority of an https camera; empty: those of the operating system.

    Raises:
        SensorError: ``service`` is not an address.
    """

    def __init__(self, service: str, credentials: Credentials | None, *, ca: str = "") -> None:
        self._device = split_address(service, ("http", "https"))
        self._credentials = credentials
        self._client = CameraClient(timeout_s=_TIMEOUT_S, tls=lambda: tls_context(ca), basic=False)
        self._ahead = dt.timedelta()

    def streams(self) -> tuple[Stream, ...]:
        """The streams, in the camera's order.

        Raises:
            SensorError: The camera does not respond as an ONVIF camera, or rejects the credentials.
        """
        where = shown(self._device)
        try:
            self._measure_clock()
            media = self._own(messages.media_address(self._call(self._device, messages.GET_CAPABILITIES)))
            found = messages.profiles(self._call(media, messages.GET_PROFILES))
            return tuple(Stream(profile, self._stream_url(media, profile)) for profile in found)
        except OnvifError as error:
            raise SensorError(f"{where} does not respond as an ONVIF camera: {error}") from error

    def _measure_clock(self) -> None:
        """Digests are valid at the camera's time only, which is often wrong."""
        theirs = messages.time_of(self._call(self._device, messages.GET_TIME, signed=False))
        if theirs is not None:
            self._ahead = theirs - dt.datetime.now(dt.UTC)

    def _stream_url(self, media: SplitResult, profile: Profile) -> str:
        url = messages.stream_uri(self._call(media, messages.get_stream_uri(profile.token)))
        parts = split_address(url, ("rtsp",))
        if parts.hostname != self._device.hostname:
            raise OnvifError(f"its stream is at another host, {messages.printable(parts.hostname or '')}")
        return parts._replace(netloc=parts.netloc.rpartition("@")[2], fragment="").geturl()

    def _own(self, address: str) -> SplitResult:
        """An address that the camera names, at its own host."""
        parts = split_address(address, ("http", "https"))
        if (parts.scheme, parts.hostname) != (self._device.scheme, self._device.hostname):
            raise OnvifError(f"it names a service at another host, {messages.printable(parts.hostname or '')}")
        return parts

    def _call(self, address: SplitResult, request: str, *, signed: bool = True) -> bytes:
        credentials = self._credentials if signed else None
        now = dt.datetime.now(dt.UTC) + self._ahead
        content = messages.envelope(request, credentials, now=now, nonce=secrets.token_bytes(16))
        try:
            response = self._client.open(address, credentials, Body(_MEDIA_TYPE, content))
            received = response.read(_MAX_BYTES + 1)
        except (OSError, HTTPException, ValueError) as error:
            raise failure(address, error) from error
        finally:
            self._client.close()
        if len(received) > _MAX_BYTES:
            raise OnvifError("its response is too long")
        return received
