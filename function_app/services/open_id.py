"""Signing in elsewhere: a browser is sent to an OpenID Connect provider and comes back with its word on who this is.

What has to be remembered in between is one row, found by the hash of ``state`` and deleted by whoever brings it first.
It belongs to one browser, by a secret in a cookie: whoever is sent here with somebody else's ``code`` is not signed in.
"""

import base64
import hashlib
import hmac
import logging
from dataclasses import dataclass
from typing import Final

from function_app.domain.problems import Problem
from function_app.ports.clock import Clock
from function_app.ports.open_id import OpenId, OpenIdError
from function_app.ports.tables import Conflict, Row, Tables
from function_app.services import store
from function_app.services.identity import new_secret
from function_app.services.sessions import From, Sessions, SignedIn
from function_app.services.sign_in import SignIn

BEGUN_S: Final = 10 * 60
"""So long somebody may take to sign in there."""

_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class Begun:
    """Where to send the browser, and what it is to keep until it comes back."""

    address: str
    secret: str


@dataclass(frozen=True, slots=True)
class Returned:
    """What a browser comes back with; empty where it brought nothing.

    Attributes:
        secret: That it was to keep.
        issuer: Who sent it back; ``None`` where that is not said.
        error: Why the provider signs nobody in.
    """

    state: str = ""
    code: str = ""
    secret: str = ""
    issuer: str | None = None
    error: str = ""


class OpenIdSignIn:
    """Signing in at one provider, where there is one."""

    def __init__(
        self,
        *,
        tables: Tables,
        provider: OpenId | None,
        redirect: str,
        sign_in: SignIn,
        sessions: Sessions,
        clock: Clock,
    ) -> None:
        self._tables = tables
        self._provider = provider
        self._redirect = redirect
        self._sign_in = sign_in
        self._sessions = sessions
        self._clock = clock

    async def begin(self) -> Begun:
        """Begin in one browser.

        Raises:
            Problem: ``open-id-unknown``: there is no provider; ``open-id-unavailable``.
        """
        state, nonce, verifier, secret = (new_secret() for _ in range(4))
        challenge = base64.urlsafe_b64encode(hashlib.sha256(verifier.encode()).digest()).rstrip(b"=").decode()
        try:
            address = await self._known().address(
                state=state, nonce=nonce, challenge=challenge, redirect=self._redirect
            )
        except OpenIdError as error:
            _log.error("sign-in elsewhere: %s", error)
            detail = "The sign-in provider cannot be used now; the log of this server says why."
            raise Problem("open-id-unavailable", 503, "No sign-in elsewhere now", detail, retry_after_s=30) from error
        hashed = _hash(state)
        data = {
            "nonce": nonce,
            "verifier": verifier,
            "secret": _hash(secret),
            "expires_ms": self._clock.now_ms() + BEGUN_S * 1000,
        }
        await self._tables.create(store.SIGN_INS, Row(hashed[0], hashed, data))
        return Begun(address, secret)

    async def finish(self, returned: Returned, whence: From) -> SignedIn:
        """Sign in whoever comes back. What was begun is used up by it, whatever becomes of it.

        Raises:
            Problem: ``open-id-unknown``: there is no provider; ``open-id-expired``: this was not begun here, in this
                browser, just now; ``open-id-refused``: the provider, or what came from it, does not sign them in.
        """
        provider = self._known()
        begun = await self._begun(returned)
        if returned.error or not returned.code:
            _log.warning("sign-in elsewhere: the provider says %r", returned.error[:200])
            raise _refused()
        try:
            subject = await provider.redeem(
                code=returned.code,
                verifier=begun["verifier"],
                nonce=begun["nonce"],
                redirect=self._redirect,
                issuer=returned.issuer,
            )
        except OpenIdError as error:
            _log.error("sign-in elsewhere: %s", error)
            raise _refused() from error
        account = await self._sign_in.account_elsewhere(subject.issuer, subject.id, subject.name)
        return await self._sessions.begin(account, "open-id", whence)

    async def _begun(self, returned: Returned) -> dict[str, str]:
        hashed = _hash(returned.state)
        expired = Problem(
            "open-id-expired", 403, "Begin again", "This sign-in was not begun here just now. Begin again."
        )
        row = await self._tables.get(store.SIGN_INS, hashed[0], hashed)
        if row is None or not hmac.compare_digest(str(row.data["secret"]), _hash(returned.secret)):
            raise expired
        try:
            await self._tables.delete(store.SIGN_INS, row)
        except Conflict as conflict:
            raise expired from conflict
        if self._clock.now_ms() >= row.data["expires_ms"]:
            raise expired
        return {name: str(row.data[name]) for name in ("verifier", "nonce")}

    def _known(self) -> OpenId:
        if self._provider is None:
            detail = "Nobody signs in elsewhere at this server. Use a password or a one-time link."
            raise Problem("open-id-unknown", 404, "No sign-in elsewhere", detail)
        return self._provider


def _refused() -> Problem:
    detail = "The sign-in provider did not sign you in. Try again, or ask whoever runs this server: its log says why."
    return Problem("open-id-refused", 403, "Not signed in", detail)


def _hash(text: str) -> str:
    """Of another kind than a one-time link's: neither is ever taken for the other."""
    return hashlib.sha256(f"open-id:{text}".encode()).hexdigest()
