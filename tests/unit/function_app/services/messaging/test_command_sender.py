"""Content, signature and lifetime of commands, and what a failed delivery means for the caller."""

import asyncio
from typing import Any, cast

import pytest
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
from msgspec import UNSET
from msgspec.structs import replace

from device_agent.protocol import CancelAction, Command, GrantLease, MoveJoints, RunMovement, StopDevice, codec
from device_agent.protocol.security import signing
from function_app.domain.actions.action import Action
from function_app.domain.common.ids import split_command
from function_app.domain.common.problems import Problem
from function_app.domain.devices.devices import Device
from function_app.ports.command_bus import BusUnavailable
from function_app.ports.monitoring import Counter
from function_app.services.messaging.command_sender import SHORT_TTL_MS, STOP_LIFETIME_MS, CommandSender
from function_app.services.messaging.delivery import Confirmation, SignedCommand
from tests.fakes.clock import MemoryClock
from tests.fakes.signing_keys import MemorySigningKeys
from tests.fakes.tracing import TRACEPARENT, FakeTracing
from tests.unit.function_app.services.messaging.conftest import ARM

LEASE = GrantLease(holder="ann", lease_ms=1000)
MOVE = MoveJoints(position_rad={"elbow": 1.0})
COMMAND = Command(
    id="c1", space="s", agent="aaaaaaaaaa", device="arm", issued_at_ms=1000, ttl_ms=500, caller="ann", epoch=3,
    request=MOVE,
)  # fmt: skip
SOURCE = "robot.home()"


class FakeDelivery:
    """Records calls; every delivery fails while ``reachable`` is false."""

    def __init__(self) -> None:
        self.reachable = True
        self.calls: list[tuple[Any, ...]] = []

    def _call(self, *call: Any) -> None:
        if not self.reachable:
            raise BusUnavailable("the broker is away")
        self.calls.append(call)

    async def send(self, device: Device, signed: SignedCommand) -> None:
        self._call("send", device, signed)

    async def withdraw(self, device: Device, command: str) -> None:
        self._call("withdraw", device, command)

    async def send_confirmed(self, device: Device, signed: SignedCommand, *, wait_ms: int) -> Confirmation:
        self._call("send_confirmed", device, signed, wait_ms)
        return Confirmation(confirmed=True)


class SenderFixture:
    """A sender with fakes."""

    def __init__(self) -> None:
        self.clock, self.delivery, self.counts = MemoryClock(), FakeDelivery(), list[tuple[Any, ...]]()
        self.keys = MemorySigningKeys(now_ms=self.clock.now_ms)
        self.sender = CommandSender(
            delivery=cast("Any", self.delivery), keys=self.keys, metrics=cast("Any", self), tracing=FakeTracing(),
            clock=self.clock,
        )  # fmt: skip

    def count(self, *labels: Any) -> None:
        self.counts.append(labels)

    def run(self, call: Any) -> Any:
        return asyncio.run(call)

    def read(self, signed: SignedCommand) -> Command:
        """The command, whose signature devices accept."""
        payload = signing.verify(signed.payload, self.run(self.keys.public()))
        return codec.decode(payload, Command)

    def rotate(self, **options: Any) -> None:
        self.run(self.keys.rotate(**options))

    def movement(self, key: Ed25519PrivateKey) -> RunMovement:
        """A movement that was saved with this key."""
        sha256 = "0" * 64
        text = signing.movement_text("ur5", "dance", 4, sha256)
        return RunMovement(
            robot_type="ur5", name="dance", version=4, sha256=sha256, source=SOURCE,
            key=signing.key_id(key.public_key()),
            signature=signing.sign_text(text, key, context=signing.MOVEMENT_CONTEXT),
        )  # fmt: skip

    def sent_movement(self, movement: RunMovement) -> RunMovement:
        request = self.read(self.run(self.sender.sign(replace(COMMAND, request=movement)))).request
        assert isinstance(request, RunMovement)
        return request


