"""Setpoints for a frame and for a base."""

import json
import math
from collections.abc import Callable
from contextlib import suppress

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from device_agent.geometry.mujoco_geometry import MujocoGeometry
from device_agent.protocol import DriveTarget, JogTarget, JointTarget, Mode, Setpoint, codec
from device_agent.protocol.errors import ProtocolError
from device_agent.protocol.manifests import robot_type
from device_agent.runtime.authority.lease_gate import LeaseGate
from device_agent.runtime.control.controller import Controller
from device_agent.runtime.errors import Refused
from tests.fakes.drivers import BASE, PERIOD_S
from tests.harness.agent.controller_fixture import ControllerFixture, Target, refuses
from tests.harness.paths import UR5

KIND = robot_type.load(UR5)
SHAPE = MujocoGeometry(KIND, UR5 / KIND.scene)
HOME = [KIND.home_rad[joint.name] for joint in KIND.joints]
AT_REST = pytest.approx((0.0, 0.0, 0.0), abs=1e-6)
LIMIT_RAD_S = 0.35 * 3.1416


class Jogger(ControllerFixture):
    """An operator with a joystick at a UR5, or a fake robot with a base."""

    def __init__(self, *, base: bool = False) -> None:
        super().__init__(base=BASE if base else None)
        if not base:
            self.controller = Controller(KIND, LeaseGate(), geometry=SHAPE)
            self.controller.start_at(HOME)
        self.grant(1)

    def hold(self, target: Target, seconds: float, *, age_ms: int = 20) -> None:
        self.stream(1, seconds, target, age_ms=age_ms)

    @property
    def positions(self) -> list[list[float]]:
        return [output.position_rad for output in self.outputs]

    @property
    def twists(self) -> list[tuple[float, ...]]:
        return [tuple(output.twist) for output in self.outputs]

    def flange(self) -> tuple[float, ...]:
        return SHAPE.poses(self.controller.commanded_rad)["flange"]


def test_a_jog_moves_the_frame_and_keeps_its_orientation() -> None:
    fixture = Jogger()
    begin = fixture.flange()
    fixture.hold(JogTarget(linear_m_s=(0.0, 0.1, 0.0)), 1.2)
    fixture.hold(JogTarget(), 0.3)
    end = fixture.flange()
    assert end[1] - begin[1] == pytest.approx(0.11, abs=0.02)
    assert math.dist((begin[0], begin[2]), (end[0], end[2])) < 0.004
    assert abs(sum(a * b for a, b in zip(begin[3:], end[3:], strict=True))) > math.cos(0.01)
    assert not fixture.controller.moving
    assert fixture.lease_epoch == 1, "a released joystick keeps the lease"
    fixture.hold(JointTarget(position_rad={"wrist_3": 0.3}), 1.5)
    assert fixture.controller.commanded_rad[5] == pytest.approx(0.3, abs=1e-3)
    assert abs(fixture.controller.commanded_rad[0] - HOME[0]) > 0.02, "joint setpoints continue from there"


def test_a_tool_jog_uses_the_frames_axes() -> None:
    fixture = Jogger()
    begin = fixture.flange()
    fixture.hold(JogTarget(linear_m_s=(0.0, 0.0, 0.05), tool=True, frame="flange"), 0.8)
    fixture.hold(JogTarget(), 0.3)
    assert fixture.flange()[2] < begin[2] - 0.02, "the flange looks down"
    fixture.hold(JogTarget(angular_rad_s=(0.0, 0.0, 0.4)), 0.8)
    assert abs(sum(a * b for a, b in zip(begin[3:], fixture.flange()[3:], strict=True))) < math.cos(0.1)


def test_a_jog_that_stops_arriving_ends_the_lease() -> None:
    fixture = Jogger()
    fixture.hold(JogTarget(linear_m_s=(0.0, 0.1, 0.0)), 0.8)
    assert fixture.controller.moving
    fixture.run(0.31)
    assert not np.any(np.abs(np.subtract(fixture.positions[-1], fixture.positions[-2])) > 1e-9)
    with pytest.raises(Refused):
        fixture.hold(JogTarget(linear_m_s=(0.0, 0.1, 0.0)), 0.1)


