"""Cameras of this machine. There is none here, so these tests show only the failures and the encoding."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from device_agent.sensors.camera import decoder, decoder_process
from tests.harness.network.brokers import wait_until
from tests.harness.network.cameras.steps import CreateDriver, failure

pytestmark = pytest.mark.slow
_NOBODY = "65534"


def test_a_missing_camera_is_named(create: CreateDriver) -> None:
    driver = create("v4l2", device="/dev/video99")
    wait_until(lambda: "/dev/video99 does not exist; check that the camera is plugged in" in failure(driver), "it")


@pytest.mark.parametrize("device", ["/dev/null", "/etc/hostname"])
def test_another_device_is_not_opened_as_a_camera(create: CreateDriver, device: str) -> None:
    driver = create("v4l2", device=device)
    wait_until(lambda: f"{device} is not a camera; list the cameras" in failure(driver), "the message")


def test_a_missing_permission_names_the_group(
    create: CreateDriver, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    device = tmp_path / "video0"
    device.touch(mode=0o000)
    if os.geteuid() == 0:  # root may open everything, so the decoder runs as another user, who sees only its program
        for folder in (tmp_path, *tmp_path.parents[:-2]):
            folder.chmod(0o755)
        program = tmp_path / "decoder.py"
        program.write_bytes(Path(decoder.__file__).read_bytes())
        unprivileged = ("setpriv", f"--reuid={_NOBODY}", "--clear-groups", "/usr/bin/python3", "-I")
        monkeypatch.setattr(decoder_process, "INTERPRETER", unprivileged)
        monkeypatch.setattr(decoder_process, "_PROGRAM", program)
    driver = create("v4l2", device=str(device))
    wait_until(lambda: "add the agent's user to the group video" in failure(driver), "the message")


def test_images_are_encoded_within_the_limit() -> None:
    process = subprocess.run([sys.executable, "-c", _ENCODE], capture_output=True, text=True, check=True)
    width, height, length, first_bytes = json.loads(process.stdout)
    assert (width, height, first_bytes) == (640, 480, "ffd8")
    assert length <= 100_000


_ENCODE = """
import json, numpy as np
from device_agent.sensors.camera import decoder
noise = np.random.default_rng(1).integers(0, 255, (480, 640, 3), dtype=np.uint8)
_, width, height, jpeg = decoder.encoded(noise, 100_000)
print(json.dumps([width, height, len(jpeg), jpeg[:2].hex()]))
"""
