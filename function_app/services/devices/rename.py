"""Labels that an owner gives to devices, stored until the owner changes."""

from function_app.domain.audit.hash_chain import AccountEvent
from function_app.domain.common.problems import not_found
from function_app.domain.devices import devices as rules
from function_app.domain.devices.devices import Agent
from function_app.domain.identity.accounts import Identity
from function_app.ports.tables import Tables
from function_app.services.audit.audit_log import AuditLog
from function_app.services.devices.device_access import DeviceAccess, require_owner
from function_app.services.storage import records


class DeviceRename:
    """Sets device labels. The agent keeps its own label and is not notified."""

    def __init__(self, *, tables: Tables, devices: DeviceAccess, audit_log: AuditLog) -> None:
        self._tables = tables
        self._devices = devices
        self._audit_log = audit_log

    async def rename(self, caller: Identity, device_id: str, label: str | None) -> None:
        """Set the label of a device; ``None`` restores the agent's label.

        Raises ``device-unknown``, ``forbidden`` or ``busy``.
        """
        device = require_owner(await self._devices.get(caller, device_id))
        async with self._audit_log.change(
            caller.account, AccountEvent.DEVICE_RENAMED, caller, on=device.id, label=label
        ) as change:

            async def attempt() -> None:
                row, agent = await records.find(self._tables, records.AGENTS, device.agent, "agent", Agent)
                if row is None or agent is None or agent.pairing != device.pairing:
                    raise not_found("device", device.id)
                changed = rules.rename(agent, device.name, label)
                await change.store_pending()
                await self._tables.replace(records.AGENTS, row.changed(records.to_data(changed)))

            await records.retry(attempt)
