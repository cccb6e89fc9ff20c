"""Deletion of unused robot types."""

from dataclasses import replace

from function_app.domain.audit.hash_chain import AccountEvent
from function_app.domain.common.problems import Problem, not_found
from function_app.domain.identity.accounts import Identity
from function_app.ports.clock import Clock
from function_app.ports.robot_catalogue import RobotCatalogue
from function_app.ports.tables import Tables
from function_app.services.audit.audit_log import AuditLog
from function_app.services.devices.device_access import DeviceAccess
from function_app.services.robot_types.movements import Movements
from function_app.services.robot_types.rows import INDEX, place, read_head, schedule_check
from function_app.services.storage import records

AFTER_MS = 60_000
"""Time that files of a deleted type remain, for running downloads."""
_NAMED = 5


class RobotTypeDeletion:
    """Deletes an account's own robot types."""

    def __init__(
        self,
        *,
        tables: Tables,
        catalogue: RobotCatalogue,
        devices: DeviceAccess,
        movements: Movements,
        audit_log: AuditLog,
        clock: Clock,
    ) -> None:
        self._tables = tables
        self._catalogue = catalogue
        self._devices = devices
        self._movements = movements
        self._audit_log = audit_log
        self._clock = clock

    async def delete(self, caller: Identity, robot_type: str) -> None:
        """Delete all versions. The write on the type's row decides; the timer deletes versions and files.

        Raises:
            Problem: ``robot-type-unknown``, ``robot-type-built-in``, ``robot-type-in-use`` with its users.
        """
        if robot_type in await self._catalogue.types():
            detail = f"'{robot_type}' is part of the installation and cannot be deleted."
            raise Problem("robot-type-built-in", 409, "Built-in", detail)
        where = place(caller, robot_type)
        if where is None:
            raise not_found("robot-type", robot_type)
        index = await self._tables.get(records.MEMBERS, caller.account, INDEX + robot_type)

        async def attempt() -> None:
            row, head = await read_head(self._tables, where)
            if row is None or head is None or head.deleted:
                raise not_found("robot-type", robot_type)
            await self._require_unused(caller, robot_type)
            await schedule_check(self._tables, where, self._clock.now_ms() + AFTER_MS)
            await change.store_pending()
            deleted = replace(head, deleted=True, ready=0, manifest={})
            await records.update(self._tables, records.ROBOT_TYPES, row, deleted)

        async with self._audit_log.change(
            caller.account, AccountEvent.ROBOT_TYPE_DELETED, caller, on=robot_type
        ) as change:
            await records.retry(attempt)
        await records.discard(self._tables, records.MEMBERS, index)

    async def _require_unused(self, caller: Identity, robot_type: str) -> None:
        own = [device for device in await self._devices.all(caller) if device.owner == caller.account]
        devices = [device.id for device in own if device.robot_type == robot_type]
        movements = list(await self._movements.own(caller, robot_type))
        users = [f"device {name}" for name in devices] + [f"movement {name}" for name in movements]
        if users:
            more = f" and {len(users) - _NAMED} more" if len(users) > _NAMED else ""
            detail = f"'{robot_type}' is used by {', '.join(users[:_NAMED])}{more}. Unpair or delete these first."
            extras = {"devices": devices[:_NAMED], "movements": movements[:_NAMED]}
            raise Problem("robot-type-in-use", 409, "The robot type is in use", detail, extras=extras)
