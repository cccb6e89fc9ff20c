"""Lookup of robot types: those of the installation and those of an account."""

import asyncio
import io
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import msgspec

from device_agent.protocol import Twin
from device_agent.protocol.manifests.robot_type import RobotType
from function_app.domain.common.ids import ID
from function_app.domain.common.problems import Problem, invalid, not_found
from function_app.domain.identity.accounts import Identity
from function_app.domain.robot_types.robot_types import TypeHead, TypeVersion
from function_app.ports.blobs import Blobs
from function_app.ports.model_compiler import ModelReport
from function_app.ports.robot_catalogue import RobotCatalogue
from function_app.ports.tables import Tables
from function_app.services.robot_types.integrity import IntegritySeals, require_intact
from function_app.services.robot_types.rows import INDEX, REPORT, Place, place, read_head, read_version
from function_app.services.storage import records

_ZIP_TIME = (1980, 1, 1, 0, 0, 0)


@dataclass(frozen=True, slots=True)
class KnownType:
    """A robot type as visible to its account.

    Attributes:
        manifest: Manifest of the active version; without one, of the newest upload.
        version: Version of the manifest.
        files: Name → size [bytes], of the same version.
        usable: Whether devices and movements may use it.
        upload: Newest upload of an account's own type.
    """

    manifest: RobotType
    version: int
    files: dict[str, int]
    usable: bool
    upload: TypeVersion | None = None

    @property
    def built_in(self) -> bool:
        """Whether it is part of the installation."""
        return self.upload is None


@dataclass(frozen=True, slots=True)
class Model:
    """The drawing of a robot type for display, and its contents."""

    twin: Twin
    actuators: tuple[str, ...]
    cameras: tuple[str, ...]


