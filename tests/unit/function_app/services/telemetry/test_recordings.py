"""Recordings are uploaded segment by segment, read with their session, and annotated."""

from dataclasses import replace

import msgspec
import pytest

from function_app.domain.telemetry.recordings import SPARE_SEGMENTS
from function_app.ports.tables import MAX_DATA_BYTES
from tests.harness.cloud.cloud import Cloud, Person, problem
from tests.unit.function_app.services.sharing.shares import share
from tests.unit.function_app.services.telemetry.recordings_fixture import CONTENT, OVERVIEW, Recorder, episode, sha256


def test_a_session_shows_its_recording(recorder: Recorder) -> None:
    assert recorder.read()["recording"] is None
    recorder.store(0)
    recorder.store(1)
    shown = recorder.read()
    assert (shown["epoch"], shown["holder"], shown["recorded"]) == (recorder.epoch, "anna", True)
    recording = shown["recording"]
    assert [each["segment"] for each in recording["segments"]] == [0, 1]
    assert (recording["cameras"], recording["episodes"], recording["complete"]) == ([], [], False)
    first = recording["segments"][0]
    assert (first["length"], first["sha256"]) == (len(CONTENT), sha256(CONTENT))
    assert first["ended_at"] == recording["segments"][1]["started_at"]
    assert recorder.cloud.request("GET", first["url"]).content == CONTENT
    assert recorder.cloud.request("GET", first["overview_url"]).content == OVERVIEW


def test_the_list_of_sessions_shows_which_are_recorded(recorder: Recorder) -> None:
    recorder.release()
    recorder.anna.take_lease(recorder.robot.device)
    path = f"/devices/{recorder.robot.device}/sessions"
    assert [each["recorded"] for each in recorder.anna.get(path).json()["items"]] == [False, False]
    recorder.store()
    assert [each["recorded"] for each in recorder.anna.get(path).json()["items"]] == [False, True]


def test_an_empty_page_of_sessions_has_no_recordings(recorder: Recorder, cloud: Cloud) -> None:
    device = cloud.run(cloud.functions.devices.get_as_owner(recorder.robot.device))
    assert device is not None
    assert cloud.run(cloud.functions.recordings.recorded(device, [])) == set()


def test_an_upload_continues_after_a_lost_connection_without_a_second_copy(recorder: Recorder) -> None:
    upload = recorder.begin().json()
    assert recorder.send(upload["segment"], CONTENT) == 201  # then the link is lost
    again = recorder.begin().json()
    assert (again["stored"], again["segment"]) == (False, None)
    assert recorder.send(again["overview"], OVERVIEW) == 201  # the response to this one is lost
    assert recorder.begin().json() == {"stored": False, "segment": None, "overview": None}
    assert [recorder.complete().status_code for _ in range(2)] == [204, 204]
    assert recorder.begin().json()["stored"] is True
    assert len(recorder.blobs()) == 2
    assert recorder.used_bytes() == len(CONTENT) + len(OVERVIEW)


def test_content_that_differs_from_its_announcement_is_refused(recorder: Recorder, cloud: Cloud) -> None:
    problem(recorder.complete(), 404, "segment-unknown")
    upload = recorder.begin().json()
    problem(recorder.complete(), 409, "upload-missing")
    assert recorder.send(upload["segment"], bytes(len(CONTENT))) == 201
    problem(recorder.complete(), 409, "upload-mismatch")
    again = recorder.begin().json()
    assert recorder.send(again["segment"], CONTENT) == 201
    blob = recorder.blobs()[0].replace(".mcap", ".json")
    cloud.run(cloud.functions.blobs.put(blob, b"x"))  # some stores accept any length
    problem(recorder.complete(), 409, "upload-mismatch")
    cloud.run(cloud.functions.blobs.put(blob, b"x"))
    assert recorder.send(recorder.begin().json()["overview"], OVERVIEW) == 201
    assert recorder.complete().status_code == 204


