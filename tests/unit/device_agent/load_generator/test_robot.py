"""One robot of a swarm on the wire: it obeys who may, answers each command once, and ends what it began."""

import uuid
from typing import Any

import pytest

from device_agent.load_generator.kinematic_arm import DEVICE, SPEED_RAD_S, Shape, robot_type
from device_agent.load_generator.robot import SwarmRobot
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
from device_agent.protocol.security import signing
from tests.harness.agent.pinned_keys import pinned_keys_of

SPACE, AGENT = "space", "agent"
FAR = {"joint_1": 3.0}


class Bench:
    """A robot, the cloud's key, a clock that the test moves, and all that was said."""

    def __init__(self, rate_hz: float = 5.0) -> None:
        self.key = signing.generate()
        self.said: list[tuple[str, bytes, int, bool]] = []
        self.now_s = 100.0
        self.cloud_ms: float | None = float(wall_ms())
        self.robot = SwarmRobot(
            (SPACE, AGENT),
            Shape(robot_type("load-test-arm", 2, rate_hz)),
            pins=pinned_keys_of(self.key),
            cloud_ms=lambda: self.cloud_ms,
            say=self.say,
            now_s=self.now_s,
        )

    def say(self, topic: str, payload: bytes, *, qos: int, retain: bool = False) -> None:
        self.said.append((topic, payload, qos, retain))

    def topic(self, kind: str, name: str = "") -> str:
        return topics.device(SPACE, AGENT, DEVICE, kind, name)

    def told(self, kind: str, message: type[Any], name: str = "") -> list[Any]:
        return [codec.decode(payload, message) for topic, payload, _, _ in self.said if topic == self.topic(kind, name)]

    def command(self, request: Any, *, epoch: int = 0, key: Any = None, **changes: Any) -> str:
        fields: dict[str, Any] = {
            "id": uuid.uuid4().hex,
            "space": SPACE,
            "agent": AGENT,
            "device": DEVICE,
            "issued_at_ms": wall_ms(),
            "ttl_ms": 5000,
            "caller": "ann",
            "epoch": epoch,
            "request": request,
        }
        command = Command(**{**fields, **changes})
        self.hear(topics.CMD, signing.sign(codec.encode(command), key or self.key))
        return command.id

    def hear(self, kind: str, payload: bytes, name: str = "") -> None:
        self.robot.receive(self.topic(kind, name), payload, self.now_s)

    def acks(self, command: str) -> list[AckStatus]:
        found = [ack for ack in self.told(topics.ACK, Ack) if ack.id == command]
        assert [ack.sequence for ack in found] == sorted({ack.sequence for ack in found})
        return [ack.status for ack in found]

    def end(self, command: str) -> Ack:
        last: Ack = [ack for ack in self.told(topics.ACK, Ack) if ack.id == command][-1]
        assert last.status.terminal
        return last

    def code(self, command: str) -> str:
        reason = self.end(command).reason
        assert reason is not None
        return reason.code

    def after(self, seconds: float) -> JointTelemetry:
        self.now_s += seconds
        self.robot.tick(self.now_s)
        newest: JointTelemetry = self.told(topics.TELE, JointTelemetry, topics.JOINTS)[-1]
        return newest

    def take(self, epoch: int = 1) -> None:
        assert self.end(self.command(GrantLease(holder="ann", lease_ms=60_000), epoch=epoch)).status is AckStatus.DONE

    def steer(self, position_rad: float, *, epoch: int = 1, sequence: int = 1, echo_tick_ms: int | None = None) -> None:
        tick = round(self.now_s * 1000) if echo_tick_ms is None else echo_tick_ms
        target = JointTarget(position_rad={"joint_1": position_rad})
        setpoint = Setpoint(epoch=epoch, sequence=sequence, echo_tick_ms=tick, sent_ms=7.0, target=target)
        self.hear(topics.CTL, codec.encode(setpoint), str(epoch))


@pytest.fixture
def bench() -> Bench:
    return Bench()


def test_it_describes_itself_and_its_state_is_kept_by_the_broker(bench: Bench) -> None:
    bench.robot.introduce(bench.now_s)
    (described,), (state,) = bench.told(topics.DESC, Description), bench.told(topics.STATE, State)
    assert [joint.name for joint in described.joints] == ["joint_1", "joint_2"]
    assert (described.simulated, described.actions, described.streams[0].rate_hz) == (True, ("move_joints",), 5.0)
    assert (state.mode, state.epoch) == (Mode.IDLE, 0)
    assert {(qos, retain) for _, _, qos, retain in bench.said} == {(1, True)}


