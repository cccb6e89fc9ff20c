"""Movement scripts: built-in ones, and those of an account, which may shadow them.

One partition contains an account's movements of one robot type: a row per name, whose ETag decides which version is the
newest, and a row per version in the same batch. Each version has its own blob, so deletions do not affect other
versions.
"""

import asyncio
import hashlib
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

from device_agent.protocol import SHIPPED
from function_app.domain.audit.hash_chain import AccountEvent
from function_app.domain.common.ids import ID
from function_app.domain.common.problems import Problem, invalid, not_found
from function_app.domain.identity.accounts import Identity
from function_app.domain.robot_types.movements import Movement
from function_app.ports.blobs import Blobs
from function_app.ports.clock import Clock
from function_app.ports.robot_catalogue import BuiltInMovement, RobotCatalogue
from function_app.ports.signing_keys import SigningKeys
from function_app.ports.tables import Row, Tables, Write
from function_app.services.audit.audit_log import AuditLog
from function_app.services.robot_types.catalogue import RobotTypes
from function_app.services.robot_types.script_metadata import Script, read_script
from function_app.services.robot_types.script_store import ScriptStore, blob_name
from function_app.services.storage import records
from function_app.services.storage.quota import StorageQuota
from function_app.services.storage.retention import DAY_MS, Retention

MAX_OWN = 1_000
"""Maximum number of movements of an account for one robot type."""
KEEP_SCRIPT_MS = 3 * DAY_MS
"""Time that the script of a deleted movement remains, for republished commands of running actions."""
_VERSIONS = "~"
"""Key prefix of version rows, which sort after all names."""
_LAST_VERSION = 10**8


@dataclass(frozen=True, slots=True)
class Draft:
    """A movement to save. Description and schema default to those in the script.

    Attributes:
        based_on: Version that it is derived from, which must still be the newest; 0: the name must be new.
    """

    source: str
    description: str | None = None
    parameters_schema: dict[str, Any] | None = None
    based_on: int | None = None


