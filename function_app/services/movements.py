"""Movement scripts: those that come with a robot type, and an account's own, which may shadow them."""

import ast
import hashlib
from collections import OrderedDict
from dataclasses import dataclass, replace

from device_agent.protocol.robot_type import RobotType
from function_app.domain.accounts import Identity
from function_app.domain.ids import ID
from function_app.domain.problems import Problem, invalid, not_found
from function_app.ports.blobs import Blobs
from function_app.ports.catalogue import BuiltIn, Catalogue
from function_app.ports.clock import Clock
from function_app.ports.tables import Row, Tables
from function_app.services import store

MAX_SOURCE = 64_000
"""Characters of a script: what a ``RunMovement`` command carries."""
MAX_OWN = 1_000
"""Movements an account may keep for one robot type."""
_KEPT_SOURCES = 256


@dataclass(frozen=True, slots=True)
class Movement:
    """One movement in its newest version. ``deleted`` rows stay, so that a version number is never used twice."""

    name: str
    description: str
    version: int
    sha256: str
    updated_ms: int
    built_in: bool = False
    deleted: bool = False


class Movements:
    """The library of an account, robot type by robot type."""

    def __init__(self, *, tables: Tables, blobs: Blobs, catalogue: Catalogue, clock: Clock) -> None:
        self._tables = tables
        self._blobs = blobs
        self._catalogue = catalogue
        self._clock = clock
        self._sources: OrderedDict[str, str] = OrderedDict()

    async def types(self) -> tuple[RobotType, ...]:
        """All robot types."""
        return tuple((await self._catalogue.types()).values())

    async def type(self, robot_type: str) -> RobotType:
        """One robot type.

        Raises:
            Problem: ``robot-type-unknown``.
        """
        found = (await self._catalogue.types()).get(robot_type)
        if found is None:
            raise not_found("robot-type", robot_type)
        return found

    async def list(self, who: Identity, robot_type: str) -> list[Movement]:
        """Newest versions, by name; an account's own in place of a built-in one of the same name.

        Raises:
            Problem: ``robot-type-unknown``.
        """
        await self.type(robot_type)
        found = {item.name: _built_in(item) for item in (await self._catalogue.movements(robot_type)).values()}
        page = await self._tables.query(store.MOVEMENTS, _partition(who, robot_type), limit=MAX_OWN)
        for row in page.rows:
            movement = store.read(row, Movement)
            if not movement.deleted:
                found[movement.name] = movement
        return [found[name] for name in sorted(found)]

    async def get(self, who: Identity, robot_type: str, name: str) -> tuple[Movement, str]:
        """One movement and its source.

        Raises:
            Problem: ``robot-type-unknown``, ``movement-unknown``.
        """
        await self.type(robot_type)
        row = await self._row(who, robot_type, name)
        own = store.read(row, Movement) if row else None
        if own is not None and not own.deleted:
            return own, await self._source(who, robot_type, own)
        found = (await self._catalogue.movements(robot_type)).get(name)
        if found is None:
            raise not_found("movement", name)
        return _built_in(found), found.source

    async def put(
        self, who: Identity, robot_type: str, name: str, *, source: str, description: str | None
    ) -> tuple[Movement, bool]:
        """Store a new version; and whether the account had none of this name.

        The source is stored under its hash before the row that names it: a row without its source cannot be.

        Raises:
            Problem: ``robot-type-unknown``, ``movement-invalid`` with the line, ``movements-full``.
        """
        await self.type(robot_type)
        if not ID.match(name):
            raise invalid("A movement's name has letters, digits, _ and -, 1 to 64 of them.")
        docstring = check_source(source)
        sha256 = hashlib.sha256(source.encode()).hexdigest()
        await self._blobs.put(_blob(who, robot_type, sha256), source.encode())

        async def once() -> tuple[Movement, bool]:
            row = await self._row(who, robot_type, name)
            old = store.read(row, Movement) if row else None
            shown = (await self._catalogue.movements(robot_type)).get(name)
            version = max(old.version if old else 0, shown.version if shown else 0) + 1
            text = docstring if description is None else description
            new = Movement(name, text, version, sha256, self._clock.now_ms())
            data = Row(_partition(who, robot_type), name, store.fields(new), row.etag if row else "")
            if row is None:
                await self._check_room(who, robot_type)
                await self._tables.create(store.MOVEMENTS, data)
            else:
                await self._tables.replace(store.MOVEMENTS, data)
            return new, old is None or old.deleted

        return await store.retry(once)

    async def delete(self, who: Identity, robot_type: str, name: str) -> None:
        """Delete the account's own movement; a built-in one of the same name shows again.

        Raises:
            Problem: ``robot-type-unknown``, ``movement-unknown``, ``movement-built-in``.
        """
        await self.type(robot_type)

        async def once() -> None:
            row = await self._row(who, robot_type, name)
            old = store.read(row, Movement) if row else None
            if row is None or old is None or old.deleted:
                if name in await self._catalogue.movements(robot_type):
                    detail = f"'{name}' comes with the robot type and cannot be deleted."
                    raise Problem("movement-built-in", 409, "Built-in", detail)
                raise not_found("movement", name)
            gone = replace(old, deleted=True, updated_ms=self._clock.now_ms())
            await self._tables.replace(store.MOVEMENTS, Row(row.partition, row.key, store.fields(gone), row.etag))

        await store.retry(once)

    async def pinned_source(self, who: Identity, robot_type: str, name: str, sha256: str) -> str | None:
        """The source of exactly this hash, for a command that is sent again; ``None`` when it is gone."""
        found = (await self._catalogue.movements(robot_type)).get(name)
        if found is not None and found.sha256 == sha256:
            return found.source
        content = await self._blobs.get(_blob(who, robot_type, sha256))
        return None if content is None else content.decode()

    async def _row(self, who: Identity, robot_type: str, name: str) -> Row | None:
        if not ID.match(name):
            return None
        return await self._tables.get(store.MOVEMENTS, _partition(who, robot_type), name)

    async def _check_room(self, who: Identity, robot_type: str) -> None:
        page = await self._tables.query(store.MOVEMENTS, _partition(who, robot_type), limit=MAX_OWN)
        if len(page.rows) >= MAX_OWN:
            detail = f"An account keeps at most {MAX_OWN} movements for one robot type."
            raise Problem("movements-full", 409, "Too many movements", detail)

    async def _source(self, who: Identity, robot_type: str, movement: Movement) -> str:
        """From memory where this process has read it before: content under its own hash never changes."""
        key = _blob(who, robot_type, movement.sha256)
        if key in self._sources:
            self._sources.move_to_end(key)
            return self._sources[key]
        content = await self._blobs.get(key)
        if content is None or hashlib.sha256(content).hexdigest() != movement.sha256:
            detail = f"The source of '{movement.name}' is missing or was changed in the store. Save it again."
            raise Problem("movement-damaged", 409, "The movement cannot be used", detail)
        self._sources[key] = content.decode()
        if len(self._sources) > _KEPT_SOURCES:
            self._sources.popitem(last=False)
        return self._sources[key]


