"""Captures: announced, uploaded past the API, registered, found, and forgotten on time."""

import hashlib
from typing import Any

import httpx
import pytest

from function_app.domain.devices.devices import Agent
from function_app.services.devices.device_access import devices_of
from function_app.services.storage import records
from function_app.services.telemetry import uploads
from function_app.services.telemetry.uploads import LIFETIME_S, SHARDS, UNREGISTERED_MS
from tests.fakes.agent import Robot
from tests.harness.cloud.cloud import API, Cloud, Person, problem

PICTURE = bytes(range(256)) * 100
WANTED = {"stream": "camera", "length": len(PICTURE), "content_type": "image/png", "name": "Küche 1.png", "at_ms": 1000}
DAY_S = 86_400


def send(cloud: Cloud, begun: dict[str, Any], content: bytes, **headers: str) -> httpx.Response:
    """What a client without any token does with the address."""
    given = {**begun["headers"], "Content-Length": str(len(content)), **headers}
    return cloud.ask(begun["method"], begun["url"], headers=given, content=content)


def begin(anna: Person, robot: Robot, **changes: Any) -> dict[str, Any]:
    answer = anna.post(f"/devices/{robot.device}/uploads", {**WANTED, **changes})
    assert answer.status_code == 201, answer.text
    found: dict[str, Any] = answer.json()
    return found


def complete(anna: Person, robot: Robot, upload: str) -> httpx.Response:
    return anna.post(f"/devices/{robot.device}/uploads/{upload}/complete")


def listed(anna: Person, robot: Robot) -> list[str]:
    return [item["id"] for item in anna.get(f"/devices/{robot.device}/uploads").json()["items"]]


def forget(cloud: Cloud) -> None:
    for _ in range(SHARDS):
        cloud.run(cloud.functions.uploads.forget_due())


def blobs(cloud: Cloud) -> tuple[str, ...]:
    return cloud.run(cloud.functions.blobs.list("uploads/"))


def rows(cloud: Cloud, robot: Robot) -> int:
    """Rows of captures and notes that there are."""

    async def count() -> int:
        found = 0
        row = await cloud.functions.tables.get(records.AGENTS, robot.id, "agent")
        assert row is not None
        pairing = records.read(row, Agent).pairing
        for partition in (f"{robot.device}/{pairing}", *(f"due:{shard}" for shard in range(SHARDS))):
            found += len((await cloud.functions.tables.query(records.UPLOADS, partition)).rows)
        return found

    return cloud.run(count())


def test_a_capture_is_uploaded_registered_found_and_deleted(cloud: Cloud, pair: tuple[Person, Robot]) -> None:
    anna, robot = pair
    digest = hashlib.sha256(PICTURE).hexdigest()
    begun = begin(anna, robot, sha256=digest)
    assert listed(anna, robot) == []
    problem(complete(anna, robot, begun["id"]), 409, "upload-missing")
    assert send(cloud, begun, PICTURE).status_code == 201

    done = complete(anna, robot, begun["id"]).json()
    assert complete(anna, robot, begun["id"]).json() == done
    names = ("stream", "name", "length", "content_type", "sha256", "verified", "created_by")
    assert {name: done[name] for name in names} == {
        "stream": "camera", "name": "Küche 1.png", "length": len(PICTURE), "content_type": "image/png",
        "sha256": digest, "verified": True, "created_by": "account:anna",
    }  # fmt: skip
    assert done["at"] == "1970-01-01T00:00:01.000Z"
    assert listed(anna, robot) == [begun["id"]]
    found = anna.get(f"/devices/{robot.device}/uploads/{begun['id']}").json()
    content = cloud.ask("GET", found.pop("url"))
    assert found == done
    assert content.content == PICTURE
    assert (content.headers["content-type"], content.headers["content-disposition"]) == ("image/png", "attachment")

    assert send(cloud, begun, bytes(len(PICTURE))).status_code == 409
    assert anna.delete(f"/devices/{robot.device}/uploads/{begun['id']}").status_code == 204
    assert listed(anna, robot) == []
    assert blobs(cloud) == ()
    for call in (anna.get, anna.delete):
        problem(call(f"/devices/{robot.device}/uploads/{begun['id']}"), 404, "upload-unknown")


def test_an_upload_may_be_larger_than_any_request_body(cloud: Cloud, pair: tuple[Person, Robot]) -> None:
    anna, robot = pair
    content = b"bag" * 3_000_000
    begun = begin(anna, robot, length=len(content), content_type="application/x-rosbag")
    assert send(cloud, begun, content).status_code == 201
    assert complete(anna, robot, begun["id"]).json()["verified"] is False
    url = anna.get(f"/devices/{robot.device}/uploads/{begun['id']}").json()["url"]
    assert cloud.ask("GET", url).content == content


