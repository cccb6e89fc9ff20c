"""Joint couplings: no command leaves the range that depends on another joint."""

import math
from collections.abc import Mapping
from contextlib import suppress

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from device_agent.protocol import JointTarget, Setpoint, StopLatch
from device_agent.runtime.authority.lease_gate import LeaseGate
from device_agent.runtime.control.controller import Controller
from device_agent.runtime.control.goals import GoalResult
from device_agent.runtime.control.joint_motion import JointMotion
from device_agent.runtime.control.limits import MotionLimits
from device_agent.runtime.errors import Refused
from device_agent.runtime.planning.joint_couplings import Couplings
from tests.fakes.head_driver import BENT, FACTOR, PERIOD_S, RANGES, SPEED, WIDE, head

ENDS_RAD = 1e-8 + 1e-12
"""How far beyond a limit a command may be, and rounding. A target is never beyond; but ``ruckig`` integrates its phases
from the present state, and takes the result for good if it ends within 1e-8 of the target (``p_precision`` in its
``profile.hpp``). Each plan ends so near to its own target, so nothing adds up: in 4575 random lives 156 periods were
beyond, by 9.7e-9 at most: less than a millionth of a degree, which drivers clamp away."""


class Neck:
    """A controller whose every command is looked at."""

    def __init__(self, table: tuple[tuple[float, float, float], ...] = WIDE, start: tuple[float, ...] = (0.0,) * 4):
        self.kind = head(table)
        self.controller = Controller(self.kind, LeaseGate())
        self.controller.start_at(start)
        self.position = list(start)
        self.limited: set[str] = set()
        self.now_s, self.epoch, self.sequence = 100.0, 1, 0
        self.grant()

    def grant(self) -> None:
        self.epoch = max(self.controller.epochs) + 1
        self.controller.grant(epoch=self.epoch, holder="ann", lease_s=999.0, now_s=self.now_s)
        self.sequence = 0

    def offer(self, position_rad: Mapping[str, float]) -> None:
        self.sequence += 1
        tick_ms = round(self.now_s * 1000)
        target = JointTarget(position_rad=dict(position_rad))
        setpoint = Setpoint(
            epoch=self.epoch, sequence=self.sequence, echo_tick_ms=tick_ms - 20, sent_ms=0.0, target=target
        )
        self.controller.accept_setpoint(setpoint, now_s=self.now_s, tick_ms=tick_ms)

    def tick(self, late_s: float = 0.0) -> None:
        self.now_s += PERIOD_S + late_s
        tick = self.controller.update(self.now_s)
        self.limited |= set(tick.limited)
        yaw, pitch, left, right = tick.position_rad
        lower, upper = self.kind.position_dependent_limits[0].at(yaw)
        assert lower <= pitch <= upper, f"pitch {pitch} at yaw {yaw}"
        assert right == left * FACTOR
        for (low, high), now, before in zip(RANGES, tick.position_rad, self.position, strict=True):
            assert low - ENDS_RAD <= now <= high + ENDS_RAD
            assert abs(now - before) <= SPEED * PERIOD_S * 1.001, "it jumped"
        self.position = tick.position_rad

    def stream(self, seconds: float, **position_rad: float) -> None:
        for _ in range(round(seconds / PERIOD_S)):
            self.offer(position_rad)
            self.tick()

    def move(self, seconds: float = 5.0, **position_rad: float) -> GoalResult | None:
        reservation = self.controller.reserve(epoch=self.epoch, on_revoked=lambda _: None)
        move = self.controller.start_joint_goal(reservation, position_rad, speed=1.0)
        for _ in range(round(seconds / PERIOD_S)):
            if not move.finished.is_set():
                self.tick()
        self.limited |= set(move.limited)
        self.controller.end_reservation(reservation)
        return move.result


asked = st.fixed_dictionaries(
    {},
    optional={
        "yaw": st.floats(-3, 3),
        "pitch": st.floats(-1, 1),
        "left": st.floats(-2, 2),
        "right": st.floats(-2, 2),
    },
)
acts = st.lists(
    st.tuples(
        st.sampled_from(("stream", "stream", "move", "stop", "silence", "late")),
        asked,
        st.integers(1, 40),
    ),
    min_size=2,
    max_size=14,
)


def live(neck: Neck, life: list[tuple[str, dict[str, float], int]]) -> None:
    for act, position_rad, periods in life:
        match act:
            case "stop":
                neck.controller.stop(StopLatch(caller="bob", reason="", at_ms=0))
            case "move":
                reservation = neck.controller.reserve(epoch=neck.epoch, on_revoked=lambda _: None)
                with suppress(Refused):
                    neck.controller.start_joint_goal(reservation, position_rad, speed=1.0)
                for _ in range(periods):
                    neck.tick()
                neck.controller.end_reservation(reservation)
        for number in range(periods):
            if act == "stream" and position_rad:
                with suppress(Refused):  # the watchdog may have ended the lease, where periods came late
                    neck.offer(position_rad)
            neck.tick(late_s=PERIOD_S * (number % 3) if act == "late" else 0.0)
        if neck.controller.latch is not None:
            neck.controller.reset_stop(epoch=max(neck.controller.epochs) + 1)
        neck.grant()


