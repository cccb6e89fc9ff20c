"""Authenticates the caller of the webhook: the namespace's managed identity, with a Microsoft Entra access token.

Signature, issuer, audience, times and identity (``oid``) are checked: any identity of the tenant can get a token for
this application. Sources: Microsoft, "Custom webhook authentication for MQTT clients" (required checks), "Access token
claims reference" (``aud`` and ``iss`` of versions 1 and 2, ``oid``).
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
CACHE_S = 3600
MIN_REFRESH_S = 10.0
"""Minimum time between two fetches due to an unknown key id."""
TIMEOUT_S = 4.0
"""Event Grid waits about five seconds for the response of the webhook."""


class EntraTokenVerifier:
    """Verifies tokens of one caller, the ``identity`` (object id). Fetches Entra's keys at the first token.

    ``audience`` is the application's id URI, ``api://<client id>``, or its client id.
    """

    def __init__(self, *, tenant: str, audience: str, identity: str, authority: str = AUTHORITY) -> None:
        self._identity = identity
        self._audiences = sorted({audience, audience.removeprefix("api://")})
        self._issuers = [f"{authority}/{tenant}/v2.0", f"{ISSUER_V1}/{tenant}/"]
        keys = f"{authority}/{tenant}/discovery/v2.0/keys"
        self._keys = jwt.PyJWKClient(keys, lifespan=CACHE_S, timeout=TIMEOUT_S)
        self._fetched_s = -MIN_REFRESH_S
        self._lock = asyncio.Lock()

    async def verify(self, token: str) -> bool:
        """Whether the token is valid and identifies the caller.

        Raises:
            StoreError: Entra's keys cannot be fetched.
        """
        try:
            key_id = jwt.get_unverified_header(token).get("kid")
            key = await self._key(key_id) if isinstance(key_id, str) else None
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
            raise StoreError(f"the keys of Microsoft Entra cannot be fetched: {error}.") from error
        except jwt.PyJWTError:
            return False
        return bool(claims["oid"] == self._identity)

    async def _key(self, key_id: str) -> Any:
        async with self._lock:
            key = await self._find(key_id, refresh=False)
            if key is None and time.monotonic() - self._fetched_s >= MIN_REFRESH_S:
                key = await self._find(key_id, refresh=True)
            return key

    async def _find(self, key_id: str, *, refresh: bool) -> Any:
        cache = self._keys.jwk_set_cache
        if refresh or cache is None or cache.get() is None:
            self._fetched_s = time.monotonic()
        key_set = await asyncio.to_thread(self._keys.get_jwk_set, refresh)
        return next((key.key for key in key_set.keys if key.key_id == key_id), None)
