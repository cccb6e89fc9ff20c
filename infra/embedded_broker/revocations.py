"""Revoked tokens, stored across restarts until every affected token has expired."""

import contextlib
import os
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import IO

import msgspec

from device_agent.protocol.security.grants import Grant, covering
from device_agent.protocol.security.revocation import Revoke

_SWEEP_S = 60.0
"""Interval between removals of expired revocations from memory [s]."""
_REWRITE_AT = 1_000
"""Number of lines at which the file is rewritten, if at most half of them are in force."""


class RevocationsError(Exception):
    """The revocation file cannot be used; the message names the remedy."""


class _Entry(msgspec.Struct, frozen=True):
    """One line of the file: a grant field, its value, and the last issue time that it covers."""

    field: str
    value: str
    before_s: float


class Revocations:
    """Revocations by token id, client id or principal.

    The file has one JSON object per line and is appended to. ``open``, and growth, rewrite it without expired entries.
    Memory holds those that may still cover a valid token, and those of one sweep.
    A line truncated by a crash is ignored.
    """

    def __init__(self, path: Path, *, lifetime_s: Callable[[str], float]) -> None:
        """``lifetime_s``: maximum lifetime of the tokens of a principal; of any, if it is empty [s].

        Revocations are stored that long.
        """
        self._path = path
        self._lifetime_s = lifetime_s
        self._before: dict[tuple[str, str], float] = {}
        self._file: IO[str] | None = None
        self._lines = 0
        self._swept_s = time.monotonic()

    def open(self) -> None:
        """Load the file, remove expired entries, and keep it open.

        Raises:
            RevocationsError: It cannot be read or written.
        """
        try:
            for entry in self._entries():
                self._store(entry)
            self._remove_expired()
            self._rewrite()
        except OSError as error:
            raise RevocationsError(f"cannot store revocations in {self._path}: {error.strerror}") from error

    def add(self, revoke: Revoke) -> None:
        """Store a revocation; it is durable when the call returns.

        Raises:
            ValueError: Not exactly one of the three fields is set.
            OSError: It could not be written; it stays in effect until the process ends.
        """
        fields = [(field, getattr(revoke, field)) for field in ("client_id", "principal", "token_id")]
        selectors = [(field, value) for field, value in fields if value]
        if len(selectors) != 1:
            raise ValueError("a revocation must name exactly one of client_id, principal and token_id")
        field, value = selectors[0]
        by_time = field != "token_id" and revoke.before_s is not None
        entry = _Entry(field, value, revoke.before_s if by_time and revoke.before_s is not None else time.time())
        self._store(entry)
        if self._file is not None:
            self._file.write(_line(entry))
            self._file.flush()
            os.fsync(self._file.fileno())
            self._lines += 1
        if time.monotonic() - self._swept_s >= _SWEEP_S:
            self._remove_expired()
        if self._lines >= max(_REWRITE_AT, 2 * len(self._before)):
            self._lines = 0  # after a failed rewrite, the next one waits for as many lines again
            with contextlib.suppress(OSError):  # the existing file is still complete
                self._rewrite()

    def covers(self, grant: Grant, issued_at: float) -> bool:
        """Whether a grant whose token was issued at ``issued_at`` [s since 1970] is revoked.

        A revocation from further ahead than the maximum lifetime was stamped by a wrong clock. No token that the broker
        accepts can be as new, and it would lock out the principal until then.
        """
        fields = [("client_id", grant.client_id), *(("principal", name) for name in covering(grant.principal))]
        latest = time.time() + self._lifetime_s("")
        return ("token_id", grant.token_id) in self._before or any(
            issued_at <= self._before.get(name, -1.0) <= latest for name in fields
        )

    def close(self) -> None:
        """Close the file."""
        if self._file is not None:
            self._file.close()
            self._file = None

    def _remove_expired(self) -> None:
        """Remove entries that can no longer cover a valid token."""
        self._swept_s = time.monotonic()
        now_s = time.time()
        self._before = {key: before for key, before in self._before.items() if now_s - before <= self._keep_s(*key)}

    def _keep_s(self, field: str, value: str) -> float:
        """Maximum lifetime of the tokens that a revocation covers [s]."""
        return self._lifetime_s(value if field == "principal" else "")

    def _rewrite(self) -> None:
        """Replace the file by the current entries."""
        temporary = self._path.with_name(f"{self._path.name}.new")
        temporary.touch(mode=0o600)
        with contextlib.ExitStack() as on_error:
            file = on_error.enter_context(temporary.open("w"))
            file.writelines(_line(_Entry(*key, before)) for key, before in self._before.items())
            file.flush()
            os.fsync(file.fileno())
            temporary.replace(self._path)
            on_error.pop_all()
        self.close()
        self._file, self._lines = file, len(self._before)

    def _store(self, entry: _Entry) -> None:
        key = (entry.field, entry.value)
        self._before[key] = max(entry.before_s, self._before.get(key, entry.before_s))

    def _entries(self) -> Iterator[_Entry]:
        if not self._path.exists():
            return
        with self._path.open(errors="replace") as file:
            for line in file:
                try:
                    yield msgspec.json.decode(line, type=_Entry)
                except msgspec.MsgspecError:
                    continue


def _line(entry: _Entry) -> str:
    return msgspec.json.encode(entry).decode() + "\n"