def test_what_is_not_what_was_announced_is_not_registered(cloud: Cloud, pair: tuple[Person, Robot]) -> None:
    anna, robot = pair
    begun = begin(anna, robot, sha256="0" * 64)
    problem(send(cloud, begun, PICTURE[1:]), 403, "transfer-refused")
    problem(send(cloud, begun, PICTURE, **{"Content-Type": "text/html"}), 403, "transfer-refused")
    problem(complete(anna, robot, begun["id"]), 409, "upload-missing")
    assert send(cloud, begun, PICTURE).status_code == 201
    problem(complete(anna, robot, begun["id"]), 409, "upload-mismatch")
    assert blobs(cloud) == ()
    # As a store does that takes any length.
    begun = begin(anna, robot)
    cloud.run(cloud.functions.blobs.put(f"uploads/{robot.device}/{pairing(cloud, robot)}/{begun['id']}", b"x"))
    problem(complete(anna, robot, begun["id"]), 409, "upload-mismatch")
    assert send(cloud, begun, PICTURE).status_code == 201
    assert complete(anna, robot, begun["id"]).status_code == 200


def pairing(cloud: Cloud, robot: Robot) -> str:
    row = cloud.run(cloud.functions.tables.get(records.AGENTS, robot.id, "agent"))
    assert row is not None
    return records.read(row, Agent).pairing


def test_an_agent_uploads_of_its_own_devices(cloud: Cloud, pair: tuple[Person, Robot]) -> None:
    anna, robot = pair
    path = f"/agents/{robot.id}/uploads"
    begun = robot.ask("POST", path, json={**WANTED, "device": "arm"}).json()
    assert send(cloud, begun, PICTURE).status_code == 201
    done = robot.ask("POST", f"{path}/{begun['id']}/complete", json={"device": "arm"})
    assert (done.status_code, done.json()["created_by"]) == (200, f"agent:{robot.id}")
    assert listed(anna, robot) == [begun["id"]]
    problem(robot.ask("POST", path, json={**WANTED, "device": "leg"}), 404, "device-unknown")
    problem(robot.ask("POST", "/agents/abcdefghij/uploads", json={**WANTED, "device": "arm"}), 404, "agent-unknown")
    problem(anna.post(path, {**WANTED, "device": "arm"}), 401, "unauthorized")


def test_captures_of_other_and_former_owners_cannot_be_read(cloud: Cloud, pair: tuple[Person, Robot]) -> None:
    anna, robot = pair
    begun = begin(anna, robot)
    send(cloud, begun, PICTURE)
    complete(anna, robot, begun["id"])
    bert = cloud.sign_in("bert")
    path = f"/devices/{robot.device}/uploads"
    for answer in (
        bert.get(path),
        bert.get(f"{path}/{begun['id']}"),
        bert.post(path, WANTED),
        bert.delete(f"{path}/x"),
    ):
        problem(answer, 404, "device-unknown")
    assert anna.delete(f"/agents/{robot.id}").status_code == 204
    robot.pair(bert)
    assert listed(bert, robot) == []
    problem(bert.get(f"{path}/{begun['id']}"), 404, "upload-unknown")
    problem(complete(bert, robot, begun["id"]), 404, "upload-unknown")


@pytest.mark.parametrize(
    "changes",
    [
        {"length": -1},
        {"length": 2**40},
        {"length": "1"},
        {"content_type": "html"},
        {"content_type": "text/html\n"},
        {"content_type": "text/html; charset=x"},
        {"stream": "a/b"},
        {"stream": ""},
        {"name": "x" * 201},
        {"at_ms": -1},
        {"at_ms": 10**14},
        {"sha256": "A" * 64},
        {"other": 1},
    ],
    ids=str,
)
def test_what_cannot_be_uploaded_is_refused(pair: tuple[Person, Robot], changes: dict[str, Any]) -> None:
    anna, robot = pair
    problem(anna.post(f"/devices/{robot.device}/uploads", {**WANTED, **changes}), 422, "invalid")


def test_a_page_from_an_upload_does_not_run(cloud: Cloud, pair: tuple[Person, Robot]) -> None:
    anna, robot = pair
    page = b"<script>alert(1)</script>"
    begun = begin(anna, robot, length=len(page), content_type="text/html")
    assert send(cloud, begun, page).status_code == 201
    complete(anna, robot, begun["id"])
    url = anna.get(f"/devices/{robot.device}/uploads/{begun['id']}").json()["url"]
    answer = cloud.ask("GET", url)
    assert answer.headers["content-type"] == "application/octet-stream"
    assert answer.headers["content-disposition"] == "attachment"
    assert answer.headers["x-content-type-options"] == "nosniff"


def test_unsigned_addresses_are_refused(cloud: Cloud, pair: tuple[Person, Robot]) -> None:
    anna, robot = pair
    begun = begin(anna, robot)
    for token in ("x", "a.b.c", anna.token, begun["url"].rpartition("/")[2][:-4], "%00", "é"):
        for method in ("GET", "PUT"):
            problem(cloud.ask(method, f"{API}/blobs/{token}", content=b"x"), 403, "transfer-refused")


