"""Sensors of a room are monitored: limits of the room manifest, silent and stuck sensors."""

from collections.abc import Iterator
from pathlib import Path

import msgspec
import pytest

from device_agent.protocol import Description, Measurements, Mode, State, codec, topics
from device_agent.protocol.manifests import room
from device_agent.protocol.manifests.room import RoomDeviceManifest, Watch
from device_agent.runtime.commands import command_processor
from device_agent.runtime.room.room_device import RoomDevice
from device_agent.sensors.mujoco import scalar_sensors
from device_agent.simulation.room.climate import Climate
from device_agent.simulation.room.pedestrian import Pedestrian
from function_app.entrypoints.ingest.router import ingest, ingest_telemetry
from tests.fakes.agent import Robot
from tests.harness.agent.device_harness import DeviceHarness, eventually
from tests.harness.agent.rooms import LAB, ManualWorld
from tests.harness.cloud.cloud import Cloud, Person
from tests.unit.function_app.services.health.test_diagnostics import MINUTE, diagnostics, open_faults

pytestmark = pytest.mark.slow

WINDOW_S = 10.0
SPEEDUP = 20.0
"""Speed of the climate model relative to the room: one window takes 0.5 s of room time."""


class SimulatedAir:
    """Ingests the CO₂ measurements of a simulated laboratory with people, in accelerated time."""

    def __init__(self, cloud: Cloud, person: Person, robot: Robot, monkeypatch: pytest.MonkeyPatch) -> None:
        self.cloud, self.now_s = cloud, 0.0
        manifest = msgspec.structs.replace(room.load(LAB), robots=())
        self.world = ManualWorld(manifest=manifest)
        self.people: list[Pedestrian] = []
        self.world.add(Climate(manifest, self.world.world, self.people, speedup=SPEEDUP))
        monkeypatch.setattr(scalar_sensors, "time", self)
        self.meter = self.world.driver("co2")
        self.meter.connect()
        entry = self.world.entry("co2")
        claim(person, robot, entry)
        ingest_description(cloud, robot, entry)
        self._topic = topics.device(robot.space, robot.id, "co2", topics.TELE, "co2")
        self._at_ms = cloud.clock.now_ms()

    def monotonic(self) -> float:
        """The clock of the meter."""
        return self.now_s

    def live(self, minutes: int) -> None:
        messages = []
        for number in range(minutes * MINUTE):
            self.world.advance(WINDOW_S / SPEEDUP)
            self.cloud.clock.advance(WINDOW_S)
            self.now_s += WINDOW_S
            self._at_ms += round(WINDOW_S * 1000)
            values = dict(self.meter.read("co2"))
            message = Measurements(tick_ms=self._at_ms, at_ms=self._at_ms, sequence=number + 1, values=values)
            messages.append((self._topic, codec.encode(message)))
        self.cloud.run(ingest_telemetry(self.cloud.functions, messages))


def claim(person: Person, robot: Robot, entry: RoomDeviceManifest) -> None:
    devices = [{"name": entry.name, "kind": entry.kind, "robot_type": entry.kind, "label": entry.label}]
    person.post("/agents/claim", {"code": robot.enroll(devices=devices).json()["claim_code"]})
    robot.space = robot.enrollment()["space"]


def ingest_description(cloud: Cloud, robot: Robot, entry: RoomDeviceManifest) -> None:
    description = Description(
        device=entry.name, kind=entry.kind, robot_type=entry.kind, label=entry.label, diagnostics=entry.diagnostics
    )
    topic = topics.device(robot.space, robot.id, entry.name, topics.DESC)
    cloud.run(ingest(cloud.functions, topic, codec.encode(description)))


def test_people_in_a_closed_room_raise_a_co2_fault_that_an_open_door_clears(
    cloud: Cloud, monkeypatch: pytest.MonkeyPatch
) -> None:
    anna = cloud.sign_in("anna")
    with cloud.robot("co2") as robot:
        air = SimulatedAir(cloud, anna, robot, monkeypatch)
        air.live(30)
        assert open_faults(anna, robot) == [], "the room is empty"
        air.people += [Pedestrian(air.world.manifest.people[0]) for _ in range(12)]
        air.live(16)
        (warned,) = open_faults(anna, robot)
        assert (warned["code"], warned["severity"]) == ("co2.co2_ppm", "warning")
        assert warned["message"].startswith("CO₂ in the air is ")
        assert warned["message"].endswith(
            "Open the door or a window, or reduce the number of people. Below 400 ppm, calibrate the sensor."
        )
        air.live(60)
        anna = cloud.sign_in("anna")
        (fault,) = open_faults(anna, robot)
        assert (fault["id"], fault["kind"], fault["severity"], fault["limit"]) == (
            warned["id"],
            "level",
            "error",
            2000.0,
        )
        air.world.set("door", 1.5)
        air.people.clear()
        air.live(45)
        anna = cloud.sign_in("anna")
        assert open_faults(anna, robot) == []
        (shown,) = diagnostics(anna, robot)["fields"]
        assert (shown["warning_high"], shown["high"]) == (1000.0, 2000.0)


@pytest.fixture
def meter(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[DeviceHarness]:
    """The CO₂ meter of the laboratory, with a higher rate and shorter time limits."""
    monkeypatch.setattr(command_processor, "FAULT_STABLE_S", 0.05)
    world = ManualWorld(manifest=msgspec.structs.replace(room.load(LAB), robots=()))
    entry = world.entry("co2")
    (stream,) = entry.streams
    entry = msgspec.structs.replace(
        entry,
        streams=(msgspec.structs.replace(stream, rate_hz=50.0),),
        watch=(Watch(source="co2", silent_s=0.5, stuck_s=0.5),),
        options={"faults": str(tmp_path / "co2.toml")},
    )
    instrument = RoomDevice(world.driver(entry), entry, None)
    harness = DeviceHarness(tmp_path, driver=instrument, kind=entry.robot_type())  # type: ignore[arg-type]  # not a fake driver
    harness.device.start()
    harness.device.link_changed(True)
    yield harness
    harness.stop()


@pytest.mark.parametrize("fault_kind", ["silent", "stuck"])
def test_a_silent_or_stuck_sensor_raises_a_fault_in_state_and_cloud(
    cloud: Cloud, meter: DeviceHarness, tmp_path: Path, fault_kind: str
) -> None:
    anna = cloud.sign_in("anna")
    with cloud.robot("arm") as robot:
        claim(anna, robot, msgspec.structs.replace(room.load(LAB).devices[0], name="arm"))

        def ingest_state() -> State:
            """Ingest the newest state of the harness, which publishes at most one per second."""
            state: State = meter.published(topics.STATE, State)[-1]
            cloud.run(ingest(cloud.functions, robot.topic(topics.STATE), codec.encode(state)))
            return state

        eventually(lambda: meter.published(topics.TELE, Measurements, "co2") and meter.published(topics.STATE, State))
        assert ingest_state().faults == ()
        assert meter.published(topics.DESC, Description)[0].diagnostics[0].high == 2000.0
        (tmp_path / "co2.toml").write_text(f'{fault_kind} = ["co2"]')
        eventually(lambda: ingest_state().faults)
        assert ingest_state().mode is Mode.IDLE, "it remains usable"
        (fault,) = open_faults(anna, robot)
        assert (fault["code"], fault["severity"]) == (f"{fault_kind}.co2", "error")
        (tmp_path / "co2.toml").unlink()
        eventually(lambda: not ingest_state().faults)
        assert open_faults(anna, robot) == []
