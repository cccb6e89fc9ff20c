"""Messages of WS-Discovery and ONVIF: requests as text, responses as checked values.

Sources: WS-Discovery (April 2005), ONVIF Core and Media specifications, and the WSDL files at onvif.org/ver10.
"""

import base64
import datetime as dt
import hashlib
from html import escape
from typing import NamedTuple
from urllib.parse import unquote
from xml.etree.ElementTree import Element, ParseError

from defusedxml import DefusedXmlException, ElementTree

from device_agent.sensors.camera.options import Credentials

_SOAP = "http://www.w3.org/2003/05/soap-envelope"
_ADDRESSING = "http://schemas.xmlsoap.org/ws/2004/08/addressing"
_DISCOVERY = "http://schemas.xmlsoap.org/ws/2005/04/discovery"
_SECURITY = "http://docs.oasis-open.org/wss/2004/01/oasis-200401-wss-wssecurity-secext-1.0.xsd"
_UTILITY = "http://docs.oasis-open.org/wss/2004/01/oasis-200401-wss-wssecurity-utility-1.0.xsd"
_DIGEST = "http://docs.oasis-open.org/wss/2004/01/oasis-200401-wss-username-token-profile-1.0#PasswordDigest"
_BASE64 = "http://docs.oasis-open.org/wss/2004/01/oasis-200401-wss-soap-message-security-1.0#Base64Binary"
_DEVICE = "http://www.onvif.org/ver10/device/wsdl"
_MEDIA = "http://www.onvif.org/ver10/media/wsdl"
_SCHEMA = "http://www.onvif.org/ver10/schema"
_NAME, _HARDWARE = "onvif://www.onvif.org/name/", "onvif://www.onvif.org/hardware/"
_MAX_TEXT = 60
_MAX_TOKEN = 200
_MAX_PROFILES = 16

GET_TIME = f'<GetSystemDateAndTime xmlns="{_DEVICE}"/>'
GET_CAPABILITIES = f'<GetCapabilities xmlns="{_DEVICE}"><Category>Media</Category></GetCapabilities>'
GET_PROFILES = f'<GetProfiles xmlns="{_MEDIA}"/>'


class OnvifError(Exception):
    """A message is not valid. The text is a clause for users."""


class ProbeMatch(NamedTuple):
    """Response to a probe.

    Attributes:
        name: Name and hardware of the camera, printable.
        addresses: Addresses of its device service.
    """

    name: str
    addresses: tuple[str, ...]


class Profile(NamedTuple):
    """Stream of a camera. ``width`` and ``height`` [pixels] are 0 if unknown."""

    token: str
    name: str
    width: int
    height: int


def probe(message_id: str) -> bytes:
    """The request to all cameras of the network."""
    return (
        f'<?xml version="1.0" encoding="utf-8"?><e:Envelope xmlns:e="{_SOAP}" xmlns:w="{_ADDRESSING}" '
        f'xmlns:d="{_DISCOVERY}" xmlns:n="http://www.onvif.org/ver10/network/wsdl"><e:Header>'
        f"<w:MessageID>{message_id}</w:MessageID><w:To>urn:schemas-xmlsoap-org:ws:2005:04:discovery</w:To>"
        f"<w:Action>{_DISCOVERY}/Probe</w:Action></e:Header><e:Body><d:Probe>"
        "<d:Types>n:NetworkVideoTransmitter</d:Types></d:Probe></e:Body></e:Envelope>"
    ).encode()


def probe_match(content: bytes, message_id: str) -> ProbeMatch:
    """The response to the probe with this id.

    Raises:
        OnvifError: It is not valid XML, or responds to another probe.
    """
    envelope = _parse(content)
    if _text(envelope, f".//{{{_ADDRESSING}}}RelatesTo") != message_id:
        raise OnvifError("it responds to another request")
    addresses = _text(envelope, f".//{{{_DISCOVERY}}}XAddrs").split()
    scopes = _text(envelope, f".//{{{_DISCOVERY}}}Scopes").split()
    names = [
        unquote(scope.removeprefix(prefix)) for prefix in (_NAME, _HARDWARE) for scope in scopes if prefix in scope
    ]
    return ProbeMatch(name=printable(" ".join(dict.fromkeys(names))), addresses=tuple(addresses[:8]))


def envelope(body: str, credentials: Credentials | None, *, now: dt.datetime, nonce: bytes) -> bytes:
    """A request, with a digest of the password at the camera's time ``now`` if there are credentials."""
    header = "" if credentials is None else _username_token(credentials, now=now, nonce=nonce)
    return (
        f'<?xml version="1.0" encoding="utf-8"?><e:Envelope xmlns:e="{_SOAP}"><e:Header>{header}</e:Header>'
        f"<e:Body>{body}</e:Body></e:Envelope>"
    ).encode()


