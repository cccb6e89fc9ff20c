"""What Home Assistant is told, held to what its own package takes; and what is carried in both directions."""

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

OWN: dict[str, Any] = json.loads((Path(__file__).parent / "home_assistant.json").read_text())
LAB = room.load(Path(ROOT) / "robots" / "rooms" / "lab")
VALUES: dict[str, float | bool] = {
    "temperature_c": 20.5,
    "humidity_percent": 40.0,
    "co2_ppm": 600.0,
    "light_lux": 300.0,
    "sound_db": 40.0,
    "range_m.3": 2.0,
    "people": 1.0,
    "present": True,
    "open": False,
    "seen.door": True,
    "taken_bits.3": 1024.0,
}


def described(device: room.RoomDeviceManifest) -> Description:
    return Description(
        device=device.name,
        kind=device.kind,
        robot_type=device.kind,
        label=device.label,
        streams=device.streams,
        cameras=device.cameras,
        captures=device.captures,
        controls=device.controls,
    )


class Both:
    """A bridge between two lists."""

    def __init__(self) -> None:
        self.said: list[tuple[str, bytes, bool]] = []
        self.orders: list[tuple[str, str, float]] = []
        self.ordered = threading.Event()
        self.bridge = Bridge(lambda *said: self.said.append(said), self.order)

    def order(self, device: str, control: str, value: float) -> str:
        self.orders.append((device, control, value))
        self.ordered.set()
        return ""

    def hear(self, name: str, kind: str, message: Any, stream: str = "") -> None:
        payload = message if isinstance(message, bytes) else codec.encode(message)
        self.bridge.hear(topics.device("s", "a", name, kind, stream), payload)

    def announced(self) -> list[tuple[str, dict[str, Any]]]:
        return [(topic, json.loads(content)) for topic, content, _ in self.said if topic.endswith("/config")]


@pytest.fixture
def both() -> Iterator[Both]:
    both = Both()
    for device in LAB.devices:
        both.hear(device.name, topics.DESC, described(device))
    yield both
    both.bridge.close()


def test_every_announcement_is_one_that_home_assistant_takes(both: Both) -> None:
    for device in LAB.devices:
        for stream in device.streams:
            values = VALUES | {control.name: 0.5 for control in device.controls}
            both.hear(
                device.name, topics.TELE, Measurements(tick_ms=1, at_ms=1, sequence=1, values=values), stream.name
            )
    announced = both.announced()
    components = [topic.split("/")[1] for topic, _ in announced]
    assert not any("_bits" in topic for topic, _ in announced), "that is for programs"
    assert set(components) == {"sensor", "binary_sensor", "number", "camera"}
    for component, (_, content) in zip(components, announced, strict=True):
        allowed = OWN["keys"][component]
        assert set(content) <= set(allowed)
        assert {key for key, required in allowed.items() if required} <= set(content)
        kind = content.get("device_class")
        if component == "sensor" and kind is not None:
            assert content["unit_of_measurement"] in OWN["sensor_units"][kind]
        if component == "binary_sensor" and kind is not None:
            assert kind in OWN["binary_sensor_classes"]
        if component == "number":
            assert content["min"] < content["max"]
            assert content["step"] >= 0.001
    assert len({content["unique_id"] for _, content in announced}) == len(announced)
    assert len({topic for topic, _ in announced}) == len(announced)


def test_it_is_announced_once_retained_and_again_when_home_assistant_starts(both: Both) -> None:
    before = len(both.announced())
    for device in LAB.devices:
        both.hear(device.name, topics.DESC, described(device))
    assert len(both.announced()) == before
    both.bridge.again()
    assert len(both.announced()) == 2 * before
    assert all(retained for topic, _, retained in both.said if topic.endswith(("/config", "/available")))


def test_a_control_is_a_slider_and_its_value_no_second_sensor(both: Both) -> None:
    both.hear("door", topics.TELE, Measurements(tick_ms=1, at_ms=1, sequence=1, values={"opening": 0.5}), "settings")
    own = [topic for topic, _ in both.announced() if "/a-door/" in topic]
    assert own == ["homeassistant/number/a-door/set-opening/config"]


def test_measurements_and_pictures_are_carried_as_they_are(both: Both) -> None:
    measured = Measurements(tick_ms=1, at_ms=1, sequence=1, values={"temperature_c": 20.5})
    both.hear("thermometer", topics.TELE, measured, "temperature")
    assert both.said[-1] == ("telescope/a-thermometer/tele/temperature", codec.encode(measured), False)
    both.hear("camera", topics.CAM, camera_frames.encode(CameraFrame(1, 1, 4, 3, b"JPEG")), "colour")
    assert both.said[-1] == ("telescope/a-camera/cam/colour", b"JPEG", False)


def test_robots_and_strangers_are_left_out(both: Both) -> None:
    before = len(both.said)
    both.hear("thing", topics.TELE, Measurements(tick_ms=1, at_ms=1, sequence=1, values={"x": 1.0}), "joints")
    both.hear("thing", topics.DESC, Description(device="thing", kind="arm", robot_type="ur5", label="Arm"))
    both.hear("camera", topics.CAM, b"no picture", "colour")
    both.bridge.hear("nonsense", b"")
    assert len(both.said) == before


def test_who_is_gone_is_shown_as_gone(both: Both) -> None:
    both.bridge.hear(topics.conn("s", "a"), codec.encode(Presence(online=False, session=1, at_ms=1)))
    gone = {topic for topic, content, _ in both.said if content == b"offline"}
    shown = [device for device in LAB.devices if device.streams or device.controls or device.cameras]
    assert gone == {f"telescope/a-{device.name}/available" for device in shown}
    both.bridge.hear(topics.conn("s", "other"), codec.encode(Presence(online=False, session=1, at_ms=1)))
    assert len([1 for _, content, _ in both.said if content == b"offline"]) == len(gone)


@pytest.mark.parametrize(
    ("topic", "content"),
    [
        ("telescope/a-door/set/opening", b"nan"),
        ("telescope/a-door/set/opening", b"1.5"),
        ("telescope/a-door/set/opening", b"open"),
        ("telescope/a-door/set/colour", b"0.5"),
        ("telescope/a-nobody/set/opening", b"0.5"),
        ("telescope/a-door/available", b"0.5"),
    ],
)
def test_a_slider_sets_its_control_and_nothing_else_does(both: Both, topic: str, content: bytes) -> None:
    both.bridge.told(topic, content)
    both.bridge.told("telescope/a-door/set/opening", b"0.5")
    assert both.ordered.wait(10)
    assert both.orders == [("a-door", "opening", 0.5)]


def test_a_control_without_a_stream_that_shows_it_has_no_state() -> None:
    about = Description(
        device="x", kind="x", robot_type="x", label="X", controls=(Control(name="a", label="A", lower=0.0, upper=0.01),)
    )
    (number,) = discovery.of_device("a-x", about)
    assert "state_topic" not in number.content
    assert number.content["step"] == 0.001
