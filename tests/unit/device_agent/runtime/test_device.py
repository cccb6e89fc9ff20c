"""A whole device with a fake driver and broker: commands in, acks out."""

import threading
import time
from pathlib import Path
from typing import Any

import pytest
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

from device_agent.ports.clock import tick_ms, wall_ms
from device_agent.protocol import (
    Ack,
    AckStatus,
    CancelAction,
    Description,
    GrantLease,
    JointTarget,
    Mode,
    MoveJoints,
    ReleaseLease,
    RequestControl,
    ResetStop,
    RotateKey,
    Setpoint,
    State,
    Stop,
    StopDevice,
    WithdrawRequest,
    codec,
    topics,
)
from device_agent.protocol.security import signing
from device_agent.protocol.security.key_rotation import KEYS_CONTEXT, NewKey
from device_agent.runtime.control.controller import Controller
from tests.harness.agent.device_harness import WITHIN_S, DeviceHarness, eventually, shown


def test_description_and_state_are_published_on_connection(harness: DeviceHarness) -> None:
    described: Description = eventually(lambda: harness.heard(topics.DESC, Description))[0]
    assert [joint.name for joint in described.joints] == ["shoulder", "elbow"]
    state: State = eventually(lambda: harness.heard(topics.STATE, State))[0]
    assert state.mode is Mode.IDLE
    assert harness.telemetry().position_rad == (0.0, 0.0)


def test_an_action_is_accepted_started_and_done_in_this_order(harness: DeviceHarness) -> None:
    ack = harness.end(harness.command(MoveJoints(position_rad={"elbow": 0.2}, speed=1.0), epoch=1))
    assert ack.status is AckStatus.DONE
    assert ack.result["position_rad"]["elbow"] == pytest.approx(0.2, abs=1e-3)
    acks = harness.acks(ack.id)
    assert [ack.status for ack in acks] == [AckStatus.ACCEPTED, AckStatus.STARTED, AckStatus.DONE]
    assert [ack.sequence for ack in acks] == sorted({ack.sequence for ack in acks})
    assert harness.driver.position[1] == pytest.approx(0.2, abs=1e-3)


def test_a_command_runs_once_however_often_it_arrives(harness: DeviceHarness) -> None:
    move = MoveJoints(position_rad={"elbow": 0.2}, speed=1.0)
    first = harness.end(harness.command(move, epoch=1, command_id="same"))
    harness.end(harness.command(MoveJoints(position_rad={"elbow": 0.0}, speed=1.0), epoch=1))
    harness.command(move, epoch=1, command_id="same")
    eventually(lambda: len(harness.acks("same")) == 4)
    assert harness.acks("same")[-1] == first
    assert harness.driver.position[1] == pytest.approx(0.0, abs=1e-3)


@pytest.mark.parametrize(
    ("changes", "code", "status"),
    [
        ({"issued_at_ms": wall_ms() - 3_600_000}, "expired", AckStatus.EXPIRED),
        ({"issued_at_ms": wall_ms() + 3_600_000}, "from_the_future", AckStatus.FAILED),
    ],
)
def test_a_command_out_of_its_time_does_not_run(
    harness: DeviceHarness, changes: dict[str, Any], code: str, status: AckStatus
) -> None:
    ack = harness.end(harness.command(MoveJoints(position_rad={"elbow": 0.2}), epoch=1, **changes))
    assert (ack.status, ack.reason and ack.reason.code) == (status, code)
    assert harness.driver.position == (0.0, 0.0)


def test_without_cloud_time_motion_commands_are_rejected(harness: DeviceHarness) -> None:
    harness.clock.__init__()  # type: ignore[misc]
    assert harness.end_code(harness.command(MoveJoints(position_rad={"elbow": 0.2}), epoch=1)) == "no_clock"


