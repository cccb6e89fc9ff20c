"""What a source requested before limits, and which telemetry an operator had seen, as recordings contain it."""

import numpy as np

from device_agent.protocol import DriveTarget, JogTarget, JointTarget
from device_agent.runtime.control.command_arbiter import ControlOutput
from device_agent.runtime.planning.trajectory import Trajectory
from tests.fakes.drivers import BASE, PERIOD_S
from tests.harness.agent.controller_fixture import ControllerFixture, Wall, leased


class JogWall(Wall):
    """A wall far away, and a frame that a jog moves with the elbow."""

    frames = ("hand",)

    def rates(self, *_: object, **__: object) -> tuple[float, ...]:
        return (0.0, 0.1)


def newest(fixture: ControllerFixture) -> ControlOutput:
    fixture.run(PERIOD_S)
    return fixture.outputs[-1]


def test_a_setpoint_beyond_the_range_is_shown_as_requested() -> None:
    fixture = leased()
    assert tuple(newest(fixture).requested_rad) == ()
    fixture.offer(1, 4.0, age_ms=20)
    tick_ms = fixture.tick_ms
    output = newest(fixture)
    assert tuple(output.requested_rad) == (0.0, 4.0)
    assert "elbow: range" in output.limited
    assert output.seen_tick_ms == tick_ms - 20


def test_joints_that_a_setpoint_does_not_name_are_requested_where_they_are_held() -> None:
    fixture = leased()
    fixture.offer(1, JointTarget(position_rad={"shoulder": 0.5}))
    newest(fixture)
    fixture.offer(1, 1.0)
    assert tuple(newest(fixture).requested_rad) == (0.5, 1.0)


def test_a_jog_requests_no_positions() -> None:
    fixture = leased(geometry=JogWall(at_rad=100.0))
    fixture.offer(1, 1.0)
    newest(fixture)
    fixture.offer(1, JogTarget(linear_m_s=(0.1, 0.0, 0.0)))
    assert tuple(newest(fixture).requested_rad) == ()


def test_driving_keeps_the_request_for_the_joints() -> None:
    fixture = ControllerFixture(base=BASE)
    fixture.grant(1)
    fixture.offer(1, 1.0)
    newest(fixture)
    fixture.offer(1, DriveTarget(forward_m_s=0.1))
    assert tuple(newest(fixture).requested_rad) == (0.0, 1.0)


def test_the_final_position_of_a_goal_is_requested() -> None:
    fixture = leased()
    fixture.move(elbow=0.5)
    assert tuple(newest(fixture).requested_rad) == (0.0, 0.5)
    fixture.at_rest_after(5.0)
    fixture.run(PERIOD_S)
    position = fixture.controller.commanded_rad
    path = np.array([position, [position[0], 0.5001], [position[0], 0.5002]])
    rest = np.zeros_like(path)
    fixture.controller.start_trajectory(fixture.reservation, Trajectory(PERIOD_S, path, rest, rest))
    assert tuple(newest(fixture).requested_rad) == (position[0], 0.5002)


def test_a_new_operator_has_requested_nothing() -> None:
    fixture = leased()
    fixture.offer(1, 1.0)
    newest(fixture)
    fixture.grant(2)
    output = newest(fixture)
    assert (tuple(output.requested_rad), output.seen_tick_ms) == ((), 0)
