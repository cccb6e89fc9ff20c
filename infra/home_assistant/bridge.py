"""Forwards device messages to Home Assistant's broker and its commands to the devices."""

import json
import logging
import math
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor

from device_agent.protocol import Description, Measurements, Presence, camera_frames, codec, topics
from device_agent.protocol.errors import ProtocolError
from infra.home_assistant import discovery
from infra.home_assistant.discovery import Announcement

Publish = Callable[[str, bytes, bool], object]
"""Publishes on Home Assistant's broker: topic, content, retained."""
SetControl = Callable[[str, str, float], str]
"""Sets a control: device, control, value. Returns an error message, or an empty string."""
_log = logging.getLogger(__name__)


class Bridge:
    """Connects two brokers. Each callback runs in its connection's thread and never blocks.

    Args:
        publish: Publishes to Home Assistant.
        set_control: Sets a control; may block for the network.
    """

    def __init__(self, publish: Publish, set_control: SetControl) -> None:
        self._publish = publish
        self._set_control = set_control
        self._requests = ThreadPoolExecutor(max_workers=1, thread_name_prefix="set-control")
        self._known: dict[str, Description] = {}
        self._announced: set[str] = set()

    def close(self) -> None:
        """Wait for pending requests."""
        self._requests.shutdown(wait=True, cancel_futures=True)

    def announce_all(self) -> None:
        """Announce all known devices, after Home Assistant or its broker has restarted."""
        self._announced.clear()
        for device, description in list(self._known.items()):
            self._announce(discovery.announce_device(device, description))

    # ------------------------------------------------------------ from devices

    def on_device_message(self, topic: str, payload: bytes) -> None:
        """Process a message of a device or agent; ignores messages of other devices."""
        try:
            parsed = topics.parse(topic)
            device = f"{parsed.agent}-{parsed.device}"
            match parsed.kind:
                case topics.CONN:
                    self._available(parsed.agent, online=codec.decode(payload, Presence).online)
                case topics.DESC if not parsed.name:
                    self._describe(device, codec.decode(payload, Description))
                case topics.TELE if device in self._known:
                    self._measured(device, parsed.name, payload)
                case topics.CAM if device in self._known:
                    frame = camera_frames.decode(payload)
                    if frame.kind == camera_frames.COLOUR:
                        self._publish(discovery.topic(device, "cam", parsed.name), frame.content, False)
        except ProtocolError as error:
            _log.warning("%s: %s", topic, str(error)[:300])

    def _describe(self, device: str, description: Description) -> None:
        shown = description.streams or description.controls or discovery.pictures(description)
        if description.joints or not shown:
            return  # robots are not controlled from Home Assistant, which shows no depth images and people
        self._known[device] = description
        self._announce(discovery.announce_device(device, description))
        self._publish(discovery.topic(device, "available"), b"online", True)

    def _available(self, agent: str, *, online: bool) -> None:
        for device in self._known:
            if device.startswith(f"{agent}-"):
                self._publish(discovery.topic(device, "available"), b"online" if online else b"offline", True)

    def _measured(self, device: str, stream: str, payload: bytes) -> None:
        values = codec.decode(payload, Measurements).values
        self._announce(discovery.announce_values(device, self._known[device], stream, values))
        self._publish(discovery.topic(device, "tele", stream), payload, False)

    def _announce(self, announcements: Iterable[Announcement]) -> None:
        for announcement in announcements:
            if announcement.topic not in self._announced:
                self._announced.add(announcement.topic)
                self._publish(announcement.topic, json.dumps(announcement.content, ensure_ascii=False).encode(), True)

    # ------------------------------------------------------------ from Home Assistant

    def on_command(self, topic: str, payload: bytes) -> None:
        """Process a command of Home Assistant; ignores unknown controls and invalid values."""
        match topic.split("/"):
            case [discovery.ROOT, device, "set", name] if device in self._known:
                control = next((one for one in self._known[device].controls if one.name == name), None)
                try:
                    value = float(payload)
                except ValueError:
                    value = math.nan
                if control is None or not control.lower <= value <= control.upper:
                    _log.warning("%s: invalid value %r", topic, payload[:40])
                    return
                self._requests.submit(self._set, device, name, value)

    def _set(self, device: str, control: str, value: float) -> None:
        error = self._set_control(device, control, value)
        if error:
            _log.warning("%s of %s was not set to %g: %s", control, device, value, error)