class Movements:
    """The movements of an account, by robot type."""

    def __init__(
        self,
        *,
        tables: Tables,
        blobs: Blobs,
        quota: StorageQuota,
        catalogue: RobotCatalogue,
        robot_types: RobotTypes,
        keys: SigningKeys,
        retention: Retention,
        audit_log: AuditLog,
        clock: Clock,
    ) -> None:
        self._tables = tables
        self._scripts = ScriptStore(tables=tables, blobs=blobs, quota=quota, keys=keys)
        self._catalogue = catalogue
        self._types = robot_types
        self._retention = retention
        self._audit_log = audit_log
        self._clock = clock
        self._read: dict[str, Script] = {}

    async def list(
        self, caller: Identity, robot_type: str, *, cursor: str | None, limit: int
    ) -> tuple[tuple[Movement, ...], str | None]:
        """Newest versions by name; an account's own movement replaces the built-in one with the same name.

        Raises:
            Problem: ``robot-type-unknown``, ``cursor-invalid``.
        """
        await self._types.get(caller, robot_type)
        if cursor is not None and not ID.match(cursor):
            raise _bad_cursor()
        after = "" if cursor is None else cursor + "\0"
        partition = _partition(caller, robot_type)
        page = await self._tables.query(records.MOVEMENTS, partition, first=after, last=_VERSIONS, limit=limit)
        own = {row.key: records.read(row, Movement) for row in page.rows}
        end = None if page.cursor is None else page.rows[-1].key
        visible = {
            name: await self._built_in(robot_type, item)
            for name, item in (await self._catalogue.movements(robot_type)).items()
            if after <= name and (end is None or name <= end)
        }
        visible |= {name: movement for name, movement in own.items() if not movement.deleted}
        names = sorted(visible)
        last = names[limit - 1] if len(names) > limit else end
        return tuple(visible[name] for name in names[:limit]), last

    async def versions(
        self, caller: Identity, robot_type: str, name: str, *, cursor: str | None, limit: int
    ) -> tuple[tuple[Movement, ...], str | None]:
        """All versions of a movement, newest first; the shadowed built-in one is last.

        Raises:
            Problem: ``robot-type-unknown``, ``movement-unknown``, ``cursor-invalid``.
        """
        newest = await self._newest(caller, robot_type, name)
        built_in = (await self._catalogue.movements(robot_type)).get(name)
        result: list[Movement] = []
        following = None
        if not newest.built_in:
            try:
                page = await self._tables.query(
                    records.MOVEMENTS,
                    _partition(caller, robot_type),
                    first=_version_key(name, newest.version),
                    last=_version_key(name, newest.since) + "\0",
                    limit=limit,
                    cursor=cursor,
                )
            except ValueError as error:
                raise _bad_cursor() from error
            result = [records.read(row, Movement) for row in page.rows]
            following = page.cursor
        if built_in is not None and following is None:
            result.append(await self._built_in(robot_type, built_in))
        return tuple(result), following

    async def get(
        self, caller: Identity, robot_type: str, name: str, version: int | None = None
    ) -> tuple[Movement, str]:
        """A movement and its source, in the newest or the given version.

        Raises:
            Problem: ``robot-type-unknown``, ``movement-unknown``, ``movement-version-unknown``, ``movement-damaged``.
        """
        result = await self._newest(caller, robot_type, name)
        built_in = (await self._catalogue.movements(robot_type)).get(name)
        if version is not None and version != result.version:
            if built_in is not None and version == built_in.version:
                result = await self._built_in(robot_type, built_in)
            else:
                result = await self._version(caller, robot_type, result, version)
        if result.built_in and built_in is not None:
            return result, built_in.source
        return result, await self._scripts.get(caller, robot_type, result)

    async def put(self, caller: Identity, robot_type: str, name: str, draft: Draft) -> tuple[Movement, bool]:
        """Store a new version; also return whether the name is new.

        The script is stored before the rows, so that no row exists without its script.

        Raises:
            Problem: ``robot-type-unknown``, ``movement-invalid`` with the line, ``schema-invalid``, ``movements-full``,
                ``movement-changed`` with the newest version, ``quota-exceeded``, ``storage-full``.
        """
        await self._types.get(caller, robot_type)
        if not ID.match(name):
            raise invalid("A movement's name consists of 1 to 64 letters, digits, _ and -.")
        script = read_script(draft.source)
        new = Movement(
            name=name,
            description=script.description if draft.description is None else draft.description,
            version=0,
            sha256=hashlib.sha256(draft.source.encode()).hexdigest(),
            updated_ms=self._clock.now_ms(),
            author=caller.account,
            parameters_schema=script.schema if draft.parameters_schema is None else draft.parameters_schema,
        )
        orphans: list[Movement] = []

        async def attempt() -> tuple[Movement, bool]:
            row = await self._row(caller, robot_type, name)
            old = records.read(row, Movement) if row else None
            await self._check_newest(robot_type, name, old, draft.based_on)
            if row is None:
                await self._check_room(caller, robot_type)
            elif old is not None and old.deleted:
                await self._schedule_version_deletion(caller, robot_type, old)
            numbered = await self._scripts.sign(robot_type, await self._numbered(robot_type, new, old))
            await self._scripts.put(caller, robot_type, numbered, draft.source)
            orphans.append(numbered)
            change.data["version"] = numbered.version
            await change.store_pending()
            await self._tables.batch(records.MOVEMENTS, _writes(_partition(caller, robot_type), numbered, row))
            orphans.pop()
            return numbered, old is None or old.deleted

        on = f"{robot_type}/{name}"
        async with self._audit_log.change(
            caller.account, AccountEvent.MOVEMENT_SAVED, caller, on=on, sha256=new.sha256
        ) as change:
            done = await records.retry(attempt)
        for movement in orphans:
            await self._drop_orphan(caller, robot_type, movement)
        return done

    async def delete(self, caller: Identity, robot_type: str, name: str) -> None:
        """Delete all versions of an own movement; a built-in one with the same name becomes visible again.

        Running actions continue: the script remains for ``KEEP_SCRIPT_MS``.

        Raises:
            Problem: ``robot-type-unknown``, ``movement-unknown``, ``movement-built-in``.
        """
        await self._types.get(caller, robot_type)

        async def attempt() -> Movement:
            row = await self._row(caller, robot_type, name)
            old = records.read(row, Movement) if row else None
            if row is None or old is None or old.deleted:
                if old is not None:
                    await self._schedule_version_deletion(caller, robot_type, old)
                if name in await self._catalogue.movements(robot_type):
                    detail = f"'{name}' is part of the robot type and cannot be deleted."
                    raise Problem("movement-built-in", 409, "Built-in", detail)
                raise not_found("movement", name)
            deleted = replace(old, deleted=True, updated_ms=self._clock.now_ms())
            await change.store_pending()
            await records.update(self._tables, records.MOVEMENTS, row, deleted)
            return deleted

        async with self._audit_log.change(
            caller.account, AccountEvent.MOVEMENT_DELETED, caller, on=f"{robot_type}/{name}"
        ) as change:
            deleted = await records.retry(attempt)
        await self._schedule_version_deletion(caller, robot_type, deleted)

    async def own(self, caller: Identity, robot_type: str) -> tuple[str, ...]:
        """Names of the account's own movements for a robot type."""
        partition = _partition(caller, robot_type)
        page = await self._tables.query(records.MOVEMENTS, partition, last=_VERSIONS, limit=MAX_OWN)
        return tuple(row.key for row in page.rows if not records.read(row, Movement).deleted)

    async def pinned_source(self, caller: Identity, name: str, pinned: Mapping[str, Any]) -> str | None:
        """The pinned script of a republished action; ``None`` if it was deleted."""
        result = (await self._catalogue.movements(pinned["robot_type"])).get(name)
        if result is not None and result.sha256 == pinned["sha256"]:
            return result.source
        movement = Movement(name=name, description="", version=pinned["version"], sha256=pinned["sha256"], updated_ms=0)
        return await self._scripts.find(caller, pinned["robot_type"], movement)

    async def _newest(self, caller: Identity, robot_type: str, name: str) -> Movement:
        await self._types.get(caller, robot_type)
        row = await self._row(caller, robot_type, name)
        own = records.read(row, Movement) if row else None
        if own is not None and not own.deleted:
            return own
        result = (await self._catalogue.movements(robot_type)).get(name)
        if result is None:
            raise not_found("movement", name)
        return await self._built_in(robot_type, result)

    async def _version(self, caller: Identity, robot_type: str, newest: Movement, version: int) -> Movement:
        row = None
        if not newest.built_in and newest.since <= version < newest.version:
            key = _version_key(newest.name, version)
            row = await self._tables.get(records.MOVEMENTS, _partition(caller, robot_type), key)
        if row is None:
            raise not_found("movement-version", f"{newest.name}, version {version}")
        return records.read(row, Movement)

    async def _row(self, caller: Identity, robot_type: str, name: str) -> Row | None:
        if not ID.match(name):
            return None
        return await self._tables.get(records.MOVEMENTS, _partition(caller, robot_type), name)

    async def _check_newest(self, robot_type: str, name: str, old: Movement | None, based_on: int | None) -> None:
        """Reject saving over a version that was saved concurrently."""
        built_in = (await self._catalogue.movements(robot_type)).get(name)
        newest = old.version if old and not old.deleted else built_in.version if built_in else 0
        if based_on is None or based_on == newest:
            return
        reason = f"Version {newest} of '{name}' is the newest" if newest else f"'{name}' has been deleted meanwhile"
        detail = (
            f"{reason}, but this draft is based on version {based_on}." if based_on else f"'{name}' exists already."
        )
        raise Problem(
            "movement-changed", 409, "The movement was changed concurrently", detail, extras={"version": newest}
        )

    async def _check_room(self, caller: Identity, robot_type: str) -> None:
        partition = _partition(caller, robot_type)
        page = await self._tables.query(records.MOVEMENTS, partition, last=_VERSIONS, limit=MAX_OWN)
        if len(page.rows) >= MAX_OWN:
            detail = f"An account has at most {MAX_OWN} movements for one robot type."
            raise Problem("movements-full", 409, "Too many movements", detail)

    async def _numbered(self, robot_type: str, new: Movement, old: Movement | None) -> Movement:
        """The next version, and the first version since the last deletion."""
        built_in = (await self._catalogue.movements(robot_type)).get(new.name)
        version = max(old.version if old else 0, built_in.version if built_in else 0) + 1
        return replace(new, version=version, since=old.since if old and not old.deleted else version)

    async def _drop_orphan(self, caller: Identity, robot_type: str, movement: Movement) -> None:
        """Delete the script of a version number that another request got, unless it is the same script."""
        key = _version_key(movement.name, movement.version)
        row = await self._tables.get(records.MOVEMENTS, _partition(caller, robot_type), key)
        if row is None or row.data["sha256"] != movement.sha256:
            await self._scripts.delete(caller, robot_type, movement)

    async def _schedule_version_deletion(self, caller: Identity, robot_type: str, deleted: Movement) -> None:
        """Schedule the deletion of scripts, then of rows. Idempotent."""
        due_ms = deleted.updated_ms + KEEP_SCRIPT_MS
        partition = _partition(caller, robot_type)
        first, last = _version_key(deleted.name, deleted.version), _version_key(deleted.name, deleted.since) + "\0"
        start: str | None = first
        while start is not None:
            page = await self._tables.query(records.MOVEMENTS, partition, first=start, last=last)
            blobs = [blob_name(caller, robot_type, records.read(row, Movement)) for row in page.rows]
            await asyncio.gather(*(self._retention.delete_blob_at(blob, due_ms=due_ms) for blob in blobs))
            start = page.rows[-1].key + "\0" if page.cursor is not None else None
        await self._retention.delete_rows_at(records.MOVEMENTS, partition, first=first, last=last, due_ms=due_ms)

    async def _built_in(self, robot_type: str, item: BuiltInMovement) -> Movement:
        script = self._read.get(item.sha256)
        if script is None:
            script = self._read[item.sha256] = read_script(item.source)
        movement = Movement(
            name=item.name,
            description=item.description,
            version=item.version,
            sha256=item.sha256,
            updated_ms=item.updated_ms,
            built_in=True,
            author=SHIPPED,
            parameters_schema=script.schema,
        )
        return await self._scripts.sign(robot_type, movement)


def _writes(partition: str, movement: Movement, row: Row | None) -> list[Write]:
    data = records.to_data(movement)
    return [
        records.write(row, partition, movement.name, data),
        Write("create", Row(partition, _version_key(movement.name, movement.version), data)),
    ]


def _bad_cursor() -> Problem:
    return invalid("The cursor is not valid for this list. Start without a cursor.", code="cursor-invalid")


def _partition(caller: Identity, robot_type: str) -> str:
    return f"{caller.account}/{robot_type}"


def _version_key(name: str, version: int) -> str:
    """Newest first."""
    return f"{_VERSIONS}{name}:{_LAST_VERSION - version:08d}"
