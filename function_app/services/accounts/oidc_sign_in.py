"""Sign-in with OpenID Connect: redirects a browser to the provider and handles the callback.

The state between the two is one row, found by the hash of ``state`` and deleted by the first callback. It is bound to
one browser by a secret in a cookie, so a callback with the ``code`` of another person does not sign in.
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
from function_app.services.sharing.invitations import Invitations, KnownInvitation
from function_app.services.storage import records

SIGN_IN_TIMEOUT_S: Final = 10 * 60
"""Time limit for signing in at the provider [s]."""

_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class OidcRedirect:
    """The provider's address for the browser, and the secret that the browser stores until the callback."""

    address: str
    secret: str


@dataclass(frozen=True, slots=True)
class OidcCallback:
    """Parameters of the callback; empty if missing. ``secret`` comes from the cookie."""

    state: str = ""
    code: str = ""
    secret: str = ""
    issuer: str | None = None
    error: str = ""


class OidcSignIn:
    """Signs in through the provider. Creates accounts for invited persons; for others only if ``anyone`` is set."""

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
        """Start a sign-in in one browser; ``invitation`` is the secret of an invitation, for new accounts.

        Raises:
            Problem: ``oidc-unknown``: no provider is configured; ``oidc-unavailable``; ``invitation-unknown``.
        """
        provider = self._require_provider()
        invitation_id = (await self._invitations.look(invitation)).id if invitation else ""
        state, nonce, verifier, secret = (new_secret() for _ in range(4))
        challenge = base64.urlsafe_b64encode(hashlib.sha256(verifier.encode()).digest()).rstrip(b"=").decode()
        try:
            address = await provider.address(state=state, nonce=nonce, challenge=challenge, redirect=self._redirect)
        except OidcError as error:
            _log.error("OIDC sign-in: %s", error)
            detail = "The sign-in provider is not available. See the server's log."
            raise Problem(
                "oidc-unavailable", 503, "The sign-in provider is not available", detail, retry_after_s=30
            ) from error
        hashed = _hash(state)
        data = {
            "nonce": nonce,
            "verifier": verifier,
            "secret": _hash(secret),
            "invitation": invitation_id,
            "expires_ms": self._clock.now_ms() + SIGN_IN_TIMEOUT_S * 1000,
        }
        await self._tables.create(records.SIGN_INS, Row(hashed[0], hashed, data))
        return OidcRedirect(address, secret)

    async def finish(self, callback: OidcCallback, origin: SignInOrigin) -> SignedIn:
        """Complete a sign-in. The stored state is consumed in any case.

        Raises:
            Problem: ``oidc-unknown``: no provider is configured; ``oidc-expired``: not started in this browser, or too
                long ago; ``oidc-rejected``: the provider rejected the sign-in, or its response is not valid;
                ``oidc-uninvited``: there is no account, and none is created.
        """
        provider = self._require_provider()
        started = await self._consume_state(callback)
        if callback.error or not callback.code:
            _log.warning("OIDC sign-in: the provider reports %r", callback.error[:200])
            raise _refused()
        try:
            subject = await provider.redeem(
                code=callback.code,
                verifier=started["verifier"],
                nonce=started["nonce"],
                redirect=self._redirect,
                issuer=callback.issuer,
            )
        except OidcError as error:
            _log.error("OIDC sign-in: %s", error)
            raise _refused() from error
        is_new = not await self._sign_in.has_oidc_account(subject.issuer, subject.id)
        existing = await self._invited(started["invitation"]) if is_new else None
        if is_new and existing is None and not self._anyone:
            await self._refuse_uninvited(subject, origin)
        account = await self._sign_in.oidc_account(subject.issuer, subject.id, subject.name)
        signed_in = await self._sessions.begin(account, "oidc", origin)
        if existing is not None:
            await self._redeem_invitation(Identity(account.id, account.name, signed_in.session), existing)
        return signed_in

    async def _invited(self, invitation: str) -> KnownInvitation | None:
        """The invitation of a new person, if it is valid and not reserved for another account."""
        if not invitation:
            return None
        try:
            existing = await self._invitations.find(invitation)
        except Problem:
            return None
        return None if existing.invitation.account else existing

    async def _redeem_invitation(self, caller: Identity, existing: KnownInvitation) -> None:
        try:
            await self._invitations.redeem(caller, existing)
        except Problem as problem:
            # Another account took its last use. The account exists but is empty.
            _log.warning("OIDC sign-in: the invitation of a new account failed: %s", problem.detail)

    async def _refuse_uninvited(self, subject: Subject, origin: SignInOrigin) -> NoReturn:
        code = "oidc-uninvited"
        _log.warning("OIDC sign-in: %r (%r) has no account and no invitation", subject.name, subject.id)
        await self._audit_log.record_rejection(
            CLOUD, AccountEvent.SIGN_IN_REJECTED, None, code=code, address=origin.address
        )
        detail = "You have no account here. Ask an owner for an invitation, or contact the operator of this server."
        raise Problem(code, 403, "Not invited", detail)

    async def _consume_state(self, callback: OidcCallback) -> dict[str, str]:
        hashed = _hash(callback.state)
        expired = Problem(
            "oidc-expired",
            403,
            "Sign-in expired",
            "This sign-in was not started in this browser, or has expired. Start again.",
        )
        row = await self._tables.get(records.SIGN_INS, hashed[0], hashed)
        if row is None or not hmac.compare_digest(str(row.data["secret"]), _hash(callback.secret)):
            raise expired
        try:
            await self._tables.delete(records.SIGN_INS, row)
        except Conflict as conflict:
            raise expired from conflict
        if self._clock.now_ms() >= row.data["expires_ms"]:
            raise expired
        return {name: str(row.data.get(name, "")) for name in ("verifier", "nonce", "invitation")}

    def _require_provider(self) -> OidcProvider:
        if self._provider is None:
            detail = "No sign-in provider is configured. Use a password or a one-time link."
            raise Problem("oidc-unknown", 404, "No sign-in provider", detail)
        return self._provider


def _refused() -> Problem:
    detail = "The sign-in provider rejected the sign-in. Try again, or contact the operator of this server."
    return Problem("oidc-rejected", 403, "Not signed in", detail)


def _hash(text: str) -> str:
    """Domain-separated from one-time links, so that the tokens are not interchangeable."""
    return hashlib.sha256(f"open-id:{text}".encode()).hexdigest()