@pytest.mark.parametrize("changes", [{"space": "x"}, {"agent": "x"}, {"device": "x"}])
def test_a_command_for_another_device_gets_no_ack(harness: DeviceHarness, changes: dict[str, str]) -> None:
    foreign = harness.command(MoveJoints(position_rad={"elbow": 0.2}), epoch=1, **changes)
    harness.end(harness.command(GrantLease(holder="ann", lease_ms=5000), epoch=1))
    assert harness.acks(foreign) == []
    assert harness.device.publisher.rejections == {"wrong_address": 1}


def test_unsigned_commands_are_rejected(harness: DeviceHarness) -> None:
    harness.key = signing.generate()
    harness.command(GrantLease(holder="eve", lease_ms=5000), epoch=9)
    harness.receive(topics.CMD, b"{}")
    eventually(lambda: harness.device.publisher.rejections == {"bad_signature": 1, "malformed": 1})
    assert harness.heard(topics.ACK, Ack) == []


def test_streaming_needs_the_lease_and_moves_the_device(harness: DeviceHarness) -> None:
    harness.setpoint(1, 1)
    assert harness.device.publisher.rejections == {"no_lease": 1}
    harness.end(harness.command(GrantLease(holder="ann", lease_ms=60_000), epoch=1))
    for sequence in range(1, 40):
        harness.setpoint(1, sequence)
        time.sleep(0.02)
    assert harness.driver.position[1] > 0.1
    assert harness.telemetry().epoch == 1
    assert harness.telemetry().setpoint_sequence > 1
    state: State = eventually(lambda: [s for s in harness.heard(topics.STATE, State) if s.lease])[-1]
    assert state.lease is not None
    assert state.lease.holder == "ann"


def test_an_epoch_in_the_topic_that_differs_from_the_message_is_refused(harness: DeviceHarness) -> None:
    harness.end(harness.command(GrantLease(holder="ann", lease_ms=60_000), epoch=2))
    setpoint = Setpoint(
        epoch=2, sequence=1, echo_tick_ms=tick_ms(), sent_ms=0, target=JointTarget(position_rad={"elbow": 1})
    )
    harness.receive(topics.CTL, codec.encode(setpoint), "1")
    assert harness.device.publisher.rejections == {"no_lease": 1}


def test_stop_needs_no_lease_and_survives_a_restart(harness: DeviceHarness, tmp_path: Path) -> None:
    running = harness.command(harness.script("wait(600)"), epoch=1)
    eventually(lambda: [ack for ack in harness.acks(running) if ack.status is AckStatus.STARTED])
    harness.receive(topics.STOP, codec.encode(Stop(id="s1", caller="bob", reason="smoke")))
    ack = harness.end(running)
    assert ack.status is AckStatus.FAILED
    assert ack.reason is not None
    assert ack.reason.code == "stopped"
    state = shown(harness, lambda state: state.mode is Mode.STOPPED)
    assert state.stop is not None
    assert state.stop.caller == "bob"
    assert harness.end_code(harness.command(MoveJoints(position_rad={"elbow": 0.2}), epoch=2)) == "stopped"
    again = DeviceHarness(tmp_path)
    again.device.start()
    eventually(lambda: again.telemetry().mode is Mode.STOPPED)
    again.end(again.command(ResetStop(), epoch=3))
    assert again.end(again.command(MoveJoints(position_rad={"elbow": 0.1}), epoch=4)).status is AckStatus.DONE
    again.stop()


def test_a_late_signed_stop_is_applied(harness: DeviceHarness) -> None:
    ack = harness.end(harness.command(StopDevice(reason="late"), issued_at_ms=1))
    assert ack.status is AckStatus.DONE
    eventually(lambda: harness.telemetry().mode is Mode.STOPPED)


def test_a_key_rotation_needs_a_pinned_signer(harness: DeviceHarness) -> None:
    new = signing.generate()

    def statement(by: Ed25519PrivateKey, of: Ed25519PrivateKey = new, serial: int = 2) -> str:
        key = signing.public_text(of.public_key())
        told = NewKey(serial=serial, key=key, former_until_ms=wall_ms() + 60_000)
        return signing.sign(codec.encode(told), by, context=KEYS_CONTEXT).decode()

    assert harness.end_code(harness.command(RotateKey(statements=(statement(new),)))) == "bad_signature"
    # The harness's pins know no time of the cloud, and without it no key is taken up.
    assert harness.end_code(harness.command(RotateKey(statements=(statement(harness.key),)))) == "no_clock"
    known = statement(harness.key, of=harness.key, serial=1)
    assert harness.end(harness.command(RotateKey(statements=(known,)))).status is AckStatus.DONE


