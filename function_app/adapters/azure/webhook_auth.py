"""Who asks our webhook: the namespace's managed identity, by a token of Microsoft Entra's for our application.

Checked are signature, issuer, audience, times, and the identity (``oid``): any identity of the tenant may ask Entra
for a token for our application. Sources: Microsoft, "Custom webhook authentication for MQTT clients" (what a webhook
has to check), "Access token claims reference" (``aud`` and ``iss`` of versions 1 and 2, ``oid``).
"""

import asyncio
import time
from typing import Any

import jwt

from function_app.ports.tables import StoreError

AUTHORITY = "https://login.microsoftonline.com"
ISSUER_V1 = "https://sts.windows.net"
ALGORITHM = "RS256"
SKEW_S = 60
KEPT_S = 3600
AGAIN_S = 10.0
"""A key that is not known yet has the keys fetched anew, but not more often."""
WITHIN_S = 4.0
"""The namespace waits about five."""


class EntraCallers:
    """Knows one caller, by the object id of its ``identity``. Fetches Entra's keys at the first token.

    ``audience`` is the application's id URI, ``api://<client id>``, or its client id.
    """

    def __init__(self, *, tenant: str, audience: str, identity: str, authority: str = AUTHORITY) -> None:
        self._identity = identity
        self._audiences = sorted({audience, audience.removeprefix("api://")})
        self._issuers = [f"{authority}/{tenant}/v2.0", f"{ISSUER_V1}/{tenant}/"]
        keys = f"{authority}/{tenant}/discovery/v2.0/keys"
        self._keys = jwt.PyJWKClient(keys, lifespan=KEPT_S, timeout=WITHIN_S)
        self._fetched_s = -AGAIN_S
        self._lock = asyncio.Lock()

    async def knows(self, token: str) -> bool:
        """Whether this is the namespace.

        Raises:
            StoreError: Entra's keys cannot be had.
        """
        try:
            name = jwt.get_unverified_header(token).get("kid")
            key = await self._key(name) if isinstance(name, str) else None
            if key is None:
                return False
            claims: dict[str, Any] = jwt.decode(
                token,
                key,
                algorithms=[ALGORITHM],
                audience=self._audiences,
                issuer=self._issuers,
                leeway=SKEW_S,
                options={"require": ["iss", "aud", "exp", "nbf", "oid"]},
            )
        except jwt.PyJWKClientError as error:
            raise StoreError(f"Microsoft Entra's keys cannot be had: {error}.") from error
        except jwt.PyJWTError:
            return False
        return bool(claims["oid"] == self._identity)

    async def _key(self, name: str) -> Any:
        async with self._lock:
            found = await self._among(name, refresh=False)
            if found is None and time.monotonic() - self._fetched_s >= AGAIN_S:
                found = await self._among(name, refresh=True)
            return found

    async def _among(self, name: str, *, refresh: bool) -> Any:
        known = self._keys.jwk_set_cache
        if refresh or known is None or known.get() is None:
            self._fetched_s = time.monotonic()
        shown = await asyncio.to_thread(self._keys.get_jwk_set, refresh)
        return next((key.key for key in shown.keys if key.key_id == name), None)
