"""Script policy: signatures, versions and authors."""

from collections.abc import Iterator
from pathlib import Path

import msgspec
import pytest

from device_agent.protocol import SHIPPED, RunMovement
from device_agent.protocol.security import signing
from device_agent.runtime.actions.script_policy import ScriptPolicy
from device_agent.runtime.errors import Refused
from device_agent.runtime.storage.journal import Journal
from tests.harness.agent.device_harness import signed_movement

OWNER, OTHER = "accountaaaaaaaaa", "accountbbbbbbbbb"
KEY = signing.generate()


@pytest.fixture
def journal(tmp_path: Path) -> Iterator[Journal]:
    journal = Journal(tmp_path / "journal.db")
    journal.open(now_ms=0)
    yield journal
    journal.close()


def trust_of(journal: Journal, *, device: str = "arm", owner: str = OWNER) -> ScriptPolicy:
    keys = {signing.key_id(KEY.public_key()): KEY.public_key()}
    return ScriptPolicy(device=device, robot_type="toy", owner=owner, keys=keys, journal=journal)


def movement(version: int = 1, author: str = OWNER) -> RunMovement:
    return signed_movement("print(1)", KEY, version=version, author=author)


def refusal(trust: ScriptPolicy, order: RunMovement) -> str:
    with pytest.raises(Refused) as refused:
        trust.verify(order)
    return refused.value.code


def test_a_signed_script_is_accepted(journal: Journal) -> None:
    trust_of(journal).verify(movement())


@pytest.mark.parametrize(
    ("changes", "code"),
    [
        ({"source": "print(2)"}, "wrong_hash"),
        ({"sha256": "0" * 64}, "wrong_hash"),
        ({"robot_type": "nao"}, "wrong_type"),
        ({"name": "wave"}, "bad_signature"),
        ({"version": 2}, "bad_signature"),
        ({"signature": ""}, "bad_signature"),
        ({"signature": "x" * 86}, "bad_signature"),
        ({"key": ""}, "bad_signature"),
        ({"key": "another"}, "bad_signature"),
    ],
)
def test_a_modified_script_is_rejected(journal: Journal, changes: object, code: str) -> None:
    changed = msgspec.structs.replace(movement(), **changes)  # type: ignore[arg-type]
    assert refusal(trust_of(journal), changed) == code


def test_every_character_of_the_signature_counts(journal: Journal) -> None:
    good = movement()
    trust = trust_of(journal)
    for place in (*range(0, len(good.signature), 5), len(good.signature) - 1):
        other = "A" if good.signature[place] != "A" else "B"
        flipped = good.signature[:place] + other + good.signature[place + 1 :]
        assert refusal(trust, msgspec.structs.replace(good, signature=flipped)) == "bad_signature"


def test_a_command_signature_is_not_valid_for_a_movement(journal: Journal) -> None:
    good = movement()
    text = signing.movement_text(good.robot_type, good.name, good.version, good.sha256)
    stolen = signing.sign_text(text, KEY, context=signing.COMMAND_CONTEXT)
    assert refusal(trust_of(journal), msgspec.structs.replace(good, signature=stolen)) == "bad_signature"


def test_an_older_version_than_one_that_ran_is_refused_also_after_a_restart(journal: Journal, tmp_path: Path) -> None:
    trust = trust_of(journal)
    trust.verify(movement(3))
    trust.record_version(movement(3))
    trust.record_version(movement(2))
    journal.close()
    journal.open(now_ms=0)
    again = trust_of(journal)
    assert refusal(again, movement(2)) == "rolled_back"
    again.verify(movement(3))
    again.verify(movement(4))
    assert (tmp_path / "journal.db").exists()


def test_a_rejected_version_does_not_block_older_ones(journal: Journal) -> None:
    trust = trust_of(journal)
    trust.verify(movement(9))
    trust.verify(movement(3))


@pytest.mark.parametrize(
    ("device", "author"), [("other", OWNER), ("arm", SHIPPED), ("arm", OTHER)], ids=["device", "shipped", "account"]
)
def test_versions_count_per_device_and_author(journal: Journal, device: str, author: str) -> None:
    trust_of(journal).record_version(movement(9))
    trust_of(journal, device=device).verify(movement(1, author))


@pytest.mark.parametrize(
    ("author", "owner", "untrusted"),
    [
        (SHIPPED, OWNER, False),
        (OWNER, OWNER, False),
        (OTHER, OWNER, True),
        ("", OWNER, True),
        ("", "", True),
        (OTHER, "", True),
        (SHIPPED, "", False),
    ],
)
def test_which_authors_are_untrusted(journal: Journal, author: str, owner: str, untrusted: bool) -> None:
    assert trust_of(journal, owner=owner).is_untrusted(movement(author=author)) is untrusted
