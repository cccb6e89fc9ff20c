"""One agent: one link, any number of devices. Routes received messages and link changes to the devices."""

import logging
from collections.abc import Mapping

from device_agent.ports.transport import Transport
from device_agent.protocol import topics
from device_agent.protocol.errors import ProtocolError
from device_agent.runtime.device import Device
from device_agent.runtime.readings import ReadingCache
from device_agent.runtime.telemetry.outbox import Outbox

_log = logging.getLogger(__name__)


class Agent:
    """Connects devices to a transport.

    Attributes:
        linked: Whether the link is up.
    """

    def __init__(
        self,
        devices: Mapping[str, Device],
        transport: Transport,
        *,
        outbox: Outbox,
        readings: ReadingCache,
        address: tuple[str, str],
    ) -> None:
        self._devices = devices
        self._transport = transport
        self._outbox = outbox
        self._readings = readings
        self._address = address
        self.linked = False

    def start(self) -> None:
        """Start every device, then the link: a device holds before it can receive messages.

        Raises:
            DriverError: A device does not respond.
            TransportError: The transport's configuration is invalid.
        """
        self._outbox.start()
        for device in self._devices.values():
            device.start()
        self._transport.start(self._receive, self._link_changed)

    def stop(self) -> None:
        """Hold and close every device, then disconnect. May be called twice."""
        for device in self._devices.values():
            device.stop()
        self._outbox.stop()
        self._transport.stop()

    @property
    def quiet(self) -> bool:
        """Whether no device moves or runs an action, so that a short interruption of the link is harmless."""
        return all(device.quiet for device in self._devices.values())

    def suspend(self, why: str) -> str:
        """Reject all motion at every device until ``resume``. Returns what prevents it, or an empty string."""
        for device in self._devices.values():
            if reason := device.suspend(why):
                self.resume()
                return f"{device.name}: {reason}"
        return ""

    def resume(self) -> None:
        """Allow motion again."""
        for device in self._devices.values():
            device.resume()

    def _receive(self, topic: str, payload: bytes) -> None:
        try:
            parsed = topics.parse(topic)
            if (parsed.space, parsed.agent) != self._address:
                self._readings.receive(parsed, payload)
                return
        except ProtocolError as error:
            _log.warning("message rejected: %s", str(error)[:300])
            return
        device = self._devices.get(parsed.device)
        if device is not None:
            device.receive(parsed, payload)

    def _link_changed(self, up: bool) -> None:
        _log.info("link %s", "up" if up else "lost")
        self.linked = up
        self._outbox.link_changed(up)
        for device in self._devices.values():
            device.link_changed(up)
