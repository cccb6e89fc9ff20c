"""The harness of a room device."""

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.unit.device_agent.runtime.room.room_device_fixture import RoomDeviceHarness

MakeRoomDevice = Callable[..., RoomDeviceHarness]


@pytest.fixture
def make_room_device(tmp_path: Path) -> Iterator[MakeRoomDevice]:
    harnesses: list[RoomDeviceHarness] = []

    def make(**parts: Any) -> RoomDeviceHarness:
        harnesses.append(RoomDeviceHarness(tmp_path, **parts))
        harnesses[-1].start()
        return harnesses[-1]

    yield make
    for harness in harnesses:
        harness.stop()


@pytest.fixture
def harness(make_room_device: MakeRoomDevice) -> RoomDeviceHarness:
    return make_room_device()