def test_a_second_action_is_refused_while_one_runs_and_the_first_can_be_cancelled(harness: DeviceHarness) -> None:
    first = harness.command(harness.script("print('hello')\nwait(600)"), epoch=1)
    eventually(lambda: [ack for ack in harness.acks(first) if ack.status is AckStatus.STARTED])
    assert harness.end_code(harness.command(MoveJoints(position_rad={"elbow": 0.2}), epoch=1)) == "busy"
    eventually(lambda: [ack for ack in harness.acks(first) if "hello" in ack.output])
    assert harness.end(harness.command(CancelAction(action="unknown"))).status is AckStatus.FAILED
    assert harness.end(harness.command(CancelAction(action=first))).status is AckStatus.DONE
    cancelled = harness.end(first)
    assert cancelled.status is AckStatus.CANCELLED
    assert cancelled.output == "hello\n"
    assert harness.end(harness.command(MoveJoints(position_rad={"elbow": 0.1}), epoch=1)).status is AckStatus.DONE


def test_a_lost_link_ends_the_action_and_the_ack_is_sent_on_reconnection(harness: DeviceHarness) -> None:
    running = harness.command(harness.script("wait(600)"), epoch=1)
    eventually(lambda: [ack for ack in harness.acks(running) if ack.status is AckStatus.STARTED])
    gone = threading.Event()

    def deaf(*_args: Any, **_options: Any) -> bool:
        gone.set()
        return False

    harness.device.publisher._publish = deaf
    harness.device.link_changed(False)
    assert gone.wait(WITHIN_S)
    harness.device.publisher._publish = harness.publish
    harness.device.link_changed(True)
    assert harness.end_code(running) == "link_lost"


def test_a_driver_error_is_a_fault_until_the_driver_responds(harness: DeviceHarness) -> None:
    harness.driver.broken = True
    state: State = eventually(lambda: [s for s in harness.heard(topics.STATE, State) if s.faults])[-1]
    assert "switched on" in state.faults[0].message
    assert harness.end_code(harness.command(MoveJoints(position_rad={"elbow": 0.2}), epoch=1)) == "fault"
    harness.driver.broken = False
    eventually(lambda: (s := harness.heard(topics.STATE, State)) and not s[-1].faults)
    assert harness.end(harness.command(MoveJoints(position_rad={"elbow": 0.1}), epoch=1)).status is AckStatus.DONE


def test_a_lease_from_before_a_restart_is_rejected(harness: DeviceHarness, tmp_path: Path) -> None:
    harness.end(harness.command(GrantLease(holder="ann", lease_ms=60_000), epoch=4))
    again = DeviceHarness(tmp_path)
    again.device.start()
    ack = again.end(again.command(GrantLease(holder="ann", lease_ms=60_000), epoch=4))
    assert ack.reason is not None
    assert ack.reason.code == "lease_ended"
    assert again.end(again.command(GrantLease(holder="ann", lease_ms=60_000), epoch=5)).status is AckStatus.DONE
    again.stop()


def test_malformed_messages_are_counted_and_ignored(harness: DeviceHarness) -> None:
    for kind in (topics.CTL, topics.STOP, topics.CMD):
        for payload in (b"", b"\x00" * 10, b'{"id":1}', b"NaN"):
            harness.receive(kind, payload, "1")
    eventually(lambda: harness.device.publisher.rejections == {"malformed": 12})
    assert harness.telemetry().mode is Mode.IDLE


