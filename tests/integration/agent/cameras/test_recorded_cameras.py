"""Cameras of a simulated robot are recorded only with the owner's consent, while a relay in the room is on."""

import os
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import av
import msgspec
import pytest
import simplejpeg

from device_agent import __main__ as program
from device_agent.cli.export.recording import open_recording
from device_agent.config.agent_config import DeviceEntry, Indicator, Recording
from device_agent.protocol import Command, SetCameraConsent, camera_frames, codec, topics
from device_agent.protocol.security import signing
from device_agent.runtime.recording.format import CompressedImage
from function_app.adapters.local.signing_keys import FileKeys
from function_app.domain.common.ids import command_id
from function_app.services.messaging.delivery import SignedCommand
from tests.harness.agent.pairing import paired_devices
from tests.harness.cloud.cloud import problem
from tests.harness.cloud.cloud_processes import CloudProcesses, start_cloud_processes
from tests.harness.network.brokers import Client, wait_until
from tests.harness.paths import ROOT
from tests.harness.robots.room_devices.house_broker import HouseBroker
from tests.harness.robots.room_devices.tasmota import Tasmota

EYES = "/frames/eyes"


def entries(house: HouseBroker) -> list[DeviceEntry]:
    plug = {
        "name": "plug",
        "type": "plug",
        "driver": "tasmota",
        "label": "Lamp at the door",
        "streams": [{"name": "settings", "rate_hz": 1.0}],
        "controls": [{"name": "relay", "label": "Relay", "lower": 0.0, "upper": 1.0}],
        "options": {"broker": house.options(), "topic": "plug", "controls": {"relay": {"command": "POWER1"}}},
    }
    return [DeviceEntry(name="robot", type="qbo"), msgspec.convert(plug, DeviceEntry)]


@dataclass
class Site:
    """The cloud, an agent with a robot and a relay, and a viewer of the robot's camera."""

    processes: CloudProcesses
    tasmota: Tasmota
    ids: dict[str, str]
    viewer: Client
    ticks_ms: set[int] = field(default_factory=set)

    @property
    def path(self) -> str:
        return f"/devices/{self.ids['robot']}"

    def state(self) -> dict[str, Any]:
        state: dict[str, Any] = self.processes.anna.get(self.path).json()["state"] or {}
        return state

    def consent(self, *cameras: str) -> None:
        answer = self.processes.anna.put(f"{self.path}/camera-consent", {"cameras": cameras, "wait_ms": 30_000})
        assert answer.json()["confirmed"], answer.text

    def recorded(self, *cameras: str) -> None:
        wait_until(lambda: self.state()["recorded_cameras"] == list(cameras), f"recorded cameras: {cameras}")

    def watch(self, count: int) -> None:
        """Wait until the viewer has received so many frames more."""
        wanted = len(self.ticks_ms) + count

        def received() -> bool:
            for message in self.viewer.pending():
                if topics.parse(message.topic).kind == topics.CAM:
                    self.ticks_ms.add(camera_frames.decode(message.payload).tick_ms)
            return len(self.ticks_ms) >= wanted

        wait_until(received, f"{count} frames")

    def send_old_consent(self) -> None:
        """Send a validly signed command with the number of the first decision."""
        device = next(each for each in self.processes.devices(self.viewer_agent) if each.id == self.ids["robot"])
        now_ms = self.processes.cloud.clock.now_ms()
        request = SetCameraConsent(cameras=("eyes",), account=self.processes.anna.account, number=1)
        command = Command(
            id=command_id(device.id, now_ms),
            space=device.space,
            agent=device.agent,
            device=device.name,
            issued_at_ms=now_ms,
            ttl_ms=30_000,
            caller="anna",
            epoch=0,
            request=request,
        )
        payload = signing.sign(codec.encode(command), FileKeys(self.processes.home / "keys").load())
        self.processes.cloud.run(self.processes.delivery.send(device, SignedCommand(command.id, payload, 2**53)))

    @property
    def viewer_agent(self) -> str:
        return self.ids["robot"].partition("-")[0]

    def rejections(self) -> list[str]:
        items = self.processes.anna.get(f"{self.path}/events").json()["items"]
        return [each["data"].get("code") for each in items if each["kind"] == "command-rejected"]

    def session(self, epoch: int) -> dict[str, Any]:
        session: dict[str, Any] = self.processes.anna.get(f"{self.path}/sessions/{epoch}").json()
        return session

    def download(self, epoch: int, folder: Path) -> dict[str, Any]:
        """Download the segments of a session; returns its recording."""
        wait_until(lambda: (self.session(epoch).get("recording") or {}).get("complete"), "the recording")
        recording: dict[str, Any] = self.session(epoch)["recording"]
        for each in recording["segments"]:
            path = each["url"].partition("/api/v1")[2] or each["url"]
            content = self.processes.anna.get(path).content
            (folder / f"{each['segment']:06d}.mcap").write_bytes(content)
        return recording


