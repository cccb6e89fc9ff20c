"""What was taken back, remembered over restarts until no token from before can still be running."""

import contextlib
import json
import os
import time
from collections.abc import Iterator
from pathlib import Path
from typing import IO

import msgspec

from device_agent.protocol.security.grants import Grant, covering
from device_agent.protocol.security.revocation import Revoke

_TIDY_AT = 1_000
"""Revocations from which on those that have run out are looked for."""


class RevocationsError(Exception):
    """The file of revocations cannot be used; the text says what to do."""


class _Entry(msgspec.Struct, frozen=True):
    """One line of the file: which field of a grant, its value, and the last moment of issue that it covers."""

    field: str
    value: str
    before_s: float


class Revocations:
    """Refused tokens, by token id, client id or principal.

    The file has one JSON object a line and is appended to; at ``open``, and when there are many, it is written anew
    without what has run out. A line that a crash has cut short is passed over.
    """

    def __init__(self, path: Path, *, keep_s: float) -> None:
        """Remember for ``keep_s`` [s]: the longest that a token may run."""
        self._path = path
        self._keep_s = keep_s
        self._before: dict[tuple[str, str], float] = {}
        self._file: IO[str] | None = None
        self._tidy_at = _TIDY_AT

    def open(self) -> None:
        """Read the file, tidy it, and keep it open.

        Raises:
            RevocationsError: It cannot be read or written.
        """
        oldest = time.time() - self._keep_s
        try:
            for entry in self._entries():
                if entry.before_s >= oldest:
                    self._keep(entry)
            self._write_anew()
        except OSError as error:
            raise RevocationsError(f"cannot keep revocations in {self._path}: {error.strerror}") from error

    def add(self, revoke: Revoke) -> None:
        """Refuse from now on what ``revoke`` names; on return this survives the end of the process.

        Raises:
            ValueError: Not exactly one of its three was given.
            OSError: It could not be written. It holds all the same, as long as this process lives.
        """
        named = [(field, getattr(revoke, field)) for field in ("client_id", "principal", "token_id")]
        given = [(field, value) for field, value in named if value]
        if len(given) != 1:
            raise ValueError("a revocation names exactly one of client_id, principal and token_id")
        field, value = given[0]
        by_time = field != "token_id" and revoke.before_s is not None
        entry = _Entry(field, value, revoke.before_s if by_time and revoke.before_s is not None else time.time())
        self._keep(entry)
        if self._file is not None:
            self._file.write(f"{self._line(entry)}\n")
            self._file.flush()
            os.fsync(self._file.fileno())
        if len(self._before) >= self._tidy_at:
            self._forget()
            self._tidy_at = max(_TIDY_AT, 2 * len(self._before))
            with contextlib.suppress(OSError):  # the file that there is has all of it, and more
                self._write_anew()

    def covers(self, grant: Grant, issued_at: float) -> bool:
        """Whether a grant whose token was made at ``issued_at`` [s since 1970] has been taken back."""
        named = [("client_id", grant.client_id), *(("principal", name) for name in covering(grant.principal))]
        return ("token_id", grant.token_id) in self._before or any(
            issued_at <= self._before.get(name, -1.0) for name in named
        )

    def close(self) -> None:
        """Close the file."""
        if self._file is not None:
            self._file.close()
            self._file = None

    def _forget(self) -> None:
        """Let go of what no running token can be covered by any more."""
        oldest = time.time() - self._keep_s
        self._before = {key: before for key, before in self._before.items() if before >= oldest}

    def _write_anew(self) -> None:
        """Have a file of what is remembered, and of nothing else, in the place of the one before."""
        tidy = self._path.with_name(f"{self._path.name}.new")
        tidy.touch(mode=0o600)
        with contextlib.ExitStack() as on_error:
            file = on_error.enter_context(tidy.open("w"))
            file.writelines(f"{self._line(_Entry(*key, before))}\n" for key, before in self._before.items())
            file.flush()
            os.fsync(file.fileno())
            tidy.replace(self._path)
            on_error.pop_all()
        self.close()
        self._file = file

    def _keep(self, entry: _Entry) -> None:
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

    @staticmethod
    def _line(entry: _Entry) -> str:
        return json.dumps(msgspec.to_builtins(entry))
