"""Drivers with one defect each, and the contract suite for each of them. ``test_planted_defects`` runs this file.

``caught_by`` is the test of the suite that must fail.
"""

import math
import threading
import time
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, ClassVar

import pytest

from device_agent.drivers.ros.joint_commands import JointCommands
from device_agent.drivers.testing.template.base_driver import TemplateBaseDriver
from device_agent.drivers.testing.template.connection import Measurement
from device_agent.drivers.testing.template.driver import TemplateDriver
from device_agent.drivers.testing.template.test_driver import TestTemplateDriver as TemplateContract
from device_agent.ports.driver import DriverFault, Observation, UnreachableError
from device_agent.ports.threads import SupervisedThread
from tests.contract.drivers.ros.test_contract import TestRos1Arm as RosContract


def assert_never_set(event: threading.Event) -> None:
    assert event.wait()


class NoWatchdog(TemplateBaseDriver):
    def __init__(self, *args: Any) -> None:
        super().__init__(*args)
        self._watchdog.feed = lambda: None  # type: ignore[method-assign]


class WrongUnits(TemplateDriver):
    def observe(self) -> Observation:
        observation = super().observe()
        return replace(observation, position_rad=tuple(map(math.degrees, observation.position_rad)))


class SwallowedError(TemplateDriver):
    def send(self, position_rad: Sequence[float]) -> tuple[float, ...]:
        try:
            return super().send(position_rad)
        except UnreachableError:
            return tuple(position_rad)


class BlockedThread(TemplateDriver):
    """Waits for the next message."""

    def observe(self) -> Observation:
        connection = self._connected()
        last = connection.measurement
        while connection.measurement is last:
            time.sleep(0.001)
        return super().observe()


class LeakedThread(TemplateDriver):
    def connect(self) -> None:
        super().connect()
        SupervisedThread(lambda: assert_never_set(threading.Event()), name="leaked", part="leaked").start()


class UnsupervisedThread(TemplateDriver):
    def connect(self) -> None:
        super().connect()
        thread = threading.Thread(target=self._connected()._closed.wait, name="unsupervised", daemon=True)
        thread.start()


class NanPassedThrough(TemplateDriver):
    """Replaces the values of messages that the connection rejects."""

    def connect(self) -> None:
        super().connect()
        connection = self._connected()
        accept = connection._accept

        def accept_all(line: bytes) -> None:
            accept(line)
            if b"NaN" in line:
                values = (math.nan,) * len(self._names)
                connection.newest = replace(connection.measurement, position_rad=values, at_s=time.monotonic())

        connection._accept = accept_all  # type: ignore[method-assign]


class WrongJointOrder(TemplateDriver):
    """Expects the joints in the order of the robot type."""

    def connect(self) -> None:
        super().connect()
        connection = self._connected()
        parse = connection._parse

        def parse_unnamed(message: dict[str, Any]) -> Measurement:
            return parse(message | {"names": self._names})

        connection._parse = parse_unnamed  # type: ignore[method-assign, assignment]


class WrongSimulated(TemplateDriver):
    @property
    def simulated(self) -> bool:
        return True


class RequestedInsteadOfApplied(TemplateDriver):
    def send(self, position_rad: Sequence[float]) -> tuple[float, ...]:
        super().send(position_rad)
        return tuple(position_rad)


class IgnoredProtectiveStop(TemplateDriver):
    def faults(self) -> tuple[DriverFault, ...]:
        return ()


class StaleTimestamps(TemplateDriver):
    """Takes every measurement as new."""

    def observe(self) -> Observation:
        return replace(super().observe(), at_s=time.monotonic())


class HealthyWhenDisconnected(TemplateDriver):
    """Repeats the last measurement."""

    last: Observation | None = None

    def observe(self) -> Observation:
        try:
            self.last = super().observe()
        except UnreachableError:
            if self.last is None:
                raise
            self.last = replace(self.last, at_s=time.monotonic())
        return self.last


class NoReconnection(TemplateDriver):
    def connect(self) -> None:
        if self._connection is None:
            super().connect()


class RawError(TemplateDriver):
    """Raises errors of the network library."""

    def connect(self) -> None:
        try:
            super().connect()
        except UnreachableError as error:
            raise OSError(str(error)) from error


class Planted(TemplateContract):
    deadline_s = 3.0
    caught_by: ClassVar[str]


class TestNoWatchdog(Planted):
    driver_class, type_name = NoWatchdog, "qbo"
    caught_by = "test_a_base_stops_without_commands_and_when_it_is_halted[False]"


class TestWrongUnits(Planted):
    driver_class = WrongUnits
    caught_by = "test_send_moves_the_joints_and_reconnecting_keeps_them"


class TestSwallowedError(Planted):
    driver_class = SwallowedError
    caught_by = "test_a_lost_device_is_reported_and_repeats_nothing_when_it_returns"


class TestBlockedThread(Planted):
    driver_class = BlockedThread
    caught_by = "test_invalid_and_outdated_messages_are_no_measurement[silence]"


class TestLeakedThread(Planted):
    driver_class = LeakedThread
    caught_by = "test_it_ends_all_its_threads"


class TestUnsupervisedThread(Planted):
    driver_class = UnsupervisedThread
    caught_by = "test_it_ends_all_its_threads"


class TestNanPassedThrough(Planted):
    driver_class = NanPassedThrough
    caught_by = "test_invalid_and_outdated_messages_are_no_measurement[nan]"


class TestWrongJointOrder(Planted):
    driver_class = WrongJointOrder
    caught_by = "test_joints_are_matched_by_name"


class TestWrongSimulated(Planted):
    driver_class = WrongSimulated
    caught_by = "test_it_tells_whether_it_is_simulated"


class TestRequestedInsteadOfApplied(Planted):
    driver_class = RequestedInsteadOfApplied
    caught_by = "test_send_returns_the_applied_values"


class TestIgnoredProtectiveStop(Planted):
    driver_class = IgnoredProtectiveStop
    caught_by = "test_a_device_that_stops_itself_is_reported_and_receives_no_commands"


class TestStaleTimestamps(Planted):
    driver_class = StaleTimestamps
    caught_by = "test_invalid_and_outdated_messages_are_no_measurement[clock]"


class TestHealthyWhenDisconnected(Planted):
    driver_class = HealthyWhenDisconnected
    caught_by = "test_a_lost_device_is_reported_and_repeats_nothing_when_it_returns"


class TestNoReconnection(Planted):
    driver_class = NoReconnection
    caught_by = "test_a_lost_device_is_reported_and_repeats_nothing_when_it_returns"


class TestRawError(Planted):
    driver_class = RawError
    caught_by = "test_a_missing_device_is_described_and_reported"


class TestLongerTrajectory(RosContract):
    """Each trajectory of the driver for ROS is longer by 0.5 s."""

    deadline_s = 3.0
    caught_by = "test_a_motion_ends_in_time_after_a_cut"

    @pytest.fixture(autouse=True)
    def _plant(self, monkeypatch: pytest.MonkeyPatch) -> None:
        request = JointCommands._request

        def longer(self: JointCommands, position_rad: Any, duration_s: float, **more: Any) -> Any:
            return request(self, position_rad, duration_s + 0.5, **more)

        monkeypatch.setattr(JointCommands, "_request", longer)