@pytest.fixture
def fixture() -> SenderFixture:
    return SenderFixture()


def test_a_validated_command_has_its_fields_and_neither_epoch_nor_times(fixture: SenderFixture) -> None:
    command = fixture.sender.validated(ARM, "c1", MOVE, caller="ann\n", traceparent=TRACEPARENT)
    assert command == Command(
        id="c1", space="s", agent="aaaaaaaaaa", device="arm", issued_at_ms=0, ttl_ms=1, caller="ann\ufffd", epoch=0,
        request=MOVE, traceparent=TRACEPARENT,
    )  # fmt: skip
    assert fixture.sender.validated(ARM, "c1", MOVE, caller="ann", traceparent="").traceparent is UNSET


@pytest.mark.parametrize(
    "request_", [MoveJoints(position_rad={"elbow": float("nan")}), MoveJoints(position_rad={"elbow": 1.0}, speed=7.0)]
)
def test_a_command_that_a_device_cannot_decode_is_invalid(fixture: SenderFixture, request_: MoveJoints) -> None:
    with pytest.raises(Problem) as problem:
        fixture.sender.validated(ARM, "c1", request_, caller="ann", traceparent="")
    assert (problem.value.code, problem.value.status) == ("invalid", 422)


def test_a_command_needs_space_for_its_signature_and_times(fixture: SenderFixture) -> None:
    def validated(size: int) -> Command:
        movement = replace(fixture.movement(signing.generate()), parameters={"text": "x" * size})
        return fixture.sender.validated(ARM, "c1", movement, caller="ann", traceparent=TRACEPARENT)

    space = codec.MAX_BYTES - 512 - len(codec.encode(validated(0)))
    command = replace(validated(space), epoch=2**53, issued_at_ms=2**53, ttl_ms=86_400_000)
    assert len(fixture.run(fixture.sender.sign(command)).payload) <= codec.MAX_BYTES
    with pytest.raises(Problem) as problem:
        validated(space + 1)
    assert problem.value.code == "invalid"


@pytest.mark.parametrize(
    ("request_", "expires_ms", "first"), [(MOVE, 1500, False), (StopDevice(reason=""), 1000 + STOP_LIFETIME_MS, True)]
)
def test_a_signed_command_expires_and_a_stop_is_valid_for_long_and_comes_first(
    fixture: SenderFixture, request_: Any, expires_ms: int, first: bool
) -> None:
    command = replace(COMMAND, request=request_)
    signed = fixture.run(fixture.sender.sign(command))
    assert (signed.command, signed.expires_ms, signed.first) == ("c1", expires_ms, first)
    assert fixture.read(signed) == command
    assert fixture.counts == [(Counter.COMMANDS, type(request_).__struct_config__.tag)]
    assert fixture.run(fixture.sender.sign(command)).payload == signed.payload, "the device drops duplicates"


def test_a_command_with_a_number_that_is_not_finite_is_not_signed(fixture: SenderFixture) -> None:
    command = replace(COMMAND, request=MoveJoints(position_rad={"elbow": float("inf")}))
    with pytest.raises(Problem) as problem:
        fixture.run(fixture.sender.sign(command))
    assert problem.value.code == "invalid"
    assert fixture.counts == []


class TestMovements:
    """Devices know only the newest keys."""

    def test_a_movement_of_an_older_key_is_signed_again(self, fixture: SenderFixture) -> None:
        movement = fixture.movement(fixture.run(fixture.keys.current()))
        fixture.rotate(learn_ms=0)
        key = fixture.run(fixture.keys.for_devices())
        assert fixture.sent_movement(movement) == fixture.movement(key)

    def test_a_movement_of_the_present_key_is_sent_as_it_is(self, fixture: SenderFixture) -> None:
        movement = fixture.movement(fixture.run(fixture.keys.for_devices()))
        assert fixture.sent_movement(movement) == movement

    def test_a_forged_movement_is_not_signed_again(self, fixture: SenderFixture) -> None:
        movement = fixture.movement(fixture.run(fixture.keys.current()))
        fixture.rotate(learn_ms=0)
        for forged in (replace(movement, version=5), fixture.movement(signing.generate())):
            assert fixture.sent_movement(forged) == forged


