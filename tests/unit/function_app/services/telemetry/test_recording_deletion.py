"""Recordings are deleted by their owner, after their session, and if an upload is not completed."""

from collections.abc import Mapping

import pytest

from function_app.domain.devices.devices import Agent
from function_app.services.storage import records
from function_app.services.telemetry.recordings import LIFETIME_S, UNCOMPLETED_MS
from function_app.services.telemetry.series_writer import MARGIN_MS
from function_app.services.telemetry.session_log import KEEP_SESSIONS_MS
from tests.fakes.agent import Robot
from tests.harness.cloud.cloud import Cloud, Person, problem
from tests.unit.function_app.services.sharing.shares import share
from tests.unit.function_app.services.telemetry.recordings_fixture import CONTENT, OVERVIEW, Recorder, episode


def test_owners_delete_a_recording_for_good(recorder: Recorder, bert: Person) -> None:
    share(recorder.anna, f"devices/{recorder.robot.device}", bert, "operator")
    problem(recorder.delete(), 404, "recording-unknown")
    recorder.store()
    recorder.put_episodes(episode(0, 1))
    problem(recorder.delete(bert), 403, "forbidden")
    assert [recorder.delete().status_code for _ in range(2)] == [204, 204]
    assert recorder.blobs() == ()
    assert recorder.begin(1).json()["stored"] is True  # the agent does not offer it again
    shown = recorder.read()
    assert (shown["recorded"], shown["recording"]) == (False, None)
    problem(recorder.put_episodes(etag='"1"'), 404, "recording-unknown")


class Killed(Exception):  # noqa: N818 (not an error: the end of the process)
    """The process is killed."""


def sweep(cloud: Cloud) -> None:
    cloud.run(cloud.functions.retention.delete_due(cloud.clock.now_ms()))


def rows(cloud: Cloud, partition: str) -> int:
    return len(cloud.run(cloud.functions.tables.query(records.RECORDINGS, partition)).rows)


def partition_of(cloud: Cloud, robot: Robot) -> str:
    row = cloud.run(cloud.functions.tables.get(records.AGENTS, robot.id, "agent"))
    assert row is not None
    return f"{robot.device}/{records.read(row, Agent).pairing}"


def test_a_recording_is_deleted_after_its_session(recorder: Recorder, cloud: Cloud) -> None:
    recorder.store()
    partition = partition_of(cloud, recorder.robot)
    cloud.clock.advance(KEEP_SESSIONS_MS / 1000)
    sweep(cloud)
    assert (rows(cloud, partition), len(recorder.blobs())) == (2, 2)
    cloud.clock.advance(2 * 86_400)
    sweep(cloud)
    assert (rows(cloud, partition), recorder.blobs(), recorder.used_bytes()) == (0, (), 0)


def expire(cloud: Cloud) -> None:
    """Let the announcements of now expire."""
    cloud.clock.advance(UNCOMPLETED_MS / 1000)
    sweep(cloud)


def test_an_upload_that_is_not_completed_expires_and_can_be_announced_again(recorder: Recorder, cloud: Cloud) -> None:
    partition = partition_of(cloud, recorder.robot)
    assert recorder.send(recorder.begin().json()["segment"], CONTENT) == 201
    cloud.clock.advance(LIFETIME_S)
    sweep(cloud)
    assert recorder.used_bytes() == len(CONTENT) + len(OVERVIEW)
    expire(cloud)
    assert (rows(cloud, partition), recorder.blobs(), recorder.used_bytes()) == (0, (), 0)
    recorder.store()
    expire(cloud)
    assert (rows(cloud, partition), len(recorder.blobs())) == (2, 2)
    assert recorder.used_bytes() == len(CONTENT) + len(OVERVIEW)


def test_a_repeated_announcement_is_valid_as_long_as_its_urls(recorder: Recorder, cloud: Cloud) -> None:
    recorder.begin()
    cloud.clock.advance(LIFETIME_S)
    upload = recorder.begin().json()
    cloud.clock.advance(UNCOMPLETED_MS / 1000 - LIFETIME_S)
    sweep(cloud)
    assert recorder.used_bytes() == len(CONTENT) + len(OVERVIEW)
    cloud.clock.advance(-60)
    assert recorder.send(upload["segment"], CONTENT) == 201
    assert recorder.send(upload["overview"], OVERVIEW) == 201
    assert recorder.complete().status_code == 204


