"""A simulated robot of a load test follows the wire contract of an agent."""

import itertools
from typing import Any

import pytest

from device_agent.load_generator.kinematic_arm import DEVICE, SPEED_RAD_S, Arm, ArmType, robot_type
from device_agent.load_generator.robot import MAX_LOOP_AGE_S, WATCHDOG_S, SimulatedRobot
from device_agent.ports.clock import wall_ms
from device_agent.protocol import (
    Ack,
    AckStatus,
    CancelAction,
    Command,
    Description,
    Event,
    GrantLease,
    JogTarget,
    JointTarget,
    JointTelemetry,
    Mode,
    MoveJoints,
    ReleaseLease,
    RequestControl,
    ResetStop,
    Say,
    Setpoint,
    State,
    Stop,
    StopDevice,
    WithdrawRequest,
    codec,
    topics,
)
from device_agent.protocol.events import EventKind
from device_agent.protocol.security import setpoints, signing
from device_agent.runtime.control import setpoint_stream
from tests.harness.agent.pinned_keys import IDENTITY, pinned_keys_of

SPACE, AGENT = "space", "agent"
FAR = {"joint_1": 3.0}
MOVE = MoveJoints(position_rad=FAR, speed=1.0)
GRANT = GrantLease(holder="ann", lease_ms=1000)


class RobotFixture:
    """A robot, the cloud's key, a virtual clock, and all messages that the robot has sent."""

    def __init__(self) -> None:
        self.key = signing.generate()
        self.sent: list[tuple[str, bytes, int, bool]] = []
        self.now_s = 100.0
        self.cloud_ms: float | None = float(wall_ms())
        self._ids = itertools.count()
        self.robot = SimulatedRobot(
            (SPACE, AGENT),
            ArmType(robot_type("load-test-arm", 2, 5.0)),
            keys=pinned_keys_of(self.key),
            cloud_ms=lambda: self.cloud_ms,
            publish=self.publish,
            now_s=self.now_s,
        )

    def publish(self, topic: str, payload: bytes, *, qos: int, retain: bool = False) -> None:
        self.sent.append((topic, payload, qos, retain))

    def messages(self, kind: str, message: type[Any], name: str = "") -> list[Any]:
        expected = topics.device(SPACE, AGENT, DEVICE, kind, name)
        return [codec.decode(payload, message) for topic, payload, _, _ in self.sent if topic == expected]

    def receive(self, kind: str, payload: bytes, name: str = "") -> None:
        self.robot.receive(topics.device(SPACE, AGENT, DEVICE, kind, name), payload, self.now_s)

    def command(self, request: Any, *, epoch: int = 0, key: Any = None, **changes: Any) -> str:
        fields: dict[str, Any] = {
            "id": f"c{next(self._ids)}", "space": SPACE, "agent": AGENT, "device": DEVICE, "issued_at_ms": wall_ms(),
            "ttl_ms": 5000, "caller": "ann", "epoch": epoch, "request": request,
        }  # fmt: skip
        command = Command(**{**fields, **changes})
        self.receive(topics.CMD, signing.sign(codec.encode(command), key or self.key))
        return command.id

    def acquire(self, epoch: int = 1) -> None:
        assert (
            self.terminal_ack(self.command(GrantLease(holder="ann", lease_ms=60_000), epoch=epoch)).status
            is AckStatus.DONE
        )

    def send_joints(self, position_rad: float, *, epoch: int = 1, sequence: int = 1, age_ms: int = 0) -> None:
        self.send_setpoint(
            JointTarget(position_rad={"joint_1": position_rad}), epoch=epoch, sequence=sequence, age_ms=age_ms
        )

    def send_setpoint(
        self, target: Any, *, epoch: int = 1, sequence: int = 1, age_ms: int = 0, topic: str = ""
    ) -> None:
        tick_ms = round(self.now_s * 1000) - age_ms
        setpoint = Setpoint(epoch=epoch, sequence=sequence, echo_tick_ms=tick_ms, sent_ms=7.0, target=target)
        address = topics.device(SPACE, AGENT, DEVICE, topics.CTL, topic or str(epoch))
        key = setpoints.lease_key(self.key, IDENTITY.public_key(), topic=address, pairing="")
        self.receive(topics.CTL, setpoints.seal(codec.encode(setpoint), key, address), topic or str(epoch))

    def advance(self, seconds: float) -> JointTelemetry:
        self.now_s += seconds
        self.robot.tick(self.now_s)
        newest: JointTelemetry = self.messages(topics.TELE, JointTelemetry, topics.JOINTS)[-1]
        return newest

    def state(self) -> State:
        newest: State = self.messages(topics.STATE, State)[-1]
        return newest

    def acks(self, command: str) -> list[Ack]:
        acks = [ack for ack in self.messages(topics.ACK, Ack) if ack.id == command]
        assert [ack.sequence for ack in acks] == sorted({ack.sequence for ack in acks})
        return acks

    def terminal_ack(self, command: str) -> Ack:
        last = self.acks(command)[-1]
        assert last.status.terminal
        return last

    def reason_code(self, command: str) -> str:
        reason = self.terminal_ack(command).reason
        assert reason is not None
        return reason.code