class TestSending:
    @pytest.mark.parametrize(("until_ms", "expires_ms"), [(0, 1500), (9000, 9000)])
    def test_the_command_of_an_action_has_its_fields(
        self, fixture: SenderFixture, until_ms: int, expires_ms: int
    ) -> None:
        action = Action(
            id="c1", device=ARM.id, account="a", caller="ann", pairing="p", request={}, epoch=3, created_ms=1000,
            ttl_ms=500, deadline_ms=9000, traceparent=TRACEPARENT,
        )  # fmt: skip
        fixture.run(fixture.sender.send_action(ARM, MOVE, action, until_ms=until_ms))
        ((call, device, signed),) = fixture.delivery.calls
        assert (call, device, signed.expires_ms) == ("send", ARM, expires_ms)
        assert fixture.read(signed) == replace(COMMAND, traceparent=TRACEPARENT)

    def test_a_short_lived_command_is_signed_and_sent(self, fixture: SenderFixture) -> None:
        id_ = fixture.run(fixture.sender.send(ARM, LEASE, caller="ann", epoch=3))
        ((call, device, signed),) = fixture.delivery.calls
        now_ms = fixture.clock.now_ms()
        assert (call, device, signed.command, signed.expires_ms) == ("send", ARM, id_, now_ms + SHORT_TTL_MS)
        assert split_command(id_)
        command = fixture.read(signed)
        assert (command.id, command.issued_at_ms, command.ttl_ms) == (id_, now_ms, SHORT_TTL_MS)
        assert (command.caller, command.epoch, command.request) == ("ann", 3, LEASE)
        assert command.traceparent == TRACEPARENT
        assert (command.space, command.agent, command.device) == (ARM.space, ARM.agent, ARM.name)

    def test_a_cancel_withdraws_its_action_first(self, fixture: SenderFixture) -> None:
        fixture.run(fixture.sender.send(ARM, CancelAction(action="a1"), caller="ann", epoch=3))
        assert [call[:2] for call in fixture.delivery.calls] == [("withdraw", ARM), ("send", ARM)]
        assert fixture.delivery.calls[0][2] == "a1"

    def test_best_effort_reports_whether_the_command_was_sent(self, fixture: SenderFixture) -> None:
        for fixture.delivery.reachable in (True, False):
            sent = fixture.run(fixture.sender.try_send(ARM, LEASE, caller="ann", epoch=3))
            assert sent is fixture.delivery.reachable
        ((_, device, signed),) = fixture.delivery.calls
        command = fixture.read(signed)
        assert (device, command.caller, command.epoch, command.request) == (ARM, "ann", 3, LEASE)

    def test_a_confirmed_command_has_the_id_of_its_caller(self, fixture: SenderFixture) -> None:
        confirm = fixture.sender.send_confirmed
        answer = fixture.run(confirm(ARM, LEASE, caller="ann", epoch=3, wait_ms=70, command="c7"))
        assert answer.confirmed
        ((_, device, signed, wait_ms),) = fixture.delivery.calls
        command = fixture.read(signed)
        assert (device, wait_ms, command.id, command.caller) == (ARM, 70, "c7", "ann")
        assert (command.epoch, command.request) == (3, LEASE)
        fixture.delivery.reachable = False
        with pytest.raises(Problem) as problem:
            fixture.run(confirm(ARM, LEASE, caller="ann", epoch=3, wait_ms=70))
        assert (problem.value.code, problem.value.status) == ("broker-unavailable", 503)
