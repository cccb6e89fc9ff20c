"""Signing keys in AWS Secrets Manager, which encrypts them with a KMS key."""

from collections.abc import Callable

from function_app.adapters.aws.client import Client, ServiceError
from function_app.adapters.shared.key_ring_keys import wall_ms
from function_app.adapters.shared.vault_keys import Secret, VaultKeys

_MISSING = "ResourceNotFoundException"
_EXISTS = "ResourceExistsException"


class SecretsManagerKeys(VaultKeys):
    """``SigningKeys`` in one secret. An empty ``kms_key`` (an id) selects the account's default key."""

    def __init__(
        self,
        *,
        secret: str,
        region: str,
        endpoint: str | None = None,
        kms_key: str = "",
        now_ms: Callable[[], int] = wall_ms,
    ) -> None:
        resource = f"the secret '{secret}'"
        super().__init__(resource=resource, now_ms=now_ms)
        self._secret = secret
        self._kms_key = kms_key
        self._client = Client(
            "secretsmanager",
            resource=resource,
            setting="TELESCOPE_KEYS_SECRET",
            creation="a text secret",
            region=region,
            endpoint=endpoint,
        )

    async def close(self) -> None:
        await self._client.close()

    async def _fetch(self) -> Secret | None:
        try:
            found = await self._client.call("get_secret_value", SecretId=self._secret)
        except ServiceError as error:
            if error.code == _MISSING:
                return None
            raise
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
        except ServiceError as error:
            if error.code != _EXISTS:  # another process created it
                raise

    async def _put(self, text: str) -> None:
        await self._client.call("put_secret_value", SecretId=self._secret, SecretString=text)
