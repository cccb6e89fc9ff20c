"""Reads and verifies the chains of the audit log."""

import base64
import binascii
import json
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final

from cryptography.exceptions import InvalidSignature

from function_app.domain.audit import hash_chain as rules
from function_app.domain.audit.hash_chain import FIRST, Head
from function_app.domain.common.problems import forbidden, invalid_cursor
from function_app.domain.common.timestamps import rfc3339
from function_app.domain.identity.accounts import Identity
from function_app.ports.blobs import Blobs
from function_app.ports.signing_keys import SigningKeys
from function_app.ports.tables import Row, Tables
from function_app.services.audit.audit_log import anchors, record_key
from function_app.services.storage import records

MAX_SCANNED: Final = 1_000
"""Records read for one page. With a selective filter a page may be short and still have a cursor."""
_CURSOR_DIGITS: Final = 12
_LETTERS: Final = "abcdefghijklmnopqrstuvwxyz234567"
_MOST_NAMES: Final = 1_000


@dataclass(frozen=True, slots=True)
class AuditFilter:
    """A filter by kind, target and time span (``None``: all)."""

    event: str | None = None
    target: str | None = None
    since_ms: int | None = None
    until_ms: int | None = None

    def fits(self, record: Mapping[str, Any]) -> bool:
        """Whether ``record`` matches."""
        at_ms = record["at_ms"]
        return (
            self.event in {None, record["event"]}
            and self.target in {None, record["target"]}
            and (self.since_ms is None or at_ms >= self.since_ms)
            and (self.until_ms is None or at_ms < self.until_ms)
        )


@dataclass(frozen=True, slots=True)
class VerificationResult:
    """The state of one chain.

    Attributes:
        broken: The first invalid place; empty: the chain is intact.
        missing: Which records are missing because a backup was restored, as the chain itself records.
    """

    chain: str
    head: Head
    broken: str = ""
    anchors: int = 0
    missing: str = ""


