"""Publishes messages of devices on Foxglove channels."""

import logging
import time
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any, Final

from foxglove import Context
from foxglove.channels import CompressedImageChannel, FrameTransformsChannel, JointStatesChannel, LogChannel

from device_agent.protocol import Description, Event, JointTelemetry, camera_frames, codec, topics
from device_agent.protocol.errors import ProtocolError
from device_agent.protocol.topics import Topic
from infra.foxglove import messages

_CHANNELS: Final = {"joint_states": JointStatesChannel, "transforms": FrameTransformsChannel, "events": LogChannel}
_log = logging.getLogger(__name__)


@dataclass(slots=True)
class _Device:
    """What is known of one device.

    Attributes:
        description: Its description, once received.
        offset_ms: Wall clock minus monotonic clock of its agent [ms]; ``None`` before the first telemetry.
        channels: Its channels by the last part of their topic.
    """

    description: Description | None = None
    offset_ms: int | None = None
    channels: dict[str, Any] = field(default_factory=dict)


class Endpoint:
    """Converts messages of the broker to Foxglove messages. Called by one thread.

    Args:
        context: Foxglove context of the WebSocket server.
        devices: Ids of the devices to publish; messages of all others are ignored.
    """

    def __init__(self, context: Context, devices: Iterable[str]) -> None:
        self._context = context
        self._devices = {device: _Device() for device in devices}

    def receive(self, topic: str, payload: bytes) -> None:
        """Process a message of the broker."""
        try:
            parsed = topics.parse(topic)
            name = f"{parsed.agent}-{parsed.device}"
            device = self._devices.get(name)
            if device is not None:
                self._publish(name, device, parsed, payload)
        except (ProtocolError, ValueError) as error:
            _log.warning("%s: %s", topic, str(error)[:300])

    def close(self) -> None:
        """Remove all channels."""
        for device in self._devices.values():
            for channel in device.channels.values():
                channel.close()

    def _publish(self, name: str, device: _Device, topic: Topic, payload: bytes) -> None:
        match topic.kind:
            case topics.DESC if not topic.name:
                device.description = codec.decode(payload, Description)
            case topics.TELE if topic.name == topics.JOINTS and device.description is not None:
                self._joints(name, device, device.description, codec.decode(payload, JointTelemetry))
            case topics.EVENT:
                event = codec.decode(payload, Event)
                self._channel(name, device, "events").log(messages.log(name, event), log_time=_ns(event.at_ms))
            case topics.CAM:
                frame = camera_frames.decode(payload)
                if frame.kind == camera_frames.COLOUR:
                    self._image(name, device, topic.name, frame)

    def _joints(self, name: str, device: _Device, description: Description, telemetry: JointTelemetry) -> None:
        states = messages.joint_states(description, telemetry)
        # Set only now: a time that is refused must not give images a wrong time.
        device.offset_ms = telemetry.at_ms - telemetry.tick_ms
        self._channel(name, device, "joint_states").log(states, log_time=_ns(telemetry.at_ms))
        if telemetry.frames:
            transforms = messages.frame_transforms(name, description, telemetry)
            self._channel(name, device, "transforms").log(transforms, log_time=_ns(telemetry.at_ms))

    def _image(self, name: str, device: _Device, camera: str, frame: camera_frames.CameraFrame) -> None:
        # A frame has no wall-clock time. Devices without joints send none, so the time of arrival replaces it.
        at_ms = time.time_ns() // 1_000_000 if device.offset_ms is None else frame.tick_ms + device.offset_ms
        image = messages.compressed_image(f"{name}/{camera}", frame, at_ms)
        self._channel(name, device, f"cam/{camera}", CompressedImageChannel).log(image, log_time=_ns(at_ms))

    def _channel(self, name: str, device: _Device, part: str, kind: Any = None) -> Any:
        if part not in device.channels:
            device.channels[part] = (kind or _CHANNELS[part])(f"/{name}/{part}", context=self._context)
        return device.channels[part]


def _ns(at_ms: int) -> int:
    """A time in ns. ``messages.timestamp`` has checked it, so that Foxglove can express it."""
    return at_ms * 1_000_000
