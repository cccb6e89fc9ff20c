"""Joint couplings: no command leaves the range that depends on another joint."""

import math
from contextlib import nullcontext, suppress

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from device_agent.protocol import JointTarget
from device_agent.runtime.authority.lease_gate import LeaseGate
from device_agent.runtime.control.controller import Controller
from device_agent.runtime.control.goals import GoalResult
from device_agent.runtime.control.joint_motion import JointMotion
from device_agent.runtime.control.limits import MotionLimits
from device_agent.runtime.errors import Refused
from device_agent.runtime.planning.joint_couplings import Couplings
from tests.fakes.head_driver import BENT, FACTOR, PERIOD_S, RANGES, SPEED, WIDE, head
from tests.harness.agent.controller_fixture import ControllerFixture

ENDS_RAD = 1e-8 + 1e-12
"""Tolerance of the joints' ranges: ``ruckig`` accepts a profile that ends within 1e-8 of its target [rad]."""
Table = tuple[tuple[float, float, float], ...]
BOTH_TABLES = pytest.mark.parametrize("table", [WIDE, BENT], ids=["wide", "bent"])


class Neck(ControllerFixture):
    """A controller of a head whose every command is checked."""

    def __init__(self, table: Table = WIDE) -> None:
        super().__init__()
        self.kind = head(table)
        self.controller = Controller(self.kind, LeaseGate())
        self.position = [0.0] * 4
        self.controller.start_at(self.position)
        self.grant_next()

    def grant_next(self) -> None:
        self.epoch = max(self.controller.epochs) + 1
        self.grant(self.epoch, lease_s=999.0)

    def request(self, position_rad: dict[str, float]) -> None:
        self.offer(self.epoch, JointTarget(position_rad=position_rad))

    def tick(self, late_s: float = 0.0) -> None:
        self.now_s += PERIOD_S + late_s
        output = self.controller.update(self.now_s)
        self.limited |= set(output.limited)
        yaw, pitch, left, right = output.position_rad
        lower, upper = self.kind.position_dependent_limits[0].at(yaw)
        assert lower <= pitch <= upper, f"pitch {pitch} at yaw {yaw}"
        assert right == left * FACTOR
        for (low, high), now, before in zip(RANGES, output.position_rad, self.position, strict=True):
            assert low - ENDS_RAD <= now <= high + ENDS_RAD
            assert abs(now - before) <= SPEED * PERIOD_S * 1.001, "it jumped"
        self.position = output.position_rad

    def hold(self, seconds: float, **position_rad: float) -> None:
        for _ in range(round(seconds / PERIOD_S)):
            self.request(position_rad)
            self.tick()

    def reach(self, seconds: float = 5.0, **position_rad: float) -> GoalResult | None:
        reservation = self.reserve(self.epoch)
        move = self.controller.start_joint_goal(reservation, position_rad, speed=1.0)
        for _ in range(round(seconds / PERIOD_S)):
            if not move.finished.is_set():
                self.tick()
        self.limited |= set(move.limited)
        self.controller.end_reservation(reservation)
        return move.result


requests = st.fixed_dictionaries(
    {},
    optional={"yaw": st.floats(-3, 3), "pitch": st.floats(-1, 1), "left": st.floats(-2, 2), "right": st.floats(-2, 2)},
)
Events = list[tuple[str, dict[str, float], int]]
events = st.lists(
    st.tuples(st.sampled_from(("stream", "stream", "move", "stop", "silence", "late")), requests, st.integers(1, 40)),
    min_size=2,
    max_size=14,
)


def run(neck: Neck, events: Events) -> None:
    for event, position_rad, periods in events:
        if event == "stop":
            neck.stop()
        elif event == "move":
            reservation = neck.reserve(neck.epoch)
            with suppress(Refused):
                neck.controller.start_joint_goal(reservation, position_rad, speed=1.0)
            for _ in range(periods):
                neck.tick()
            neck.controller.end_reservation(reservation)
        for number in range(periods):
            if event == "stream" and position_rad:
                with suppress(Refused):  # the watchdog may have ended the lease
                    neck.request(position_rad)
            neck.tick(late_s=PERIOD_S * (number % 3) if event == "late" else 0.0)
        if neck.controller.latch is not None:
            neck.controller.reset_stop(epoch=max(neck.controller.epochs) + 1)
        neck.grant_next()


@pytest.mark.slow
@BOTH_TABLES
@settings(max_examples=30)
@given(events=events)
def test_no_command_leaves_the_dependent_range(table: Table, events: Events) -> None:
    run(Neck(table), events)


@pytest.mark.long
@BOTH_TABLES
@settings(max_examples=3000)
@given(events=events)
def test_no_command_leaves_the_dependent_range_in_thousands_of_runs(table: Table, events: Events) -> None:
    run(Neck(table), events)


