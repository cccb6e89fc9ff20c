"""Previews of robot types: an upload is stored and validated in a separate place, and expires unless it is saved."""

import asyncio
from collections.abc import Mapping
from dataclasses import dataclass, replace

import msgspec

from device_agent.protocol.manifests.robot_type import RobotType
from function_app.domain.common.ids import ID, new_id
from function_app.domain.common.problems import Problem, not_found
from function_app.domain.identity.accounts import Identity
from function_app.domain.robot_types.robot_types import TypeHead, TypeVersion
from function_app.ports.blobs import Blobs
from function_app.ports.clock import Clock
from function_app.ports.robot_catalogue import RobotCatalogue
from function_app.ports.tables import Row, Tables, Write
from function_app.services.robot_types.catalogue import KnownType, Model, RobotTypes
from function_app.services.robot_types.integrity import IntegritySeals, require_intact
from function_app.services.robot_types.package_reader import MAX_REPORTED, Upload, read_upload
from function_app.services.robot_types.rows import (
    HEAD,
    PREVIEWS,
    Place,
    preview_index,
    preview_place,
    read_head,
    read_version,
    schedule_check,
    version_key,
)
from function_app.services.robot_types.script_metadata import read_script
from function_app.services.robot_types.upload import RobotTypeUpload, require_own
from function_app.services.robot_types.versions import GIVE_UP_MS, KEEP_PREVIEW_MS, TypeVersions, refused
from function_app.services.storage import records

MAX_PREVIEWS = 4
"""Maximum number of previews per account; a new one replaces the oldest."""
_VERSION = 1


@dataclass(frozen=True, slots=True)
class Preview:
    """A previewed upload."""

    id: str
    upload: TypeVersion
    manifest: RobotType

    @property
    def expires_ms(self) -> int:
        """Expiry time [ms since 1970]."""
        return self.upload.created_ms + KEEP_PREVIEW_MS


