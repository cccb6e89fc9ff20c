"""Commands and movements with a flipped bit are rejected."""

import msgspec
import pytest

from device_agent.protocol import Command, GrantLease, Request, RunMovement, codec
from device_agent.protocol.errors import ProtocolError, SignatureError
from device_agent.protocol.security import signing
from device_agent.runtime.actions.script_policy import ScriptPolicy
from device_agent.runtime.errors import Refused
from tests.harness.agent.device_harness import signed_movement
from tests.harness.agent.pinned_keys import pinned_keys_of

KEY = signing.generate()
PINS = pinned_keys_of(KEY)


def limits(request: Request) -> bytes:
    order = Command(
        id="a-arm-1",
        space="s",
        agent="a",
        device="arm",
        issued_at_ms=1000,
        ttl_ms=5000,
        caller="ann",
        epoch=5,
        request=request,
    )
    return signing.sign(codec.encode(order), KEY)


@pytest.mark.parametrize(
    "request_",
    [GrantLease(holder="ann", lease_ms=30_000), signed_movement("print(1)\n", KEY)],
    ids=["lease", "movement"],
)
def test_a_command_with_a_flipped_bit_is_rejected(request_: Request) -> None:
    good = limits(request_)
    codec.decode(signing.verify(good, PINS), Command)
    for place in range(len(good)):
        for bit in (0x01, 0x20, 0x80):
            bad = bytearray(good)
            bad[place] ^= bit
            with pytest.raises((SignatureError, ProtocolError)):
                codec.decode(signing.verify(bytes(bad), PINS), Command)


class _NoJournal:
    def movement(self, *_: object) -> int:
        return 0


def trust() -> ScriptPolicy:
    return ScriptPolicy(device="arm", robot_type="toy", owner="", keys=PINS, journal=_NoJournal())  # type: ignore[arg-type]


def test_a_changed_movement_is_rejected_in_a_newly_signed_command() -> None:
    """Who changes what the cloud has stored has the cloud itself sign the order."""
    good = signed_movement('"""Wave."""\nrobot.home()\n', KEY)
    trust().verify(good)
    for field in ("source", "sha256", "name", "robot_type", "signature", "key"):
        text: str = getattr(good, field)
        for place in range(len(text)):
            other = "b" if text[place] != "b" else "c"
            bad: RunMovement = msgspec.structs.replace(good, **{field: text[:place] + other + text[place + 1 :]})
            with pytest.raises(Refused):
                trust().verify(bad)
    for version in (good.version - 1, good.version + 1):
        with pytest.raises(Refused):
            trust().verify(msgspec.structs.replace(good, version=version))
