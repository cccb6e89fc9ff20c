"""Home Assistant announcements match its own schema; messages are forwarded in bridge directions."""

import json
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from device_agent.protocol import Control, Description, Measurements, Presence, camera_frames, codec, topics
from device_agent.protocol.camera_frames import CameraFrame
from device_agent.protocol.manifests import room
from infra.home_assistant import discovery
from infra.home_assistant.bridge import Bridge
from tests.harness.paths import ROOT

SCHEMA: dict[str, Any] = json.loads((Path(__file__).parent / "home_assistant.json").read_text())
LAB = room.load(Path(ROOT) / "robots" / "rooms" / "lab")
VALUES: dict[str, float | bool] = {
    "temperature_c": 20.5, "humidity_percent": 40.0, "co2_ppm": 600.0, "light_lux": 300.0, "sound_db": 40.0,
    "range_m.3": 2.0, "people": 1.0, "present": True, "open": False, "seen.door": True, "taken_bits.3": 1024.0,
}  # fmt: skip


def measurements(values: dict[str, float | bool]) -> Measurements:
    return Measurements(tick_ms=1, at_ms=1, sequence=1, values=values)


class RecordingBridge:
    """A bridge that records its messages and requests."""

    def __init__(self) -> None:
        self.published: list[tuple[str, bytes, bool]] = []
        self.requests: list[tuple[str, str, float]] = []
        self.requested = threading.Event()
        self.target = Bridge(lambda *message: self.published.append(message), self.set_control)

    def set_control(self, device: str, control: str, value: float) -> str:
        self.requests.append((device, control, value))
        self.requested.set()
        return ""

    def receive(self, name: str, kind: str, message: Any, stream: str = "") -> None:
        payload = message if isinstance(message, bytes) else codec.encode(message)
        self.target.on_device_message(topics.device("s", "a", name, kind, stream), payload)

    def describe(self, device: room.RoomDeviceManifest) -> None:
        description = Description(
            device=device.name, kind=device.kind, robot_type=device.kind, label=device.label, streams=device.streams,
            cameras=device.cameras, captures=device.captures, controls=device.controls,
        )  # fmt: skip
        self.receive(device.name, topics.DESC, description)

    def disconnect(self, agent: str) -> None:
        presence = Presence(online=False, session=1, at_ms=1)
        self.target.on_device_message(topics.conn("s", agent), codec.encode(presence))

    def announced(self) -> list[tuple[str, dict[str, Any]]]:
        return [(topic, json.loads(content)) for topic, content, _ in self.published if topic.endswith("/config")]

    def offline(self) -> list[str]:
        return [topic for topic, content, _ in self.published if content == b"offline"]


@pytest.fixture
def bridge() -> Iterator[RecordingBridge]:
    bridge = RecordingBridge()
    for device in LAB.devices:
        bridge.describe(device)
    yield bridge
    bridge.target.close()


def test_announcements_match_home_assistants_schema(bridge: RecordingBridge) -> None:
    for device in LAB.devices:
        values = VALUES | {control.name: 0.5 for control in device.controls}
        for stream in device.streams:
            bridge.receive(device.name, topics.TELE, measurements(values), stream.name)
    announced = bridge.announced()
    components = [topic.split("/")[1] for topic, _ in announced]
    assert not any("_bits" in topic for topic, _ in announced)
    assert set(components) == {"sensor", "binary_sensor", "number", "camera"}
    for component, (_, content) in zip(components, announced, strict=True):
        allowed = SCHEMA["keys"][component]
        assert {key for key, required in allowed.items() if required} <= set(content) <= set(allowed)
        kind = content.get("device_class")
        if component == "sensor" and kind is not None:
            assert content["unit_of_measurement"] in SCHEMA["sensor_units"][kind]
        if component == "binary_sensor" and kind is not None:
            assert kind in SCHEMA["binary_sensor_classes"]
        if component == "number":
            assert content["min"] < content["max"]
            assert content["step"] >= 0.001
    assert len({content["unique_id"] for _, content in announced}) == len(announced)
    assert len({topic for topic, _ in announced}) == len(announced)


