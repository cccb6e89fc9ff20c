"""An OpenID Connect provider."""

from dataclasses import dataclass
from typing import Protocol


class OidcError(Exception):
    """The provider is not usable, or its response is not trusted. The text is for operators, not for the page."""


@dataclass(frozen=True, slots=True)
class Subject:
    """The signed-in person. ``issuer`` and ``id`` are stable; the name is not verified."""

    issuer: str
    id: str
    name: str


class OidcProvider(Protocol):
    """One provider, used with the code flow and PKCE. The constructor makes no request; metadata are cached.

    If the provider is not reachable, calls raise ``OidcError``. ``address`` may be retried; a code can be redeemed
    once.

    Example::

        url = await provider.address(state=state, nonce=nonce, challenge=challenge, redirect=callback)
    """

    async def address(self, *, state: str, nonce: str, challenge: str, redirect: str) -> str:
        """The URL to which a browser is redirected for sign-in.

        The browser returns ``state``, the signed token ``nonce``; ``challenge`` is the S256 challenge of the verifier
        that is passed to ``redeem``, and ``redirect`` the callback URL.

        Raises:
            OidcError: The provider is not reachable or its metadata are not valid.
        """

    async def redeem(self, *, code: str, verifier: str, nonce: str, redirect: str, issuer: str | None) -> Subject:
        """The person whom the provider signed in.

        ``code`` and ``issuer`` (``iss``, RFC 9207) are parameters of the callback, the others as sent to ``address``.

        Raises:
            OidcError: The code is rejected, or the token is not signed, not for this client, expired, or of another
                sign-in.
        """
