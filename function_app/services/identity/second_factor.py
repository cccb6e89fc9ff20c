"""Second factor of local accounts: time-based one-time passwords (TOTP, RFC 6238) and recovery codes."""

import base64
import hashlib
import secrets
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final, Literal

from function_app.domain.audit.hash_chain import AccountEvent
from function_app.domain.common.ids import new_id
from function_app.domain.common.problems import Problem
from function_app.domain.identity.accounts import Account, Identity
from function_app.ports.clock import Clock
from function_app.ports.tables import Row, Tables
from function_app.services.audit.audit_log import AuditLog
from function_app.services.identity.guess_limiter import Guess, GuessLimiter
from function_app.services.identity.sessions import SignInOrigin
from function_app.services.storage import records

if TYPE_CHECKING:
    from pyotp import TOTP

ISSUER: Final = "Telescope"
GUESS: Final = Guess("second-factor", 3_600_000, "Too many wrong codes.")
WRONG_TRIES: Final = 10
"""Wrong codes in one hour. Each guess hits one of three valid codes of 10⁶. Only a caller with the password guesses."""
RECOVERY_CODES: Final = 10
_RECOVERY_LENGTH: Final = 16
"""Characters of a recovery code: 80 bits, so a fast hash is sufficient."""
_SECRET_BYTES: Final = 20
"""160 bits, as RFC 4226 recommends."""
_STEPS: Final = 1
"""Accepted steps of 30 s before and after the current one."""
_KEY: Final = "second-factor"

Used = Literal["", "totp", "recovery-code"]


@dataclass(frozen=True, slots=True)
class _Stored:
    """The factor of an account. ``enabled_ms`` 0: not confirmed. ``step``: newest used time step."""

    secret: str
    enabled_ms: int = 0
    step: int = 0
    recovery: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class SecondFactorStatus:
    """Whether a second factor is enabled, since when, and its unused recovery codes."""

    enabled_ms: int
    recovery_codes: int