@pytest.mark.slow
def test_a_jog_is_held_before_the_table_and_can_leave_it() -> None:
    fixture = Jogger()
    fixture.hold(JogTarget(linear_m_s=(0.0, 0.0, -0.4)), 4.0)
    assert any(one.startswith(("clearance", "workspace")) for one in fixture.limited)
    low = fixture.flange()[2]
    assert SHAPE.clearance(fixture.controller.commanded_rad).excess_m >= 0
    fixture.hold(JogTarget(linear_m_s=(0.0, 0.0, 0.2)), 0.8)
    assert fixture.flange()[2] > low + 0.03


@pytest.mark.slow
def test_a_jog_near_a_singularity_is_slow() -> None:
    fixture = Jogger()
    fixture.hold(JogTarget(linear_m_s=(-0.5, 0.0, 0.2)), 5.0)
    steps = np.abs(np.diff(fixture.positions, axis=0)) / PERIOD_S
    assert steps.max() <= LIMIT_RAD_S * 1.001
    assert "speed: joints" in fixture.limited


@pytest.mark.slow
@settings(max_examples=12)
@given(twists=st.lists(st.tuples(*[st.floats(-2, 2)] * 6, st.booleans()), min_size=1, max_size=4))
def test_random_jogs_stay_within_every_limit(twists: list[tuple[float, ...]]) -> None:
    fixture = Jogger()
    for x, y, z, a, b, c, tool in twists:
        fixture.hold(JogTarget(linear_m_s=(x, y, z), angular_rad_s=(a, b, c), tool=bool(tool)), 0.5)
    fixture.run(0.35)
    positions = np.array(fixture.positions)
    velocity = np.diff(positions, axis=0) / PERIOD_S
    assert np.abs(velocity).max() <= LIMIT_RAD_S * 1.01
    assert np.abs(np.diff(velocity, axis=0) / PERIOD_S).max() <= 21.0 + 0.1
    assert not fixture.controller.moving
    assert all(SHAPE.clearance(position).excess_m > -0.004 for position in positions[::10].tolist())


def test_a_base_drives_while_setpoints_are_fresh_and_no_longer() -> None:
    fixture = Jogger(base=True)
    fixture.hold(DriveTarget(forward_m_s=0.3, turn_rad_s=-0.4), 1.5)
    assert fixture.twists[-1] == pytest.approx((0.3, 0.0, -0.4), abs=1e-6)
    fixture.run(0.31)
    assert fixture.twists[-1] == AT_REST
    assert fixture.controller.mode is Mode.HOLDING
    with pytest.raises(Refused):
        fixture.hold(DriveTarget(forward_m_s=0.3), 0.1)


def test_a_zero_twist_brakes_and_keeps_the_lease() -> None:
    fixture = Jogger(base=True)
    fixture.hold(DriveTarget(forward_m_s=0.5, turn_rad_s=0.4), 1.5)
    fixture.hold(DriveTarget(), 0.25)  # half of the time that it would take at the acceleration of a start
    assert fixture.twists[-1] == AT_REST
    fixture.run(0.5)
    fixture.hold(DriveTarget(forward_m_s=0.3), 1.0)
    assert fixture.twists[-1] == pytest.approx((0.3, 0.0, 0.0), abs=1e-6)


def test_a_drive_setpoint_beyond_the_limits_is_clamped_and_reported() -> None:
    fixture = Jogger(base=True)
    fixture.hold(DriveTarget(forward_m_s=9.0, left_m_s=1.0), 1.5)
    assert fixture.twists[-1] == pytest.approx((0.5, 0.0, 0.0), abs=1e-6)
    assert {"forward_m_s: range", "left_m_s: range"} <= fixture.limited
    fixture.hold(DriveTarget(forward_m_s=0.5), 2.0, age_ms=160)
    assert fixture.twists[-1][0] < 0.4, "old telemetry slows it"


