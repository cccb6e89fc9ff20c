"""Cameras over HTTP and RTSP keep the contract of every room driver."""

from collections.abc import Iterator
from pathlib import Path

import pytest

from device_agent import bootstrap
from device_agent.config import catalogue
from device_agent.config.agent_config import DeviceEntry
from device_agent.ports.sensor import RoomDriver
from device_agent.protocol.manifests.room import RoomDeviceManifest
from tests.contract.sensors.suite import RoomDriverContract
from tests.harness.network.cameras.mjpeg import MjpegCamera
from tests.harness.network.cameras.rtsp import RtspCamera
from tests.harness.network.cameras.steps import entry, wait_for_connection

CAMERAS = {"mjpeg": MjpegCamera, "rtsp": RtspCamera}


@pytest.mark.parametrize("name", CAMERAS)
class TestCameras(RoomDriverContract):
    @pytest.fixture
    def camera(self, name: str) -> Iterator[MjpegCamera | RtspCamera]:
        camera = CAMERAS[name]()
        yield camera
        camera.close()

    @pytest.fixture
    def device(self, name: str, camera: MjpegCamera | RtspCamera) -> DeviceEntry:
        return entry(name, url=camera.url(), stale_s=60.0)

    @pytest.fixture
    def entry(self, device: DeviceEntry) -> RoomDeviceManifest:
        found = catalogue.room_device_of(device)
        assert found is not None
        return found

    @pytest.fixture
    def driver(self, device: DeviceEntry, tmp_path: Path) -> Iterator[RoomDriver]:
        created = bootstrap.create_room_device(device, {}, home=tmp_path)
        assert created is not None
        yield created.driver
        created.close()

    @pytest.fixture
    def connected(self, driver: RoomDriver) -> RoomDriver:
        """Connected as the agent does, which tries again while the decoder starts."""
        wait_for_connection(driver)
        return driver