def test_a_segment_with_other_content_does_not_replace_the_first(recorder: Recorder) -> None:
    recorder.store()
    problem(recorder.begin(sha256="0" * 64), 409, "recording-conflict")
    problem(recorder.begin(1, ended_ms=0), 422, "invalid")
    problem(recorder.begin(1, length=0), 422, "invalid")


def test_only_known_sessions_of_own_devices_are_recorded(recorder: Recorder) -> None:
    problem(recorder.begin(epoch=recorder.epoch + 1), 404, "session-unknown")
    problem(recorder.begin(device="leg"), 404, "device-unknown")
    problem(recorder.anna.get(f"/devices/{recorder.robot.device}/sessions/99"), 404, "session-unknown")


def test_a_recording_uses_the_quota_of_the_account(recorder: Recorder, cloud: Cloud) -> None:
    cloud.functions.quota.limits = replace(cloud.functions.quota.limits, account_bytes=len(CONTENT) + 100)
    recorder.store()
    problem(recorder.begin(1), 413, "quota-exceeded")
    assert recorder.used_bytes() == len(CONTENT) + len(OVERVIEW)
    limit_bytes = 2 * len(CONTENT) + len(OVERVIEW) + 1
    cloud.functions.quota.limits = replace(cloud.functions.quota.limits, account_bytes=limit_bytes)
    problem(recorder.begin(1), 413, "quota-exceeded")  # only the overview does not fit
    assert recorder.used_bytes() == len(CONTENT) + len(OVERVIEW)
    assert recorder.delete().status_code == 204
    assert recorder.used_bytes() == 0


def test_a_recording_is_complete_when_its_segments_cover_the_ended_session(recorder: Recorder, cloud: Cloud) -> None:
    shown = []
    recorder.store(0)
    recorder.store(2)
    cloud.clock.advance(125)
    shown.append(recorder.read()["recording"]["complete"])
    recorder.release()
    shown.append(recorder.read()["recording"]["complete"])
    recorder.store(1)
    shown.append(recorder.read()["recording"]["complete"])
    assert shown == [False, False, True]


def test_a_recording_without_its_last_minute_is_not_complete(recorder: Recorder, cloud: Cloud) -> None:
    recorder.store(0)
    cloud.clock.advance(120)
    recorder.release()
    assert recorder.read()["recording"]["complete"] is False


def test_a_recording_is_final_when_the_agent_has_no_other_segment(recorder: Recorder, cloud: Cloud) -> None:
    recorder.store(0, pending=[1, 2])
    assert recorder.missing() == ([(1, "waiting"), (2, "waiting")], False)
    cloud.clock.advance(185)
    recorder.store(3, pending=[2])
    assert recorder.missing() == ([(1, "lost"), (2, "waiting")], False)
    recorder.release()
    cloud.clock.advance(5)
    recorder.store(2, pending=[])
    assert recorder.missing() == ([(1, "lost")], True)


def test_a_recording_is_not_final_while_its_session_lasts_or_after_an_older_upload(
    recorder: Recorder, cloud: Cloud
) -> None:
    recorder.store(1, pending=[])
    assert recorder.missing() == ([(0, "lost")], False)
    cloud.clock.advance(125)
    recorder.release()
    assert recorder.missing() == ([(0, "lost")], False)  # the agent may have recorded more since its last upload


def test_an_agent_that_does_not_name_its_segments_may_upload_more(recorder: Recorder, cloud: Cloud) -> None:
    cloud.clock.advance(125)
    recorder.release()
    recorder.store(1)
    assert recorder.missing() == ([(0, "unknown")], False)
    recorder.store(0)
    assert recorder.missing() == ([], True)


