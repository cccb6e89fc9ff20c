"""A whole device with a fake driver and broker: commands in, acks out."""

import itertools
import threading
from collections.abc import Callable
from typing import Any

import pytest
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

from device_agent.ports.clock import wall_ms
from device_agent.protocol import (
    Ack,
    AckStatus,
    CancelAction,
    Description,
    GrantLease,
    Mode,
    MoveJoints,
    ReleaseLease,
    RequestControl,
    ResetStop,
    RotateKey,
    State,
    StopDevice,
    WithdrawRequest,
    codec,
    topics,
)
from device_agent.protocol.events import EventKind
from device_agent.protocol.security import setpoints, signing
from device_agent.protocol.security.key_rotation import KEYS_CONTEXT, NewKey
from device_agent.runtime.control.controller import Controller
from tests.harness.agent.device_harness import WITHIN_S, DeviceHarness, eventually, wait_for_state
from tests.unit.device_agent.runtime.conftest import MakeDevice


def move(elbow: float) -> MoveJoints:
    return MoveJoints(position_rad={"elbow": elbow}, speed=1.0)


def grant(holder: str = "ann", reason: str = "") -> GrantLease:
    return GrantLease(holder=holder, lease_ms=60_000, reason=reason)


def await_mode(harness: DeviceHarness, mode: Mode) -> None:
    eventually(lambda: harness.telemetry().mode is mode)


def test_description_and_state_are_published_on_connection(harness: DeviceHarness) -> None:
    described: Description = eventually(lambda: harness.published(topics.DESC, Description))[0]
    assert [joint.name for joint in described.joints] == ["shoulder", "elbow"]
    state: State = eventually(lambda: harness.published(topics.STATE, State))[0]
    assert state.mode is Mode.IDLE
    assert harness.telemetry().position_rad == (0.0, 0.0)


def test_an_action_is_accepted_started_and_done_once_however_often_it_arrives(harness: DeviceHarness) -> None:
    first = harness.done(move(0.2), epoch=1, command_id="same")
    assert first.result["position_rad"]["elbow"] == pytest.approx(0.2, abs=1e-3)
    acks = harness.acks("same")
    assert [ack.status for ack in acks] == [AckStatus.ACCEPTED, AckStatus.STARTED, AckStatus.DONE]
    assert [ack.sequence for ack in acks] == sorted({ack.sequence for ack in acks})
    assert harness.driver.position[1] == pytest.approx(0.2, abs=1e-3)
    harness.done(move(0.0), epoch=1)
    harness.command(move(0.2), epoch=1, command_id="same")
    eventually(lambda: len(harness.acks("same")) == 4)
    assert harness.acks("same")[-1] == first
    assert harness.driver.position[1] == pytest.approx(0.0, abs=1e-3)


def test_a_command_out_of_its_time_does_not_run(harness: DeviceHarness) -> None:
    expired = harness.end(harness.command(move(0.2), epoch=1, issued_at_ms=wall_ms() - 3_600_000))
    assert (expired.status, expired.reason and expired.reason.code) == (AckStatus.EXPIRED, "expired")
    assert harness.failed(move(0.2), epoch=1, issued_at_ms=wall_ms() + 3_600_000).code == "from_the_future"
    harness.clock.__init__()  # type: ignore[misc]
    assert harness.failed(move(0.2), epoch=1).code == "no_clock"
    assert harness.driver.position == (0.0, 0.0)


def test_foreign_and_unsigned_commands_get_no_ack(harness: DeviceHarness) -> None:
    foreign: tuple[dict[str, Any], ...] = ({"space": "x"}, {"agent": "x"}, {"device": "x"})
    for changes in foreign:
        harness.command(move(0.2), epoch=1, **changes)
    harness.key = signing.generate()
    harness.command(grant("eve"), epoch=9)
    harness.receive(topics.CMD, b"{}")
    eventually(lambda: harness.device.publisher.rejections == {"wrong_address": 3, "bad_signature": 1, "malformed": 1})
    assert harness.published(topics.ACK, Ack) == []