@pytest.fixture
def fixture() -> RobotFixture:
    return RobotFixture()


def test_description_and_state_are_retained(fixture: RobotFixture) -> None:
    fixture.robot.on_connected(fixture.now_s)
    (description,) = fixture.messages(topics.DESC, Description)
    assert [joint.name for joint in description.joints] == ["joint_1", "joint_2"]
    assert (description.simulated, description.actions, description.streams[0].rate_hz) == (True, ("move_joints",), 5.0)
    assert (fixture.state().mode, fixture.state().epoch) == (Mode.IDLE, 0)
    assert {(qos, retain) for _, _, qos, retain in fixture.sent} == {(1, True)}


def test_state_is_sent_on_change_at_most_once_a_second_and_every_thirty_seconds(fixture: RobotFixture) -> None:
    def count_after(seconds: float) -> int:
        fixture.advance(seconds)
        return len(fixture.messages(topics.STATE, State))

    fixture.robot.on_connected(fixture.now_s)
    assert count_after(0.5) == 1
    fixture.acquire()
    assert [count_after(seconds) for seconds in (0.1, 0.5, 20, 11)] == [1, 2, 2, 3]
    assert fixture.state().lease.holder == "ann"  # type: ignore[union-attr]


def test_a_move_is_accepted_started_and_done_at_its_target(fixture: RobotFixture) -> None:
    fixture.acquire()
    move = fixture.command(MoveJoints(position_rad={"joint_1": 1.5}, speed=1.0), epoch=1)
    assert [ack.status for ack in fixture.acks(move)] == [AckStatus.RECEIVED, AckStatus.ACCEPTED, AckStatus.STARTED]
    telemetry = fixture.advance(0.5)
    assert telemetry.mode is Mode.ACTION
    assert telemetry.position_rad == pytest.approx((0.5 * SPEED_RAD_S, 0.0))
    fixture.advance(1.0)
    fixture.advance(0.1)
    ack = fixture.terminal_ack(move)
    assert (ack.status, ack.result) == (AckStatus.DONE, {"position_rad": {"joint_1": 1.5, "joint_2": 0.0}})
    assert fixture.advance(1.0).mode is Mode.IDLE


def test_a_repeated_command_is_acknowledged_again_but_not_executed(fixture: RobotFixture) -> None:
    fixture.acquire()
    move = fixture.command(MOVE, epoch=1, id="repeated")
    fixture.advance(5)
    last, acks = fixture.terminal_ack(move), fixture.messages(topics.ACK, Ack)
    fixture.command(MOVE, epoch=1, id="repeated")
    assert fixture.messages(topics.ACK, Ack) == [*acks, last]
    assert fixture.advance(1.0).mode is Mode.IDLE


@pytest.mark.parametrize(
    ("request_", "epoch", "code"),
    [
        (MOVE, 0, "stale_epoch"),
        (MoveJoints(position_rad={"joint_1": 99.0}), 1, "out_of_range"),
        (MoveJoints(position_rad={"tail": 1.0}), 1, "unknown_joint"),
        (Say(text="hello"), 1, "unsupported"),
        (CancelAction(action="nothing"), 1, "not_running"),
        (RequestControl(request="r", requester="bob", answer_within_ms=1000), 5, "no_lease"),
    ],
)
def test_invalid_commands_are_refused(fixture: RobotFixture, request_: Any, epoch: int, code: str) -> None:
    fixture.acquire()
    assert fixture.reason_code(fixture.command(request_, epoch=epoch)) == code
    assert fixture.advance(1.0).position_rad == (0.0, 0.0)


