"""Carries what devices say to Home Assistant's broker, and what is set there back to the devices."""

import json
import logging
import math
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor

from device_agent.protocol import Description, Measurements, Presence, camera_frames, codec, topics
from device_agent.protocol.errors import ProtocolError
from infra.home_assistant import discovery
from infra.home_assistant.discovery import Announcement

Say = Callable[[str, bytes, bool], object]
"""Publishes on Home Assistant's broker: topic, content, retained."""
Order = Callable[[str, str, float], str]
"""Sets a control: device, control, value. Gives why not, or nothing."""
_log = logging.getLogger(__name__)


class Bridge:
    """Between two brokers. ``hear`` is called by one connection's thread, ``told`` by the other's; neither waits.

    Args:
        say: Speaks to Home Assistant.
        order: Asks Telescope; may take as long as the network needs.
    """

    def __init__(self, say: Say, order: Order) -> None:
        self._say = say
        self._order = order
        self._orders = ThreadPoolExecutor(max_workers=1, thread_name_prefix="orders")
        self._known: dict[str, Description] = {}
        self._announced: set[str] = set()

    def close(self) -> None:
        """Let what is under way end."""
        self._orders.shutdown(wait=True, cancel_futures=True)

    def again(self) -> None:
        """Home Assistant's broker is there anew: announce all, as it is heard."""
        self._announced.clear()
        for device, about in list(self._known.items()):
            self._announce(discovery.of_device(device, about))

    # ------------------------------------------------------------ from devices

    def hear(self, topic: str, payload: bytes) -> None:
        """What a device or agent said; what is none of a room device's is let go."""
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
                    self._say(discovery.topic(device, "cam", parsed.name), camera_frames.decode(payload).jpeg, False)
        except ProtocolError as error:
            _log.warning("%s: %s", topic, str(error)[:300])

    def _describe(self, device: str, about: Description) -> None:
        if about.joints or not (about.streams or about.controls or about.cameras):
            return  # a robot: Home Assistant is no place to move one
        self._known[device] = about
        self._announce(discovery.of_device(device, about))
        self._say(discovery.topic(device, "available"), b"online", True)

    def _available(self, agent: str, *, online: bool) -> None:
        for device in self._known:
            if device.startswith(f"{agent}-"):
                self._say(discovery.topic(device, "available"), b"online" if online else b"offline", True)

    def _measured(self, device: str, stream: str, payload: bytes) -> None:
        values = codec.decode(payload, Measurements).values
        self._announce(discovery.of_values(device, self._known[device], stream, values))
        self._say(discovery.topic(device, "tele", stream), payload, False)

    def _announce(self, announcements: Iterable[Announcement]) -> None:
        for each in announcements:
            if each.topic not in self._announced:
                self._announced.add(each.topic)
                self._say(each.topic, json.dumps(each.content, ensure_ascii=False).encode(), True)

    # ------------------------------------------------------------ from Home Assistant

    def told(self, topic: str, payload: bytes) -> None:
        """Somebody moved a slider; what the device does not have, or is no number, is let go."""
        match topic.split("/"):
            case [discovery.ROOT, device, "set", name] if device in self._known:
                control = next((each for each in self._known[device].controls if each.name == name), None)
                try:
                    value = float(payload)
                except ValueError:
                    value = math.nan
                if control is None or not control.lower <= value <= control.upper:
                    _log.warning("%s: %r is nothing to set it to", topic, payload[:40])
                    return
                self._orders.submit(self._set, device, name, value)

    def _set(self, device: str, control: str, value: float) -> None:
        why = self._order(device, control, value)
        if why:
            _log.warning("%s of %s was not set to %g: %s", control, device, value, why)
