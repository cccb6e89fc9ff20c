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

FIRST, SECOND, THIRD = (signing.generate() for _ in range(3))
ENDS_MS = 5000


def name(key: Ed25519PrivateKey) -> str:
    return signing.key_id(key.public_key())


def statement(
    of: Ed25519PrivateKey, by: Ed25519PrivateKey, serial: int, *, ends_ms: int = ENDS_MS, context: bytes = KEYS_CONTEXT
) -> str:
    new = NewKey(serial=serial, key=signing.public_text(of.public_key()), former_until_ms=ends_ms)
    return signing.sign(codec.encode(new), by, context=context).decode()


class Kept:
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
        return PinnedKeys(pairing, save=self.store.save_pairing, now_ms=lambda: self.now_ms)


@pytest.fixture
def kept(tmp_path: Path) -> Kept:
    return Kept(tmp_path / "agent")


def refusal(pins: PinnedKeys, *statements: str) -> str:
    before = dict(pins), pins.serial
    with pytest.raises(Refused) as refused:
        pins.follow(statements)
    assert (dict(pins), pins.serial) == before
    return refused.value.code


def test_a_new_key_is_valid_beside_the_old_one_until_it_expires(kept: Kept) -> None:
    kept.pins.follow([statement(SECOND, FIRST, 2)])
    assert set(kept.pins) == {name(FIRST), name(SECOND)}
    kept.now_ms = ENDS_MS - 1
    assert name(FIRST) in kept.pins
    kept.now_ms = ENDS_MS
    assert set(kept.pins) == {name(SECOND)}
    with pytest.raises(KeyError):
        kept.pins[name(FIRST)]


def test_a_new_key_is_stored_before_it_is_valid(kept: Kept, tmp_path: Path) -> None:
    kept.pins.follow([statement(SECOND, FIRST, 2)])
    again = kept.load()
    assert dict(again) == dict(kept.pins)
    assert again.serial == 2
    assert (tmp_path / "agent" / "pairing.json").stat().st_mode & 0o077 == 0


def test_a_key_that_cannot_be_stored_is_not_valid(kept: Kept, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(_: Pairing) -> None:
        raise ConfigError("no space left on device")

    monkeypatch.setattr(kept.pins, "_save", full)
    assert refusal(kept.pins, statement(SECOND, FIRST, 2)) == "journal"


def test_a_chain_is_followed_once(kept: Kept) -> None:
    chain = [statement(SECOND, FIRST, 2), statement(THIRD, SECOND, 3)]
    kept.pins.follow(chain)
    kept.pins.follow(chain)
    assert kept.pins.serial == 3
    kept.now_ms = ENDS_MS
    kept.pins.follow(chain)
    assert set(kept.pins) == {name(THIRD)}


@pytest.mark.parametrize(
    ("told", "code"),
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
def test_statements_without_a_pinned_signer_are_rejected(kept: Kept, told: str, code: str) -> None:
    assert refusal(kept.pins, told) == code


def test_a_statement_with_a_changed_byte_is_rejected(kept: Kept) -> None:
    good = statement(SECOND, FIRST, 2).encode()
    for place in range(len(good)):
        bad = bytearray(good)
        bad[place] ^= 1
        try:
            text = bytes(bad).decode()
        except UnicodeDecodeError:
            continue
        assert refusal(kept.pins, text) in {"bad_signature", "malformed"}
    kept.pins.follow([good.decode()])


def test_no_statement_leads_back_to_an_older_key(kept: Kept) -> None:
    kept.pins.follow([statement(SECOND, FIRST, 2), statement(THIRD, SECOND, 3)])
    old = signing.generate()
    assert refusal(kept.pins, statement(old, THIRD, 2)) == "rolled_back"
    assert refusal(kept.pins, statement(old, THIRD, 3)) == "rolled_back"


def test_a_key_with_a_successor_signs_no_other(kept: Kept) -> None:
    """Who stole the old key cannot use its overlap to have a key of theirs pinned."""
    kept.pins.follow([statement(SECOND, FIRST, 2)])
    assert refusal(kept.pins, statement(THIRD, FIRST, 3)) == "rolled_back"
    assert refusal(kept.load(), statement(THIRD, FIRST, 3)) == "rolled_back"


def test_an_agent_that_missed_the_overlap_gets_advice(kept: Kept, caplog: pytest.LogCaptureFixture) -> None:
    kept.now_ms = ENDS_MS
    with pytest.raises(Refused, match="repin"):
        kept.pins.follow([statement(SECOND, FIRST, 2)])
    kept.pins.check(name(SECOND))
    kept.pins.check(name(SECOND))
    assert caplog.text.count("repin") == 1


def test_without_cloud_time_no_key_is_added_or_expires(kept: Kept) -> None:
    kept.pins.follow([statement(SECOND, FIRST, 2)])
    kept.now_ms = None
    assert refusal(kept.pins, statement(THIRD, SECOND, 3)) == "no_clock"
    assert set(kept.pins) == {name(FIRST), name(SECOND)}


def test_a_repeated_statement_of_an_expired_key_changes_nothing(kept: Kept) -> None:
    first = statement(SECOND, FIRST, 2)
    kept.pins.follow([first])
    kept.now_ms = ENDS_MS
    kept.pins.follow([statement(THIRD, SECOND, 3, ends_ms=2 * ENDS_MS)])
    assert name(FIRST) not in kept.store.pairing().keys  # type: ignore[union-attr]
    kept.pins.follow([first])
    assert (set(kept.pins), kept.pins.serial) == ({name(SECOND), name(THIRD)}, 3)


def test_a_valid_key_is_not_logged(kept: Kept, caplog: pytest.LogCaptureFixture) -> None:
    assert len(kept.pins) == 1
    kept.pins.check(name(FIRST))
    kept.pins.check("")
    assert not caplog.text
