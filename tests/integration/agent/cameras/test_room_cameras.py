"""Cameras that only ``agent.toml`` describes: their pictures reach a viewer through agent, broker and cloud."""

import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import msgspec
import pytest
import simplejpeg

from device_agent.config.agent_config import AgentConfig
from device_agent.protocol import camera_frames, topics
from device_agent.protocol.camera_frames import CameraFrame
from device_agent.protocol.state import State
from tests.harness.cloud.cloud_processes import CloudProcesses
from tests.harness.network.brokers import BrokerKind, Client, wait_until
from tests.harness.network.cameras import steps
from tests.harness.network.cameras.mjpeg import PASSWORD, USER, MjpegCamera
from tests.harness.network.cameras.pictures import HEIGHT, WIDTH
from tests.harness.network.cameras.rtsp import RtspCamera
from tests.harness.paths import ROOT

_END_S = 120.0


class Viewer:
    """Anna's console: frames and states of the agent's devices."""

    def __init__(self, client: Client) -> None:
        self._client = client
        self._frames: dict[str, list[CameraFrame]] = {}
        self._states: dict[str, State] = {}

    def receive(self) -> None:
        for message in self._client.pending():
            device, _, kind = message.topic.split("/", 4)[4].partition("/")
            kind = kind.split("/")[0]
            if kind == topics.CAM:
                self._frames.setdefault(device, []).append(camera_frames.decode(message.payload))
            elif kind == topics.STATE:
                self._states[device] = msgspec.json.decode(message.payload, type=State)

    def frames(self, device: str) -> list[CameraFrame]:
        self.receive()
        return self._frames.get(device, [])

    def wait_for_frames(self, device: str, count: int) -> list[CameraFrame]:
        wait_until(lambda: len(self.frames(device)) >= count, f"pictures of {device}")
        return self.frames(device)

    def faults(self, device: str) -> str:
        self.receive()
        state = self._states.get(device)
        return "" if state is None else " ".join(fault.message for fault in state.faults)


@pytest.fixture
def processes(start_processes: Callable[[BrokerKind], CloudProcesses]) -> CloudProcesses:
    return start_processes("amqtt")


@pytest.fixture
def mjpeg() -> Iterator[MjpegCamera]:
    camera = MjpegCamera()
    camera.authentication = "digest"
    yield camera
    camera.close()


@pytest.fixture
def rtsp() -> Iterator[RtspCamera]:
    camera = RtspCamera()
    yield camera
    camera.close()


def agent(command: str, home: Path, *arguments: str, **options: Any) -> "subprocess.Popen[str]":
    return subprocess.Popen(
        [sys.executable, "-m", "device_agent", command, "--home", str(home), *arguments], cwd=ROOT, text=True, **options
    )


def enroll(processes: CloudProcesses, home: Path, cameras: dict[str, dict[str, Any]]) -> dict[str, Any]:
    """Describe the cameras in ``agent.toml``, enroll with the command line, and claim the agent."""
    devices = tuple(steps.entry(name, name=name, **options) for name, options in cameras.items())
    AgentConfig(server=processes.url, name="room", devices=devices).save(home)
    with agent("enroll", home, "--no-wait", "--no-qr", stdout=subprocess.PIPE) as process:
        output, _ = process.communicate(timeout=_END_S)
    assert process.returncode == 0, output
    code = output.split("claim code ")[1].split()[0]
    claimed: dict[str, Any] = processes.anna.post("/agents/claim", {"code": code}).json()
    return claimed


def test_a_viewer_receives_pictures_and_the_fault_of_a_frozen_camera(
    processes: CloudProcesses, mjpeg: MjpegCamera, rtsp: RtspCamera, tmp_path: Path
) -> None:
    home, secret, log = tmp_path / "agent", tmp_path / "password", tmp_path / "log"
    secret.write_text(PASSWORD)
    options = {"url": mjpeg.url(), "user": USER, "password_file": str(secret), "stale_s": 2.0}
    claimed = enroll(processes, home, {"mjpeg": options, "rtsp": {"url": rtsp.url(login="viewer:hidden@")}})
    anna, ids = processes.anna, {each["name"]: each["id"] for each in claimed["devices"]}
    with log.open("w") as output, agent("run", home, stdout=output, stderr=output) as process:
        try:
            viewer = Viewer(processes.viewer(claimed["agent"]))
            for device in ids:
                frames = viewer.wait_for_frames(device, 3)
                assert [frame.sequence for frame in frames] == sorted({frame.sequence for frame in frames})
                assert [frame.tick_ms for frame in frames] == sorted({frame.tick_ms for frame in frames})
                assert simplejpeg.decode_jpeg(frames[-1].content).shape == (HEIGHT, WIDTH, 3)
            device = anna.get(f"/devices/{ids['mjpeg']}").json()
            assert (device["online"], device["robot_type"], device["kind"]) == (True, "camera", "camera")

            request = {"kind": "capture", "name": "image"}
            action = anna.start(ids["mjpeg"], request=request, wait_ms=30_000, wait_for="done").json()
            assert action["result"]["media_type"] == "image/jpeg", action

            # A camera that needs more than two seconds to connect shows a fault until then.
            wait_until(lambda: not viewer.faults("rtsp"), "the camera without a fault")
            mjpeg.frozen.set()
            wait_until(lambda: "no new picture" in viewer.faults("mjpeg"), "the fault of the frozen camera")
            viewer.frames("mjpeg").clear()
            assert not viewer.faults("rtsp"), "the other camera is not affected"
            viewer.wait_for_frames("rtsp", len(viewer.frames("rtsp")) + 3)
            assert viewer.frames("mjpeg") == [], "a frozen picture is not shown"
            mjpeg.frozen.clear()
            wait_until(lambda: viewer.frames("mjpeg") and not viewer.faults("mjpeg"), "the recovered camera")
        finally:
            process.terminate()
            assert process.wait(_END_S) == 0, log.read_text()
    assert not any(word in log.read_text() for word in ("hidden", PASSWORD))