@pytest.fixture
def site(tmp_path: Path) -> Iterator[Site]:
    indicator = Indicator(device="plug", control="relay")
    with (
        HouseBroker(tmp_path / "house") as house,
        Tasmota(house, "plug") as tasmota,
        start_cloud_processes("amqtt", tmp_path / "cloud") as processes,
        (tmp_path / "log").open("wb") as log,
    ):
        recording = Recording(min_free_gb=0, indicator=indicator)
        ids = paired_devices(processes, tmp_path / "agent", entries(house), recording=recording)
        command = [sys.executable, "-m", "device_agent", "run", "--home", str(tmp_path / "agent")]
        with subprocess.Popen(command, cwd=ROOT, stdout=log, stderr=log, env=os.environ) as agent:
            try:
                with processes.viewer(ids["robot"].partition("-")[0]) as viewer:
                    site = Site(processes, tasmota, ids, viewer)
                    wait_until(lambda: site.state().get("camera_consent") is not None, "the agent")
                    yield site
            finally:
                agent.terminate()
                assert agent.wait(60) == 0, (tmp_path / "log").read_text()
    assert tasmota.state["POWER"] == "OFF"


@pytest.mark.timeout(600)
def test_frames_are_recorded_between_consent_and_withdrawal_and_exported(site: Site, tmp_path: Path) -> None:
    anna = site.processes.anna
    oscar = site.processes.cloud.sign_in("oscar")
    assert anna.post(f"{site.path}/shares", {"account": "oscar", "role": "operator"}).status_code == 201
    epoch = oscar.post(f"{site.path}/lease", {"lease_ms": 600_000}).json()["epoch"]
    wait_until(lambda: site.state()["recording"], "the recording")
    site.watch(3)
    assert site.state()["recorded_cameras"] == []
    refused = oscar.put(f"{site.path}/camera-consent", {"cameras": ["eyes"]})
    assert "Only the owner" in problem(refused, 403, "forbidden")["detail"]

    before_ns = time.monotonic_ns()
    site.consent("eyes")
    site.recorded("eyes")
    assert site.tasmota.state["POWER"] == "ON"
    site.watch(8)
    site.consent()
    after_ns = time.monotonic_ns()
    site.recorded()
    wait_until(lambda: site.tasmota.state["POWER"] == "OFF", "the relay")
    site.send_old_consent()
    wait_until(lambda: "outdated" in site.rejections(), "the rejection of an old consent")

    site.tasmota.deaf = True
    site.consent("eyes")
    wait_until(lambda: "camera-indicator" in str(site.state()["faults"]), "the fault of the indicator")
    site.watch(3)
    assert site.state()["recorded_cameras"] == []
    site.consent()
    site.tasmota.deaf = False
    assert oscar.delete(f"{site.path}/lease?epoch={epoch}").status_code == 204

    folder = tmp_path / "recording"
    folder.mkdir()
    recording = site.download(epoch, folder)
    assert recording["cameras"] == [EYES]
    check_frames(folder, site.ticks_ms, before_ns, after_ns)
    check_exports(folder, tmp_path)


def check_frames(folder: Path, ticks_ms: set[int], before_ns: int, after_ns: int) -> None:
    opened = open_recording(sorted(folder.iterdir()))
    assert opened.cameras == (EYES,)
    info, found_ms = opened.info, set()
    for entry in opened.entries(topics=(EYES,)):
        tick_ns = entry.time_ns - info.started_ns + info.started_tick_ns
        assert before_ns < tick_ns < after_ns
        assert abs(entry.publish_ns - time.time_ns()) < 600 * 10**9
        image = msgspec.json.decode(entry.data, type=CompressedImage)
        assert image.timestamp.sec * 10**9 + image.timestamp.nsec == entry.time_ns
        assert simplejpeg.decode_jpeg(image.data).ndim == 3
        found_ms.add(round(tick_ns / 1e6))
    assert len(found_ms) >= 4
    assert len({tick for tick in found_ms if {tick - 1, tick, tick + 1} & ticks_ms}) >= 4, "ticks of the exposures"


def check_exports(folder: Path, tmp_path: Path) -> None:
    def export(kind: str, output: str) -> Path:
        arguments = ["--recording", str(folder), "--format", kind, "--output", str(tmp_path / output)]
        assert program.main(["export", *arguments]) == 0
        return tmp_path / output

    count = len(list(open_recording(sorted(folder.iterdir())).entries(topics=(EYES,))))
    again = open_recording([export("mcap", "out.mcap")])
    assert len(list(again.entries(topics=(EYES,)))) == count
    videos = list(export("lerobot", "dataset").glob("videos/**/*eyes*/**/*.mp4"))
    assert videos
    with av.open(str(videos[0])) as container:
        frames = sum(1 for _ in container.decode(video=0))
    assert frames >= count