@pytest.mark.parametrize(
    ("interrupt", "mode"),
    [
        (lambda fixture: fixture.hold(JointTarget(position_rad={"elbow": 0.1}), 0.6), Mode.STREAMING),
        (ControllerFixture.reserve, Mode.ACTION),
        (ControllerFixture.stop, Mode.STOPPED),
    ],
)
def test_other_commands_brake_a_streamed_base_and_nothing_resumes(
    interrupt: Callable[[Jogger], object], mode: Mode
) -> None:
    fixture = Jogger(base=True)
    fixture.hold(DriveTarget(forward_m_s=0.3), 1.0)
    interrupt(fixture)
    fixture.run(0.2)
    assert fixture.controller.mode is mode
    assert fixture.twists[-1] == AT_REST
    fixture.controller.reset_stop(epoch=2)
    fixture.run(0.5)
    assert fixture.twists[-1] == AT_REST


@pytest.mark.parametrize(
    ("base", "target", "code"),
    [
        (False, DriveTarget(forward_m_s=0.1), "no_base"),
        (False, JogTarget(frame="foot"), "unknown_frame"),
        (False, JogTarget(linear_m_s=(math.nan, 0.0, 0.0)), "not_finite"),
        (False, JogTarget(angular_rad_s=(0.0, math.inf, 0.0)), "not_finite"),
        (True, DriveTarget(forward_m_s=-math.inf), "not_finite"),
        (True, JogTarget(linear_m_s=(0.1, 0.0, 0.0)), "no_model"),
    ],
)
def test_invalid_targets_are_rejected(base: bool, target: Target, code: str) -> None:
    with refuses(code):
        Jogger(base=base).hold(target, 0.03)


_INVALID_NUMBERS: st.SearchStrategy[object] = st.one_of(
    st.floats(),
    st.floats(-3, 3),
    st.integers(),
    st.sampled_from([None, True, "1", "NaN", [], [0.1], {}, 1e308, -1e308, 5e-324, -0.0]),
)


@pytest.mark.slow
@settings(max_examples=100)
@given(
    st.dictionaries(st.sampled_from([*DriveTarget.__struct_fields__, "up_m_s", ""]), _INVALID_NUMBERS),
    st.integers(0, 220),
)
def test_random_drive_messages_are_rejected_or_stay_within_limits(sent: dict[str, object], age_ms: int) -> None:
    target: object = {"kind": "drive"} | sent
    text = json.dumps({"epoch": 1, "sequence": 1, "echo_tick_ms": 1, "sent_ms": 1.0, "target": target})
    try:
        target = codec.decode(text.encode(), Setpoint).target
    except ProtocolError:
        assert any(name not in DriveTarget.__struct_fields__ or not _number(value) for name, value in sent.items())
        return
    assert isinstance(target, DriveTarget)
    assert all(math.isfinite(part) for part in (target.forward_m_s, target.left_m_s, target.turn_rad_s))
    fixture = Jogger(base=True)
    with suppress(Refused):
        fixture.hold(target, 0.4, age_ms=age_ms)
    fixture.run(0.31)
    limits = (BASE.max_linear_m_s, 0.0, BASE.max_angular_rad_s)
    assert all(abs(part) <= most + 1e-9 for twist in fixture.twists for part, most in zip(twist, limits, strict=True))
    assert fixture.twists[-1] == AT_REST
    assert age_ms <= 200 or not any(map(any, fixture.twists))


def _number(value: object) -> bool:
    """Whether JSON represents this as a finite number."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        return False
    try:
        return math.isfinite(float(value))
    except OverflowError:
        return False


@pytest.mark.parametrize("wrong", [b'{"kind":"jog","linear_m_s":[1,2]}', b'{"kind":"drive","forward_m_s":1e999}'])
def test_a_malformed_setpoint_does_not_pass_the_parser(wrong: bytes) -> None:
    setpoint = Setpoint(epoch=1, sequence=1, echo_tick_ms=1, sent_ms=1.0, target=JogTarget())
    text = msgspec.json.encode(setpoint)
    assert codec.decode(text, Setpoint) == setpoint
    with pytest.raises(ProtocolError):
        codec.decode(text.replace(msgspec.json.encode(setpoint.target), wrong), Setpoint)