def _username_token(credentials: Credentials, *, now: dt.datetime, nonce: bytes) -> str:
    created = now.strftime("%Y-%m-%dT%H:%M:%SZ")
    # The profile requires SHA-1. An observer can still try passwords, but does not see the password.
    digest = hashlib.sha1(nonce + created.encode() + credentials.password.encode(), usedforsecurity=False).digest()
    return (
        f'<s:Security xmlns:s="{_SECURITY}" e:mustUnderstand="true"><s:UsernameToken>'
        f"<s:Username>{escape(credentials.user)}</s:Username>"
        f'<s:Password Type="{_DIGEST}">{base64.b64encode(digest).decode()}</s:Password>'
        f'<s:Nonce EncodingType="{_BASE64}">{base64.b64encode(nonce).decode()}</s:Nonce>'
        f'<u:Created xmlns:u="{_UTILITY}">{created}</u:Created></s:UsernameToken></s:Security>'
    )


def get_stream_uri(token: str) -> str:
    """The request for the address of a profile's RTSP stream."""
    return (
        f'<GetStreamUri xmlns="{_MEDIA}" xmlns:t="{_SCHEMA}"><StreamSetup><t:Stream>RTP-Unicast</t:Stream>'
        f"<t:Transport><t:Protocol>RTSP</t:Protocol></t:Transport></StreamSetup>"
        f"<ProfileToken>{escape(token)}</ProfileToken></GetStreamUri>"
    )


def time_of(content: bytes) -> dt.datetime | None:
    """The camera's time in UTC; ``None`` if it states none.

    Raises:
        OnvifError: The response is not valid.
    """
    utc = _parse(content).find(f".//{{{_SCHEMA}}}UTCDateTime")
    if utc is None:
        return None
    fields = [_text(utc, f".//{{{_SCHEMA}}}{name}") for name in ("Year", "Month", "Day", "Hour", "Minute", "Second")]
    try:
        year, month, day, hour, minute, second = map(int, fields)
        return dt.datetime(year, month, day, hour, minute, min(second, 59), tzinfo=dt.UTC)
    except ValueError as error:
        raise OnvifError("its time is not valid") from error


def media_address(content: bytes) -> str:
    """Address of the media service.

    Raises:
        OnvifError: The response is not valid, or the camera has no media service.
    """
    address = _text(_parse(content), f".//{{{_SCHEMA}}}Media/{{{_SCHEMA}}}XAddr")
    if not address:
        raise OnvifError("it has no media service")
    return address


def profiles(content: bytes) -> tuple[Profile, ...]:
    """The profiles, in the camera's order.

    Raises:
        OnvifError: The response is not valid, or there are none.
    """
    found = []
    for element in _parse(content).iter(f"{{{_MEDIA}}}Profiles"):
        token = element.get("token", "")
        if 0 < len(token) <= _MAX_TOKEN:
            resolution = f".//{{{_SCHEMA}}}VideoEncoderConfiguration/{{{_SCHEMA}}}Resolution/{{{_SCHEMA}}}"
            width, height = (_size(_text(element, resolution + side)) for side in ("Width", "Height"))
            found.append(Profile(token, printable(_text(element, f"{{{_SCHEMA}}}Name")), width, height))
    if not found:
        raise OnvifError("it has no video profile")
    return tuple(found[:_MAX_PROFILES])


def stream_uri(content: bytes) -> str:
    """The address of a stream.

    Raises:
        OnvifError: The response is not valid.
    """
    address = _text(_parse(content), f".//{{{_SCHEMA}}}Uri")
    if not address:
        raise OnvifError("it states no address of the stream")
    return address


def printable(text: str) -> str:
    """The text without characters that control a terminal, and of limited length."""
    return "".join(character if character.isprintable() else "?" for character in text[:_MAX_TEXT])


def _size(text: str) -> int:
    return int(text) if text.isdecimal() and len(text) <= 5 else 0  # noqa: PLR2004 (digits of a resolution)


def _parse(content: bytes) -> Element:
    try:
        root: Element = ElementTree.fromstring(content, forbid_dtd=True)
    except (ParseError, DefusedXmlException, ValueError, LookupError, RecursionError) as error:
        raise OnvifError("it does not send valid XML") from error
    return root


def _text(element: Element, path: str) -> str:
    found = element.find(path)
    return "" if found is None else (found.text or "").strip()