class RobotTypes:
    """Robot types that an account may use."""

    def __init__(self, *, tables: Tables, blobs: Blobs, catalogue: RobotCatalogue, integrity: IntegritySeals) -> None:
        self._integrity = integrity
        self._tables = tables
        self._blobs = blobs
        self._catalogue = catalogue

    async def list(
        self, caller: Identity, *, cursor: str | None, limit: int
    ) -> tuple[tuple[KnownType, ...], str | None]:
        """Robot types by id.

        Raises:
            Problem: ``cursor-invalid``.
        """
        if cursor is not None and not ID.match(cursor):
            raise invalid("The cursor is not valid for this list. Start without a cursor.", code="cursor-invalid")
        after = "" if cursor is None else cursor + "\0"
        page = await self._tables.query(
            records.MEMBERS, caller.account, first=INDEX + after, last=INDEX + "\x7f", limit=limit
        )
        own = [row.key.removeprefix(INDEX) for row in page.rows]
        end = None if page.cursor is None else own[-1]
        built_in = [name for name in await self._catalogue.types() if after <= name and (end is None or name <= end)]
        names = sorted({*own, *built_in})
        last = names[limit - 1] if len(names) > limit else end
        result = await asyncio.gather(*(self._find(caller, name) for name in names[:limit]))
        return tuple(each for each in result if each is not None), last

    async def get(self, caller: Identity, robot_type: str) -> RobotType:
        """A usable robot type.

        Raises:
            Problem: ``robot-type-unknown``, ``robot-type-not-ready``, ``robot-type-damaged``.
        """
        built_in = (await self._catalogue.types()).get(robot_type)
        if built_in is not None:
            return built_in
        where, head = await self._head(caller, robot_type)
        if not head.ready:
            detail = f"No version of '{robot_type}' is ready. See the robot type for the reason."
            raise Problem("robot-type-not-ready", 409, "The robot type is not ready", detail)
        await self._integrity.check(where.account, robot_type, head)
        return msgspec.convert(head.manifest, RobotType)

    async def view(self, caller: Identity, robot_type: str) -> KnownType:
        """A robot type with its state.

        Raises:
            Problem: ``robot-type-unknown``.
        """
        result = await self._find(caller, robot_type)
        if result is None:
            raise not_found("robot-type", robot_type)
        return result

    async def file(self, caller: Identity, robot_type: str, name: str) -> bytes:
        """One file of the active version; ``robot.toml`` is the manifest.

        Raises:
            Problem: ``robot-type-unknown``, ``robot-type-not-ready``, ``robot-type-damaged``, ``file-unknown``.
        """
        await self.get(caller, robot_type)
        files = await self._catalogue.files(robot_type)
        if robot_type in await self._catalogue.types():
            content = files.get(name)
        else:
            where, head = await self._head(caller, robot_type)
            _, version = await read_version(self._tables, where, head.ready)
            existing = version is not None and name in version.files
            content = await self._blobs.get(where.prefix(head.ready) + name) if existing else None
            if content is not None:
                require_intact(robot_type, head.seal, name, content)
        if content is None:
            raise not_found("file", name)
        return content

    async def model(self, caller: Identity, robot_type: str) -> Model:
        """The drawing of the active version.

        Raises:
            Problem: ``robot-type-unknown``, ``robot-type-not-ready``, ``model-unknown``: there is no drawing.
        """
        if robot_type in await self._catalogue.types():
            drawing = await self._catalogue.drawing(robot_type)
            if drawing is None:
                raise not_found("model", robot_type)
            return _model(robot_type, msgspec.json.decode(drawing, type=ModelReport))
        await self.get(caller, robot_type)
        where, head = await self._head(caller, robot_type)
        _, version = await read_version(self._tables, where, head.ready)
        if version is None:
            raise not_found("model", robot_type)
        return await self.checked_model(where, version)

    async def checked_model(self, where: Place, version: TypeVersion) -> Model:
        """The drawing that the validator stored.

        Raises:
            Problem: ``model-unknown``.
        """
        content = await self._blobs.get(where.prefix(version.version) + REPORT)
        if content is None:
            raise not_found("model", version.manifest["type"])
        return _model(version.manifest["type"], msgspec.json.decode(content, type=ModelReport))

    async def archive(self, caller: Identity, robot_type: str) -> bytes:
        """All files of the active version as a zip archive, in a folder with the type's name.

        Raises:
            Problem: ``robot-type-unknown``, ``robot-type-not-ready``, ``file-unknown``.
        """
        _, files = await self._active(caller, robot_type)
        return await asyncio.to_thread(_zip, {f"{robot_type}/{name}": content for name, content in files.items()})

    async def package(self, caller: Identity, robot_type: str, *, agent: str) -> tuple[bytes, dict[str, bytes]]:
        """A signed statement about the active version for one agent, and its files.

        Raises:
            Problem: As ``archive``.
        """
        version, files = await self._active(caller, robot_type)
        return await self._integrity.package(agent, robot_type, version, files), files

    async def _active(self, caller: Identity, robot_type: str) -> tuple[int, dict[str, bytes]]:
        await self.get(caller, robot_type)
        existing = await self.view(caller, robot_type)
        files = {name: await self.file(caller, robot_type, name) for name in sorted(existing.files)}
        return existing.version, files

    async def _find(self, caller: Identity, robot_type: str) -> KnownType | None:
        built_in = (await self._catalogue.types()).get(robot_type)
        if built_in is not None:
            files = await self._catalogue.files(robot_type)
            sizes = {name: len(content) for name, content in files.items()}
            return KnownType(built_in, built_in.version, sizes, usable=True)
        where = place(caller, robot_type)
        if where is None:
            return None
        _, head = await read_head(self._tables, where)
        if head is None or head.deleted:
            return None
        _, newest = await read_version(self._tables, where, head.last)
        if newest is None:
            return None
        version = newest
        if head.ready not in {0, head.last}:
            _, ready = await read_version(self._tables, where, head.ready)
            version = ready or newest
        return KnownType(
            _manifest(version.manifest), version.version, version.files, usable=head.ready > 0, upload=newest
        )

    async def _head(self, caller: Identity, robot_type: str) -> tuple[Place, TypeHead]:
        where = place(caller, robot_type)
        _, head = (None, None) if where is None else await read_head(self._tables, where)
        if where is None or head is None or head.deleted:
            raise not_found("robot-type", robot_type)
        return where, head


def _model(robot_type: str, report: ModelReport) -> Model:
    if report.twin is None:
        raise not_found("model", robot_type)
    return Model(report.twin, report.actuators, report.cameras)


def _zip(files: Mapping[str, bytes]) -> bytes:
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        for name, content in files.items():
            entry = zipfile.ZipInfo(name, _ZIP_TIME)  # fixed time: equal files give equal archives
            archive.writestr(entry, content, zipfile.ZIP_DEFLATED)
    return buffer.getvalue()


def _manifest(fields: dict[str, Any]) -> RobotType:
    return msgspec.convert(fields, RobotType)
