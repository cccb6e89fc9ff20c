"""Writes, restores and verifies backups of an installation that stores its data on this machine."""

import argparse
import asyncio
import contextlib
import hashlib
import shutil
import sys
import tempfile
import time
from collections.abc import AsyncIterator, Awaitable, Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

from device_agent.protocol.security import private_folder
from function_app import bootstrap, settings
from function_app.adapters.local import table_file
from function_app.adapters.local.installation import archive, lock
from function_app.adapters.local.installation.archive import ArchiveError
from function_app.adapters.local.signing_keys import RING
from function_app.adapters.local.tables import FORMAT, SqliteTables
from function_app.adapters.shared.key_ring import Ring, RingError
from function_app.bootstrap import Functions
from function_app.domain.common.timestamps import rfc3339
from function_app.domain.identity.accounts import Identity
from function_app.domain.robot_types.movements import Movement
from function_app.domain.telemetry.recordings import RecordingRow, Segment
from function_app.ports.tables import StoreError
from function_app.services.robot_types.script_store import blob_name
from function_app.services.storage import records
from function_app.settings import Settings, SettingsError

_EXIT_BROKEN = 1
_RING = f"keys/{RING}"


def add_commands(commands: Any) -> None:
    """Add ``backup``, ``restore`` and ``verify``."""
    text = "write a backup of tables, blobs, keys and secrets to FILE; the server may run"
    backup = commands.add_parser("backup", help=text, description=f"{text}. FILE contains all keys: protect it.")
    backup.add_argument("file", type=Path, metavar="FILE")
    backup.set_defaults(run=_reported(_backup))
    text = "restore a backup to TELESCOPE_HOME; the server must not run"
    restore = commands.add_parser("restore", help=text, description=text)
    restore.add_argument("file", type=Path, metavar="FILE")
    restore.add_argument("--force", action="store_true", help="replace existing data; they are kept in another folder")
    restore.set_defaults(run=_reported(_restore))
    text = "verify TELESCOPE_HOME, or the backup FILE: hashes, tables, audit log, keys, and blobs"
    verify = commands.add_parser("verify", help=text, description=text)
    verify.add_argument("file", type=Path, metavar="FILE", nargs="?")
    verify.add_argument(
        "--remove-damaged", action="store_true", help="move damaged rows of TELESCOPE_HOME to a file next to the tables"
    )
    verify.set_defaults(run=_reported(_verify))


def _reported(command: Callable[[Settings, argparse.Namespace], int]) -> Callable[[argparse.Namespace], int]:
    def run(options: argparse.Namespace) -> int:
        configuration = settings.read()
        if configuration.store is not None:
            raise SettingsError(
                "TELESCOPE_STORE is a cloud store; back it up with its own functions: point-in-time recovery of the "
                "tables, versions of the blobs, and a copy of the vault's secret"
            )
        try:
            return command(configuration, options)
        except ArchiveError as error:
            raise SettingsError(str(error)) from error
        except lock.InUse as error:
            raise SettingsError(f"a program of the server uses {error}; stop the server first") from error
        except OSError as error:
            raise SettingsError(
                f"{error.filename or 'the folder'} cannot be used: {error.strerror or error}"
            ) from error

    return run


def _progress(text: str) -> None:
    print(text, file=sys.stderr, flush=True)


def _backup(configuration: Settings, options: argparse.Namespace) -> int:
    manifest = archive.write(configuration.home, options.file, tables_format=FORMAT, progress=_progress)
    size = sum(size for size, _ in manifest.files.values())
    print(f"{options.file}: {len(manifest.files)} files, {size / 1e6:.1f} MB. It contains all keys: protect it.")
    return 0


def _restore(configuration: Settings, options: argparse.Namespace) -> int:
    home = configuration.home
    manifest = archive.read_manifest(options.file)
    if manifest.tables > FORMAT:
        raise ArchiveError(f"{options.file} is from a newer version of Telescope; install that version")
    if not archive.is_empty(home) and not options.force:
        raise ArchiveError(f"{home} is not empty; use --force to replace its data. They are kept in another folder.")
    new = home.with_name(f"{home.name}.restoring-{time.time_ns() // 1_000_000}")
    with lock.exclusive(home) if home.exists() else contextlib.nullcontext():
        try:
            archive.extract(options.file, new, progress=_progress)
            for problem in (*table_file.damage(new / archive.TABLES), *_missing_keys(new)):
                raise ArchiveError(f"{options.file}: {problem}")
            kept_keys = _keep_newer_keys(home, new)
            count, problems = asyncio.run(_settle(replace(configuration, home=new), manifest.created_ms))
            private_folder.restrict(new, advice="restore it again")
            former = archive.swap(new, home)
        finally:
            shutil.rmtree(new, ignore_errors=True)
    print(f"restored {home} from a backup of {rfc3339(manifest.created_ms)}; {count} actions were in progress")
    for problem in problems:
        print(f"PROBLEM {problem}")
    if problems:
        print(f"{len(problems)} problems found in the backup")
    if former is not None:
        print(f"the former data are in {former}; delete them when the server works")
    if kept_keys:
        print("the signing keys of the former data were kept, so agents accept commands")
    else:
        print(
            "if signing keys were rotated after the backup, agents reject commands (`bad_signature`): run "
            "`telescope-server rotate-keys --leaked`, and `python -m device_agent repin` on each agent"
        )
    return 0


async def _settle(configuration: Settings, created_ms: int) -> tuple[int, list[str]]:
    """Settle what was in progress; returns the number of open actions, and problems with blobs."""
    async with _functions(configuration) as functions:
        agents = table_file.partitions(configuration.home / archive.TABLES, records.AGENTS)
        count = await functions.restored_backup.settle(created_ms=created_ms, agents=agents)
        return count, await _complete(_blob_problems, functions)


