"""Fixtures of the runtime's tests."""

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from device_agent.runtime.commands import command_processor
from device_agent.runtime.control import control_loop
from device_agent.runtime.room import sensor_loop
from device_agent.runtime.telemetry import device_publisher
from tests.harness.agent.device_harness import DeviceHarness

MakeDevice = Callable[..., DeviceHarness]


@pytest.fixture(autouse=True)
def short_periods(monkeypatch: pytest.MonkeyPatch) -> None:
    """Shorten the periods of reconnections, states and faults."""
    for module, name in (
        (control_loop, "_RECONNECT_PERIOD_S"),
        (sensor_loop, "_RECONNECT_PERIOD_S"),
        (device_publisher, "STATE_MIN_GAP_S"),
        (command_processor, "FAULT_STABLE_S"),
    ):
        monkeypatch.setattr(module, name, 0.05)


@pytest.fixture
def make_device(tmp_path: Path) -> Iterator[MakeDevice]:
    """Starts and connects devices; another call restarts the device."""
    harnesses: list[DeviceHarness] = []

    def make(**parts: Any) -> DeviceHarness:
        harnesses.append(DeviceHarness(tmp_path, **parts))
        harnesses[-1].start()
        return harnesses[-1]

    yield make
    for harness in harnesses:
        harness.stop()


@pytest.fixture
def harness(make_device: MakeDevice) -> DeviceHarness:
    """A running, connected device."""
    return make_device()
