"""``verify`` and ``restore`` report recordings whose files are missing or damaged."""

import asyncio
import hashlib
import time
from pathlib import Path

import pytest

from function_app import bootstrap, settings
from function_app.domain.telemetry.recordings import RecordingRow, Segment
from function_app.ports.tables import Row
from function_app.services.storage import records
from tests.integration.stores.backups.conftest import Run

CONTENT, OVERVIEW = b"content", b"overview"
PARTITION, FOLDER = "a-arm/pairing", "recordings/anna/a-arm/pairing"
LATER_MS = 2 * time.time_ns() // 1_000_000


def segment(epoch: int, number: int, *, waiting: bool = False, expires_ms: int = LATER_MS) -> Segment:
    return Segment(
        epoch=epoch,
        segment=number,
        started_ms=0,
        ended_ms=60_000,
        length=len(CONTENT),
        sha256=hashlib.sha256(CONTENT).hexdigest(),
        overview_length=len(OVERVIEW),
        overview_sha256=hashlib.sha256(OVERVIEW).hexdigest(),
        blob=f"{FOLDER}/{epoch}/{number}.mcap",
        overview_blob=f"{FOLDER}/{epoch}/{number}.json",
        state="waiting" if waiting else "stored",
        expires_ms=expires_ms,
    )


async def store(*segments: Segment, deleted: tuple[int, ...] = ()) -> None:
    """Write rows of recordings, and the files of those that end with stored ones."""
    functions = bootstrap.build(settings.read())
    for each in segments:
        key = f"segment:{each.epoch:016d}:{each.segment:06d}"
        await functions.tables.create(records.RECORDINGS, Row(PARTITION, key, records.to_data(each)))
        await functions.blobs.put(each.blob, CONTENT)
        await functions.blobs.put(each.overview_blob, OVERVIEW)
    for epoch in {each.epoch for each in segments}:
        row = records.to_data(RecordingRow(epoch=epoch, deleted=epoch in deleted))
        await functions.tables.create(records.RECORDINGS, Row(PARTITION, f"recording:{epoch:016d}", row))
    await functions.close()


async def change(contents: dict[str, bytes | None]) -> None:
    """Replace files of segments, or delete them."""
    functions = bootstrap.build(settings.read())
    for name, content in contents.items():
        if content is None:
            await functions.blobs.delete(f"{FOLDER}/{name}")
        else:
            await functions.blobs.put(f"{FOLDER}/{name}", content)
    await functions.close()


@pytest.mark.usefixtures("home")
def test_verify_reports_segments_with_missing_or_damaged_files(run: Run) -> None:
    asyncio.run(store(*(segment(7, number) for number in range(5)), segment(8, 0)))
    assert run("verify") == (0, "OK\n")
    asyncio.run(change({"7/0.mcap": None, "7/1.mcap": b"Content", "7/2.json": b"over", "7/3.json": None}))
    code, text = run("verify")
    assert (code, text) == (
        1,
        "".join(
            f"PROBLEM segment {name[0]} of the recording of session 7 of a-arm ({FOLDER}/7/{name}) "
            "is missing or damaged\n"
            for name in ("0.mcap", "1.mcap", "2.json", "3.json")
        )
        + "4 problems found\n",
    )


@pytest.mark.usefixtures("home")
def test_files_that_need_not_exist_are_no_problem(run: Run) -> None:
    asyncio.run(store(segment(7, 0, waiting=True), segment(8, 0), segment(9, 0, expires_ms=1), deleted=(8,)))
    asyncio.run(change({f"{epoch}/0.mcap": None for epoch in (7, 8, 9)}))
    assert run("verify") == (0, "OK\n")


@pytest.mark.usefixtures("home")
def test_restore_states_which_recordings_the_backup_lacks(run: Run, tmp_path: Path) -> None:
    asyncio.run(store(segment(7, 0), segment(7, 1)))
    asyncio.run(change({"7/1.mcap": None}))
    file = tmp_path / "backup.zip"
    assert run("backup", file)[0] == 0
    assert run("verify", file)[0] == 1
    code, text = run("restore", file, "--force")
    assert code == 0
    missing = f"segment 1 of the recording of session 7 of a-arm ({FOLDER}/7/1.mcap)"
    assert f"PROBLEM {missing} is missing or damaged\n1 problems found in the backup\n" in text
    asyncio.run(change({"7/1.mcap": CONTENT}))
    whole = tmp_path / "whole.zip"
    assert run("backup", whole)[0] == 0
    assert "problem" not in run("restore", whole, "--force")[1].lower()
    assert run("verify") == (0, "OK\n")