class SecondFactor:
    """Checks and manages the second factor. An account without an enabled one passes each check."""

    def __init__(self, *, tables: Tables, guess_limiter: GuessLimiter, audit_log: AuditLog, clock: Clock) -> None:
        self._tables = tables
        self._guess_limiter = guess_limiter
        self._audit_log = audit_log
        self._clock = clock

    async def status(self, account: str) -> SecondFactorStatus:
        """The state of an account's second factor."""
        _, stored = await self._find(account)
        if stored is None or not stored.enabled_ms:
            return SecondFactorStatus(0, 0)
        return SecondFactorStatus(stored.enabled_ms, len(stored.recovery))

    async def check(self, account: str, code: str, origin: SignInOrigin, *, counter: str) -> Used:
        """Check and use up the code of a sign-in or change; ``counter`` counts its wrong codes.

        Raises ``second-factor-required``, ``second-factor-wrong`` or ``too-many-tries``.
        """
        _, stored = await self._find(account)
        if stored is None or not stored.enabled_ms:
            return ""
        if not code:
            detail = "Enter the code of your authenticator app, or a recovery code."
            raise Problem("second-factor-required", 403, "Second factor required", detail)
        counters = {counter: WRONG_TRIES}
        try:
            await self._guess_limiter.add_failure(GUESS, counters)
            used = await records.retry(lambda: self._use(account, code))
        except Problem as problem:
            await self._audit_log.record_rejection(
                account, AccountEvent.SIGN_IN_REJECTED, None, each=True, code=problem.code, address=origin.address
            )
            raise
        await self._guess_limiter.remove_failure(GUESS, counters)
        return used

    async def begin(self, caller: Identity) -> tuple[str, str]:
        """A new secret and its ``otpauth`` URI for an authenticator app; ``enable`` confirms it.

        Raises ``second-factor-enabled``.
        """
        stored = _Stored(base64.b32encode(secrets.token_bytes(_SECRET_BYTES)).decode())

        def change(existing: _Stored | None) -> _Stored:
            if existing is not None and existing.enabled_ms:
                detail = "The account has a second factor. Disable it before you add another one."
                raise Problem("second-factor-enabled", 409, "Second factor enabled", detail)
            return stored

        await records.upsert(self._tables, records.ACCOUNTS, caller.account, _KEY, change, _Stored)
        return stored.secret, _totp(stored.secret).provisioning_uri(name=caller.name, issuer_name=ISSUER)

    async def enable(self, caller: Identity, code: str) -> tuple[str, ...]:
        """Enable the factor with a code of the app; return the recovery codes.

        Raises ``second-factor-unknown``: there is no new secret; ``second-factor-wrong``.
        """
        codes, hashes = _new_recovery_codes()
        now_ms = self._clock.now_ms()

        def confirm(stored: _Stored) -> _Stored:
            if stored.enabled_ms:
                raise _unknown()
            return replace(stored, enabled_ms=now_ms, step=self._step(stored, code), recovery=hashes)

        await self._change(caller, AccountEvent.SECOND_FACTOR_ENABLED, confirm)
        return codes

    async def renew_recovery_codes(self, caller: Identity) -> tuple[str, ...]:
        """Replace all recovery codes. The caller has checked a code. Raises ``second-factor-unknown``."""
        codes, hashes = _new_recovery_codes()
        await self._change(
            caller, AccountEvent.RECOVERY_CODES_MADE, lambda stored: replace(_enabled(stored), recovery=hashes)
        )
        return codes

    async def disable(self, caller: Identity) -> None:
        """Remove the factor. The caller has checked a code. Raises ``second-factor-unknown``."""
        row, stored = await self._find(caller.account)
        if row is None or stored is None:
            raise _unknown()
        _enabled(stored)
        async with self._audit_log.change(caller.account, AccountEvent.SECOND_FACTOR_DISABLED, caller) as change:
            await change.store_pending()
            await records.discard(self._tables, records.ACCOUNTS, row)

    async def remove(self, account: Account) -> None:
        """Remove the factor for the operator of the server, after the loss of app and recovery codes."""
        await self.disable(Identity(account.id, account.name, "terminal"))

    async def _find(self, account: str) -> tuple[Row | None, _Stored | None]:
        return await records.find(self._tables, records.ACCOUNTS, account, _KEY, _Stored)

    async def _change(self, caller: Identity, event: AccountEvent, change: Callable[[_Stored], _Stored]) -> None:
        def changed(stored: _Stored | None) -> _Stored:
            if stored is None:
                raise _unknown()
            return change(stored)

        async with self._audit_log.change(caller.account, event, caller) as record:
            await record.store_pending()
            await records.upsert(self._tables, records.ACCOUNTS, caller.account, _KEY, changed, _Stored)

    async def _use(self, account: str, code: str) -> Used:
        """Use up a code. Of concurrent requests with one code, one succeeds: the write by ETag decides."""
        row, stored = await self._find(account)
        if row is None or stored is None:
            return ""
        hashed = _hash(code)
        if hashed in stored.recovery:
            left = tuple(each for each in stored.recovery if each != hashed)
            await records.update(self._tables, records.ACCOUNTS, row, replace(stored, recovery=left))
            return "recovery-code"
        await records.update(self._tables, records.ACCOUNTS, row, replace(stored, step=self._step(stored, code)))
        return "totp"

    def _step(self, stored: _Stored, code: str) -> int:
        """The time step of a valid code that is newer than the last used one. Raises ``second-factor-wrong``."""
        now_s = self._clock.now_ms() // 1000
        wrong = Problem(
            "second-factor-wrong", 403, "Wrong code", "The code is wrong or was used before. Enter the next code."
        )
        from pyotp.exceptions import OTPVerificationError  # noqa: PLC0415 (as in ``_totp``)

        try:
            step = _totp(stored.secret).verify_and_get_timecode(
                "".join(code.split()), for_time=now_s, valid_window=_STEPS
            )
        except OTPVerificationError as error:
            raise wrong from error
        if step <= stored.step:
            raise wrong
        return step


def sign_in_counter(account: str, device: str) -> str:
    """Counts wrong codes of a sign-in. A known ``device`` has its own, so that others cannot lock it."""
    return f"device:{device}" if device else account


def change_counter(caller: Identity) -> str:
    """Counts wrong codes of changes in a session."""
    return f"session:{caller.session}"


def _totp(secret: str) -> "TOTP":
    from pyotp import TOTP  # noqa: PLC0415 (24 ms, which a cold start need not wait for)

    return TOTP(secret)


def _enabled(stored: _Stored) -> _Stored:
    if not stored.enabled_ms:
        raise _unknown()
    return stored


def _unknown() -> Problem:
    detail = "There is no second factor to change. Add one first."
    return Problem("second-factor-unknown", 404, "No second factor", detail)


def _new_recovery_codes() -> tuple[tuple[str, ...], tuple[str, ...]]:
    """New codes in groups of four characters, and their hashes."""
    plain = [new_id(_RECOVERY_LENGTH) for _ in range(RECOVERY_CODES)]
    shown = tuple("-".join(code[start : start + 4] for start in range(0, _RECOVERY_LENGTH, 4)) for code in plain)
    return shown, tuple(map(_hash, plain))


def _hash(code: str) -> str:
    plain = "".join(code.split()).replace("-", "").lower()
    return hashlib.sha256(f"recovery:{plain}".encode()).hexdigest()
