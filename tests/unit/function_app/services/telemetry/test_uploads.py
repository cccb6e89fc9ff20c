"""Captures are announced, uploaded to the blob store, registered, listed and deleted when due."""

import hashlib
from typing import Any

import httpx
import pytest

from function_app.domain.devices.devices import Agent
from function_app.services.storage import records
from function_app.services.telemetry import uploads
from function_app.services.telemetry.uploads import LIFETIME_S, SHARDS, UNREGISTERED_MS
from tests.fakes.agent import Robot
from tests.fixtures.cloud import Crashing
from tests.harness.cloud.cloud import API, Cloud, Person, problem
from tests.harness.crash_injection import at_instance, crashing_tables

PICTURE = bytes(range(256)) * 100
CAPTURE = {
    "stream": "camera",
    "length": len(PICTURE),
    "content_type": "image/png",
    "name": "Küche 1.png",
    "at_ms": 1000,
}
DAY_S = 86_400


def send(cloud: Cloud, upload_request: dict[str, Any], content: bytes, **changes: str) -> httpx.Response:
    """Upload to the presigned URL, without a token."""
    headers = {**upload_request["headers"], "Content-Length": str(len(content)), **changes}
    return cloud.request(upload_request["method"], upload_request["url"], headers=headers, content=content)


def begin(anna: Person, robot: Robot, **changes: Any) -> dict[str, Any]:
    answer = anna.post(f"/devices/{robot.device}/uploads", {**CAPTURE, **changes})
    assert answer.status_code == 201, answer.text
    shown: dict[str, Any] = answer.json()
    return shown


def complete(anna: Person, robot: Robot, upload: str) -> httpx.Response:
    return anna.post(f"/devices/{robot.device}/uploads/{upload}/complete")


def listed(anna: Person, robot: Robot) -> list[str]:
    return [item["id"] for item in anna.get(f"/devices/{robot.device}/uploads").json()["items"]]


def delete_due(cloud: Cloud) -> None:
    for _ in range(SHARDS):
        cloud.run(cloud.functions.uploads.delete_due())


def blobs(cloud: Cloud) -> tuple[str, ...]:
    return cloud.run(cloud.functions.blobs.list("uploads/"))


def rows(cloud: Cloud, robot: Robot) -> int:
    """Number of rows of captures and reminders."""
    partitions = (f"{robot.device}/{pairing(cloud, robot)}", *(f"due:{shard}" for shard in range(SHARDS)))
    pages = [cloud.run(cloud.functions.tables.query(records.UPLOADS, partition)) for partition in partitions]
    return sum(len(page.rows) for page in pages)


def uploaded(anna: Person, robot: Robot, **changes: Any) -> str:
    """A complete upload of ``PICTURE``."""
    upload_request = begin(anna, robot, **changes)
    send(anna.cloud, upload_request, PICTURE)
    assert complete(anna, robot, upload_request["id"]).status_code == 200
    return str(upload_request["id"])


def test_a_capture_is_uploaded_registered_found_and_deleted(cloud: Cloud, anna: Person, robot: Robot) -> None:
    digest = hashlib.sha256(PICTURE).hexdigest()
    upload_request = begin(anna, robot, sha256=digest)
    assert listed(anna, robot) == []
    problem(complete(anna, robot, upload_request["id"]), 409, "upload-missing")
    assert send(cloud, upload_request, PICTURE).status_code == 201

    done = complete(anna, robot, upload_request["id"]).json()
    assert complete(anna, robot, upload_request["id"]).json() == done
    expected = {**CAPTURE, "sha256": digest, "verified": True, "created_by": "account:anna"}
    del expected["at_ms"]
    assert expected.items() <= done.items()
    assert done["at"] == "1970-01-01T00:00:01.000Z"
    assert listed(anna, robot) == [upload_request["id"]]
    shown = anna.get(f"/devices/{robot.device}/uploads/{upload_request['id']}").json()
    content = cloud.request("GET", shown.pop("url"))
    assert shown == done
    assert content.content == PICTURE
    assert (content.headers["content-type"], content.headers["content-disposition"]) == ("image/png", "attachment")

    assert send(cloud, upload_request, bytes(len(PICTURE))).status_code == 409
    assert anna.delete(f"/devices/{robot.device}/uploads/{upload_request['id']}").status_code == 204
    assert listed(anna, robot) == []
    assert blobs(cloud) == ()
    for call in (anna.get, anna.delete):
        problem(call(f"/devices/{robot.device}/uploads/{upload_request['id']}"), 404, "upload-unknown")


