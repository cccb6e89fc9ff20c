"""Script policy: signatures, versions and authors."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgspec
import pytest

from device_agent.protocol import SHIPPED, RunMovement
from device_agent.protocol.security import signing
from device_agent.runtime.actions.script_policy import ScriptPolicy
from device_agent.runtime.errors import Refused
from device_agent.runtime.storage.journal import Journal
from tests.harness.agent.controller_fixture import refuses
from tests.harness.agent.device_harness import signed_movement

OWNER, OTHER = "accountaaaaaaaaa", "accountbbbbbbbbb"
KEY = signing.generate()


@pytest.fixture
def journal(tmp_path: Path) -> Iterator[Journal]:
    journal = Journal(tmp_path / "journal.db")
    journal.open(now_ms=0)
    yield journal
    journal.close()


def policy_of(journal: Journal, *, device: str = "arm", owner: str = OWNER) -> ScriptPolicy:
    keys = {signing.key_id(KEY.public_key()): KEY.public_key()}
    return ScriptPolicy(device=device, robot_type="test", owner=owner, keys=keys, journal=journal)


def movement(version: int = 1, author: str = OWNER) -> RunMovement:
    return signed_movement("print(1)", KEY, version=version, author=author)


@pytest.mark.parametrize(
    ("changes", "code"),
    [
        ({"source": "print(2)"}, "wrong_hash"),
        ({"sha256": "0" * 64}, "wrong_hash"),
        ({"robot_type": "nao"}, "wrong_type"),
        ({"name": "wave"}, "bad_signature"),
        ({"version": 0}, "bad_signature"),
        ({"version": 2}, "bad_signature"),
        ({"signature": ""}, "bad_signature"),
        ({"signature": "x" * 86}, "bad_signature"),
        ({"key": ""}, "bad_signature"),
        ({"key": "another"}, "bad_signature"),
    ],
)
def test_a_modified_script_is_rejected(journal: Journal, changes: Any, code: str) -> None:
    policy = policy_of(journal)
    policy.verify(movement())
    with refuses(code):
        policy.verify(msgspec.structs.replace(movement(), **changes))


def test_a_change_of_any_character_is_rejected(journal: Journal) -> None:
    valid, policy = movement(), policy_of(journal)
    for field in ("source", "sha256", "name", "robot_type", "signature", "key"):
        text: str = getattr(valid, field)
        for index in range(len(text)):
            other = "b" if text[index] != "b" else "c"
            changed: Any = {field: text[:index] + other + text[index + 1 :]}
            with pytest.raises(Refused):
                policy.verify(msgspec.structs.replace(valid, **changed))


def test_a_command_signature_is_not_valid_for_a_movement(journal: Journal) -> None:
    valid = movement()
    text = signing.movement_text(valid.robot_type, valid.name, valid.version, valid.sha256)
    signature = signing.sign_text(text, KEY, context=signing.COMMAND_CONTEXT)
    with refuses("bad_signature"):
        policy_of(journal).verify(msgspec.structs.replace(valid, signature=signature))


def test_an_older_version_than_one_that_ran_is_refused_also_after_a_restart(journal: Journal) -> None:
    policy = policy_of(journal)
    policy.verify(movement(9))
    policy.verify(movement(3))
    policy.record_version(movement(3))
    policy.record_version(movement(2))
    journal.close()
    journal.open(now_ms=0)
    restarted = policy_of(journal)
    with refuses("rolled_back"):
        restarted.verify(movement(2))
    restarted.verify(movement(3))
    restarted.verify(movement(4))


@pytest.mark.parametrize(
    ("device", "author"), [("other", OWNER), ("arm", SHIPPED), ("arm", OTHER)], ids=["device", "shipped", "account"]
)
def test_versions_count_per_device_and_author(journal: Journal, device: str, author: str) -> None:
    policy_of(journal).record_version(movement(9))
    policy_of(journal, device=device).verify(movement(1, author))


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
def test_authors_other_than_owner_and_project_are_untrusted(
    journal: Journal, author: str, owner: str, untrusted: bool
) -> None:
    assert policy_of(journal, owner=owner).is_untrusted(movement(author=author)) is untrusted