def test_streaming_needs_the_lease_and_moves_the_device(harness: DeviceHarness) -> None:
    harness.setpoint(1, 1)
    assert harness.device.publisher.rejections == {"no_lease": 1}
    harness.done(grant(), epoch=1)
    harness.receive(topics.CTL, harness.sealed(1, 1), "2")
    assert harness.device.publisher.rejections == {"no_lease": 2}, "the epoch in the topic differs"
    sequences = itertools.count(1)

    def moved() -> bool:
        sequence = next(sequences)
        # Often a new input: one ends if the machine pauses this test for 300 ms.
        harness.receive(topics.CTL, harness.sealed(1, sequence, number=1 + sequence // 10), "1")
        return harness.driver.position[1] > 0.1

    eventually(moved)
    assert harness.telemetry().epoch == 1
    assert harness.telemetry().setpoint_sequence > 1
    lease = wait_for_state(harness, lambda state: state.lease).lease
    assert lease is not None
    assert lease.holder == "ann"


def unsigned(payload: bytes) -> bytes:
    body = codec.decode(payload, setpoints.Tagged).body
    return bytes(body)


@pytest.mark.parametrize(
    ("forge", "code"),
    [
        (unsigned, "malformed"),
        (lambda payload: payload.replace(b'"elbow":2.0', b'"elbow":1.0'), "bad_signature"),
        (lambda payload: payload.replace(b'"sequence":1,', b'"sequence":9,'), "bad_signature"),
        (lambda payload: payload.replace(b'"tag":"', b'"tag":"0'), "bad_signature"),
        (lambda payload: payload + b" " * setpoints.MAX_BYTES, "malformed"),
    ],
)
def test_a_forged_setpoint_does_not_move_the_device(
    harness: DeviceHarness, forge: Callable[[bytes], bytes], code: str
) -> None:
    harness.done(grant(), epoch=1)
    harness.receive(topics.CTL, forge(harness.sealed(1, 1)), "1")
    assert harness.device.publisher.rejections == {code: 1}
    assert not harness.device._controller._state.stream.active
    harness.setpoint(1, 1)
    assert harness.device._controller._state.stream.active, "the holder's own setpoint is accepted"


def test_a_key_of_another_lease_or_cloud_does_not_authenticate_a_setpoint(harness: DeviceHarness) -> None:
    harness.done(grant(), epoch=1)
    former = harness.sealed(1, 1)
    harness.done(grant("eve"), epoch=2)
    for payload in (former, harness.sealed(2, 1, key=signing.generate()), harness.sealed(1, 1)):
        harness.receive(topics.CTL, payload, "2")
    harness.receive(topics.CTL, former, "1")
    assert harness.device.publisher.rejections == {"bad_signature": 3, "no_lease": 1}


def test_replayed_and_reordered_setpoints_are_rejected(harness: DeviceHarness) -> None:
    harness.done(grant(), epoch=1)
    older, newer = harness.sealed(1, 1), harness.sealed(1, 2)
    for payload in (newer, newer, older):
        harness.receive(topics.CTL, payload, "1")
    harness.done(grant(), epoch=1)
    harness.receive(topics.CTL, newer, "1")
    assert harness.device.publisher.rejections == {"out_of_order": 3}, "a renewal does not reset the sequence"


def test_a_signed_stop_replaces_the_unverified_author(harness: DeviceHarness) -> None:
    harness.receive(topics.STOP, b'{"id":"s1","caller":"eve (owner)","reason":"a\\nforged line"}', "bob")
    latch = wait_for_state(harness, lambda state: state.stop).stop
    assert latch is not None
    assert (latch.caller, latch.reason, latch.verified) == ("bob (unverified)", "a\ufffdforged line", False)
    command = harness.done(StopDevice(reason="smoke"))
    harness.done(StopDevice(reason="later"), caller="cat")
    verified = wait_for_state(harness, lambda state: state.stop and state.stop.verified).stop
    assert verified is not None
    assert (verified.caller, verified.reason, verified.at_ms) == ("ann", "smoke", latch.at_ms)
    (event,) = harness.events(EventKind.STOP_VERIFIED)
    assert event.data == {"stop": command.id, "caller": "ann", "reason": "smoke", "verified": True}


def test_stop_needs_no_lease_and_survives_a_restart(harness: DeviceHarness, make_device: MakeDevice) -> None:
    running = harness.running(harness.script("wait(600)"), epoch=1)
    harness.receive_stop()
    assert harness.end_code(running) == "stopped"
    stop = wait_for_state(harness, lambda state: state.mode is Mode.STOPPED).stop
    assert stop is not None
    assert (stop.caller, stop.verified) == ("bob (unverified)", False)
    harness.done(grant("eve"), epoch=2)
    for request in (move(0.2), harness.script("robot.home()")):
        assert harness.failed(request, epoch=2).code == "stopped"
    harness.setpoint(2, 1)
    assert harness.device.publisher.rejections["stopped"] == 3
    again = make_device()
    await_mode(again, Mode.STOPPED)
    assert harness.driver.position == again.driver.position == (0.0, 0.0)
    again.done(ResetStop(), epoch=3)
    again.done(move(0.1), epoch=4)


def test_a_stop_ends_the_lease_and_its_latch_survives_a_restart(
    harness: DeviceHarness, make_device: MakeDevice
) -> None:
    harness.done(grant(), epoch=4)
    harness.done(StopDevice(reason="smoke"))
    stored = harness.journal.device("arm")
    assert (stored.burned, stored.latch is not None) == (4, True), "on disk before the Stop is acknowledged"
    assert harness.failed(grant(), epoch=4).code == "lease_ended"
    state = wait_for_state(harness, lambda state: state.stop)
    assert (state.lease, state.ended_epoch) == (None, 4)
    latch = wait_for_state(make_device(), lambda state: state.stop).stop
    assert latch is not None
    assert latch == stored.latch
    assert (latch.caller, latch.reason, latch.verified) == ("ann", "smoke", True)


def test_a_late_stop_is_applied_and_a_replayed_or_late_reset_does_not_release_it(harness: DeviceHarness) -> None:
    harness.done(StopDevice(reason="late"), issued_at_ms=1)
    await_mode(harness, Mode.STOPPED)
    harness.done(ResetStop(), epoch=3, command_id="reset")
    eventually(lambda: harness.telemetry().mode is not Mode.STOPPED)
    harness.done(StopDevice())
    harness.command(ResetStop(), epoch=3, command_id="reset")
    for epoch, code in ((2, "stale_epoch"), (3, "lease_ended")):
        assert harness.failed(ResetStop(), epoch=epoch).code == code
    assert harness.end_code(harness.command(ResetStop(), epoch=9, issued_at_ms=1)) == "expired"
    await_mode(harness, Mode.STOPPED)
    assert harness.device._controller.latch is not None


def test_a_key_rotation_needs_a_pinned_signer(harness: DeviceHarness) -> None:
    new = signing.generate()

    def rotation(by: Ed25519PrivateKey, of: Ed25519PrivateKey = new, serial: int = 2) -> RotateKey:
        key = signing.public_text(of.public_key())
        statement = NewKey(serial=serial, key=key, former_until_ms=wall_ms() + 60_000)
        return RotateKey(statements=(signing.sign(codec.encode(statement), by, context=KEYS_CONTEXT).decode(),))

    assert harness.failed(rotation(new)).code == "bad_signature"
    # The harness's pins have no time of the cloud, and without it no key is pinned.
    assert harness.failed(rotation(harness.key)).code == "no_clock"
    harness.done(rotation(harness.key, of=harness.key, serial=1))


def test_a_second_action_is_refused_while_one_runs_and_the_first_can_be_cancelled(harness: DeviceHarness) -> None:
    first = harness.running(harness.script("print('hello')\nwait(600)"), epoch=1)
    assert harness.failed(move(0.2), epoch=1).code == "busy"
    eventually(lambda: [ack for ack in harness.acks(first) if "hello" in ack.output])
    harness.failed(CancelAction(action="unknown"))
    harness.done(CancelAction(action=first))
    cancelled = harness.end(first)
    assert (cancelled.status, cancelled.output) == (AckStatus.CANCELLED, "hello\n")
    harness.done(move(0.1), epoch=1)


def test_a_lost_link_ends_the_action_and_the_ack_is_sent_on_reconnection(harness: DeviceHarness) -> None:
    running = harness.running(harness.script("wait(600)"), epoch=1)
    unsent = threading.Event()

    def without_link(*_args: Any, **_options: Any) -> bool:
        unsent.set()
        return False

    harness.device.publisher._publish = without_link
    harness.device.link_changed(False)
    assert unsent.wait(WITHIN_S)
    harness.device.publisher._publish = harness.publish
    harness.device.link_changed(True)
    assert harness.end_code(running) == "link_lost"


def test_a_lease_from_before_a_restart_is_rejected(harness: DeviceHarness, make_device: MakeDevice) -> None:
    harness.done(grant(), epoch=4)
    again = make_device()
    assert again.failed(grant(), epoch=4).code == "lease_ended"
    again.done(grant(), epoch=5)


def test_a_rejected_action_runs_once_when_the_cloud_issues_it_with_a_higher_epoch(harness: DeviceHarness) -> None:
    harness.done(grant(), epoch=4)
    reason = harness.failed(move(0.1), epoch=2, command_id="action")
    assert (reason.code, reason.epoch) == ("stale_epoch", 4)
    harness.command(move(0.1), epoch=5, command_id="action")
    eventually(lambda: harness.acks("action")[-1].status is AckStatus.DONE)
    count = len(harness.acks("action"))
    for epoch in (2, 5, 6):
        harness.command(move(0.3), epoch=epoch, command_id="action")
    eventually(lambda: len(harness.acks("action")) == count + 3)
    assert [ack.status for ack in harness.acks("action")[-3:]] == [AckStatus.DONE] * 3
    assert [ack.status for ack in harness.acks("action")].count(AckStatus.STARTED) == 1


def test_malformed_messages_are_counted_and_ignored(harness: DeviceHarness) -> None:
    harness.done(grant(), epoch=1)
    for kind in (topics.CTL, topics.STOP, topics.CMD):
        for payload in (b"", b"\x00" * 10, b'{"id":1}', b"NaN"):
            harness.receive(kind, payload, "1")
    eventually(lambda: harness.device.publisher.rejections == {"malformed": 12})
    assert harness.telemetry().mode is Mode.IDLE


def test_state_shows_a_control_request_until_it_is_withdrawn(harness: DeviceHarness) -> None:
    request = RequestControl(request="r1", requester="bob", answer_within_ms=30_000)
    assert harness.failed(request, epoch=1).code == "no_lease"
    harness.done(grant(reason="needed in the lab"), epoch=1)
    harness.done(request, epoch=1)
    lease = wait_for_state(harness, lambda state: state.lease and state.lease.request).lease
    assert lease is not None
    assert lease.request is not None
    assert (lease.holder, lease.reason) == ("ann", "needed in the lab")
    assert (lease.request.id, lease.request.requester) == ("r1", "bob")
    assert 0 < lease.request.expires_in_ms <= 30_000
    harness.done(grant(), epoch=1)
    harness.done(WithdrawRequest(request="r1"), epoch=1)
    lease = wait_for_state(harness, lambda state: state.lease and not state.lease.request).lease
    assert lease is not None
    assert lease.reason == "needed in the lab", "a renewal keeps the reason"


def test_a_new_epoch_is_journalled_before_it_is_applied_and_its_end_is_shown(
    harness: DeviceHarness, monkeypatch: pytest.MonkeyPatch
) -> None:
    written: list[int] = []
    apply = Controller.grant

    def record(controller: Controller, **options: Any) -> None:
        written.append(harness.journal.device("arm").epoch)
        apply(controller, **options)

    monkeypatch.setattr(Controller, "grant", record)
    for epoch in (4, 4, 7):
        harness.done(grant(), epoch=epoch)
    assert written == [4, 4, 7]
    assert wait_for_state(harness, lambda state: state.lease and state.epoch == 7).ended_epoch < 7
    harness.done(ReleaseLease(), epoch=7)
    assert wait_for_state(harness, lambda state: not state.lease).ended_epoch == 7
