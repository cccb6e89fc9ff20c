"""Keys that sign blob URLs: the account key, or a user delegation key of the functions' managed identity."""

import threading
from datetime import UTC, datetime, timedelta
from typing import TYPE_CHECKING, Any

from function_app.adapters.azure.client import ATTEMPTS, Endpoint, transport

if TYPE_CHECKING:
    from azure.storage.blob import ContainerClient, UserDelegationKey

DELEGATION_LIFETIME = timedelta(hours=12)
_MAX_RETRY_PAUSE_S = 1
_CLOCK_SKEW = timedelta(minutes=5)
"""Maximum difference between the clocks of Azure and this machine."""


class SasKeys:
    """Keys for shared access signatures. Thread-safe; caches a user delegation key while it outlives the URLs."""

    def __init__(self, endpoint: Endpoint) -> None:
        self._endpoint = endpoint
        self._lock = threading.Lock()
        self._delegation_key: UserDelegationKey | None = None
        self._expires = datetime.min.replace(tzinfo=UTC)

    def of(self, container: "ContainerClient", lifetime_s: int) -> dict[str, Any]:
        """The SDK's key argument for a URL that is valid for ``lifetime_s`` [s]."""
        if not self._endpoint.url:
            return {"account_key": container.credential.account_key}
        now = datetime.now(UTC)
        with self._lock:
            if self._delegation_key is None or now + timedelta(seconds=lifetime_s) > self._expires:
                expires = now + timedelta(seconds=lifetime_s) + DELEGATION_LIFETIME
                self._delegation_key = self._request(container.credential, now - _CLOCK_SKEW, expires)
                self._expires = expires
            return {"user_delegation_key": self._delegation_key}

    def _request(self, credential: Any, start: datetime, end: datetime) -> "UserDelegationKey":
        from azure.storage.blob import BlobServiceClient, LinearRetry  # noqa: PLC0415 (costs half a second)

        retry = LinearRetry(backoff=0, retry_total=ATTEMPTS - 1, random_jitter_range=_MAX_RETRY_PAUSE_S)
        options: dict[str, Any] = {"transport": transport(), "retry_policy": retry}
        with BlobServiceClient(self._endpoint.url, credential=credential, **options) as service:
            return service.get_user_delegation_key(start, end)
