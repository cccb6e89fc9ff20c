"""Signing keys as a secret in Azure Key Vault, whose own keys do not support Ed25519."""

import contextlib
from collections.abc import Callable
from typing import TYPE_CHECKING

from function_app.adapters.azure.client import ATTEMPTS, Client, Endpoint, ServiceError, credential, transport
from function_app.adapters.shared.key_ring_keys import wall_ms
from function_app.adapters.shared.vault_keys import Secret, VaultKeys

if TYPE_CHECKING:
    from azure.keyvault.secrets import SecretClient

_MISSING = 404
_TYPE = "application/json"


class KeyVaultKeys(VaultKeys):
    """``SigningKeys`` in one secret of the vault at ``endpoint``."""

    def __init__(self, *, secret: str, endpoint: Endpoint, now_ms: Callable[[], int] = wall_ms) -> None:
        resource = f"the secret '{secret}'"
        super().__init__(resource=resource, now_ms=now_ms)
        self._secret = secret

        def open_(exit_stack: contextlib.ExitStack) -> "SecretClient":
            from azure.keyvault.secrets import SecretClient  # noqa: PLC0415 (see ``client``)

            return exit_stack.enter_context(
                SecretClient(
                    endpoint.url,
                    credential(endpoint, exit_stack),
                    transport=transport(),
                    retry_total=ATTEMPTS - 1,
                    retry_backoff_factor=0.1,
                )
            )

        self._client = Client(
            open_,
            endpoint=endpoint,
            resource=resource,
            role="Key Vault Secrets User' (to create and rotate keys: 'Key Vault Secrets Officer",
            settings="TELESCOPE_KEYVAULT_URL, this machine's managed identity",
            service="the key vault",
        )

    async def close(self) -> None:
        await self._client.close()

    async def _fetch(self) -> Secret | None:
        try:
            secret = await self._client.call(lambda sdk: sdk.get_secret(self._secret))
        except ServiceError as error:
            if error.status == _MISSING:
                return None
            raise
        return Secret(secret.value or "", secret.properties.version or "")

    async def _create(self, text: str) -> None:
        await self._put(text)

    async def _put(self, text: str) -> None:
        await self._client.call(lambda sdk: sdk.set_secret(self._secret, text, content_type=_TYPE))
