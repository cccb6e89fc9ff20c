"""Adds robot types: stores the files, then waits for validation."""

import contextlib
from collections.abc import Mapping

import msgspec

from function_app.domain.audit.hash_chain import AccountEvent
from function_app.domain.common.problems import Problem
from function_app.domain.identity.accounts import Identity
from function_app.domain.robot_types.robot_types import TypeHead, TypeVersion, next_version
from function_app.ports.clock import Clock
from function_app.ports.robot_catalogue import RobotCatalogue
from function_app.ports.tables import Conflict, Row, Tables, Write
from function_app.services.audit.audit_log import AuditLog, Change
from function_app.services.robot_types.catalogue import KnownType, RobotTypes
from function_app.services.robot_types.integrity import IntegritySeals
from function_app.services.robot_types.package_reader import Upload, read_upload
from function_app.services.robot_types.rows import (
    HEAD,
    INDEX,
    Place,
    read_head,
    read_version,
    schedule_check,
    version_key,
)
from function_app.services.robot_types.versions import GIVE_UP_MS, TypeVersions, refused
from function_app.services.storage import records

MAX_OWN = 100
"""Maximum number of robot types per account."""


class RobotTypeUpload:
    """Stores an upload and waits for the verdict."""

    def __init__(
        self,
        *,
        tables: Tables,
        versions: TypeVersions,
        catalogue: RobotCatalogue,
        robot_types: RobotTypes,
        integrity: IntegritySeals,
        audit_log: AuditLog,
        clock: Clock,
    ) -> None:
        self._tables = tables
        self._versions = versions
        self._catalogue = catalogue
        self._types = robot_types
        self._integrity = integrity
        self._audit_log = audit_log
        self._clock = clock

    async def upload(
        self, caller: Identity, manifest: str, files: Mapping[str, str], *, wait_ms: int
    ) -> tuple[KnownType, bool]:
        """Add a robot type or its next version; also return whether the type is new.

        The cleanup is scheduled first, so interrupted uploads are rejected. The previous version stays active until the
        new one is valid.

        Raises:
            Problem: ``manifest-invalid``, ``robot-type-invalid``, ``robot-type-built-in``, ``robot-types-full``,
                ``robot-type-checking``, ``robot-type-rejected`` with ``errors``.
        """
        return await self.add(caller, read_upload(manifest, files), wait_ms=wait_ms)

    async def add(self, caller: Identity, package: Upload, *, wait_ms: int) -> tuple[KnownType, bool]:
        """Like ``upload``, for files that were already read."""
        where = Place(caller.account, package.robot_type.type)
        await require_own(self._catalogue, where.type)
        await schedule_check(self._tables, where, self._clock.now_ms() + GIVE_UP_MS)
        await self._index(where)
        async with self._audit_log.change(
            caller.account, AccountEvent.ROBOT_TYPE_UPLOADED, caller, on=where.type
        ) as change:
            version, new = await self._number(where, package, change)
        await self._index(where)
        await self._versions.store(where, version, package.files)
        checked = await self._versions.verdict(where, version, wait_ms)
        if checked is not None and checked.state == "rejected":
            raise refused(checked)
        return await self._types.view(caller, where.type), new

    async def _index(self, where: Place) -> None:
        """List the type. The new ETag prevents a concurrent deletion from removing it from the list."""
        key = INDEX + where.type
        row = await self._tables.get(records.MEMBERS, where.account, key)
        with contextlib.suppress(Conflict):
            if row is not None:
                await self._tables.replace(records.MEMBERS, row)
                return
            page = await self._tables.query(
                records.MEMBERS, where.account, first=INDEX, last=INDEX + "\x7f", limit=MAX_OWN
            )
            if len(page.rows) >= MAX_OWN:
                detail = f"An account has at most {MAX_OWN} robot types. Delete an unused one."
                raise Problem("robot-types-full", 409, "Too many robot types", detail)
            await self._tables.create(records.MEMBERS, Row(where.account, key, {}))

    async def _number(self, where: Place, package: Upload, change: Change) -> tuple[int, bool]:
        """Assign the next version number."""
        manifest = msgspec.to_builtins(package.robot_type)
        sizes = {name: len(content) for name, content in package.files.items()}

        async def attempt() -> tuple[int, bool]:
            row, head = await read_head(self._tables, where)
            if head is not None and not head.deleted:
                await self._require_no_other(where, head)
            following = next_version(head, package.robot_type.version, where.type)
            plain = TypeVersion(following.last, "uploading", manifest, sizes, self._clock.now_ms())
            upload = await self._integrity.sealed(where.account, where.type, plain, package.files)
            new_version = Row(where.partition, version_key(following.last), records.to_data(upload))
            writes = [
                records.write(row, where.partition, HEAD, records.to_data(following)),
                Write("create", new_version),
            ]
            change.data["version"] = following.last
            await change.store_pending()
            await self._tables.batch(records.ROBOT_TYPES, writes)
            return following.last, head is None or head.deleted

        return await records.retry(attempt)

    async def _require_no_other(self, where: Place, head: TypeHead) -> None:
        _, newest = await read_version(self._tables, where, head.last)
        if newest is not None and newest.open:
            detail = f"Version {newest.version} of '{where.type}' is still being validated. Wait for the result."
            raise Problem("robot-type-checking", 409, "The last version is not validated", detail)


async def require_own(catalogue: RobotCatalogue, robot_type: str) -> None:
    """The id, if an account's own robot type may have it.

    Raises:
        Problem: ``robot-type-built-in``.
    """
    if robot_type in await catalogue.types():
        detail = f"'{robot_type}' is part of the installation. Use another id."
        raise Problem("robot-type-built-in", 409, "Built-in", detail)
