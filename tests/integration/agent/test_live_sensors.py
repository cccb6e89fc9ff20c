"""Depth images, scans and tracked people of a simulated room reach the viewers of its space only."""

import os
import subprocess
import sys
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import pytest

from device_agent.config.agent_config import DeviceEntry
from device_agent.protocol import Description, camera_frames, codec, topics
from device_agent.protocol.camera_frames import CameraFrame
from device_agent.protocol.codec import MAX_BYTES
from function_app.ports.broker_access import Credentials
from tests.harness.agent.pairing import paired_devices
from tests.harness.cloud.cloud import Person
from tests.harness.cloud.cloud_processes import CloudProcesses, start_cloud_processes
from tests.harness.network.brokers import Client, wait_until
from tests.harness.network.cameras.frames import depths_mm, people, scan
from tests.harness.paths import ROOT

ENTRIES = (
    DeviceEntry(name="depth", type="depth_camera", room="lab"),
    DeviceEntry(name="lidar", type="lidar", room="lab"),
)
STREAMS = {("depth", "depth"): "depth", ("depth", "people"): "people", ("lidar", "scan"): "scan"}
"""Device and stream → kind of its frames."""
_END_S = 60.0


@dataclass
class Viewer:
    """A broker connection that collects frames and descriptions by device and stream."""

    client: Client
    frames: dict[tuple[str, str], list[CameraFrame]] = field(default_factory=lambda: defaultdict(list))
    sizes: list[int] = field(default_factory=list)
    described: dict[str, Description] = field(default_factory=dict)
    messages: int = 0

    def receive(self) -> None:
        for message in self.client.pending():
            self.messages += 1
            parsed = topics.parse(message.topic)
            if parsed.kind == topics.CAM:
                self.frames[parsed.device, parsed.name].append(camera_frames.decode(message.payload))
                self.sizes.append(len(message.payload))
            elif parsed.kind == topics.DESC and not parsed.name:
                self.described[parsed.device] = codec.decode(message.payload, Description)

    def has(self, count: int) -> bool:
        self.receive()
        return all(len(self.frames[stream]) >= count for stream in STREAMS) and len(self.described) == len(ENTRIES)


def connected(processes: CloudProcesses, person: Person, *, foreign: tuple[str, ...] = ()) -> tuple[Viewer, list[str]]:
    """A viewer with a person's own topics, and with ``foreign`` topics if the broker grants them."""
    issued = person.post("/mqtt/credentials", {"purpose": "view"}).json()
    credentials = Credentials(issued["username"], issued["password"])
    client = processes.broker.running.connect(issued["client_id"], credentials)
    wanted = [*issued["subscribe"], *foreign]
    for topic in wanted:
        client.subscribe(topic)
    return Viewer(client), wanted


@pytest.fixture
def processes(tmp_path: Path) -> Iterator[CloudProcesses]:
    with start_cloud_processes("amqtt", tmp_path / "cloud") as processes:
        yield processes


@pytest.mark.timeout(300)
def test_all_kinds_of_frames_reach_viewers_of_the_space_only(processes: CloudProcesses, tmp_path: Path) -> None:
    ids = paired_devices(processes, tmp_path / "agent", ENTRIES)
    viewer, stranger = processes.cloud.sign_in("victor"), processes.cloud.sign_in("mallory")
    for device in ids.values():
        share = {"account": viewer.name, "role": "viewer"}
        assert processes.anna.post(f"/devices/{device}/shares", share).status_code == 201
    command = [sys.executable, "-m", "device_agent", "run", "--home", str(tmp_path / "agent")]
    log = tmp_path / "log"
    with (
        log.open("wb") as output,
        subprocess.Popen(command, cwd=ROOT, stdout=output, stderr=output, env=os.environ) as agent,
    ):
        try:
            permitted, wanted = connected(processes, viewer)
            frames = tuple(topic for topic in wanted if f"/{topics.CAM}/" in topic)
            assert frames
            excluded, _ = connected(processes, stranger, foreign=(*frames, f"{topics.ROOT}/#"))
            wait_until(lambda: permitted.has(3), "frames of all kinds", 120.0)
            wait_until(lambda: sees_person(permitted), "a tracked person", 120.0)
            excluded.receive()
        finally:
            agent.terminate()
            assert agent.wait(_END_S) == 0, log.read_text()
    assert excluded.messages == 0, "another account receives nothing"
    for (device, stream), kind in STREAMS.items():
        assert {each.name: each.kind for each in permitted.described[device].cameras}[stream] == kind
        received = permitted.frames[device, stream]
        assert {each.kind for each in received} == {kind}
        assert [each.sequence for each in received] == sorted({each.sequence for each in received})
        assert [each.tick_ms for each in received] == sorted(each.tick_ms for each in received)
    assert max(permitted.sizes) < MAX_BYTES
    assert depths_mm(permitted.frames["depth", "depth"][-1].content).shape == (240, 320)
    assert len(scan(permitted.frames["lidar", "scan"][-1].content).range_m) == 360


def sees_person(viewer: Viewer) -> bool:
    viewer.receive()
    return any(people(frame.content).people for frame in viewer.frames["depth", "people"])