@BOTH_TABLES
def test_coupled_joints_arrive_from_corner_to_corner(table: Table) -> None:
    neck = Neck(table)
    narrowing = neck.kind.position_dependent_limits[0]
    for yaw in (2.0, -2.0, 0.0, 2.0):
        for edge in narrowing.at(yaw):
            assert neck.reach(yaw=yaw, pitch=edge) is GoalResult.REACHED
            assert neck.position[:2] == pytest.approx([yaw, edge], abs=2e-4)


def test_a_joint_is_clamped_to_the_dependent_range_or_waits_and_it_is_reported() -> None:
    neck = Neck()
    neck.hold(3.0, yaw=2.0, pitch=0.5)
    assert neck.position[:2] == pytest.approx([2.0, 0.1], abs=1e-3)
    assert "pitch: range at yaw" in neck.limited
    with pytest.raises(
        Refused, match=r"pitch can go from -0\.4000 to 0\.1000 rad at the target of yaw, not to 0\.3000"
    ):
        neck.reach(yaw=2.0, pitch=0.3)
    neck = Neck()
    assert neck.reach(pitch=0.5) is GoalResult.REACHED
    assert neck.reach(yaw=2.0) is GoalResult.REACHED
    assert neck.position[1] == pytest.approx(0.1, abs=1e-3)
    assert "yaw: waits for pitch" in neck.limited


def test_either_joint_of_a_mimic_pair_moves_both_and_contradictions_are_rejected() -> None:
    neck = Neck()
    assert neck.reach(left=-0.4) is GoalResult.REACHED
    assert neck.position[3] == pytest.approx(0.2, abs=2e-4)
    assert neck.reach(right=0.1) is GoalResult.REACHED
    assert neck.position[2] == pytest.approx(-0.2, abs=2e-4)
    assert neck.reach(left=-0.4, right=0.2) is GoalResult.REACHED
    with pytest.raises(Refused, match="one motor moves right and another joint"):
        neck.reach(left=-0.4, right=-0.4)
    neck.grant_next()
    neck.hold(2.0, left=-0.4, right=0.0)
    assert neck.position[2:] == pytest.approx([-0.4, 0.2], abs=1e-3)
    assert "right: mirror" in neck.limited


def test_a_joint_outside_its_range_returns_and_never_moves_further_out() -> None:
    neck = Neck()
    neck.controller.start_at((2.0, 0.4, 0.0, 0.0))
    farthest = 0.4
    for _ in range(100):
        neck.request({"yaw": 2.0, "pitch": 0.5})
        neck.now_s += PERIOD_S
        pitch = neck.controller.update(neck.now_s).position_rad[1]
        assert pitch <= farthest + 1e-9
        farthest = pitch
    assert farthest == pytest.approx(0.1, abs=1e-3)


def test_a_command_beyond_the_range_is_clamped_to_its_edge() -> None:
    couplings = Couplings(head())
    position = [2.0, 0.3, 0.0, 0.0]
    couplings.clamp_to_range(position, [0.0, 0.3, 0.0, 0.0])
    assert position == [2.0, 0.1, 0.0, 0.0]
    outside = [1.0, 0.6, 0.0, 0.0]
    couplings.clamp_to_range(outside, [1.0, 0.55, 0.0, 0.0])
    assert outside[1] == 0.55


def test_a_joint_that_cannot_return_stays() -> None:
    heading, waits = Couplings(head(BENT)).limit_target(
        [2.0, 0.3, 0.0, 0.0], [-2.0, 0.3, 0.0, 0.0], [(-2.0, 2.0), (0.3, 0.3)]
    )
    assert heading[:2] == [-2.0, 0.3]
    assert waits == ("yaw: waits for pitch",)


@pytest.mark.parametrize(
    ("positions", "message"),
    [
        ([[0.0, 0.0, -0.4, 0.2], [2.0, 0.1, 0.0, 0.0]], ""),
        ([[0.0, 0.0, -0.4, 0.2], [2.0, 0.2, 0.0, 0.0]], "leads pitch where yaw does not allow it"),
        ([[0.0, 0.0, -0.4, 0.2], [2.0, 0.1, 0.0, 0.1]], "separates right from left, which the same motor moves"),
    ],
)
def test_a_trajectory_that_violates_couplings_is_rejected(positions: list[list[float]], message: str) -> None:
    with pytest.raises(Refused, match=message) if message else nullcontext():
        MotionLimits(head(), None).check_trajectory(np.array(positions))


def test_compliant_joints_track_the_measurement() -> None:
    motion = JointMotion(head())
    motion.start_at([0.0, 0.0, 0.0, 0.0])
    motion.track_measured({0: 0.8})
    motion.follow([1.5, 0.0, -0.3, 0.15])
    for _ in range(200):
        motion.propose()
        motion.update()
    assert motion.position_rad == pytest.approx([0.8, 0.0, -0.3, 0.15], abs=1e-3)
    assert motion.reached
    motion.track_measured({})
    motion.brake()
    assert motion.update()[0] == 0.8
    assert not math.isnan(motion.velocity_rad_s[0])