def test_state_shows_a_control_request_until_it_is_withdrawn(harness: DeviceHarness) -> None:
    early = harness.end(
        harness.command(RequestControl(request="r1", requester="bob", answer_within_ms=30_000), epoch=1)
    )
    assert early.reason is not None
    assert early.reason.code == "no_lease"
    harness.end(harness.command(GrantLease(holder="ann", lease_ms=60_000, reason="needed in the lab"), epoch=1))
    harness.end(harness.command(RequestControl(request="r1", requester="bob", answer_within_ms=30_000), epoch=1))
    lease = shown(harness, lambda state: state.lease and state.lease.request).lease
    assert lease is not None
    assert lease.request is not None
    assert (lease.holder, lease.reason, lease.request.id, lease.request.requester) == (
        "ann",
        "needed in the lab",
        "r1",
        "bob",
    )
    assert 0 < lease.request.expires_in_ms <= 30_000
    harness.end(harness.command(GrantLease(holder="ann", lease_ms=60_000), epoch=1))
    harness.end(harness.command(WithdrawRequest(request="r1"), epoch=1))
    lease = shown(harness, lambda state: state.lease and not state.lease.request).lease
    assert lease is not None
    assert lease.reason == "needed in the lab", "a renewal does not wipe it out"


def test_state_contains_the_ended_epoch(harness: DeviceHarness) -> None:
    harness.end(harness.command(GrantLease(holder="ann", lease_ms=60_000), epoch=4))
    assert shown(harness, lambda state: state.lease).ended_epoch < 4
    harness.end(harness.command(ReleaseLease(), epoch=4))
    assert shown(harness, lambda state: not state.lease).ended_epoch == 4


def test_nothing_gets_past_stop(harness: DeviceHarness, tmp_path: Path) -> None:
    harness.end(harness.command(GrantLease(holder="ann", lease_ms=60_000), epoch=1))
    harness.end(harness.command(StopDevice(reason="smoke")))
    harness.end(harness.command(GrantLease(holder="eve", lease_ms=60_000), epoch=2))
    for order in (MoveJoints(position_rad={"elbow": 0.2}), harness.script("robot.home()")):
        assert harness.end_code(harness.command(order, epoch=2)) == "stopped"
    harness.setpoint(2, 1)
    assert harness.device.publisher.rejections["stopped"] == 3
    again = DeviceHarness(tmp_path)
    again.key = harness.key
    again.device.start()
    eventually(lambda: again.telemetry().mode is Mode.STOPPED)
    again.stop()
    assert harness.driver.position == again.driver.position == (0.0, 0.0)


def test_a_replayed_or_late_reset_does_not_release_a_later_stop(harness: DeviceHarness) -> None:
    harness.end(harness.command(StopDevice()))
    harness.command(ResetStop(), epoch=3, command_id="reset")
    harness.end("reset")
    eventually(lambda: harness.telemetry().mode is not Mode.STOPPED)
    harness.end(harness.command(StopDevice()))
    harness.command(ResetStop(), epoch=3, command_id="reset")
    late = harness.end(harness.command(ResetStop(), epoch=2)).reason
    again = harness.end(harness.command(ResetStop(), epoch=3)).reason
    expired = harness.end(harness.command(ResetStop(), epoch=9, issued_at_ms=1)).reason
    assert [why and why.code for why in (late, again, expired)] == ["stale_epoch", "lease_ended", "expired"]
    eventually(lambda: harness.telemetry().mode is Mode.STOPPED)
    assert harness.device._controller.latch is not None


def test_a_new_epoch_is_journalled_before_it_is_applied(
    harness: DeviceHarness, monkeypatch: pytest.MonkeyPatch
) -> None:
    written: list[int] = []
    grant = Controller.grant

    def watched(controller: Controller, **given: Any) -> None:
        written.append(harness.journal.device("arm").epoch)
        grant(controller, **given)

    monkeypatch.setattr(Controller, "grant", watched)
    for epoch in (4, 4, 7):
        assert (
            harness.end(harness.command(GrantLease(holder="ann", lease_ms=1000), epoch=epoch)).status is AckStatus.DONE
        )
    assert written == [4, 4, 7]
