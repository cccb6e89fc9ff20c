"""RTSP cameras: decoding in a process of its own, credentials, and lost, frozen and hostile cameras."""

import json
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from urllib.parse import quote

import pytest
import simplejpeg

from device_agent.ports.sensor import SensorError
from device_agent.sensors.camera import decoder, decoder_process
from tests.harness.network.brokers import wait_until
from tests.harness.network.cameras import rtp
from tests.harness.network.cameras.pictures import HEIGHT, WIDTH
from tests.harness.network.cameras.rtsp import PASSWORD, USER, RtspCamera
from tests.harness.network.cameras.steps import CreateDriver, failure, next_frame, wait_for_connection
from tests.harness.paths import ROOT

pytestmark = pytest.mark.slow


@pytest.fixture
def rtsp(request: pytest.FixtureRequest) -> Iterator[RtspCamera]:
    camera = RtspCamera(getattr(request, "param", rtp.H264))
    yield camera
    camera.close()


def decoders() -> list[int]:
    """Processes of decoders that this process has started."""
    children = Path(f"/proc/{os.getpid()}/task").glob("*/children")
    found = (int(child) for listing in children for child in listing.read_text().split())
    return [child for child in found if b"decoder.py" in Path(f"/proc/{child}/cmdline").read_bytes()]


@pytest.mark.parametrize("rtsp", [rtp.H264, rtp.JPEG], indirect=True, ids=["h264", "jpeg"])
def test_decoded_pictures_arrive_with_their_size_and_time(create: CreateDriver, rtsp: RtspCamera) -> None:
    driver = create("rtsp", url=rtsp.url(), rate_hz=10.0)
    before_s = time.monotonic()
    wait_for_connection(driver)
    frames = [next_frame(driver) for _ in range(4)]
    assert all(before_s <= frame.taken_s <= time.monotonic() for frame in frames)
    pictures = [simplejpeg.decode_jpeg(frame.content) for frame in frames]
    assert {picture.shape for picture in pictures} == {(HEIGHT, WIDTH, 3)}
    assert len({int(picture[-4, -4, 0]) for picture in pictures}) > 1, "the pictures differ"
    assert all(picture[4, 4].min() > 240 and picture[-4, -4].max() < 220 for picture in pictures)


def test_pictures_are_reduced_to_the_width() -> None:
    process = subprocess.run([sys.executable, "-c", _REDUCE], capture_output=True, text=True, check=True)
    assert json.loads(process.stdout) == [[64, 48], [62, 46]]


_REDUCE = """
import json, av, numpy as np
from device_agent.sensors.camera import decoder, decoder_process
noise = np.random.default_rng(1).integers(0, 255, (480, 640, 3), dtype=np.uint8)
frame = av.VideoFrame.from_ndarray(noise, format="rgb24")
pictures = [decoder._scaled_jpeg(frame, width, 4000) for width in (64, 63)]
print(json.dumps([picture[1:3] for picture in pictures]))
"""


@pytest.mark.parametrize("authentication", ["basic", "digest"])
@pytest.mark.parametrize("place", ["password_file", "url"])
def test_credentials_open_the_stream(
    create: CreateDriver, rtsp: RtspCamera, tmp_path: Path, authentication: str, place: str
) -> None:
    rtsp.authentication = authentication
    secret = tmp_path / "password"
    secret.write_text(PASSWORD)
    login = f"{USER}:{quote(PASSWORD, safe='')}@"
    options = {
        "password_file": {"url": rtsp.url(), "user": USER, "password_file": str(secret)},
        "url": {"url": rtsp.url(login=login)},
    }[place]
    driver = create("rtsp", **options)
    wait_for_connection(driver)
    assert next_frame(driver)


def test_no_message_log_or_process_list_contains_the_password(
    create: CreateDriver, rtsp: RtspCamera, caplog: pytest.LogCaptureFixture, capfd: pytest.CaptureFixture[str]
) -> None:
    rtsp.authentication = "digest"
    rtsp.muted.set()
    driver = create("rtsp", url=rtsp.url("/live?key=hidden", login="viewer:hidden@"), stale_s=1.0)
    with pytest.raises(SensorError):
        driver.connect()
    wait_until(lambda: rtsp.connections, "the connection")
    arguments = [Path(f"/proc/{child}/cmdline").read_bytes() for child in decoders()]
    assert all(b"hidden" not in line for line in arguments)
    rtsp.muted.clear()
    messages: list[str] = []

    def rejected() -> bool:
        messages.append(failure(driver))
        return "user and password" in messages[-1]

    wait_until(rejected, "the rejection")
    assert "hidden" not in "".join((*messages, caplog.text, *capfd.readouterr()))


# ------------------------------------------------------------ lost, frozen and hostile cameras


def test_a_wrong_password_is_named(create: CreateDriver, rtsp: RtspCamera) -> None:
    rtsp.authentication = "digest"
    driver = create("rtsp", url=rtsp.url(login="viewer:wrong@"))
    wait_until(lambda: "does not accept user and password" in failure(driver), "the rejection")


@pytest.mark.parametrize(
    ("path", "media", "message"),
    [("/nothing", "video", "has no such stream"), ("/live", "audio", "has no video; check the path")],
)
def test_a_wrong_path_is_named(create: CreateDriver, rtsp: RtspCamera, path: str, media: str, message: str) -> None:
    rtsp.media = media
    driver = create("rtsp", url=rtsp.url(path))
    wait_until(lambda: message in failure(driver), message)


