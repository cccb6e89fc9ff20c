"""Signing keys in Azure's Key Vault, as one of its secrets: its keys know no Ed25519."""

import contextlib
from collections.abc import Callable
from typing import TYPE_CHECKING

from function_app.adapters.azure.client import ATTEMPTS, Client, Place, Refused, credential, transport
from function_app.adapters.shared.key_ring_keys import wall_ms
from function_app.adapters.shared.vault_keys import AGAIN_MS, LOOK_EVERY_MS, Secret, VaultKeys

if TYPE_CHECKING:
    from azure.keyvault.secrets import SecretClient

_MISSING = 404
_TYPE = "application/json"


class KeyVaultKeys(VaultKeys):
    """``Keys`` in one secret.

    Args:
        secret: Its name.
        place: The vault's address, and the identity to show there.
        now_ms: The wall clock, by which overlaps end.
        look_every_ms: How long what was read is good [ms].
        again_ms: Least time between two looks [ms].
    """

    def __init__(
        self,
        *,
        secret: str,
        place: Place,
        now_ms: Callable[[], int] = wall_ms,
        look_every_ms: int = LOOK_EVERY_MS,
        again_ms: int = AGAIN_MS,
    ) -> None:
        what = f"the secret '{secret}'"
        super().__init__(what=what, now_ms=now_ms, look_every_ms=look_every_ms, again_ms=again_ms)
        self._secret = secret

        def open_(things: contextlib.ExitStack) -> "SecretClient":
            from azure.keyvault.secrets import SecretClient  # noqa: PLC0415 (see the client's first lines)

            return things.enter_context(
                SecretClient(
                    place.url,
                    credential(place, things),
                    transport=transport(),
                    retry_total=ATTEMPTS - 1,
                    retry_backoff_factor=0.1,
                )
            )

        self._client = Client(
            open_,
            place=place,
            what=what,
            role="Key Vault Secrets User' (to make and rotate them: 'Key Vault Secrets Officer",
            settings="TELESCOPE_KEYVAULT_URL, this machine's managed identity",
            service="the key vault",
        )

    async def close(self) -> None:
        """See ``Keys``."""
        await self._client.close()

    async def _fetch(self) -> Secret | None:
        try:
            found = await self._client.call(lambda sdk: sdk.get_secret(self._secret))
        except Refused as error:
            if error.status == _MISSING:
                return None
            raise self._client.unusable(error) from error
        return Secret(found.value or "", found.properties.version or "")

    async def _create(self, text: str) -> None:
        await self._put(text)

    async def _put(self, text: str) -> None:
        try:
            await self._client.call(lambda sdk: sdk.set_secret(self._secret, text, content_type=_TYPE))
        except Refused as error:
            raise self._client.unusable(error) from error
