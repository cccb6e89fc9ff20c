"""Creates, lists, revokes and authenticates API keys of an account."""

import logging
from collections import OrderedDict
from dataclasses import dataclass, replace
from typing import Final

from function_app.domain.audit.hash_chain import AccountEvent
from function_app.domain.common.ids import split_device
from function_app.domain.common.problems import Problem, invalid, not_found, unauthorized
from function_app.domain.common.text import label_error
from function_app.domain.identity import api_keys as rules
from function_app.domain.identity.accounts import Identity, Role
from function_app.domain.identity.api_keys import ApiKey
from function_app.ports.clock import Clock
from function_app.ports.tables import Conflict, Row, StoreError, Tables
from function_app.services.accounts.sign_out import SignOut
from function_app.services.audit.audit_log import AuditLog
from function_app.services.devices.device_access import DeviceAccess
from function_app.services.identity.authenticator import RECHECK_MS, new_secret
from function_app.services.identity.session_status import API_KEY
from function_app.services.identity.sign_in import SignIn
from function_app.services.storage import records
from function_app.services.storage.reminders import Reminders
from function_app.services.storage.retention import DAY_MS, Retention

MAX_KEYS: Final = 50
"""Approximate maximum per account: concurrent requests may exceed it by one."""
SHOWN_MS: Final = 30 * DAY_MS
"""Time that an expired key remains in the list, so that users see why a program stopped."""
USED_EVERY_MS: Final = 3_600_000
_CACHE_SIZE: Final = 4096
_INDEX: Final = "api-key:"
REMINDER: Final = "key-expires"
"""Kind of the reminders that a key expires."""
_REFUSED: Final = "This API key is unknown, revoked or expired. Create a new one."

_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class ApiKeyRequest:
    """A request to create a key; fields as in ``ApiKey``."""

    label: str
    most: Role
    only: tuple[str, ...]
    days: int


@dataclass(slots=True)
class _Checked:
    key: ApiKey
    at_ms: int