def test_state_is_told_on_change_at_most_once_a_second_and_every_thirty(bench: Bench) -> None:
    bench.robot.introduce(bench.now_s)
    bench.after(0.5)
    bench.take()
    bench.after(0.1)
    assert len(bench.told(topics.STATE, State)) == 1
    bench.after(0.5)
    assert bench.told(topics.STATE, State)[-1].lease.holder == "ann"
    bench.after(20)
    assert len(bench.told(topics.STATE, State)) == 2
    bench.after(11)
    assert len(bench.told(topics.STATE, State)) == 3


def test_a_move_is_accepted_started_and_done_where_it_was_asked_to_end(bench: Bench) -> None:
    bench.take()
    move = bench.command(MoveJoints(position_rad={"joint_1": 1.5}, speed=1.0), epoch=1)
    assert bench.acks(move) == [AckStatus.RECEIVED, AckStatus.ACCEPTED, AckStatus.STARTED]
    seen = bench.after(0.5)
    assert seen.mode is Mode.ACTION
    assert seen.position_rad == pytest.approx((0.5 * SPEED_RAD_S, 0.0))
    bench.after(1.0)
    bench.after(0.1)
    end = bench.end(move)
    assert (end.status, end.result) == (AckStatus.DONE, {"position_rad": {"joint_1": 1.5, "joint_2": 0.0}})
    assert bench.after(1.0).mode is Mode.IDLE


def test_the_same_command_runs_once_and_is_answered_again(bench: Bench) -> None:
    bench.take()
    move = bench.command(MoveJoints(position_rad={"joint_1": 0.1}), epoch=1, id="once")
    bench.after(5)
    before = len(bench.told(topics.ACK, Ack))
    bench.command(MoveJoints(position_rad={"joint_1": 0.1}), epoch=1, id="once")
    again = bench.told(topics.ACK, Ack)[before:]
    assert [ack.status for ack in again] == [AckStatus.DONE]
    assert again[0] == bench.end(move)


@pytest.mark.parametrize(
    ("request_", "epoch", "code"),
    [
        (MoveJoints(position_rad=FAR), 0, "stale_epoch"),
        (MoveJoints(position_rad={"joint_1": 99.0}), 1, "out_of_range"),
        (MoveJoints(position_rad={"tail": 1.0}), 1, "unknown_joint"),
        (Say(text="hello"), 1, "unsupported"),
        (CancelAction(action="nothing"), 1, "not_running"),
        (RequestControl(request="r", requester="bob", answer_within_ms=1000), 5, "no_lease"),
    ],
)
def test_what_it_may_not_or_cannot_do_it_says(bench: Bench, request_: Any, epoch: int, code: str) -> None:
    bench.take()
    assert bench.code(bench.command(request_, epoch=epoch)) == code
    assert bench.after(1.0).position_rad == (0.0, 0.0)


def test_a_command_of_a_stranger_or_for_another_device_is_not_even_answered(bench: Bench) -> None:
    bench.command(StopDevice(), key=signing.generate())
    bench.command(StopDevice(), device="leg")
    bench.hear(topics.CMD, b"{}")
    bench.robot.receive("ts/v1/space/other/arm/stop", codec.encode(Stop(id="s", caller="x")), bench.now_s)
    bench.robot.receive("nonsense", b"", bench.now_s)
    assert bench.told(topics.ACK, Ack) == []
    assert bench.after(0.1).mode is Mode.IDLE
    assert bench.robot.refused == 5


def test_what_has_run_out_comes_from_the_future_or_meets_no_clock_is_refused_but_a_stop_is_not(bench: Bench) -> None:
    late = bench.command(GrantLease(holder="ann", lease_ms=1000), epoch=1, issued_at_ms=wall_ms() - 10_000)
    assert bench.end(late).status is AckStatus.EXPIRED
    early = bench.command(GrantLease(holder="ann", lease_ms=1000), epoch=1, issued_at_ms=wall_ms() + 60_000)
    assert bench.code(early) == "from_the_future"
    bench.cloud_ms = None
    assert bench.code(bench.command(ReleaseLease(), epoch=1)) == "no_clock"
    assert bench.end(bench.command(StopDevice(), issued_at_ms=1)).status is AckStatus.DONE
    assert bench.after(0.1).mode is Mode.STOPPED


def test_stop_ends_what_runs_holds_and_latches_until_it_is_reset(bench: Bench) -> None:
    bench.take()
    move = bench.command(MoveJoints(position_rad=FAR, speed=1.0), epoch=1)
    bench.after(0.5)
    bench.hear(topics.STOP, codec.encode(Stop(id="s", caller="bob")))
    assert bench.code(move) == "stopped"
    there = bench.after(0.1).position_rad
    assert bench.after(5.0).position_rad == there
    assert bench.code(bench.command(MoveJoints(position_rad=FAR), epoch=2)) == "stopped"
    assert bench.end(bench.command(ResetStop(), epoch=3)).status is AckStatus.DONE
    bench.take(4)
    assert bench.acks(bench.command(MoveJoints(position_rad=FAR), epoch=4))[-1] is AckStatus.STARTED
    assert EventKind.STOP_LATCHED in {event.kind for event in bench.told(topics.EVENT, Event)}


