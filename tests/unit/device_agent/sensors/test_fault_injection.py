"""Injected faults of simulated room devices."""

import contextlib
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace

import msgspec
import numpy as np
import pytest

from device_agent.ports.sensor import Camera, Image, Movable, RoomDriver, SensorError
from device_agent.protocol.errors import ProtocolError
from device_agent.protocol.manifests import room
from device_agent.sensors.mujoco import fault_injection, scalar_sensors
from device_agent.sensors.mujoco.fault_injection import NO_FAULTS, InjectedFaults, read
from tests.harness.agent.rooms import LAB, ManualWorld

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def world() -> ManualWorld:
    return ManualWorld(manifest=msgspec.structs.replace(room.load(LAB), robots=()))


@pytest.fixture
def file(tmp_path: Path) -> Path:
    return tmp_path / "faults.toml"


Connect = Callable[[str], RoomDriver]


@pytest.fixture
def connect(world: ManualWorld, file: Path) -> Iterator[Connect]:
    """Connects a device of the laboratory with the fault file."""
    with contextlib.ExitStack() as stack:

        def connect(name: str) -> RoomDriver:
            entry = world.entry(name)
            options = {**entry.options, "faults": str(file)}
            driver = world.driver(msgspec.structs.replace(entry, options=options))
            driver.connect()
            stack.callback(driver.close)
            return driver

        yield connect


def test_a_device_without_fault_file_is_unchanged(connect: Connect) -> None:
    co2, camera, door = connect("co2"), connect("camera"), connect("door")
    assert 500 < co2.read("co2")["co2_ppm"] < 800
    assert not isinstance(co2, Camera)
    assert isinstance(camera, Camera)
    assert camera.frame("colour") is not None
    assert isinstance(door, Movable)
    assert door.set("opening", 0.0) == 0.0
    door.hold()


def test_a_stuck_meter_repeats_its_value_until_the_file_is_removed(connect: Connect, file: Path) -> None:
    co2 = connect("co2")
    last = co2.read("co2")
    file.write_text('stuck = ["co2"]')
    assert [co2.read("co2") for _ in range(20)] == [last] * 20
    file.unlink()
    assert len({co2.read("co2")["co2_ppm"] for _ in range(20)}) > 3


def test_a_silent_stream_returns_nothing_but_rejects_unknown_names(connect: Connect, file: Path) -> None:
    pir = connect("pir")
    file.write_text('silent = ["motion"]')
    assert pir.read("motion") == {}
    with pytest.raises(SensorError, match="motion"):
        pir.read("nonsense")


def test_a_value_drifts_per_minute(connect: Connect, file: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    now_s = [1000.0]
    clock = SimpleNamespace(monotonic=lambda: now_s[0])
    monkeypatch.setattr(fault_injection, "time", clock)
    monkeypatch.setattr(scalar_sensors, "time", clock)
    co2 = connect("co2")
    before = np.mean([co2.read("co2")["co2_ppm"] for _ in range(50)])
    file.write_text("drift = { co2_ppm = 50.0 }")
    co2.read("co2")
    now_s[0] += 600.0
    after = np.mean([co2.read("co2")["co2_ppm"] for _ in range(50)])
    assert after - before == pytest.approx(500.0, abs=15.0)


def test_an_unreachable_device_fails_but_receives_hold(connect: Connect, file: Path) -> None:
    door = connect("door")
    file.write_text("unreachable = true")
    for call in (lambda: door.read("settings"), lambda: door.set("opening", 0.5), door.connect, door.raw):
        with pytest.raises(SensorError, match="'door' does not respond; check its power"):
            call()
    assert isinstance(door, Movable)
    door.hold()


def test_a_stuck_camera_repeats_its_frame_and_a_silent_one_has_none(connect: Connect, file: Path) -> None:
    camera = connect("camera")
    assert isinstance(camera, Camera)
    assert len({frame.content for _ in range(3) if (frame := camera.frame("colour"))}) == 3, "noise"
    image = camera.raw()
    file.write_text('stuck = ["colour"]')
    frames = [frame for _ in range(3) if (frame := camera.frame("colour"))]
    assert len({frame.content for frame in frames}) == 1
    assert len({frame.taken_s for frame in frames}) == 3, "timestamps are current"
    repeated = camera.raw()
    assert isinstance(image, Image)
    assert isinstance(repeated, Image)
    assert repeated.rgb is image.rgb
    file.write_text('silent = ["colour"]  # now')
    assert camera.frame("colour") is None
    with pytest.raises(SensorError, match="returns no data"):
        camera.raw()


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('stuck = ["nose"]', "no stream or camera 'nose'; valid names: co2, image"),
        ("broken = true", "unknown field `broken`; valid fields: unreachable, silent, stuck, drift"),
        ("silent = [", "valid fields: unreachable"),
    ],
)
def test_an_invalid_fault_file_is_rejected_with_valid_names(text: str, message: str) -> None:
    with pytest.raises(ProtocolError) as raised:
        read(text, ["co2", "image"])
    assert message in str(raised.value)
    assert read("", []) == NO_FAULTS == InjectedFaults()


def test_an_invalid_fault_path_is_rejected(world: ManualWorld) -> None:
    entry = msgspec.structs.replace(world.entry("pir"), options={"faults": 3})
    with pytest.raises(SensorError, match="path of a file"):
        world.driver(entry)