class ApiKeys:
    """Manages API keys. A process caches a key for a few seconds, as it does for sessions."""

    def __init__(
        self,
        *,
        tables: Tables,
        devices: DeviceAccess,
        sign_in: SignIn,
        sign_out: SignOut,
        audit_log: AuditLog,
        retention: Retention,
        reminders: Reminders,
        clock: Clock,
    ) -> None:
        self._tables = tables
        self._devices = devices
        self._sign_in = sign_in
        self._sign_out = sign_out
        self._audit_log = audit_log
        self._retention = retention
        self._reminders = reminders
        self._clock = clock
        self._cache: OrderedDict[str, _Checked] = OrderedDict()

    async def make(self, caller: Identity, request: ApiKeyRequest) -> tuple[ApiKey, str]:
        """Create a key; also return its token, which is shown only once.

        Raises:
            Problem: ``too-many-keys``; ``device-unknown``, ``space-unknown``: a target of ``only`` does not exist.
        """
        if request.most is Role.OWNER:
            raise invalid("An API key has the role operator or viewer. Only a signed-in person can be owner.")
        error = label_error(request.label)
        if error:
            raise invalid(f"The name of the key {error}.")
        if not 1 <= request.days <= rules.MOST_DAYS:
            raise invalid(f"An API key is valid for 1 to {rules.MOST_DAYS} days. Create another one after that.")
        if len(await self._ids(caller.account)) >= MAX_KEYS:
            detail = f"An account has at most {MAX_KEYS} API keys. Revoke an unused one."
            raise Problem("too-many-keys", 409, "Too many API keys", detail)
        only = tuple(dict.fromkeys(request.only))
        await self._require_targets(caller, only)
        now_ms, secret = self._clock.now_ms(), new_secret()
        key = ApiKey(
            id=rules.new_key_id(),
            account=caller.account,
            owner=caller.name,
            label=request.label,
            hash=rules.hashed(secret),
            most=request.most,
            only=only,
            created_ms=now_ms,
            expires_ms=now_ms + request.days * DAY_MS,
        )
        # Deletion is scheduled first, and the key is listed before it is valid.
        due_ms = key.expires_ms + SHOWN_MS
        await self._retention.delete_row_at(records.API_KEYS, key.id, API_KEY, due_ms=due_ms)
        await self._retention.delete_row_at(records.MEMBERS, caller.account, _INDEX + key.id, due_ms=due_ms)
        await self._reminders.schedule(f"{REMINDER}:{key.id}", key.expires_ms)
        about = {"name": key.label, "role": key.most.value, "only": list(only), "expires_ms": key.expires_ms}
        async with self._audit_log.change(
            caller.account, AccountEvent.API_KEY_MADE, caller, on=f"key:{key.id}", **about
        ) as change:
            await change.store_pending()
            await self._tables.create(records.MEMBERS, Row(caller.account, _INDEX + key.id, {}))
            await self._tables.create(records.API_KEYS, Row(key.id, API_KEY, records.to_data(key)))
        return key, rules.token(key.id, secret)

    async def of(self, account: str) -> tuple[ApiKey, ...]:
        """The keys of an account, newest first."""
        rows = [await self._tables.get(records.API_KEYS, key, API_KEY) for key in await self._ids(account)]
        result = [records.read(row, ApiKey) for row in rows if row is not None]
        return tuple(sorted((key for key in result if key.account == account), key=lambda key: -key.created_ms))

    async def revoke(self, caller: Identity, key_id: str) -> None:
        """Revoke a key and its sessions: here immediately, elsewhere within seconds. Raises ``api-key-unknown``."""
        row, key = await records.find(self._tables, records.API_KEYS, key_id, API_KEY, ApiKey)
        if row is None or key is None or key.account != caller.account:
            raise not_found("api-key", key_id)
        async with self._audit_log.change(
            caller.account, AccountEvent.API_KEY_REVOKED, caller, on=f"key:{key_id}"
        ) as change:
            await change.store_pending()
            try:
                await self._tables.delete(records.API_KEYS, row)
            except Conflict:
                change.discarded = True  # used or revoked concurrently
        if await self._tables.get(records.API_KEYS, key_id, API_KEY) is not None:
            await self.revoke(caller, key_id)
            return
        self._cache.pop(key_id, None)
        await self._sign_out.end(key.identity)
        await records.remove(self._tables, records.MEMBERS, caller.account, _INDEX + key_id)

    async def check_expiry(self, key_id: str, note: Row) -> None:
        """Called by the timer: end the sessions and actions of an expired key."""
        _, key = await records.find(self._tables, records.API_KEYS, key_id, API_KEY, ApiKey)
        if key is not None and self._clock.now_ms() >= key.expires_ms:
            await self._sign_out.end(key.identity)
        await self._reminders.cancel(note)

    async def identify(self, token: str) -> Identity:
        """The identity behind a token. Raises ``unauthorized``, with the same response for every reason."""
        parts = rules.split(token)
        if parts is None:
            raise unauthorized(_REFUSED)
        now_ms = self._clock.now_ms()
        existing = self._cache.get(parts[0])
        if existing is None or not 0 <= now_ms - existing.at_ms < RECHECK_MS:
            existing = await self._read_key(parts[0], now_ms)
        if existing is None or not existing.key.matches(parts[1]) or now_ms >= existing.key.expires_ms:
            raise unauthorized(_REFUSED)
        if now_ms - existing.key.used_ms >= USED_EVERY_MS:
            existing.key = await self._record_use(existing.key, now_ms)
        return existing.key.identity

    async def _read_key(self, key_id: str, now_ms: int) -> _Checked | None:
        row = await self._tables.get(records.API_KEYS, key_id, API_KEY)
        if row is None:
            self._cache.pop(key_id, None)
            return None
        checked = self._cache[key_id] = _Checked(records.read(row, ApiKey), now_ms)
        self._cache.move_to_end(key_id)
        if len(self._cache) > _CACHE_SIZE:
            self._cache.popitem(last=False)
        return checked

    async def _record_use(self, key: ApiKey, now_ms: int) -> ApiKey:
        """The key, after its use was recorded; at most once an hour, best effort."""
        used = replace(key, used_ms=now_ms)
        try:
            row = await self._tables.get(records.API_KEYS, key.id, API_KEY)
            if row is not None:
                await self._tables.replace(records.API_KEYS, row.changed(records.to_data(used)))
        except (Conflict, StoreError) as error:
            _log.warning("the use of API key %s was not recorded: %s", key.id, error)
        return used

    async def _require_targets(self, caller: Identity, only: tuple[str, ...]) -> None:
        spaces: set[str] = set()
        if any(each.startswith("space:") for each in only):
            spaces = {space.id for space in await self._sign_in.spaces(caller.account)}
            spaces |= {device.space for device in await self._devices.all(caller)}
        for each in only:
            if each.startswith("space:"):
                if each.removeprefix("space:") not in spaces:
                    raise not_found("space", each.removeprefix("space:"))
            elif split_device(each) is None:
                raise not_found("device", each)
            else:
                await self._devices.get(caller, each)

    async def _ids(self, account: str) -> list[str]:
        page = await self._tables.query(records.MEMBERS, account, first=_INDEX, last="api-key;", limit=1000)
        return [row.key.removeprefix(_INDEX) for row in page.rows]
