"""Ends sign-in sessions with their tokens, broker connections and leases."""

import asyncio
import logging

from function_app.domain.audit.hash_chain import AccountEvent
from function_app.domain.common.problems import Problem, not_found
from function_app.domain.devices.devices import Device
from function_app.domain.identity.accounts import Identity
from function_app.ports.broker_access import BrokerAccess, BrokerAccessError
from function_app.ports.clock import Clock
from function_app.ports.tables import Tables
from function_app.services.audit.audit_log import AuditLog
from function_app.services.control.leases import Leases
from function_app.services.devices.control_rows import read_lease
from function_app.services.devices.device_access import DeviceAccess
from function_app.services.identity.authenticator import Authenticator, principal
from function_app.services.identity.sessions import Sessions

MAX_CONCURRENT = 16
"""Devices that are processed concurrently."""

_log = logging.getLogger(__name__)


class SignOut:
    """Ends sign-in sessions, including the sessions of API keys."""

    def __init__(
        self,
        *,
        tables: Tables,
        authenticator: Authenticator,
        sessions: Sessions,
        access: BrokerAccess,
        devices: DeviceAccess,
        leases: Leases,
        audit_log: AuditLog,
        clock: Clock,
    ) -> None:
        self._tables = tables
        self._authenticator = authenticator
        self._sessions = sessions
        self._access = access
        self._devices = devices
        self._leases = leases
        self._audit_log = audit_log
        self._clock = clock

    async def end(self, caller: Identity) -> None:
        """End the session of ``caller``: first its tokens, then its broker connections, then its leases.

        If broker or device are not reachable, credentials expire within 15 minutes and leases at their expiry time.
        """
        async with self._audit_log.change(caller.account, AccountEvent.SIGNED_OUT, caller) as change:
            await change.store_pending()
            await self._authenticator.sign_out(caller)
            await self._sessions.drop(caller.account, caller.session)
        try:
            await self._access.revoke(principal=principal(caller))
        except BrokerAccessError as error:
            _log.warning("sign-out: %s", error)
        await self._release(caller)

    async def one(self, caller: Identity, session: str) -> None:
        """End one session of the account. Raises ``session-unknown``."""
        if session not in {existing.id for existing in await self._sessions.list(caller.account)}:
            raise not_found("session", session)
        await self.end(Identity(caller.account, caller.name, session))

    async def others(self, caller: Identity) -> int:
        """End all other sessions of the account; return their number."""
        others = [
            existing.id for existing in await self._sessions.list(caller.account) if existing.id != caller.session
        ]
        for session in others:
            await self.end(Identity(caller.account, caller.name, session))
        return len(others)

    async def _release(self, caller: Identity) -> None:
        gate = asyncio.Semaphore(MAX_CONCURRENT)
        await asyncio.gather(
            *(self._release_device(caller, device, gate) for device in await self._devices.all(caller))
        )

    async def _release_device(self, caller: Identity, device: Device, gate: asyncio.Semaphore) -> None:
        async with gate:
            lease = await read_lease(self._tables, device)
            if lease is None or not lease.held_by(caller) or not lease.is_live(self._clock.now_ms()):
                return
            try:
                await self._leases.release(caller, device.id, epoch=lease.epoch)
            except Problem as problem:
                _log.warning("sign-out: control over %s: %s", device.id, problem.detail)
