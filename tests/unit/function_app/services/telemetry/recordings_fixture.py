"""Uploads of the recording of one session, as an agent makes them."""

import hashlib
from typing import Any

import httpx

from tests.fakes.agent import Robot
from tests.harness.cloud.cloud import Cloud, Person

CONTENT, OVERVIEW = bytes(range(256)) * 20, b'{"time_s": []}'
MINUTE_MS = 60_000


def sha256(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()


class Recorder:
    """Uploads the recording of one session, as an agent does."""

    def __init__(self, cloud: Cloud, anna: Person, robot: Robot) -> None:
        self.cloud, self.anna, self.robot = cloud, anna, robot
        self.path = f"/agents/{robot.id}/recordings"
        self.epoch = int(anna.take_lease(robot.device, lease_ms=600_000).json()["epoch"])
        self.session = f"/devices/{robot.device}/sessions/{self.epoch}"
        self.started_ms = cloud.clock.now_ms()

    def announced(self, segment: int = 0, **changes: Any) -> dict[str, Any]:
        return {
            "device": "arm",
            "epoch": self.epoch,
            "segment": segment,
            "started_ms": self.started_ms + segment * MINUTE_MS,
            "ended_ms": self.started_ms + (segment + 1) * MINUTE_MS,
            "length": len(CONTENT),
            "sha256": sha256(CONTENT),
            "overview_length": len(OVERVIEW),
            "overview_sha256": sha256(OVERVIEW),
            "rows": 7500,
            **changes,
        }

    def begin(self, segment: int = 0, **changes: Any) -> httpx.Response:
        return self.robot.request("POST", self.path, json=self.announced(segment, **changes))

    def send(self, request: dict[str, Any], content: bytes) -> int:
        headers = {**request["headers"], "Content-Length": str(len(content))}
        return self.cloud.request(request["method"], request["url"], headers=headers, content=content).status_code

    def complete(self, segment: int = 0, pending: list[int] | None = None) -> httpx.Response:
        place = {"device": "arm", "epoch": self.epoch, "segment": segment}
        if pending is not None:
            place["pending"] = pending
        return self.robot.request("POST", f"{self.path}/complete", json=place)

    def store(self, segment: int = 0, *, pending: list[int] | None = None, **changes: Any) -> None:
        upload = self.begin(segment, **changes).json()
        assert self.send(upload["segment"], CONTENT) == 201
        assert self.send(upload["overview"], OVERVIEW) == 201
        assert self.complete(segment, pending).status_code == 204

    def missing(self) -> tuple[list[tuple[int, str]], bool]:
        recording = self.read()["recording"]
        return [(each["segment"], each["cause"]) for each in recording["missing"]], recording["final"]

    def release(self) -> None:
        assert self.anna.delete(f"/devices/{self.robot.device}/lease?epoch={self.epoch}").status_code == 204

    def read(self, person: Person | None = None) -> dict[str, Any]:
        answer = (person or self.anna).get(self.session)
        assert answer.status_code == 200, answer.text
        shown: dict[str, Any] = answer.json()
        return shown

    def blobs(self) -> tuple[str, ...]:
        return self.cloud.run(self.cloud.functions.blobs.list("recordings/"))

    def used_bytes(self) -> int:
        return self.cloud.run(self.cloud.functions.quota.usage(self.anna.account)).total_bytes

    def put_episodes(
        self, *episodes: dict[str, Any], etag: str = '"0"', person: Person | None = None
    ) -> httpx.Response:
        headers = {"If-Match": etag} if etag else {}
        body = {"episodes": list(episodes)}
        return (person or self.anna).request("PUT", f"{self.session}/episodes", json=body, headers=headers)

    def delete(self, person: Person | None = None) -> httpx.Response:
        return (person or self.anna).delete(f"{self.session}/recording")


def episode(start_s: float, end_s: float, **more: Any) -> dict[str, Any]:
    return {"start_s": start_s, "end_s": end_s, "outcome": None, "label": "", "note": "", **more}
