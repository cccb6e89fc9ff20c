"""Archives of an installation's folder: a ZIP file with a manifest of sizes and SHA-256.

The programs may run meanwhile. The order of copying keeps the archive consistent: heads of the audit log are not newer
than the tables, and blobs and keys are not older.
"""

import contextlib
import hashlib
import json
import os
import shutil
import sqlite3
import stat
import time
import zipfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath
from typing import Any, Final

from function_app.adapters.local.table_file import FILE_NAME, require_content
from function_app.ports.tables import StoreError

MANIFEST: Final = "manifest.json"
TABLES: Final = FILE_NAME
FORMAT: Final = 1
_AUDIT: Final = "blobs/audit"
_OTHER_PROGRAMS: Final = ("agents", "logs")
"""Not part of the server. An agent with an older journal could run commands twice."""
_STATE_BLOBS: Final = "blobs/health%2F"
_STATE_TABLE: Final = "Workers"
"""Blobs and table of ``ReadinessCheck`` and ``Heartbeats``: the state of running programs."""
_TRANSIENT: Final = (".lock", ".new", ".part", "-wal", "-shm", "-journal")
_FILE_MODE: Final = 0o600
_FOLDER_MODE: Final = 0o700
_CHUNK: Final = 1024 * 1024

Progress = Callable[[str], None]


class ArchiveError(Exception):
    """The archive cannot be written, read or trusted; the text states why and what to do."""


@dataclass(frozen=True, slots=True)
class Manifest:
    """What an archive contains.

    Attributes:
        created_ms: Time of the backup [ms since 1970].
        tables: Format of the tables.
        files: Relative path → size [bytes] and SHA-256.
    """

    created_ms: int
    tables: int
    files: dict[str, tuple[int, str]] = field(default_factory=dict)