def check_source(source: str) -> str:
    """Refuse what is not Python; gives the first line of the script's docstring.

    Raises:
        Problem: ``movement-invalid``, with the line.
    """
    if not 1 <= len(source) <= MAX_SOURCE:
        raise invalid(f"A script has 1 to {MAX_SOURCE} characters, not {len(source)}.", code="movement-invalid")
    try:
        source.encode()
        docstring = ast.get_docstring(ast.parse(source)) or ""
    except SyntaxError as error:
        detail = f"Line {error.lineno}: {error.msg}."
        raise invalid(detail, code="movement-invalid", line=error.lineno) from error
    except (RecursionError, MemoryError, ValueError) as error:
        raise invalid("The script is nested too deeply, or is not text.", code="movement-invalid") from error
    return docstring.partition("\n")[0][:200]


def _built_in(item: BuiltIn) -> Movement:
    return Movement(
        name=item.name,
        description=item.description,
        version=item.version,
        sha256=item.sha256,
        updated_ms=item.updated_ms,
        built_in=True,
    )


def _partition(who: Identity, robot_type: str) -> str:
    return f"{who.account}/{robot_type}"


def _blob(who: Identity, robot_type: str, sha256: str) -> str:
    return f"movements/{who.account}/{robot_type}/{sha256}.py"