class AuditReader:
    """Reads and verifies the audit log."""

    def __init__(self, *, tables: Tables, blobs: Blobs, keys: SigningKeys) -> None:
        self._tables = tables
        self._blobs = blobs
        self._keys = keys

    async def read(
        self, caller: Identity, audit_filter: AuditFilter, *, cursor: str | None, limit: int
    ) -> tuple[list[Mapping[str, Any]], str | None]:
        """Records of the caller's chain, newest first, and the cursor of the next page.

        Raises:
            Problem: ``cursor-invalid``; ``forbidden``: the API key is limited to some devices or roles.
        """
        if not caller.most.may_own or caller.only:
            raise forbidden("Reading the audit log requires full access to the account. Sign in, or use another key.")
        if cursor is None:
            row = await self._tables.get(records.AUDIT, caller.account, "head")
            newest = 0 if row is None else int(row.data["seq"])
        elif cursor.isdecimal() and cursor.isascii() and len(cursor) <= _CURSOR_DIGITS:
            newest = int(cursor)
        else:
            raise invalid_cursor()
        oldest = max(FIRST, newest - MAX_SCANNED + 1)
        result: list[Mapping[str, Any]] = []
        while newest >= oldest and len(result) < limit:
            first = max(oldest, newest - limit + 1)
            page = await self._tables.query(
                records.AUDIT, caller.account, first=record_key(first), last=record_key(newest + 1), limit=limit
            )
            for row in reversed(page.rows):
                newest = int(row.key.rpartition(":")[2]) - 1
                if audit_filter.fits(row.data):
                    result.append(row.data)
                    if len(result) == limit:
                        break
            else:
                newest = first - 1
        return result, str(newest) if newest >= FIRST else None

    async def chains(self) -> list[str]:
        """All chains, including deleted ones whose heads are still in the blob store."""
        names = {row.key async for row in records.all_rows(self._tables, records.AUDIT, "chains")}
        for prefix in ("cloud", *_LETTERS):
            names |= {name.split("/")[1] for name in await self._chain_names(f"audit/{prefix}")}
        return sorted(names)

    async def head(self, chain: str) -> Head | None:
        """The end of a chain; ``None`` if it does not exist."""
        row = await self._tables.get(records.AUDIT, chain, "head")
        return None if row is None else Head(int(row.data["seq"]), str(row.data["hash"]))

    async def verify(self, chain: str, *, expected: tuple[Head, ...] = ()) -> VerificationResult:
        """Verify a chain against its anchors in the blob store, and against ``expected``: heads stored elsewhere."""
        anchored = await self._anchors(chain)
        if isinstance(anchored, str):
            return VerificationResult(chain, rules.genesis(chain), anchored)
        result = await self._verify(chain, anchored, expected)
        restored = await self._last_restore(chain) if result.broken else None
        if restored is None:
            return result
        # Records from the restore on have other hashes than the lost ones of the same numbers.
        seq = int(restored.key.rpartition(":")[2])
        before = [tuple(head for head in heads if head.seq < seq) for heads in (anchored, expected)]
        if (await self._verify(chain, *before)).broken:
            return result
        missing = (
            f"the tables were restored at record {seq} from a backup of {rfc3339(restored.data['data']['backup_ms'])}; "
            f"records that were written between that time and {rfc3339(restored.data['at_ms'])} are missing"
        )
        return VerificationResult(chain, await self.head(chain) or result.head, "", result.anchors, missing)

    async def _last_restore(self, chain: str) -> Row | None:
        """The newest record of a restored backup."""
        restored = None
        async for row in records.all_rows(self._tables, records.AUDIT, chain, first=record_key(0), last="record;"):
            if row.data.get("event") == rules.AccountEvent.RESTORED:
                restored = row
        return restored

    async def _verify(self, chain: str, anchored: tuple[Head, ...], expected: tuple[Head, ...]) -> VerificationResult:
        existing = {head.seq: head for head in anchored} | {head.seq: head for head in expected}
        for head in (*anchored, *expected):
            if existing[head.seq] != head:
                return VerificationResult(chain, head, f"two different heads are stored for record {head.seq}")
        end = await self._tables.get(records.AUDIT, chain, "head")
        reached, broken = await self._walk(chain, end, existing)
        if not broken:
            broken = await self._end(chain, end, reached)
        if not broken and (missing := [seq for seq in existing if seq > reached.seq]):
            broken = f"record {reached.seq + 1} and all later ones are missing; an anchor names record {max(missing)}"
        return VerificationResult(chain, reached, broken, len(anchored))

    async def _walk(self, chain: str, end: Row | None, existing: Mapping[int, Head]) -> tuple[Head, str]:
        """Verify the chain up to ``end``; return the last valid head and the first error."""
        head = rules.genesis(chain)
        last = _number(end.data.get("seq")) if end is not None else 0
        span = {"first": record_key(0), "last": record_key(last + 1)}
        async for row in records.all_rows(self._tables, records.AUDIT, chain, **span):
            error = rules.record_error(head, row.data)
            if not error and row.key != record_key(head.seq + 1):
                error = "its row has another key"
            if error:
                return head, f"record {head.seq + 1}: {error}"
            head = Head(head.seq + 1, str(row.data["hash"]))
            if existing.get(head.seq, head) != head:
                return head, f"record {head.seq}: its hash differs from the anchor"
        return head, ""

    async def _end(self, chain: str, end: Row | None, reached: Head) -> str:
        """Verify the stored head of the chain."""
        after = await self._tables.query(
            records.AUDIT, chain, first=record_key(reached.seq + 1), last="record;", limit=1
        )
        now = await self._tables.get(records.AUDIT, chain, "head")
        if end is None:
            return "the head is missing, but records exist" if after.rows and now is None else ""
        if now is None:
            return "the head is missing"
        if reached.seq != _number(end.data.get("seq")):
            return f"record {reached.seq + 1}: it is missing"
        if reached.hash != end.data.get("hash"):
            return "the head is not the hash of the newest record"
        if after.rows and now.etag == end.etag:
            return f"record {reached.seq + 1}: it is newer than the head"
        return await self._signature(chain, end, reached)

    async def _signature(self, chain: str, end: Row, head: Head) -> str:
        if set(end.data) != {"seq", "hash", "at_ms", "key", "signature"}:
            return "the head has other fields than the original"
        key = (await self._keys.archive()).get(str(end.data["key"]))
        if key is None:
            name = str(end.data["key"])[:40]
            return f"the head is signed with the unknown or leaked key {name!r}"
        try:
            text = str(end.data["signature"])
            signature = base64.b64decode(text, altchars=b"-_", validate=True)
            if base64.urlsafe_b64encode(signature).decode() != text:
                return "the head's signature is not in canonical form"
            key.verify(signature, rules.signed_bytes(chain, head, end.data["at_ms"]))
        except (InvalidSignature, ValueError, binascii.Error):
            return "the head's signature is invalid"
        return ""

    async def _anchors(self, chain: str) -> tuple[Head, ...] | str:
        text = await self._blobs.get(anchors(chain)) or b""
        result = []
        for number, line in enumerate(text.splitlines(), 1):
            try:
                read = json.loads(line)
                head = rules.parse_head(f"{read['seq']}:{read['hash']}")
            except (ValueError, TypeError, KeyError):
                head = None
            if head is None:
                return f"line {number} of the anchors in the blob store ({anchors(chain)}) cannot be read"
            result.append(head)
        return tuple(result)

    async def _chain_names(self, prefix: str) -> set[str]:
        names = set(await self._blobs.list(prefix, limit=_MOST_NAMES))
        if len(names) == _MOST_NAMES:
            for letter in _LETTERS:
                names |= await self._chain_names(prefix + letter)
        return names


def _number(value: Any) -> int:
    return value if isinstance(value, int) and not isinstance(value, bool) and 0 <= value < 10**_CURSOR_DIGITS else 0