def write(home: Path, archive: Path, *, tables_format: int, progress: Progress) -> Manifest:
    """Write an archive of ``home``, readable by this user only; it appears when it is complete.

    Raises:
        ArchiveError: It exists, or the folder or the archive cannot be accessed.
    """
    if archive.exists():
        raise ArchiveError(f"{archive} exists; choose another name")
    if not (home / TABLES).is_file():
        raise ArchiveError(f"{home} contains no tables; set TELESCOPE_HOME to the folder of the installation")
    try:
        require_content(home / TABLES)
    except StoreError as error:
        raise ArchiveError(str(error)) from error
    part = archive.with_name(f"{archive.name}.part")
    manifest = Manifest(time.time_ns() // 1_000_000, tables_format)
    try:
        descriptor = os.open(part, os.O_CREAT | os.O_TRUNC | os.O_RDWR, _FILE_MODE)
        with os.fdopen(descriptor, "w+b") as file:
            with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as target:
                paths = sorted(_paths(home), key=lambda path: not path.startswith(_AUDIT))
                for path in (each for each in paths if each.startswith(_AUDIT)):
                    _add(target, manifest, path, home / path)
                progress("tables")
                with _copy_of_tables(home / TABLES, part.with_name(f"{part.name}.sqlite")) as copy:
                    _add(target, manifest, TABLES, copy)
                others = [path for path in _paths(home) if not path.startswith(_AUDIT)]
                for number, path in enumerate(others, 1):
                    _add(target, manifest, path, home / path)
                    if number % 100 == 0 or number == len(others):
                        progress(f"files {number}/{len(others)}")
                target.writestr(MANIFEST, _manifest_text(manifest))
            file.flush()
            os.fsync(file.fileno())
        part.rename(archive)
    except (OSError, sqlite3.Error, zipfile.BadZipFile) as error:
        raise ArchiveError(f"the backup could not be written: {error}") from error
    finally:
        part.unlink(missing_ok=True)
    return manifest


def read_manifest(archive: Path) -> Manifest:
    """The manifest of an archive.

    Raises:
        ArchiveError: It is not an archive of this program, or of a newer version.
    """
    with _reading(archive) as source:
        return _manifest(source)


def extract(archive: Path, target: Path, *, progress: Progress) -> Manifest:
    """Write the content of an archive to the new folder ``target``, and compare it with the manifest.

    All files become readable by this user only.

    Raises:
        ArchiveError: A file is missing, unexpected, or has another content; or there is no space left.
    """
    with _reading(archive) as source:
        manifest = _manifest(source)
        names = source.namelist()
        if len(names) != len(set(names)) or set(names) != {MANIFEST, *manifest.files}:
            raise ArchiveError(f"{archive} does not contain exactly the files of its manifest; use another backup")
        needed = sum(size for size, _ in manifest.files.values())
        if needed > shutil.disk_usage(target.parent).free:
            raise ArchiveError(f"{target.parent} has too little free space: {needed / 1e6:.0f} MB are needed")
        target.mkdir(mode=_FOLDER_MODE)
        for number, (path, (size, sha256)) in enumerate(manifest.files.items(), 1):
            place = target / _safe(path)
            place.parent.mkdir(mode=_FOLDER_MODE, parents=True, exist_ok=True)
            descriptor = os.open(place, os.O_CREAT | os.O_EXCL | os.O_WRONLY, _FILE_MODE)
            with source.open(path) as content, os.fdopen(descriptor, "wb") as file:
                if _copy(content, file, most=size) != (size, sha256):
                    raise ArchiveError(f"{path} in {archive} differs from the manifest; use another backup")
                file.flush()
                os.fsync(file.fileno())
            if number % 100 == 0 or number == len(manifest.files):
                progress(f"files {number}/{len(manifest.files)}")
    return manifest


def swap(new: Path, home: Path) -> Path | None:
    """Replace ``home`` by the folder ``new`` next to it. Returns the new place of the former content, if there is any.

    The folders of agents and logs stay in ``home``: they are not part of an archive.

    Raises:
        OSError: ``home`` cannot be renamed, for example because it is a mount point. It is unchanged.
    """
    former = home.with_name(f"{home.name}.before-restore-{time.time_ns() // 1_000_000}")
    existed = home.exists()
    if existed:
        home.rename(former)
    try:
        new.rename(home)
    except OSError:
        if existed:
            former.rename(home)
        raise
    for name in _OTHER_PROGRAMS:
        if (former / name).exists():
            (former / name).rename(home / name)
    return former if existed else None


def is_empty(home: Path) -> bool:
    """Whether a folder contains no data of a server."""
    ignored = {*_OTHER_PROGRAMS, "server.lock"}
    return not home.exists() or all(path.name in ignored for path in home.iterdir())


def _paths(home: Path) -> Iterator[str]:
    """Relative paths of all regular files of the server, except the tables and the state of running programs."""
    for folder, folders, files in os.walk(home):
        place = Path(folder).relative_to(home)
        if place == Path():
            folders[:] = [name for name in folders if name not in _OTHER_PROGRAMS]
        for name in sorted(files):
            path = place / name
            if path.as_posix().startswith((TABLES, _STATE_BLOBS)):
                continue
            if not name.endswith(_TRANSIENT) and stat.S_ISREG((home / path).lstat().st_mode):
                yield path.as_posix()


def _add(target: zipfile.ZipFile, manifest: Manifest, name: str, path: Path) -> None:
    try:
        source = path.open("rb")
    except FileNotFoundError:
        return  # deleted meanwhile
    with source, target.open(zipfile.ZipInfo(name), "w", force_zip64=True) as file:
        manifest.files[name] = _copy(source, file)


def _copy(source: Any, target: Any, *, most: int | None = None) -> tuple[int, str]:
    """Copy a stream, at most one chunk more than ``most`` bytes; returns its size and SHA-256."""
    digest, size = hashlib.sha256(), 0
    while (part := source.read(_CHUNK)) and (most is None or size <= most):
        target.write(part)
        digest.update(part)
        size += len(part)
    return size, digest.hexdigest()


@contextlib.contextmanager
def _copy_of_tables(tables: Path, copy: Path) -> Iterator[Path]:
    """A consistent copy of the tables without the state of programs, also while programs write to them."""
    copy.unlink(missing_ok=True)
    os.close(os.open(copy, os.O_CREAT | os.O_WRONLY, _FILE_MODE))
    try:
        with contextlib.closing(sqlite3.connect(tables)) as source, contextlib.closing(sqlite3.connect(copy)) as target:
            source.backup(target)
            target.execute("DELETE FROM rows WHERE tab = ?", (_STATE_TABLE,))
            target.commit()
        yield copy
    finally:
        for suffix in ("", "-wal", "-shm", "-journal"):
            copy.with_name(copy.name + suffix).unlink(missing_ok=True)


@contextlib.contextmanager
def _reading(archive: Path) -> Iterator[zipfile.ZipFile]:
    try:
        with zipfile.ZipFile(archive) as source:
            yield source
    except (OSError, zipfile.BadZipFile, EOFError, ValueError, RuntimeError, NotImplementedError) as error:
        raise ArchiveError(f"{archive} cannot be read: {error}") from error
    except Exception as error:
        if type(error).__module__ != "zlib":
            raise
        raise ArchiveError(f"{archive} is damaged: {error}") from error


def _manifest_text(manifest: Manifest) -> str:
    files = {path: {"size": size, "sha256": sha256} for path, (size, sha256) in sorted(manifest.files.items())}
    content = {"format": FORMAT, "created_ms": manifest.created_ms, "tables": manifest.tables, "files": files}
    return json.dumps(content, indent=1)


def _manifest(source: zipfile.ZipFile) -> Manifest:
    try:
        content = json.loads(source.read(MANIFEST))
        if content["format"] > FORMAT:
            raise ArchiveError("the backup is from a newer version of Telescope; install that version")
        files = {_safe(path): (int(each["size"]), str(each["sha256"])) for path, each in content["files"].items()}
        return Manifest(int(content["created_ms"]), int(content["tables"]), files)
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise ArchiveError(f"it is not a backup of Telescope, or is damaged: {error}") from error


def _safe(path: str) -> str:
    """A relative path inside the folder.

    Raises:
        ArchiveError: It leads outside.
    """
    parts = PurePosixPath(path).parts
    outside = not parts or path.startswith("/") or any(part in {"..", "."} for part in path.split("/"))
    if outside or "\\" in path or ":" in parts[0] or "\0" in path:
        raise ArchiveError(f"the archive contains the path {path!r}, which is not inside the folder")
    return path