def test_a_segment_is_not_stored_while_its_announcement_is_being_deleted(recorder: Recorder, cloud: Cloud) -> None:
    upload = recorder.begin().json()
    assert recorder.send(upload["segment"], CONTENT) == 201
    assert recorder.send(upload["overview"], OVERVIEW) == 201
    cloud.clock.advance(UNCOMPLETED_MS / 1000)
    problem(recorder.complete(), 404, "segment-unknown")
    recorder.store(ended_ms=recorder.started_ms + 1)
    sweep(cloud)
    assert len(recorder.blobs()) == 2, "the earlier files are deleted, and not the new ones"
    assert recorder.cloud.request("GET", recorder.read()["recording"]["segments"][0]["url"]).content == CONTENT


@pytest.mark.parametrize("stored", [True, False])
def test_an_upload_after_the_deletion_of_a_recording_leaves_nothing(
    recorder: Recorder, cloud: Cloud, stored: bool
) -> None:
    recorder.store(0)
    upload = recorder.begin(1).json()
    if stored:
        assert recorder.send(upload["segment"], CONTENT) == 201
        assert recorder.send(upload["overview"], OVERVIEW) == 201
        assert recorder.complete(1).status_code == 204
    cloud.clock.advance(LIFETIME_S - 1)
    assert recorder.delete().status_code == 204
    assert recorder.blobs() == ()
    assert recorder.send(upload["segment"], CONTENT) == 201
    problem(recorder.complete(1), 404, "segment-unknown")
    expire(cloud)
    assert (recorder.blobs(), recorder.used_bytes()) == ((), 0)


def test_an_interrupted_deletion_is_completed(
    recorder: Recorder, cloud: Cloud, monkeypatch: pytest.MonkeyPatch
) -> None:
    recorder.store(0)
    recorder.store(1)
    recorder.begin(2)
    partition = partition_of(cloud, recorder.robot)
    blobs = cloud.functions.blobs
    delete = blobs.delete
    deleted: list[str] = []

    async def killed_after_the_first(name: str) -> None:
        if deleted:
            raise Killed
        await delete(name)
        deleted.append(name)

    device = cloud.run(cloud.functions.devices.get_as_owner(recorder.robot.device))
    assert device is not None
    with monkeypatch.context() as patch:
        patch.setattr(blobs, "delete", killed_after_the_first)
        with pytest.raises(Killed):
            cloud.run(cloud.functions.recordings.delete(device, recorder.epoch))
    assert len(recorder.blobs()) == 3
    assert recorder.read()["recorded"] is False
    cloud.clock.advance(601)
    sweep(cloud)
    assert recorder.blobs() == ()
    expire(cloud)  # the announced segment
    assert (rows(cloud, partition), recorder.used_bytes()) == (1, 0), "only the mark of the deletion is left"


def test_a_segment_that_is_announced_during_the_deletion_is_not_stored(
    recorder: Recorder, cloud: Cloud, monkeypatch: pytest.MonkeyPatch
) -> None:
    recorder.store(0)
    partition = partition_of(cloud, recorder.robot)
    reserve = cloud.functions.quota.reserve_all

    async def deleted_meanwhile(account: str, sizes: Mapping[str, int], *, device: str = "") -> None:
        target = await cloud.functions.devices.get_as_owner(device)
        assert target is not None
        await cloud.functions.recordings.delete(target, recorder.epoch)
        await reserve(account, sizes, device=device)

    with monkeypatch.context() as patch:
        patch.setattr(cloud.functions.quota, "reserve_all", deleted_meanwhile)
        upload = recorder.begin(1).json()
    assert recorder.send(upload["segment"], CONTENT) == 201
    assert recorder.send(upload["overview"], OVERVIEW) == 201
    problem(recorder.complete(1), 404, "segment-unknown")
    assert (rows(cloud, partition), recorder.blobs(), recorder.used_bytes()) == (1, (), 0)
    assert recorder.begin(1).json()["stored"] is True  # the agent does not repeat the upload


def test_unpairing_deletes_recordings(recorder: Recorder, cloud: Cloud) -> None:
    recorder.store()
    partition = partition_of(cloud, recorder.robot)
    assert recorder.anna.delete(f"/agents/{recorder.robot.id}").status_code == 204
    cloud.clock.advance(MARGIN_MS / 1000 + 1)
    sweep(cloud)
    assert (rows(cloud, partition), recorder.blobs(), recorder.used_bytes()) == (0, (), 0)
    problem(recorder.anna.get(recorder.session), 404, "device-unknown")