def test_unauthenticated_and_misdirected_messages_are_ignored(fixture: RobotFixture) -> None:
    fixture.command(StopDevice(), key=signing.generate())
    fixture.command(StopDevice(), device="leg")
    fixture.receive(topics.CMD, b"{}")
    fixture.robot.receive("ts/v1/space/other/arm/stop", codec.encode(Stop(id="s")), fixture.now_s)
    fixture.robot.receive("nonsense", b"", fixture.now_s)
    assert fixture.messages(topics.ACK, Ack) == []
    assert fixture.advance(0.1).mode is Mode.IDLE
    assert fixture.robot.refused == 5


def test_expired_and_early_commands_and_those_without_a_clock_are_refused_except_stop(fixture: RobotFixture) -> None:
    late = fixture.command(GRANT, epoch=1, issued_at_ms=wall_ms() - 10_000)
    assert fixture.terminal_ack(late).status is AckStatus.EXPIRED
    assert fixture.reason_code(fixture.command(GRANT, epoch=1, issued_at_ms=wall_ms() + 60_000)) == "from_the_future"
    fixture.cloud_ms = None
    assert fixture.reason_code(fixture.command(ReleaseLease(), epoch=1)) == "no_clock"
    assert fixture.terminal_ack(fixture.command(StopDevice(), issued_at_ms=1)).status is AckStatus.DONE
    assert fixture.advance(0.1).mode is Mode.STOPPED


def test_stop_ends_the_action_holds_and_latches_until_it_is_reset(fixture: RobotFixture) -> None:
    fixture.acquire()
    move = fixture.command(MOVE, epoch=1)
    fixture.advance(0.5)
    fixture.receive(topics.STOP, codec.encode(Stop(id="s")), "bob")
    assert fixture.reason_code(move) == "stopped"
    assert fixture.advance(0.1).position_rad == fixture.advance(5.0).position_rad
    assert fixture.reason_code(fixture.command(MOVE, epoch=2)) == "stopped"
    assert fixture.terminal_ack(fixture.command(ResetStop(), epoch=3)).status is AckStatus.DONE
    fixture.acquire(4)
    assert fixture.acks(fixture.command(MOVE, epoch=4))[-1].status is AckStatus.STARTED
    assert EventKind.STOP_LATCHED in {event.kind for event in fixture.messages(topics.EVENT, Event)}


def test_one_action_runs_at_a_time_until_it_is_cancelled_or_a_newer_lease_ends_it(fixture: RobotFixture) -> None:
    fixture.acquire()
    first = fixture.command(MOVE, epoch=1)
    assert fixture.reason_code(fixture.command(MOVE, epoch=1)) == "busy"
    fixture.advance(0.5)
    fixture.command(CancelAction(action=first), epoch=1)
    assert fixture.terminal_ack(first).status is AckStatus.CANCELLED
    assert fixture.advance(0.1).position_rad == fixture.advance(5).position_rad
    second = fixture.command(MOVE, epoch=1)
    fixture.acquire(2)
    assert fixture.reason_code(second) == "lease_lost"
    position_rad = fixture.advance(0.1).position_rad
    fixture.send_joints(-1.0, epoch=1)
    assert fixture.advance(0.2).position_rad == position_rad, "the older lease is fenced"


def test_the_watchdog_ends_motion_after_the_last_setpoint(fixture: RobotFixture) -> None:
    fixture.acquire()
    fixture.send_joints(3.0)
    telemetry = fixture.advance(0.2)
    assert (telemetry.mode, telemetry.setpoint_sequence, telemetry.setpoint_sent_ms) == (Mode.STREAMING, 1, 7.0)
    assert telemetry.position_rad[0] == pytest.approx(0.2 * SPEED_RAD_S)
    assert fixture.advance(5.0).position_rad[0] == pytest.approx(0.3 * SPEED_RAD_S)
    assert fixture.advance(0.1).mode is Mode.IDLE