class RobotTypePreview:
    """Manages previews. Each one has its own place with one version, processed like any robot type."""

    def __init__(
        self,
        *,
        tables: Tables,
        blobs: Blobs,
        versions: TypeVersions,
        catalogue: RobotCatalogue,
        robot_types: RobotTypes,
        upload: RobotTypeUpload,
        integrity: IntegritySeals,
        clock: Clock,
    ) -> None:
        self._tables = tables
        self._blobs = blobs
        self._versions = versions
        self._catalogue = catalogue
        self._types = robot_types
        self._upload = upload
        self._integrity = integrity
        self._clock = clock

    async def begin(
        self, caller: Identity, manifest: str, files: Mapping[str, str], scripts: Mapping[str, str], *, wait_ms: int
    ) -> Preview:
        """Store an upload as a preview. The cleanup is scheduled first, so interrupted previews expire.

        Raises:
            Problem: ``manifest-invalid``, ``robot-type-invalid`` with ``errors``, ``robot-type-built-in``.
        """
        errors = _script_errors(scripts)
        try:
            package = read_upload(manifest, files)
        except Problem as problem:
            problem.extras["errors"] = [*problem.extras.get("errors", [problem.detail]), *errors][:MAX_REPORTED]
            raise
        await require_own(self._catalogue, package.robot_type.type)
        where = Place(caller.account, f"~{new_id()}")
        now_ms = self._clock.now_ms()
        await schedule_check(self._tables, where, now_ms + KEEP_PREVIEW_MS)
        await schedule_check(self._tables, where, now_ms + GIVE_UP_MS)
        await self._list(where, now_ms)
        sizes = {name: len(content) for name, content in package.files.items()}
        fields = msgspec.to_builtins(package.robot_type)
        plain = TypeVersion(_VERSION, "uploading", fields, sizes, now_ms, errors=errors)
        upload = await self._integrity.sealed(where.account, where.type, plain, package.files)
        head = Row(where.partition, HEAD, records.to_data(TypeHead(where.type, last=_VERSION, since=_VERSION)))
        version = Row(where.partition, version_key(_VERSION), records.to_data(upload))
        await self._tables.batch(records.ROBOT_TYPES, [Write("create", head), Write("create", version)])
        await self._versions.store(where, _VERSION, package.files)
        done = await self._versions.verdict(where, _VERSION, wait_ms)
        return Preview(where.type[1:], done or upload, package.robot_type)

    async def get(self, caller: Identity, look: str, *, wait_ms: int = 0) -> Preview:
        """A preview, after its validation or after ``wait_ms``.

        Raises:
            Problem: ``look-unknown``.
        """
        where, upload = await self._find(caller, look)
        if upload.open and wait_ms:
            upload = await self._versions.verdict(where, _VERSION, wait_ms) or upload
        return Preview(look, upload, msgspec.convert(upload.manifest, RobotType))

    async def model(self, caller: Identity, look: str) -> Model:
        """The drawing of a validated preview.

        Raises:
            Problem: ``look-unknown``, ``robot-type-not-ready``, ``model-unknown``.
        """
        where, upload = await self._find(caller, look)
        _require_ready(upload)
        return await self._types.checked_model(where, upload)

    async def save(self, caller: Identity, look: str, *, wait_ms: int) -> tuple[KnownType, bool]:
        """Save a preview as the next version of its robot type, which is validated like any upload."""
        where, upload = await self._find(caller, look)
        _require_ready(upload)
        seal = await self._integrity.check(where.account, where.type, upload)
        names = list(upload.files)
        contents = await asyncio.gather(*(self._blobs.get(where.prefix(_VERSION) + name) for name in names))
        files = {name: content or b"" for name, content in zip(names, contents, strict=True)}
        for name, content in files.items():
            require_intact(where.type, seal, name, content)
        result = await self._upload.add(
            caller, Upload(msgspec.convert(upload.manifest, RobotType), files), wait_ms=wait_ms
        )
        await self.drop(caller, look)
        return result

    async def drop(self, caller: Identity, look: str) -> None:
        """Delete a preview; the timer deletes its files."""
        where, _ = await self._find(caller, look)
        await self._end(where)

    async def _end(self, where: Place) -> None:
        async def attempt() -> None:
            row, head = await read_head(self._tables, where)
            await schedule_check(self._tables, where, self._clock.now_ms())
            if row is not None and head is not None and not head.deleted:
                deleted = records.to_data(replace(head, deleted=True))
                await self._tables.replace(records.ROBOT_TYPES, row.changed(deleted))

        await records.retry(attempt)

    async def _list(self, where: Place, now_ms: int) -> None:
        """List a preview; the oldest ones beyond the limit expire."""
        page = await self._tables.query(
            records.MEMBERS, where.account, first=PREVIEWS, last=PREVIEWS + "\x7f", limit=100
        )
        listed = sorted(page.rows, key=lambda row: row.data["created_ms"])
        for row in listed[: max(0, len(listed) - MAX_PREVIEWS + 1)]:
            await self._end(Place(where.account, "~" + row.key.removeprefix(PREVIEWS)))
        row = Row(where.account, preview_index(where), {"created_ms": now_ms})
        await self._tables.create(records.MEMBERS, row)

    async def _find(self, caller: Identity, look: str) -> tuple[Place, TypeVersion]:
        where = preview_place(caller, look)
        if where is not None:
            _, head = await read_head(self._tables, where)
            _, upload = await read_version(self._tables, where, _VERSION)
            live = upload is not None and self._clock.now_ms() < upload.created_ms + KEEP_PREVIEW_MS
            if upload is not None and live and head is not None and not head.deleted:
                return where, upload
        raise not_found("robot-type-preview", look)


def _require_ready(upload: TypeVersion) -> None:
    if upload.state == "rejected":
        raise refused(upload)
    if upload.state != "ready":
        raise Problem(
            "robot-type-not-ready", 409, "The upload is not validated", "The upload is still being validated."
        )


def _script_errors(scripts: Mapping[str, str]) -> tuple[str, ...]:
    """Errors in movement scripts, found without execution."""
    result = []
    for name, source in scripts.items():
        file = f"movements/{name[:80]}.py"
        if not ID.match(name):
            result.append(f"{file}: a movement's name consists of 1 to 64 letters, digits, _ and -.")
            continue
        try:
            read_script(source)
        except Problem as problem:
            result.append(f"{file}: {problem.detail}")
    return tuple(result)