def _verify(configuration: Settings, options: argparse.Namespace) -> int:
    with contextlib.ExitStack() as stack:
        if options.file is not None:
            if options.remove_damaged:
                raise SettingsError("--remove-damaged is for TELESCOPE_HOME only")
            configuration = replace(configuration, home=stack.enter_context(_extracted(options.file)))
        elif not (configuration.home / archive.TABLES).exists():
            raise SettingsError(f"{configuration.home} contains no tables; set TELESCOPE_HOME")
        problems = [*_missing_keys(configuration.home)]
        if not problems:
            problems = asyncio.run(_problems(configuration, remove_damaged=options.remove_damaged))
    for problem in problems:
        print(f"PROBLEM {problem}")
    print(f"{len(problems)} problems found" if problems else "OK")
    return _EXIT_BROKEN if problems else 0


@contextlib.contextmanager
def _extracted(file: Path) -> Iterator[Path]:
    """A temporary copy of a backup's content, which takes as much space as the content."""
    with tempfile.TemporaryDirectory(prefix=f"{file.name}.", dir=file.absolute().parent) as folder:
        archive.extract(file, Path(folder) / "home", progress=_progress)
        yield Path(folder) / "home"


def _missing_keys(home: Path) -> Iterator[str]:
    """The problem with the signing keys, before a program would create new ones."""
    try:
        Ring.read((home / _RING).read_bytes())
    except (OSError, RingError) as error:
        yield f"the signing keys ({_RING}) are missing or damaged: {error}. Restore a backup."


def _keep_newer_keys(home: Path, new: Path) -> bool:
    """Keep the keys of ``home`` if they continue those of the backup: agents have learned them. Returns whether so."""
    try:
        current = Ring.read((home / _RING).read_bytes())
    except (OSError, RingError):
        return False
    restored = Ring.read((new / _RING).read_bytes())
    continued = {key.public for key in restored.keys} <= {key.public for key in current.keys}
    if continued and current.newest.serial > restored.newest.serial:
        shutil.copyfile(home / _RING, new / _RING)
    return continued


@contextlib.asynccontextmanager
async def _functions(configuration: Settings) -> AsyncIterator[Functions]:
    functions = bootstrap.build(configuration)
    try:
        yield functions
    finally:
        await functions.close()


async def _problems(configuration: Settings, *, remove_damaged: bool) -> list[str]:
    async with _functions(configuration) as functions:
        if remove_damaged and isinstance(functions.tables, SqliteTables):
            kept = await functions.tables.remove_damaged()
            print("no row is damaged" if kept is None else f"the damaged rows were moved to {kept}")
        _progress("tables")
        problems = list(await functions.tables.check(thorough=True))
        for title, check in (("audit log", _audit_problems), ("blobs", _blob_problems)):
            _progress(title)
            problems += await _complete(check, functions)
        return problems


async def _complete(check: Callable[[Functions], Awaitable[list[str]]], functions: Functions) -> list[str]:
    try:
        return await check(functions)
    except StoreError as error:
        return [str(error)]


async def _audit_problems(functions: Functions) -> list[str]:
    results = [await functions.audit_reader.verify(chain) for chain in await functions.audit_reader.chains()]
    return [
        f"audit log of {each.chain}: {each.broken or each.missing}" for each in results if each.broken or each.missing
    ]


async def _blob_problems(functions: Functions) -> list[str]:
    """Scripts, captures and recordings whose blob is missing or has another content."""
    tables = functions.settings.home / archive.TABLES
    problems = set()
    for partition in table_file.partitions(tables, records.MOVEMENTS):
        account, _, robot_type = partition.partition("/")
        async for row in records.all_rows(functions.tables, records.MOVEMENTS, partition):
            movement = records.read(row, Movement)
            if movement.built_in or movement.deleted:
                continue
            name = blob_name(Identity(account, "", ""), robot_type, movement)
            content = await functions.blobs.get(name)
            if content is None or hashlib.sha256(content).hexdigest() != movement.sha256:
                problems.add(f"the script of movement {movement.name!r} ({name}) is missing or damaged")
    for partition in table_file.partitions(tables, records.UPLOADS):
        problems |= {
            f"the capture {row.data['blob']} is missing or incomplete"
            async for row in records.all_rows(
                functions.tables, records.UPLOADS, partition, first="stored:", last="stored;"
            )
            if await functions.blobs.size(row.data["blob"]) != row.data["length"]
        }
    for partition in table_file.partitions(tables, records.RECORDINGS):
        problems |= await _recording_problems(functions, partition)
    return sorted(problems)


async def _recording_problems(functions: Functions, partition: str) -> set[str]:
    """Stored segments of one device whose files are missing or have another content."""
    # Rows are sorted by key: those of recordings precede those of segments.
    device = partition.partition("/")[0]
    problems: set[str] = set()
    deleted: set[int] = set()
    async for row in records.all_rows(functions.tables, records.RECORDINGS, partition):
        if not row.key.startswith("segment:"):
            recording = records.read(row, RecordingRow)
            deleted |= {recording.epoch} if recording.deleted else set()
            continue
        segment = records.read(row, Segment)
        if segment.state != "stored" or segment.epoch in deleted or segment.expires_ms <= functions.clock.now_ms():
            continue
        for name, sha256 in ((segment.blob, segment.sha256), (segment.overview_blob, segment.overview_sha256)):
            content = await functions.blobs.get(name)
            if content is None or hashlib.sha256(content).hexdigest() != sha256:
                place = f"segment {segment.segment} of the recording of session {segment.epoch} of {device}"
                problems.add(f"{place} ({name}) is missing or damaged")
    return problems
