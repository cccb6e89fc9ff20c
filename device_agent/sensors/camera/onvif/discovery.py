"""Finds ONVIF cameras by WS-Discovery."""

import contextlib
import ipaddress
import socket
import time
import uuid
from typing import NamedTuple
from urllib.parse import urlsplit

from device_agent.ports.sensor import SensorError
from device_agent.sensors.camera.onvif import messages
from device_agent.sensors.camera.onvif.messages import OnvifError

MULTICAST = ("239.255.255.250", 3702)
_MAX_DATAGRAM = 65_535
_MAX_CAMERAS = 128
_REPEAT_S = 0.5
"""The probe is sent twice, as datagrams can be lost."""


class FoundCamera(NamedTuple):
    """A camera that has responded.

    Attributes:
        host: Its IP address.
        name: Its name, printable; may be empty.
        service: Address of its device service.
    """

    host: str
    name: str
    service: str


def find(destination: tuple[str, int] = MULTICAST, *, interface: str = "", wait_s: float = 3.0) -> list[FoundCamera]:
    """Cameras that respond to a probe, sorted by address.

    A camera must name an address at the host that sends the response, so that one device cannot redirect requests
    for another.

    Args:
        destination: Host and port; a multicast group reaches all cameras of the network.
        interface: IP address of the network interface; empty: the operating system selects it.
        wait_s: Time for responses [s].

    Raises:
        SensorError: The network cannot be used.
    """
    message_id = f"urn:uuid:{uuid.uuid4()}"
    found: dict[str, FoundCamera] = {}
    try:
        host = socket.gethostbyname(destination[0])
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as link:
            if ipaddress.ip_address(host).is_multicast and interface:
                link.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_IF, socket.inet_aton(interface))
            end_s = time.monotonic() + wait_s
            repeat_s = 0.0
            while (now_s := time.monotonic()) < end_s and len(found) < _MAX_CAMERAS:
                if now_s >= repeat_s:
                    link.sendto(messages.probe(message_id), (host, destination[1]))
                    repeat_s = end_s if repeat_s else now_s + _REPEAT_S
                link.settimeout(max(0.01, min(repeat_s, end_s) - now_s))
                with contextlib.suppress(TimeoutError, ConnectionRefusedError, OnvifError):
                    content, sender = link.recvfrom(_MAX_DATAGRAM)
                    camera = _camera(messages.probe_match(content, message_id), sender[0])
                    found.setdefault(camera.host, camera)
    except socket.gaierror as error:
        raise SensorError(f"the name {destination[0]} is unknown; enter the IP address of the camera") from error
    except OSError as error:
        raise SensorError(
            f"the network cannot be searched: {error.strerror or error}; name the interface with --interface"
        ) from error
    return sorted(found.values(), key=lambda camera: ipaddress.ip_address(camera.host))


def _camera(match: messages.ProbeMatch, sender: str) -> FoundCamera:
    for address in match.addresses:
        with contextlib.suppress(ValueError):
            parts = urlsplit(address)
            if parts.scheme in ("http", "https") and parts.hostname == sender and parts.port != 0:
                return FoundCamera(sender, match.name, address)
    raise OnvifError("it names no address of its own")