def test_old_repeated_unleased_and_unsupported_setpoints_are_refused(fixture: RobotFixture) -> None:
    fixture.send_joints(1.0)
    fixture.acquire()
    fixture.send_joints(1.0, age_ms=201)
    fixture.send_joints(1.0, age_ms=-1)
    fixture.send_setpoint(JogTarget())
    assert fixture.robot.refused == 4
    fixture.send_joints(1.0)
    fixture.send_setpoint(JogTarget(), topic="9")
    fixture.send_joints(-1.0)
    assert fixture.robot.refused == 6
    assert fixture.advance(0.1).position_rad[0] > 0
    fixture.command(MOVE, epoch=1)
    fixture.send_joints(-1.0, sequence=2)
    assert fixture.robot.refused == 7


def test_setpoints_are_limited_to_the_range_of_the_joint(fixture: RobotFixture) -> None:
    fixture.acquire()
    for sequence in range(1, 40):
        fixture.send_joints(99.0, sequence=sequence)
        telemetry = fixture.advance(0.2)
    assert telemetry.position_rad[0] == pytest.approx(3.14159, abs=1e-5)


def test_loss_of_lease_or_link_ends_motion_but_a_resting_arm_keeps_its_lease(fixture: RobotFixture) -> None:
    slow = MoveJoints(position_rad=FAR, speed=0.01)
    fixture.command(GRANT, epoch=1)
    move = fixture.command(slow, epoch=1)
    fixture.advance(1.5)
    assert fixture.reason_code(move) == "lease_lost"
    fixture.acquire(2)
    move = fixture.command(slow, epoch=2)
    fixture.advance(0.1)
    fixture.robot.on_disconnected()
    assert fixture.reason_code(move) == "link_lost"
    fixture.acquire(3)
    fixture.robot.on_disconnected()
    assert fixture.advance(0.1).epoch == 3


def test_control_requests_are_shown_until_withdrawn(fixture: RobotFixture) -> None:
    def lease_after(request: Any, *, epoch: int = 1) -> Any:
        fixture.command(request, epoch=epoch)
        fixture.advance(2)
        return fixture.state().lease

    fixture.acquire()
    request = RequestControl(request="r1", requester="bob", answer_within_ms=60_000)
    assert lease_after(request).request.requester == "bob"
    assert lease_after(WithdrawRequest(request="r1"), epoch=0).request is None
    assert lease_after(ReleaseLease()) is None


def test_joints_move_at_the_given_speed_and_stop_at_the_target() -> None:
    arm = Arm(ArmType(robot_type("load-test-arm", 3, 5.0)), 0.0)
    arm.move([1.5, -0.3, 0.0], speed=0.5)
    arm.advance(1.0)
    assert arm.position_rad == pytest.approx([0.5 * SPEED_RAD_S, -0.3, 0.0])
    assert arm.velocity_rad_s == pytest.approx([0.5 * SPEED_RAD_S, -0.3, 0.0])
    arm.advance(3.0)
    assert arm.position_rad == [1.5, -0.3, 0.0]
    arm.advance(3.1)
    assert arm.arrived
    assert arm.velocity_rad_s == [0.0] * 3


def test_motion_ends_at_the_given_time_independent_of_the_update_interval() -> None:
    arm = Arm(ArmType(robot_type("load-test-arm", 3, 5.0)), 0.0)
    arm.move([3.0, 0.0, 0.0], speed=1.0, until_s=0.3)
    arm.advance(0.0)
    assert (arm.position_rad, arm.velocity_rad_s) == ([0.0] * 3, [0.0] * 3), "no time has passed"
    arm.advance(10.0)
    assert arm.position_rad[0] == pytest.approx(0.3 * SPEED_RAD_S)
    assert arm.arrived
    assert arm.velocity_rad_s == [0.0] * 3


def test_timeouts_equal_those_of_a_real_agent() -> None:
    assert (WATCHDOG_S, MAX_LOOP_AGE_S) == (setpoint_stream.WATCHDOG_S, setpoint_stream.MAX_LOOP_AGE_S)