def test_an_upload_may_be_larger_than_any_request_body(cloud: Cloud, anna: Person, robot: Robot) -> None:
    content = b"bag" * 3_000_000
    upload_request = begin(anna, robot, length=len(content), content_type="application/x-rosbag")
    assert send(cloud, upload_request, content).status_code == 201
    assert complete(anna, robot, upload_request["id"]).json()["verified"] is False
    url = anna.get(f"/devices/{robot.device}/uploads/{upload_request['id']}").json()["url"]
    assert cloud.request("GET", url).content == content


def test_an_upload_that_differs_from_its_announcement_is_refused(cloud: Cloud, anna: Person, robot: Robot) -> None:
    upload_request = begin(anna, robot, sha256="0" * 64)
    problem(send(cloud, upload_request, PICTURE[1:]), 403, "transfer-rejected")
    problem(send(cloud, upload_request, PICTURE, **{"Content-Type": "text/html"}), 403, "transfer-rejected")
    problem(complete(anna, robot, upload_request["id"]), 409, "upload-missing")
    assert send(cloud, upload_request, PICTURE).status_code == 201
    problem(complete(anna, robot, upload_request["id"]), 409, "upload-mismatch")
    assert blobs(cloud) == ()
    # Some stores accept any length.
    upload_request = begin(anna, robot)
    cloud.run(cloud.functions.blobs.put(f"uploads/{robot.device}/{pairing(cloud, robot)}/{upload_request['id']}", b"x"))
    problem(complete(anna, robot, upload_request["id"]), 409, "upload-mismatch")
    assert send(cloud, upload_request, PICTURE).status_code == 201
    assert complete(anna, robot, upload_request["id"]).status_code == 200


def pairing(cloud: Cloud, robot: Robot) -> str:
    row = cloud.run(cloud.functions.tables.get(records.AGENTS, robot.id, "agent"))
    assert row is not None
    return records.read(row, Agent).pairing


def test_an_agent_uploads_captures_of_its_own_devices(cloud: Cloud, anna: Person, robot: Robot) -> None:
    path = f"/agents/{robot.id}/uploads"
    upload_request = robot.request("POST", path, json={**CAPTURE, "device": "arm"}).json()
    assert send(cloud, upload_request, PICTURE).status_code == 201
    done = robot.request("POST", f"{path}/{upload_request['id']}/complete", json={"device": "arm"})
    assert (done.status_code, done.json()["created_by"]) == (200, f"agent:{robot.id}")
    assert listed(anna, robot) == [upload_request["id"]]
    problem(robot.request("POST", path, json={**CAPTURE, "device": "leg"}), 404, "device-unknown")


def test_a_later_owner_reads_no_earlier_captures(cloud: Cloud, anna: Person, robot: Robot) -> None:
    upload = uploaded(anna, robot)
    bert = cloud.sign_in("bert")
    assert anna.delete(f"/agents/{robot.id}").status_code == 204
    robot.pair(bert)
    assert listed(bert, robot) == []
    problem(bert.get(f"/devices/{robot.device}/uploads/{upload}"), 404, "upload-unknown")
    problem(complete(bert, robot, upload), 404, "upload-unknown")


@pytest.mark.parametrize(
    "changes",
    [
        {"length": -1}, {"length": 2**40}, {"stream": "a/b"}, {"at_ms": 10**14}, {"sha256": "A" * 64},
        {"content_type": "html"}, {"content_type": "text/html\n"}, {"content_type": "text/html; charset=x"},
    ],
    ids=str,
)  # fmt: skip
def test_invalid_uploads_are_refused(anna: Person, robot: Robot, changes: dict[str, Any]) -> None:
    problem(anna.post(f"/devices/{robot.device}/uploads", {**CAPTURE, **changes}), 422, "invalid")


def test_a_page_from_an_upload_does_not_run(cloud: Cloud, anna: Person, robot: Robot) -> None:
    page = b"<script>alert(1)</script>"
    upload_request = begin(anna, robot, length=len(page), content_type="text/html")
    assert send(cloud, upload_request, page).status_code == 201
    complete(anna, robot, upload_request["id"])
    url = anna.get(f"/devices/{robot.device}/uploads/{upload_request['id']}").json()["url"]
    answer = cloud.request("GET", url)
    assert answer.headers["content-type"] == "application/octet-stream"
    assert answer.headers["content-disposition"] == "attachment"
    assert answer.headers["x-content-type-options"] == "nosniff"


