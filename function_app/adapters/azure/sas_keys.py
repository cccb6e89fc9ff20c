"""With what addresses of blobs are signed: the account's key, or one that Azure lends to the functions' identity."""

import threading
from datetime import UTC, datetime, timedelta
from typing import TYPE_CHECKING, Any

from function_app.adapters.azure.client import ATTEMPTS, Place, transport

if TYPE_CHECKING:
    from azure.storage.blob import ContainerClient, UserDelegationKey

LENT = timedelta(hours=12)
_RETRY_WITHIN_S = 1
_CLOCKS = timedelta(minutes=5)
"""Azure's clock and ours may differ by this much."""


class SigningKeys:
    """Used in threads. A lent key is kept until an address signed with it could outlive it."""

    def __init__(self, place: Place) -> None:
        self._place = place
        self._lock = threading.Lock()
        self._lent: UserDelegationKey | None = None
        self._ends = datetime.min.replace(tzinfo=UTC)

    def of(self, container: "ContainerClient", lifetime_s: int) -> dict[str, Any]:
        """The key for an address that is good for ``lifetime_s`` [s], as the SDK wants to be given it."""
        if not self._place.url:
            return {"account_key": container.credential.account_key}
        now = datetime.now(UTC)
        with self._lock:
            if self._lent is None or now + timedelta(seconds=lifetime_s) > self._ends:
                ends = now + timedelta(seconds=lifetime_s) + LENT
                self._lent = self._borrow(container.credential, now - _CLOCKS, ends)
                self._ends = ends
            return {"user_delegation_key": self._lent}

    def _borrow(self, credential: Any, start: datetime, end: datetime) -> "UserDelegationKey":
        from azure.storage.blob import BlobServiceClient, LinearRetry  # noqa: PLC0415 (costs half a second)

        retry = LinearRetry(backoff=0, retry_total=ATTEMPTS - 1, random_jitter_range=_RETRY_WITHIN_S)
        options: dict[str, Any] = {"transport": transport(), "retry_policy": retry}
        with BlobServiceClient(self._place.url, credential=credential, **options) as service:
            return service.get_user_delegation_key(start, end)
