"""The agent's client and the cloud's API: segments are uploaded, and continue after a lost connection."""

import hashlib
import time
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import pytest
import requests

from device_agent.ports.uploads import SegmentUpload, UploadError
from device_agent.transports.http import recording_uploads
from device_agent.transports.http.client import CloudError
from device_agent.transports.http.recording_uploads import HttpRecordingUploads
from tests.fakes.agent import Robot
from tests.harness.cloud.cloud import BASE, Cloud, Person

CONTENT, OVERVIEW = bytes(range(256)) * 400, b"{}"


class Site:
    """The cloud in this process. Requests after ``requests_left`` fail as with a lost connection."""

    ca = None
    server = f"{BASE}/"

    def __init__(self, cloud: Cloud, anna: Person, robot: Robot) -> None:
        self.cloud, self.anna, self.robot = cloud, anna, robot
        self.epoch = int(anna.take_lease(robot.device).json()["epoch"])
        self.requests_left = 100
        self.sent: list[str] = []
        self.uploads = HttpRecordingUploads(robot.id, lambda: self, rate_bytes_s=10**9)  # type: ignore[arg-type, return-value]
        self.segment = SegmentUpload(
            device="arm",
            epoch=self.epoch,
            segment=0,
            started_ms=1,
            ended_ms=60_001,
            rows=7500,
            cameras=tuple(f"/frames/room/{number}" for number in range(20)),
            content=CONTENT,
            overview=OVERVIEW,
        )

    def _count(self, what: str) -> None:
        if not self.requests_left:
            raise OSError("the connection is lost")
        self.requests_left -= 1
        self.sent.append(what)

    def post(self, path: str, body: Mapping[str, Any]) -> Any:
        self._count("post")
        answer = self.robot.request("POST", path, json=dict(body))
        if answer.is_error:
            raise CloudError(answer.json()["detail"])
        return answer.json() if answer.content else {}

    def transfer(self, method: str, url: str, **options: Any) -> Any:
        self._count(url.rpartition(".")[2][:4])
        content = b"".join(options["data"])
        headers = {**options["headers"], "Content-Length": str(len(content))}
        answer = self.cloud.request(method, url.removeprefix(BASE), headers=headers, content=content)
        response = requests.Response()
        response.status_code, response._content = answer.status_code, answer.content
        return response

    def segments(self) -> list[dict[str, Any]]:
        shown = self.anna.get(f"/devices/{self.robot.device}/sessions/{self.epoch}")
        recording = shown.json()["recording"]
        return [] if recording is None else list(recording["segments"])


@pytest.fixture
def site(cloud: Cloud, anna: Person, robot: Robot, monkeypatch: pytest.MonkeyPatch) -> Site:
    made = Site(cloud, anna, robot)
    monkeypatch.setattr("requests.request", made.transfer)
    return made


def test_a_segment_and_its_overview_are_stored(site: Site) -> None:
    site.uploads.store_segment(site.segment)
    (stored,) = site.segments()
    assert (stored["length"], stored["sha256"]) == (len(CONTENT), hashlib.sha256(CONTENT).hexdigest())
    assert site.cloud.request("GET", stored["url"].removeprefix(BASE)).content == CONTENT
    assert site.cloud.request("GET", stored["overview_url"].removeprefix(BASE)).content == OVERVIEW


@pytest.mark.parametrize("requests_left", range(4))
def test_an_upload_continues_after_a_lost_connection(site: Site, requests_left: int) -> None:
    site.requests_left = requests_left
    with pytest.raises(UploadError, match="the connection is lost"):
        site.uploads.store_segment(site.segment)
    assert site.segments() == []
    site.requests_left, site.sent = 100, []
    site.uploads.store_segment(site.segment)
    assert len(site.segments()) == 1
    # Announcement and completion are repeated, and the files that were not sent.
    assert len(site.sent) == 4 - max(0, requests_left - 1)
    site.sent = []
    site.uploads.store_segment(site.segment)
    assert site.sent == ["post"]


def test_a_rejection_is_an_error(site: Site) -> None:
    with pytest.raises(UploadError, match="There is no session"):
        site.uploads.store_segment(replace(site.segment, epoch=99))


def test_an_invalid_response_is_an_error(site: Site, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(site, "post", lambda *_: {})
    with pytest.raises(UploadError, match="lacks 'stored'"):
        site.uploads.store_segment(site.segment)


def test_the_rate_of_an_upload_is_limited() -> None:
    content = recording_uploads._Limited(CONTENT, rate_bytes_s=10**6)
    started_s = time.monotonic()
    assert len(content) == len(CONTENT)
    assert b"".join(content) == CONTENT
    assert time.monotonic() - started_s >= len(CONTENT) / 10**6
