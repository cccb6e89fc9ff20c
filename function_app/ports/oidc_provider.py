"""Somebody else's word on who somebody is: an OpenID Connect provider."""

from dataclasses import dataclass
from typing import Protocol


class OidcError(Exception):
    """The provider cannot be used, or what came from it is not believed. Fit for an operator, never for the page."""


@dataclass(frozen=True, slots=True)
class Subject:
    """Whom the provider says this is. ``issuer`` and ``id`` are theirs for ever; the name may be anybody's."""

    issuer: str
    id: str
    name: str


class OidcProvider(Protocol):
    """One provider, by the code flow with PKCE. The constructor reaches nobody; what is fetched is kept for a while."""

    async def address(self, *, state: str, nonce: str, challenge: str, redirect: str) -> str:
        """Where to send a browser that is to sign in.

        Args:
            state: Comes back with the browser.
            nonce: Comes back in the signed word.
            challenge: Of the verifier that ``redeem`` will show (S256).
            redirect: Where the browser is sent back to.

        Raises:
            OpenIdError: The provider is not reached, or not what it should be.
        """

    async def redeem(self, *, code: str, verifier: str, nonce: str, redirect: str, issuer: str | None) -> Subject:
        """Whom the provider has signed in.

        Args:
            code: As it came back.
            verifier: Whose hash was the challenge.
            nonce: As it was sent.
            redirect: As it was sent.
            issuer: Who says it sent the browser back, where that was said (RFC 9207).

        Raises:
            OpenIdError: It is refused, or is not signed, or not for us, now and this very sign-in.
        """
