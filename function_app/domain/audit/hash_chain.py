"""A hash chain of audit records: each hash covers the record and the previous hash.

A changed, deleted, swapped or inserted record breaks the chain at that place. Truncation is detected by signed heads
that are also stored elsewhere (``services/audit/audit_log.py``).
"""

import hashlib
import json
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Any, Final, Literal

from function_app.domain.identity.accounts import Identity

Outcome = Literal["done", "rejected", "failed", "unknown"]
"""``unknown``: the process was killed during the operation; check its target."""
CLOUD: Final = "cloud"
"""The chain of records without an account."""
FIRST: Final = 1
"""Number of the first record of a chain."""
_GENESIS: Final = b"telescope/v1/audit\n"
_HEAD: Final = b"telescope/v1/audit-head\n"
_EXPECTED: Final = re.compile(r"\A([0-9]{1,12}):([0-9a-f]{64})\Z")


class AccountEvent(StrEnum):
    """Audited operations on an account. For operations on control see ``control_events.Fact``."""

    SIGNED_IN = "signed-in"
    SIGN_IN_REJECTED = "sign-in-rejected"
    SIGNED_OUT = "signed-out"
    ACCOUNT_MADE = "account-made"
    PASSWORD_SET = "password-set"  # noqa: S105 (an event, not a password)
    SECOND_FACTOR_ENABLED = "second-factor-enabled"
    SECOND_FACTOR_DISABLED = "second-factor-disabled"
    RECOVERY_CODES_MADE = "recovery-codes-made"
    API_KEY_MADE = "api-key-made"
    API_KEY_REVOKED = "api-key-revoked"
    SIGNING_KEY_ROTATED = "signing-key-rotated"
    SPACE_MADE = "space-made"
    AGENT_CLAIMED = "agent-claimed"
    CLAIM_REJECTED = "claim-rejected"
    AGENT_UNPAIRED = "agent-unpaired"
    AGENT_MOVED = "agent-moved"
    DEVICE_RENAMED = "device-renamed"
    CAMERA_CONSENT_SET = "camera-consent-set"
    SHARED = "shared"
    UNSHARED = "unshared"
    INVITED = "invited"
    INVITATION_REDEEMED = "invitation-redeemed"
    INVITATION_REVOKED = "invitation-revoked"
    TRANSFERRED = "transferred"
    MOVEMENT_SAVED = "movement-saved"
    MOVEMENT_DELETED = "movement-deleted"
    ROBOT_TYPE_UPLOADED = "robot-type-uploaded"
    ROBOT_TYPE_DELETED = "robot-type-deleted"
    RESTORED = "restored"


@dataclass(frozen=True, slots=True)
class Entry:
    """A record to append. ``data`` is plain JSON."""

    id: str
    at_ms: int
    event: str
    outcome: Outcome = "done"
    target: str = ""
    actor: str = ""
    account: str = ""
    session: str = ""
    key: str = ""
    data: Mapping[str, Any] = field(default_factory=dict)

    def fields(self) -> dict[str, Any]:
        """The fields as stored."""
        return {
            "id": self.id,
            "at_ms": self.at_ms,
            "event": self.event,
            "outcome": self.outcome,
            "target": self.target,
            "actor": self.actor,
            "account": self.account,
            "session": self.session,
            "key": self.key,
            "data": json.loads(json.dumps(dict(self.data), allow_nan=False)),
        }


@dataclass(frozen=True, slots=True)
class Head:
    """The end of a chain: number and hash of its newest record."""

    seq: int
    hash: str

    def __str__(self) -> str:
        return f"{self.seq}:{self.hash}"


def entry(
    event: str,
    caller: Identity | None,
    *,
    entry_id: str,
    at_ms: int,
    on: str = "",
    outcome: Outcome = "done",
    **data: Any,
) -> Entry:
    """An entry for an operation of ``caller`` on the target ``on``; ``None``: an unknown caller, or the cloud."""
    by = {} if caller is None else {"actor": caller.name, "account": caller.account, "session": caller.session}
    return Entry(entry_id, at_ms, event, outcome, on, **by, key="" if caller is None else caller.key, data=data)


def genesis(chain: str) -> Head:
    """The head of an empty chain. It differs between accounts, so that chains are not interchangeable."""
    return Head(FIRST - 1, hashlib.sha256(_GENESIS + chain.encode()).hexdigest())


def append(head: Head, fields: Mapping[str, Any]) -> tuple[Head, dict[str, Any]]:
    """The head after ``fields`` are appended, and the record as stored."""
    numbered = {**fields, "seq": head.seq + 1}
    after = Head(head.seq + 1, _hash(head.hash, numbered))
    return after, {**numbered, "hash": after.hash}


def record_error(head: Head, record: Mapping[str, Any]) -> str:
    """Why ``record`` is not valid after ``head``; empty if it is valid."""
    if record.get("seq") != head.seq + 1 or isinstance(record["seq"], bool):
        return f"its number is {record.get('seq')!r}"
    rest = {name: value for name, value in record.items() if name != "hash"}
    if _hash(head.hash, rest) != record.get("hash"):
        return "the record or its hash was modified"
    return ""


def signed_bytes(chain: str, head: Head, at_ms: int) -> bytes:
    """The bytes of a head that the cloud signs."""
    return _HEAD + f"{chain}\n{head}\n{at_ms}".encode()


def parse_head(text: str) -> Head | None:
    """A head from its text form ``<number>:<hash>``; ``None`` if it is not valid."""
    result = _EXPECTED.match(text.strip())
    return Head(int(result[1]), result[2]) if result else None


def _hash(before: str, fields: Mapping[str, Any]) -> str:
    # Sorted, without spaces, in ASCII: a record has the same bytes in every store.
    text = json.dumps(fields, sort_keys=True, separators=(",", ":"), allow_nan=False)
    return hashlib.sha256(bytes.fromhex(before) + text.encode()).hexdigest()