def test_unsigned_addresses_are_refused(cloud: Cloud, anna: Person, robot: Robot) -> None:
    upload_request = begin(anna, robot)
    for token in ("x", "a.b.c", anna.token, upload_request["url"].rpartition("/")[2][:-4], "%00", "é"):
        for method in ("GET", "PUT"):
            problem(cloud.request(method, f"{API}/blobs/{token}", content=b"x"), 403, "transfer-rejected")


def test_captures_are_listed_newest_first_in_pages(cloud: Cloud, anna: Person, robot: Robot) -> None:
    ids = []
    for _ in range(5):
        cloud.clock.advance(1)
        ids.append(uploaded(anna, robot))
    begin(anna, robot)
    path = f"/devices/{robot.device}/uploads"
    assert [item["id"] for item in anna.pages(path, limit=2)] == ids[::-1]
    problem(anna.get(path, params={"cursor": "\x00?"}), 422, "cursor-invalid")


def test_the_number_of_unregistered_uploads_is_limited(
    cloud: Cloud, pair: tuple[Person, Robot], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(uploads, "MAX_UNREGISTERED", 3)
    anna, robot = pair
    upload_request = [begin(anna, robot) for _ in range(3)]
    problem(anna.post(f"/devices/{robot.device}/uploads", CAPTURE), 409, "too-many-uploads")
    send(cloud, upload_request[0], PICTURE)
    complete(anna, robot, upload_request[0]["id"])
    begin(anna, robot)


def test_unregistered_uploads_are_deleted_with_their_blob(cloud: Cloud, anna: Person, robot: Robot) -> None:
    upload_request = begin(anna, robot)
    send(cloud, upload_request, PICTURE)
    cloud.clock.advance(LIFETIME_S)
    delete_due(cloud)
    assert len(blobs(cloud)) == 1
    cloud.clock.advance(UNREGISTERED_MS / 1000)
    anna = cloud.sign_in("anna")
    problem(complete(anna, robot, upload_request["id"]), 404, "upload-unknown")
    delete_due(cloud)
    assert blobs(cloud) == ()
    assert rows(cloud, robot) == 0


def test_an_upload_after_the_deletion_of_a_capture_leaves_nothing(cloud: Cloud, anna: Person, robot: Robot) -> None:
    request = begin(anna, robot)
    send(cloud, request, PICTURE)
    assert complete(anna, robot, request["id"]).status_code == 200
    assert anna.delete(f"/devices/{robot.device}/uploads/{request['id']}").status_code == 204
    assert send(cloud, request, PICTURE).status_code == 201
    cloud.clock.advance(UNREGISTERED_MS / 1000)
    delete_due(cloud)
    assert blobs(cloud) == ()


def test_a_registered_capture_is_deleted_after_its_retention(cloud: Cloud, anna: Person, robot: Robot) -> None:
    upload = uploaded(anna, robot)
    cloud.clock.advance(29 * DAY_S)
    delete_due(cloud)
    assert listed(cloud.sign_in("anna"), robot) == [upload]
    cloud.clock.advance(DAY_S)
    assert listed(cloud.sign_in("anna"), robot) == []
    delete_due(cloud)
    assert blobs(cloud) == ()
    assert rows(cloud, robot) == 0


@pytest.mark.parametrize("step", ["begin", "complete", "delete"])
def test_a_kill_between_any_two_writes_leaves_no_orphans(
    cloud: Cloud, anna: Person, robot: Robot, crashing: Crashing, step: str
) -> None:
    path = f"/devices/{robot.device}/uploads"
    for number in range(5):
        upload_request = begin(anna, robot)
        upload = upload_request["id"]
        send(cloud, upload_request, PICTURE)
        if step == "delete":
            complete(anna, robot, upload)
        process, point = crashing(cloud.clock)
        contents: Any = cloud.functions.blobs
        uploads_of_process: Any = process.functions.uploads
        uploads_of_process._blobs = crashing_tables(contents, point)
        client = at_instance(process, anna)
        assert client.get("/accounts/me").status_code == 200
        point.left = number
        if step == "begin":
            client.post(path, CAPTURE)
        elif step == "complete":
            complete(client, robot, upload)
            assert complete(anna, robot, upload).status_code == 200
        else:
            client.delete(f"{path}/{upload}")
            assert number <= 1 or upload not in listed(anna, robot)
    cloud.clock.advance(31 * DAY_S)
    delete_due(cloud)
    assert blobs(cloud) == ()
    assert rows(cloud, robot) == 0