@pytest.mark.parametrize("table", [WIDE, BENT], ids=["wide", "bent"])
@settings(max_examples=30, deadline=None)
@given(life=acts)
def test_no_command_leaves_the_dependent_range(
    table: tuple[tuple[float, float, float], ...], life: list[tuple[str, dict[str, float], int]]
) -> None:
    live(Neck(table), life)


@pytest.mark.long
@pytest.mark.parametrize("table", [WIDE, BENT], ids=["wide", "bent"])
@settings(max_examples=3000, deadline=None)
@given(life=acts)
def test_no_command_leaves_the_dependent_range_in_thousands_of_runs(
    table: tuple[tuple[float, float, float], ...], life: list[tuple[str, dict[str, float], int]]
) -> None:
    live(Neck(table), life)


@pytest.mark.parametrize("table", [WIDE, BENT], ids=["wide", "bent"])
def test_coupled_joints_arrive_from_corner_to_corner(table: tuple[tuple[float, float, float], ...]) -> None:
    neck = Neck(table)
    narrowing = neck.kind.position_dependent_limits[0]
    for yaw in (2.0, -2.0, 0.0, 2.0):
        for edge in narrowing.at(yaw):
            assert neck.move(yaw=yaw, pitch=edge) is GoalResult.REACHED
            assert neck.position[:2] == pytest.approx([yaw, edge], abs=2e-4)


def test_a_setpoint_is_clamped_to_the_dependent_range_and_reported() -> None:
    neck = Neck()
    neck.stream(3.0, yaw=2.0, pitch=0.5)
    assert neck.position[:2] == pytest.approx([2.0, 0.1], abs=1e-3)
    assert "pitch: range at yaw" in neck.limited


def test_a_joint_waits_for_the_coupled_joint() -> None:
    neck = Neck()
    assert neck.move(pitch=0.5) is GoalResult.REACHED
    assert neck.move(yaw=2.0) is GoalResult.REACHED
    assert neck.position[1] == pytest.approx(0.1, abs=1e-3)
    assert "yaw: waits for pitch" in neck.limited


def test_a_goal_outside_the_dependent_range_is_rejected() -> None:
    neck = Neck()
    with pytest.raises(
        Refused, match=r"pitch can go from -0\.4000 to 0\.1000 rad at the target of yaw, not to 0\.3000"
    ):
        neck.move(yaw=2.0, pitch=0.3)


def test_either_joint_of_a_mimic_pair_moves_both() -> None:
    neck = Neck()
    assert neck.move(left=-0.4) is GoalResult.REACHED
    assert neck.position[3] == pytest.approx(0.2, abs=2e-4)
    assert neck.move(right=0.1) is GoalResult.REACHED
    assert neck.position[2] == pytest.approx(-0.2, abs=2e-4)
    assert neck.move(left=-0.4, right=0.2) is GoalResult.REACHED


def test_contradictory_mimic_positions_are_rejected() -> None:
    neck = Neck()
    with pytest.raises(Refused, match="one motor moves right and another joint"):
        neck.move(left=-0.4, right=-0.4)
    neck.grant()
    neck.stream(2.0, left=-0.4, right=0.0)
    assert neck.position[2:] == pytest.approx([-0.4, 0.2], abs=1e-3)
    assert "right: mirror" in neck.limited


def test_a_joint_outside_its_range_returns_and_never_moves_further_out() -> None:
    neck = Neck(start=(2.0, 0.4, 0.0, 0.0))
    farthest = 0.4
    for _ in range(100):
        neck.offer({"yaw": 2.0, "pitch": 0.5})
        neck.now_s += PERIOD_S
        pitch = neck.controller.update(neck.now_s).position_rad[1]
        assert pitch <= farthest + 1e-9
        farthest = pitch
    assert farthest == pytest.approx(0.1, abs=1e-3)


def test_a_command_beyond_the_range_is_clamped_to_its_edge() -> None:
    """Commands from any source are clamped."""
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
    ("places", "says"),
    [
        ([[0.0, 0.0, -0.4, 0.2], [2.0, 0.1, 0.0, 0.0]], ""),
        ([[0.0, 0.0, -0.4, 0.2], [2.0, 0.2, 0.0, 0.0]], "leads pitch where yaw does not allow it"),
        ([[0.0, 0.0, -0.4, 0.2], [2.0, 0.1, 0.0, 0.1]], "separates right from left, which the same motor moves"),
    ],
)
def test_a_trajectory_that_violates_couplings_is_rejected(places: list[list[float]], says: str) -> None:
    limits = MotionLimits(head(), None)
    if says:
        with pytest.raises(Refused, match=says):
            limits.check_trajectory(np.array(places))
    else:
        limits.check_trajectory(np.array(places))


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
