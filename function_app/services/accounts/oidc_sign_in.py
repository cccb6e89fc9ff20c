"""Signing in elsewhere: a browser is sent to an OpenID Connect provider and comes back with its word on who this is.

What has to be remembered in between is one row, found by the hash of ``state`` and deleted by whoever brings it first.
It belongs to one browser, by a secret in a cookie: whoever is sent here with somebody else's ``code`` is not signed in.
"""

import base64
import hashlib
import hmac
import logging
from dataclasses import dataclass
from typing import Final, NoReturn

from function_app.domain.audit.hash_chain import CLOUD, AccountEvent
from function_app.domain.common.problems import Problem
from function_app.domain.identity.accounts import Identity
from function_app.ports.clock import Clock
from function_app.ports.oidc_provider import OidcError, OidcProvider, Subject
from function_app.ports.tables import Conflict, Row, Tables
from function_app.services.audit.audit_log import AuditLog
from function_app.services.identity.authenticator import new_secret
from function_app.services.identity.sessions import Sessions, SignedIn, SignInOrigin
from function_app.services.identity.sign_in import SignIn
from function_app.services.sharing.invitations import Invitations, Known
from function_app.services.storage import records

BEGUN_S: Final = 10 * 60
"""So long somebody may take to sign in there."""

_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class OidcRedirect:
    """Where to send the browser, and what it is to keep until it comes back."""

    address: str
    secret: str


@dataclass(frozen=True, slots=True)
class OidcCallback:
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


class OidcSignIn:
    """Signing in at one provider, where there is one.

    An account is made for who brings an invitation; for ``anyone`` else only where that is wanted.
    """

    def __init__(
        self,
        *,
        tables: Tables,
        provider: OidcProvider | None,
        redirect: str,
        anyone: bool,
        sign_in: SignIn,
        sessions: Sessions,
        invitations: Invitations,
        audit_log: AuditLog,
        clock: Clock,
    ) -> None:
        self._tables = tables
        self._provider = provider
        self._redirect = redirect
        self._anyone = anyone
        self._sign_in = sign_in
        self._sessions = sessions
        self._invitations = invitations
        self._audit_log = audit_log
        self._clock = clock

    async def begin(self, invitation: str = "") -> OidcRedirect:
        """Begin in one browser.

        Args:
            invitation: The secret of one that whoever signs in brings along.

        Raises:
            Problem: ``oidc-unknown``: there is no provider; ``oidc-unavailable``; ``invitation-unknown``.
        """
        provider = self._known()
        brought = (await self._invitations.look(invitation)).id if invitation else ""
        state, nonce, verifier, secret = (new_secret() for _ in range(4))
        challenge = base64.urlsafe_b64encode(hashlib.sha256(verifier.encode()).digest()).rstrip(b"=").decode()
        try:
            address = await provider.address(state=state, nonce=nonce, challenge=challenge, redirect=self._redirect)
        except OidcError as error:
            _log.error("sign-in elsewhere: %s", error)
            detail = "The sign-in provider cannot be used now; the log of this server says why."
            raise Problem("oidc-unavailable", 503, "No sign-in elsewhere now", detail, retry_after_s=30) from error
        hashed = _hash(state)
        data = {
            "nonce": nonce,
            "verifier": verifier,
            "secret": _hash(secret),
            "invitation": brought,
            "expires_ms": self._clock.now_ms() + BEGUN_S * 1000,
        }
        await self._tables.create(records.SIGN_INS, Row(hashed[0], hashed, data))
        return OidcRedirect(address, secret)

    async def finish(self, returned: OidcCallback, whence: SignInOrigin) -> SignedIn:
        """Sign in whoever comes back. What was begun is used up by it, whatever becomes of it.

        Raises:
            Problem: ``oidc-unknown``: there is no provider; ``oidc-expired``: this was not begun here, in this
                browser, just now; ``oidc-rejected``: the provider, or what came from it, does not sign them in;
                ``oidc-uninvited``: they have no account here, and none is made for them.
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
        except OidcError as error:
            _log.error("sign-in elsewhere: %s", error)
            raise _refused() from error
        is_new = not await self._sign_in.is_known_elsewhere(subject.issuer, subject.id)
        existing = await self._invited(begun["invitation"]) if is_new else None
        if is_new and existing is None and not self._anyone:
            await self._refuse_stranger(subject, whence)
        account = await self._sign_in.account_elsewhere(subject.issuer, subject.id, subject.name)
        done = await self._sessions.begin(account, "oidc", whence)
        if existing is not None:
            await self._take(Identity(account.id, account.name, done.session), existing)
        return done

    async def _invited(self, invitation: str) -> Known | None:
        """What a newcomer brings along, if it is still good and for nobody else."""
        if not invitation:
            return None
        try:
            existing = await self._invitations.find(invitation)
        except Problem:
            return None
        return None if existing.invitation.account else existing

    async def _take(self, caller: Identity, existing: Known) -> None:
        try:
            await self._invitations.redeem(caller, existing)
        except Problem as problem:
            # Somebody else was first with its last use. The account is there all the same, and empty.
            _log.warning("sign-in elsewhere: the invitation of a new account came to nothing: %s", problem.detail)

    async def _refuse_stranger(self, subject: Subject, whence: SignInOrigin) -> NoReturn:
        code = "oidc-uninvited"
        _log.warning("sign-in elsewhere: %r (%r) has no account here and was not invited", subject.name, subject.id)
        await self._audit_log.record_rejection(
            CLOUD, AccountEvent.SIGN_IN_REFUSED, None, code=code, address=whence.address
        )
        detail = "Nobody has invited you here. Ask somebody for an invitation, or whoever runs this server."
        raise Problem(code, 403, "Not invited", detail)

    async def _begun(self, returned: OidcCallback) -> dict[str, str]:
        hashed = _hash(returned.state)
        expired = Problem("oidc-expired", 403, "Begin again", "This sign-in was not begun here just now. Begin again.")
        row = await self._tables.get(records.SIGN_INS, hashed[0], hashed)
        if row is None or not hmac.compare_digest(str(row.data["secret"]), _hash(returned.secret)):
            raise expired
        try:
            await self._tables.delete(records.SIGN_INS, row)
        except Conflict as conflict:
            raise expired from conflict
        if self._clock.now_ms() >= row.data["expires_ms"]:
            raise expired
        return {name: str(row.data.get(name, "")) for name in ("verifier", "nonce", "invitation")}

    def _known(self) -> OidcProvider:
        if self._provider is None:
            detail = "Nobody signs in elsewhere at this server. Use a password or a one-time link."
            raise Problem("oidc-unknown", 404, "No sign-in elsewhere", detail)
        return self._provider


def _refused() -> Problem:
    detail = "The sign-in provider did not sign you in. Try again, or ask whoever runs this server: its log says why."
    return Problem("oidc-rejected", 403, "Not signed in", detail)


def _hash(text: str) -> str:
    """Of another kind than a one-time link's: neither is ever taken for the other."""
    return hashlib.sha256(f"open-id:{text}".encode()).hexdigest()