def test_numbers_that_a_session_cannot_have_reached_are_refused(recorder: Recorder, cloud: Cloud) -> None:
    problem(recorder.begin(SPARE_SEGMENTS + 1), 422, "invalid")
    cloud.clock.advance(100)
    last = SPARE_SEGMENTS + 100
    assert str(last) in problem(recorder.begin(999_999), 422, "invalid")["detail"]
    recorder.store(0, pending=[last])
    upload = recorder.begin(last).json()
    recorder.send(upload["segment"], CONTENT)
    recorder.send(upload["overview"], OVERVIEW)
    problem(recorder.complete(last, [0, 999_999]), 422, "invalid")
    assert recorder.complete(last, [1]).status_code == 204


@pytest.mark.parametrize(("excess", "status"), [(0, 200), (1, 422)])
def test_the_size_of_all_episodes_is_limited(recorder: Recorder, excess: int, status: int) -> None:
    recorder.store()
    episodes = [episode(each / 10, (each + 1) / 10, note="é" * 600) for each in range(200)]
    left = MAX_DATA_BYTES - 1_024 + excess - len(msgspec.json.encode(episodes))
    for each in episodes:
        text = "x" * max(0, min(left, 800))
        each["note"] += text
        left -= len(text)
    assert left == 0
    answer = recorder.put_episodes(*episodes)
    assert answer.status_code == status
    if excess:
        assert "Shorten labels and notes" in problem(answer, 422, "episodes-invalid")["detail"]
    else:
        assert recorder.read()["recording"]["episodes"] == episodes
        recorder.store(1)  # the row is written again


def test_operators_annotate_and_viewers_read_episodes(recorder: Recorder, bert: Person) -> None:
    recorder.store()
    share(recorder.anna, f"devices/{recorder.robot.device}", bert, "viewer")
    problem(recorder.put_episodes(person=bert), 403, "forbidden")
    share(recorder.anna, f"devices/{recorder.robot.device}", bert, "operator")
    late, early = episode(10, 20, outcome="failure", note="slipped"), episode(0, 10, outcome="success", label="grasp")
    answer = recorder.put_episodes(late, early, person=bert)
    assert (answer.json(), answer.headers["etag"]) == ({"episodes": [early, late]}, '"1"')
    read = bert.get(recorder.session)
    assert (read.json()["recording"]["episodes"], read.headers["etag"]) == ([early, late], '"1"')


def test_a_concurrent_change_of_episodes_is_not_lost(recorder: Recorder) -> None:
    problem(recorder.put_episodes(), 404, "recording-unknown")
    recorder.store()
    assert recorder.put_episodes(episode(0, 1)).status_code == 200
    problem(recorder.put_episodes(episode(2, 3)), 412, "episodes-changed")
    problem(recorder.put_episodes(etag=""), 428, "if-match-missing")
    problem(recorder.put_episodes(etag="*"), 428, "if-match-missing")
    recorder.store(1)  # later segments do not change the version
    assert recorder.put_episodes(etag='"1"').headers["etag"] == '"2"'
    assert recorder.read()["recording"]["episodes"] == []


@pytest.mark.parametrize(
    ("episodes", "reason"),
    [
        ([(5, 5)], "must end after its start"),
        ([(6, 5)], "must end after its start"),
        ([(0, 71)], "outside the session"),
        ([(0, 10), (9.5, 20)], "overlap"),
        ([(0, 10), (2, 3)], "overlap"),
    ],
)
def test_invalid_episodes_are_refused(recorder: Recorder, episodes: list[tuple[float, float]], reason: str) -> None:
    recorder.store()
    answer = recorder.put_episodes(*(episode(*each) for each in episodes))
    assert reason in problem(answer, 422, "episodes-invalid")["detail"]
    assert recorder.put_episodes(episode(0, 10), episode(10, 70)).status_code == 200


def test_other_tenants_do_not_see_a_recording(recorder: Recorder, bert: Person) -> None:
    recorder.store()
    problem(bert.get(recorder.session), 404, "device-unknown")
    problem(recorder.put_episodes(person=bert), 404, "device-unknown")
    problem(recorder.delete(bert), 404, "device-unknown")
    assert len(recorder.blobs()) == 2