def test_captures_come_newest_first_in_pages(cloud: Cloud, pair: tuple[Person, Robot]) -> None:
    anna, robot = pair
    ids = []
    for _ in range(5):
        cloud.clock.advance(1)
        begun = begin(anna, robot)
        send(cloud, begun, PICTURE)
        assert complete(anna, robot, begun["id"]).status_code == 200
        ids.append(begun["id"])
    begin(anna, robot)
    found: list[str] = []
    query: dict[str, Any] = {"limit": 2}
    while True:
        page = anna.get(f"/devices/{robot.device}/uploads", params=query).json()
        found += [item["id"] for item in page["items"]]
        if page["cursor"] is None:
            break
        query["cursor"] = page["cursor"]
    assert found == ids[::-1]
    problem(anna.get(f"/devices/{robot.device}/uploads", params={"cursor": "\x00?"}), 422, "cursor-invalid")


def test_so_many_uploads_may_be_under_way(
    cloud: Cloud, pair: tuple[Person, Robot], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(uploads, "MAX_UNREGISTERED", 3)
    anna, robot = pair
    begun = [begin(anna, robot) for _ in range(3)]
    problem(anna.post(f"/devices/{robot.device}/uploads", WANTED), 409, "too-many-uploads")
    send(cloud, begun[0], PICTURE)
    complete(anna, robot, begun[0]["id"])
    begin(anna, robot)


def test_what_is_not_registered_is_forgotten_with_its_blob(cloud: Cloud, pair: tuple[Person, Robot]) -> None:
    anna, robot = pair
    begun = begin(anna, robot)
    send(cloud, begun, PICTURE)
    cloud.clock.advance(LIFETIME_S)
    forget(cloud)
    assert len(blobs(cloud)) == 1
    cloud.clock.advance(UNREGISTERED_MS / 1000)
    anna = cloud.sign_in("anna")
    problem(complete(anna, robot, begun["id"]), 404, "upload-unknown")
    forget(cloud)
    assert blobs(cloud) == ()
    assert rows(cloud, robot) == 0


def test_what_is_registered_is_kept_for_its_time(cloud: Cloud, pair: tuple[Person, Robot]) -> None:
    anna, robot = pair
    begun = begin(anna, robot)
    send(cloud, begun, PICTURE)
    complete(anna, robot, begun["id"])
    cloud.clock.advance(29 * DAY_S)
    forget(cloud)
    assert listed(cloud.sign_in("anna"), robot) == [begun["id"]]
    cloud.clock.advance(DAY_S)
    assert listed(cloud.sign_in("anna"), robot) == []
    forget(cloud)
    assert blobs(cloud) == ()
    assert rows(cloud, robot) == 0


@pytest.mark.parametrize("step", ["begin", "complete", "delete"])
def test_a_kill_between_any_two_writes_leaves_nothing_for_ever(
    cloud: Cloud, pair: tuple[Person, Robot], step: str
) -> None:
    anna, robot = pair
    service = cloud.functions.uploads
    row = cloud.run(cloud.functions.tables.get(records.AGENTS, robot.id, "agent"))
    assert row is not None
    (device,) = devices_of(records.read(row, Agent))
    wanted = uploads.Announced(stream="camera", length=1, content_type="image/png")
    for number in range(4):
        begun = begin(anna, robot)
        send(cloud, begun, PICTURE)
        if step == "delete":
            complete(anna, robot, begun["id"])
        tables, content = service._tables, service._blobs
        spoilt = Spoilt((tables, content), number)
        service._tables, service._blobs = spoilt, spoilt
        calls: dict[str, Any] = {
            "begin": lambda: service.begin(device, wanted, by="anna"),
            "complete": lambda begun=begun: service.complete(device, begun["id"]),
            "delete": lambda begun=begun: service.delete(device, begun["id"]),
        }
        try:
            cloud.run(calls[step]())
        except Killed:
            assert spoilt.left < 0
        finally:
            service._tables, service._blobs = tables, content
        if step == "complete":
            assert complete(anna, robot, begun["id"]).status_code == 200
        if step == "delete" and number > 1:
            assert begun["id"] not in listed(anna, robot)
    cloud.clock.advance(31 * DAY_S)
    forget(cloud)
    assert blobs(cloud) == ()
    assert rows(cloud, robot) == 0


class Killed(Exception):  # noqa: N818 (as the signal)
    """The process ends here."""


class Spoilt:
    """Stores that end the process at one of their writes."""

    def __init__(self, stores: tuple[Any, Any], left: int) -> None:
        self._stores = stores
        self.left = left

    def __getattr__(self, name: str) -> Any:
        tables, content = self._stores
        real = getattr(tables, name, None)
        if name == "delete":

            async def delete(*arguments: Any) -> Any:
                self._count()
                return await (tables.delete if len(arguments) > 1 else content.delete)(*arguments)

            return delete
        if real is None:
            return getattr(content, name)
        if name not in {"create", "replace", "batch"}:
            return real if name != "get" else self._get

        async def write(*arguments: Any) -> Any:
            self._count()
            return await real(*arguments)

        return write

    async def _get(self, *arguments: Any) -> Any:
        tables, content = self._stores
        return await (tables.get if len(arguments) > 1 else content.get)(*arguments)

    def _count(self) -> None:
        self.left -= 1
        if self.left < 0:
            raise Killed
