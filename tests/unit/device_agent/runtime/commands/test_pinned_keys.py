"""Pinned keys: rotation, expiry and rejection."""

from pathlib import Path

import pytest
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

from device_agent.config.errors import ConfigError
from device_agent.config.identity_store import IdentityStore, Pairing
from device_agent.protocol import codec
from device_agent.protocol.security import signing
from device_agent.protocol.security.key_rotation import KEYS_CONTEXT, NewKey
from device_agent.runtime.commands.pinned_keys import PinnedKeys
from device_agent.runtime.errors import Refused
from tests.harness.agent.pinned_keys import IDENTITY

FIRST, SECOND, THIRD = (signing.generate() for _ in range(3))
ENDS_MS = 5000


def name(key: Ed25519PrivateKey) -> str:
    return signing.key_id(key.public_key())


def statement(
    of: Ed25519PrivateKey, by: Ed25519PrivateKey, serial: int, *, ends_ms: int = ENDS_MS, context: bytes = KEYS_CONTEXT
) -> str:
    new = NewKey(serial=serial, key=signing.public_text(of.public_key()), former_until_ms=ends_ms)
    return signing.sign(codec.encode(new), by, context=context).decode()


class PinsFixture:
    """A store with one pinned key, and the cloud's time."""

    def __init__(self, folder: Path) -> None:
        self.store = IdentityStore(folder)
        self.now_ms: float | None = 1000
        keys = {name(FIRST): signing.public_text(FIRST.public_key())}
        self.store.save_pairing(Pairing(agent="a", space="s", account="ann", keys=keys))
        self.pins = self.load()

    def load(self) -> PinnedKeys:
        pairing = self.store.pairing()
        assert pairing is not None
        return PinnedKeys(pairing, identity=IDENTITY, save=self.store.save_pairing, now_ms=lambda: self.now_ms)


@pytest.fixture
def fixture(tmp_path: Path) -> PinsFixture:
    return PinsFixture(tmp_path / "agent")


def rejection(pins: PinnedKeys, *statements: str) -> str:
    before = dict(pins), pins.serial
    with pytest.raises(Refused) as refused:
        pins.follow(statements)
    assert (dict(pins), pins.serial) == before
    return refused.value.code


def test_a_new_key_is_stored_and_valid_beside_the_old_one_until_it_expires(
    fixture: PinsFixture, tmp_path: Path
) -> None:
    fixture.pins.follow([statement(SECOND, FIRST, 2)])
    assert set(fixture.pins) == {name(FIRST), name(SECOND)}
    again = fixture.load()
    assert (dict(again), again.serial) == (dict(fixture.pins), 2)
    assert (tmp_path / "agent" / "pairing.json").stat().st_mode & 0o077 == 0
    fixture.now_ms = ENDS_MS - 1
    assert name(FIRST) in fixture.pins
    fixture.now_ms = ENDS_MS
    assert set(fixture.pins) == {name(SECOND)}
    with pytest.raises(KeyError):
        fixture.pins[name(FIRST)]


def test_a_key_that_cannot_be_stored_is_not_valid(fixture: PinsFixture, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(_: Pairing) -> None:
        raise ConfigError("no space left on device")

    monkeypatch.setattr(fixture.pins, "_save", full)
    assert rejection(fixture.pins, statement(SECOND, FIRST, 2)) == "journal"


def test_a_chain_is_followed_once(fixture: PinsFixture) -> None:
    chain = [statement(SECOND, FIRST, 2), statement(THIRD, SECOND, 3)]
    fixture.pins.follow(chain)
    fixture.pins.follow(chain)
    assert fixture.pins.serial == 3
    fixture.now_ms = ENDS_MS
    fixture.pins.follow(chain)
    assert set(fixture.pins) == {name(THIRD)}


@pytest.mark.parametrize(
    ("text", "code"),
    [
        (statement(SECOND, THIRD, 2), "bad_signature"),
        (statement(SECOND, SECOND, 2), "bad_signature"),
        (statement(SECOND, FIRST, 2, context=signing.COMMAND_CONTEXT), "bad_signature"),
        (statement(SECOND, FIRST, 2, context=signing.MOVEMENT_CONTEXT), "bad_signature"),
        (statement(SECOND, FIRST, 1), "rolled_back"),
        (statement(SECOND, FIRST, 2, ends_ms=1000), "expired"),
        ("no statement", "malformed"),
        ("{}", "malformed"),
    ],
)
def test_statements_without_a_pinned_signer_are_rejected(fixture: PinsFixture, text: str, code: str) -> None:
    assert rejection(fixture.pins, text) == code


def test_a_statement_with_a_changed_byte_is_rejected(fixture: PinsFixture) -> None:
    valid = statement(SECOND, FIRST, 2).encode()
    for index in range(len(valid)):
        changed = bytearray(valid)
        changed[index] ^= 1
        try:
            text = bytes(changed).decode()
        except UnicodeDecodeError:
            continue
        assert rejection(fixture.pins, text) in {"bad_signature", "malformed"}
    fixture.pins.follow([valid.decode()])


def test_older_keys_and_keys_with_a_successor_cannot_introduce_keys(fixture: PinsFixture) -> None:
    fixture.pins.follow([statement(SECOND, FIRST, 2)])
    for pins in (fixture.pins, fixture.load()):
        assert rejection(pins, statement(THIRD, FIRST, 3)) == "rolled_back"
    fixture.pins.follow([statement(THIRD, SECOND, 3)])
    for serial in (2, 3):
        assert rejection(fixture.pins, statement(signing.generate(), THIRD, serial)) == "rolled_back"


def test_an_agent_that_missed_the_overlap_gets_advice(fixture: PinsFixture, caplog: pytest.LogCaptureFixture) -> None:
    fixture.now_ms = ENDS_MS
    with pytest.raises(Refused, match="repin"):
        fixture.pins.follow([statement(SECOND, FIRST, 2)])
    assert len(fixture.pins) == 1
    for key in (name(FIRST), "", name(SECOND), name(SECOND)):
        fixture.pins.check(key)
    assert caplog.text.count("repin") == 1, "only the unknown key, and once"


def test_without_cloud_time_no_key_is_added_or_expires(fixture: PinsFixture) -> None:
    fixture.pins.follow([statement(SECOND, FIRST, 2)])
    fixture.now_ms = None
    assert rejection(fixture.pins, statement(THIRD, SECOND, 3)) == "no_clock"
    assert set(fixture.pins) == {name(FIRST), name(SECOND)}


def test_a_repeated_statement_of_an_expired_key_changes_nothing(fixture: PinsFixture) -> None:
    first = statement(SECOND, FIRST, 2)
    fixture.pins.follow([first])
    fixture.now_ms = ENDS_MS
    fixture.pins.follow([statement(THIRD, SECOND, 3, ends_ms=2 * ENDS_MS)])
    assert name(FIRST) not in fixture.store.pairing().keys  # type: ignore[union-attr]
    fixture.pins.follow([first])
    assert (set(fixture.pins), fixture.pins.serial) == ({name(SECOND), name(THIRD)}, 3)