def test_announcements_are_retained_and_repeated_when_home_assistant_restarts(bridge: RecordingBridge) -> None:
    announced = bridge.announced()
    for device in LAB.devices:
        bridge.describe(device)
    assert bridge.announced() == announced
    bridge.target.announce_all()
    assert len(bridge.announced()) == 2 * len(announced)
    assert all(retained for topic, _, retained in bridge.published if topic.endswith(("/config", "/available")))


def test_a_control_is_announced_as_number_only(bridge: RecordingBridge) -> None:
    bridge.receive("door", topics.TELE, measurements({"opening": 0.5}), "settings")
    announced = [topic for topic, _ in bridge.announced() if "/a-door/" in topic]
    assert announced == ["homeassistant/number/a-door/set-opening/config"]


def test_measurements_and_frames_are_forwarded_unchanged(bridge: RecordingBridge) -> None:
    measured = measurements({"temperature_c": 20.5})
    bridge.receive("thermometer", topics.TELE, measured, "temperature")
    bridge.receive("camera", topics.CAM, camera_frames.encode(CameraFrame(1, 1, 4, 3, b"JPEG")), "colour")
    assert bridge.published[-2:] == [
        ("telescope/a-thermometer/tele/temperature", codec.encode(measured), False),
        ("telescope/a-camera/cam/colour", b"JPEG", False),
    ]


def test_frames_that_are_no_pictures_are_neither_announced_nor_forwarded(bridge: RecordingBridge) -> None:
    assert not [topic for topic, _ in bridge.announced() if "/a-depth/" in topic or "cam-scan" in topic]
    published = list(bridge.published)
    for device, kind in (("depth", "depth"), ("depth", "people"), ("lidar", "scan")):
        bridge.receive(device, topics.CAM, camera_frames.encode(CameraFrame(1, 1, 4, 3, b"{}", kind)), kind)
    assert bridge.published == published


def test_robots_and_invalid_messages_are_ignored(bridge: RecordingBridge) -> None:
    published = list(bridge.published)
    bridge.receive("arm", topics.TELE, measurements({"x": 1.0}), "joints")
    bridge.receive("arm", topics.DESC, Description(device="arm", kind="arm", robot_type="ur5", label="Arm"))
    bridge.receive("camera", topics.CAM, b"no picture", "colour")
    bridge.target.on_device_message("nonsense", b"")
    assert bridge.published == published


def test_an_offline_agent_makes_its_devices_unavailable(bridge: RecordingBridge) -> None:
    bridge.disconnect("a")
    bridge.disconnect("other")
    pictures = {device.name for device in LAB.devices for camera in device.cameras if camera.kind == "colour"}
    expected = [device.name for device in LAB.devices if device.streams or device.controls or device.name in pictures]
    assert sorted(bridge.offline()) == sorted(f"telescope/a-{name}/available" for name in expected)


@pytest.mark.parametrize(
    ("topic", "content"),
    [
        ("telescope/a-door/set/opening", b"nan"),
        ("telescope/a-door/set/opening", b"1.5"),
        ("telescope/a-door/set/opening", b"open"),
        ("telescope/a-door/set/colour", b"0.5"),
        ("telescope/a-unknown/set/opening", b"0.5"),
        ("telescope/a-door/available", b"0.5"),
    ],
)
def test_only_valid_commands_set_a_control(bridge: RecordingBridge, topic: str, content: bytes) -> None:
    bridge.target.on_command(topic, content)
    bridge.target.on_command("telescope/a-door/set/opening", b"0.5")
    assert bridge.requested.wait(10)
    assert bridge.requests == [("a-door", "opening", 0.5)]


def test_a_control_without_settings_stream_has_no_state() -> None:
    description = Description(
        device="x", kind="x", robot_type="x", label="X", controls=(Control(name="a", label="A", lower=0.0, upper=0.01),)
    )
    (number,) = discovery.announce_device("a-x", description)
    assert "state_topic" not in number.content
    assert number.content["step"] == 0.001