def test_a_frozen_camera_is_a_fault_until_it_sends_again(create: CreateDriver, rtsp: RtspCamera) -> None:
    driver = create("rtsp", url=rtsp.url(), stale_s=1.0)
    wait_for_connection(driver)
    rtsp.frozen.set()

    def fails() -> bool:
        try:
            driver.frame("colour")
        except SensorError:
            return True
        return False

    wait_until(fails, "the fault of a frozen camera")
    with pytest.raises(SensorError):
        driver.capture("image")
    rtsp.frozen.clear()
    wait_for_connection(driver)
    assert next_frame(driver)


def test_a_silent_server_does_not_block_and_is_a_fault(create: CreateDriver, rtsp: RtspCamera) -> None:
    rtsp.muted.set()
    driver = create("rtsp", url=rtsp.url(), stale_s=1.0)
    wait_until(lambda: "does not respond" in failure(driver), "the timeout")
    driver.close()
    assert decoders() == []


def test_damaged_video_is_a_fault(create: CreateDriver, rtsp: RtspCamera) -> None:
    rtsp.damaged.set()
    driver = create("rtsp", url=rtsp.url(), stale_s=1.0)
    with pytest.raises(SensorError):
        driver.connect()
    rtsp.damaged.clear()
    wait_for_connection(driver)


@pytest.mark.parametrize("blow", [signal.SIGKILL, signal.SIGSEGV, signal.SIGSTOP])
def test_a_crashed_or_hanging_decoder_is_replaced(create: CreateDriver, rtsp: RtspCamera, blow: signal.Signals) -> None:
    driver = create("rtsp", url=rtsp.url(), stale_s=1.0)
    wait_for_connection(driver)
    (first,) = decoders()
    os.kill(first, blow)

    def replaced() -> bool:
        try:
            driver.frame("colour")
        except SensorError:
            try:
                driver.connect()
            except SensorError:
                return False
        return decoders() not in ([], [first])

    wait_until(replaced, "another decoder")
    wait_for_connection(driver)
    assert next_frame(driver)


def test_closing_ends_the_decoder(create: CreateDriver, rtsp: RtspCamera) -> None:
    driver = create("rtsp", url=rtsp.url())
    wait_for_connection(driver)
    assert len(decoders()) == 1
    driver.close()
    assert decoders() == []


def test_the_decoder_ends_with_the_agent(rtsp: RtspCamera) -> None:
    host, port = rtsp.server_address[:2]
    address = {"source": "rtsp", "url": f"rtsp://{{host}}:{port}/live", "host": host, "port": port}
    settings = {**address, "rate_hz": 5, "timeout_s": 5, "width": 640, "max_bytes": 100_000}
    with subprocess.Popen(
        [sys.executable, "-I", decoder.__file__], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    ) as process:
        assert process.stdin is not None
        assert process.stdout is not None
        process.stdin.write(json.dumps(settings).encode() + b"\n")
        process.stdin.flush()
        assert process.stdout.read(decoder.HEADER.size)[:1] == decoder.FRAME
        process.stdin.close()
        assert process.wait(60) == 0


def test_a_decoder_that_is_taken_over_reads_no_file_and_reaches_no_other_port(rtsp: RtspCamera) -> None:
    with socket.create_server(("127.0.0.1", 0)) as other:
        ports = [rtsp.server_address[1], other.getsockname()[1]]
        process = subprocess.run(
            [sys.executable, "-c", _TAKEN_OVER, *map(str, ports)], capture_output=True, text=True, check=True, cwd=ROOT
        )
    assert json.loads(process.stdout) == ["PermissionError", "connected", "PermissionError"]


_TAKEN_OVER = """
import json, pathlib, socket, sys
from device_agent.sensors.camera import decoder
own, other = map(int, sys.argv[1:])
decoder.confine(own)
outcomes = []
def attempt(step):
    try:
        step()
        outcomes.append("connected")
    except OSError as error:
        outcomes.append(type(error).__name__)
attempt(lambda: open("/etc/passwd"))
attempt(lambda: socket.create_connection(("127.0.0.1", own)))
attempt(lambda: socket.create_connection(("127.0.0.1", other)))
print(json.dumps(outcomes))
"""


def test_a_camera_that_is_off_is_named(create: CreateDriver) -> None:
    with socket.create_server(("127.0.0.1", 0)) as unused:
        port = unused.getsockname()[1]
    driver = create("rtsp", url=f"rtsp://127.0.0.1:{port}/live")
    wait_until(lambda: "cannot be reached; check that the camera has power" in failure(driver), "the failure")


def test_a_missing_library_is_named_with_its_installation(
    create: CreateDriver, monkeypatch: pytest.MonkeyPatch
) -> None:
    # An interpreter without installed packages, as on a room PC without the extra `camera`.
    monkeypatch.setattr(decoder_process, "INTERPRETER", (sys.executable, "-I", "-S"))
    driver = create("rtsp", url="rtsp://127.0.0.1/live")
    wait_until(lambda: "needs the package av; install it with `pip install" in failure(driver), "the message")