def test_one_action_at_a_time_and_cancel_holds(bench: Bench) -> None:
    bench.take()
    first = bench.command(MoveJoints(position_rad=FAR), epoch=1)
    assert bench.code(bench.command(MoveJoints(position_rad=FAR), epoch=1)) == "busy"
    bench.after(0.5)
    bench.command(CancelAction(action=first), epoch=1)
    assert bench.end(first).status is AckStatus.CANCELLED
    there = bench.after(0.1).position_rad
    assert bench.after(5).position_rad == there


def test_a_newer_lease_takes_it_from_what_runs_and_the_older_is_obeyed_no_more(bench: Bench) -> None:
    bench.take()
    move = bench.command(MoveJoints(position_rad=FAR), epoch=1)
    bench.take(2)
    assert bench.code(move) == "lease_lost"
    bench.steer(1.0, epoch=1)
    assert bench.after(0.2).position_rad == (0.0, 0.0)


def test_setpoints_move_it_while_they_are_fresh_and_no_longer(bench: Bench) -> None:
    bench.take()
    bench.steer(3.0)
    seen = bench.after(0.2)
    assert (seen.mode, seen.setpoint_sequence, seen.setpoint_sent_ms) == (Mode.STREAMING, 1, 7.0)
    assert seen.position_rad[0] == pytest.approx(0.2 * SPEED_RAD_S)
    seen = bench.after(5.0)
    assert seen.position_rad[0] == pytest.approx(0.3 * SPEED_RAD_S)
    assert bench.after(0.1).mode is Mode.IDLE


def test_setpoints_that_are_old_doubled_unleased_or_of_another_kind_move_nothing(bench: Bench) -> None:
    bench.steer(1.0)
    bench.take()
    bench.steer(1.0, echo_tick_ms=round(bench.now_s * 1000) - 201)
    bench.steer(1.0, echo_tick_ms=round(bench.now_s * 1000) + 1)
    jog = Setpoint(epoch=1, sequence=1, echo_tick_ms=round(bench.now_s * 1000), sent_ms=0.0, target=JogTarget())
    bench.hear(topics.CTL, codec.encode(jog), "1")
    bench.steer(1.0, epoch=1, sequence=1)
    bench.hear(topics.CTL, codec.encode(jog), "9")
    assert bench.robot.refused == 5
    bench.steer(-1.0, sequence=1)
    assert bench.robot.refused == 6
    assert bench.after(0.1).position_rad[0] > 0
    bench.command(MoveJoints(position_rad=FAR), epoch=1)
    bench.steer(-1.0, sequence=2)
    assert bench.robot.refused == 7


def test_a_setpoint_beyond_a_joints_range_ends_at_its_range(bench: Bench) -> None:
    bench.take()
    for sequence in range(1, 40):
        bench.steer(99.0, sequence=sequence)
        seen = bench.after(0.2)
    assert seen.position_rad[0] == pytest.approx(3.14159, abs=1e-5)


def test_a_lease_that_runs_out_and_a_link_that_is_lost_end_what_moves(bench: Bench) -> None:
    bench.command(GrantLease(holder="ann", lease_ms=1000), epoch=1)
    move = bench.command(MoveJoints(position_rad=FAR, speed=0.01), epoch=1)
    bench.after(1.5)
    assert bench.code(move) == "lease_lost"
    bench.take(2)
    move = bench.command(MoveJoints(position_rad=FAR, speed=0.01), epoch=2)
    bench.after(0.1)
    bench.robot.lost()
    assert bench.code(move) == "link_lost"
    bench.take(3)
    bench.robot.lost()
    assert bench.after(0.1).epoch == 3, "what rests keeps its lease"


def test_who_asks_for_control_is_shown_until_the_request_is_dropped(bench: Bench) -> None:
    bench.take()
    bench.command(RequestControl(request="r1", requester="bob", answer_within_ms=60_000), epoch=1)
    bench.after(2)
    assert bench.told(topics.STATE, State)[-1].lease.request.requester == "bob"
    bench.command(WithdrawRequest(request="r1"))
    bench.after(2)
    assert bench.told(topics.STATE, State)[-1].lease.request is None
    bench.command(ReleaseLease(), epoch=1)
    bench.after(2)
    assert bench.told(topics.STATE, State)[-1].lease is None
