"""Signing keys in Amazon's Secrets Manager, which encrypts them with a key of KMS."""

from collections.abc import Callable

from function_app.adapters.aws.client import Client, Refused
from function_app.adapters.shared.key_ring_keys import wall_ms
from function_app.adapters.shared.vault_keys import AGAIN_MS, LOOK_EVERY_MS, Secret, VaultKeys

_MISSING = "ResourceNotFoundException"
_EXISTS = "ResourceExistsException"


class SecretsManagerKeys(VaultKeys):
    """``Keys`` in one secret.

    Args:
        secret: Its name.
        region: Where it is.
        endpoint: An emulator's address, ``None`` for Amazon's own.
        kms_key: Id of the KMS key to make it with; empty for the account's own.
        now_ms: The wall clock, by which overlaps end.
        look_every_ms: How long what was read is good [ms].
        again_ms: Least time between two looks [ms].
    """

    def __init__(
        self,
        *,
        secret: str,
        region: str,
        endpoint: str | None = None,
        kms_key: str = "",
        now_ms: Callable[[], int] = wall_ms,
        look_every_ms: int = LOOK_EVERY_MS,
        again_ms: int = AGAIN_MS,
    ) -> None:
        what = f"the secret '{secret}'"
        super().__init__(what=what, now_ms=now_ms, look_every_ms=look_every_ms, again_ms=again_ms)
        self._secret = secret
        self._kms_key = kms_key
        self._client = Client(
            "secretsmanager",
            what=what,
            setting="TELESCOPE_KEYS_SECRET",
            how="a secret of text",
            region=region,
            endpoint=endpoint,
        )

    async def close(self) -> None:
        """See ``Keys``."""
        await self._client.close()

    async def _fetch(self) -> Secret | None:
        try:
            found = await self._client.call("get_secret_value", SecretId=self._secret)
        except Refused as error:
            if error.code == _MISSING:
                return None
            raise self._client.unusable(error) from error
        return Secret(str(found.get("SecretString", "")), str(found["VersionId"]))

    async def _create(self, text: str) -> None:
        encrypted = {"KmsKeyId": self._kms_key} if self._kms_key else {}
        try:
            await self._client.call(
                "create_secret",
                Name=self._secret,
                SecretString=text,
                Description="Signing keys of Telescope: a reader of this secret can command every robot",
                **encrypted,
            )
        except Refused as error:
            if error.code != _EXISTS:  # another process created it
                raise self._client.unusable(error) from error

    async def _put(self, text: str) -> None:
        try:
            await self._client.call("put_secret_value", SecretId=self._secret, SecretString=text)
        except Refused as error:
            raise self._client.unusable(error) from error
