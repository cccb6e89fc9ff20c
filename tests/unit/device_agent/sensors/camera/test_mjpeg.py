"""MJPEG cameras over HTTP: streams, single pictures, credentials, and hostile responses."""

import datetime as dt
import itertools
import re
import threading
import time
from pathlib import Path
from urllib.parse import quote

import pytest
import simplejpeg

from device_agent.ports.sensor import SensorError
from infra.tls import server_ca
from tests.harness.network.brokers import wait_until
from tests.harness.network.cameras.mjpeg import PASSWORD, USER, MjpegCamera
from tests.harness.network.cameras.pictures import HEIGHT, WIDTH
from tests.harness.network.cameras.steps import CreateDriver, failure, next_frame, wait_for_connection

_SOCKET_BUFFERS = 16 * 1024 * 1024
"""More than the operating system buffers between two sockets of this machine."""


@pytest.mark.parametrize("path", ["/stream", "/without-lengths", "/picture.jpg", "/moved"])
def test_new_pictures_arrive_with_their_size_and_time(create: CreateDriver, camera: MjpegCamera, path: str) -> None:
    driver = create("mjpeg", url=camera.url(path))
    before_s = time.monotonic()
    driver.connect()
    first, second = next_frame(driver), next_frame(driver)
    assert (first.width, first.height) == (WIDTH, HEIGHT)
    assert simplejpeg.decode_jpeg(first.content).shape == (HEIGHT, WIDTH, 3)
    assert before_s <= first.taken_s < second.taken_s <= time.monotonic()
    assert first.content != second.content


def test_a_frame_is_returned_once_and_at_most_at_the_rate(create: CreateDriver, camera: MjpegCamera) -> None:
    driver = create("mjpeg", url=camera.url(), rate_hz=2.0)
    driver.connect()
    times_s = [next_frame(driver).taken_s for _ in range(3)]
    assert min(later - earlier for earlier, later in itertools.pairwise(times_s)) >= 0.9 / 2


def test_the_capture_is_the_newest_picture(create: CreateDriver, camera: MjpegCamera) -> None:
    driver = create("mjpeg", url=camera.url())
    driver.connect()
    taken = driver.capture("image")
    assert taken.media_type == "image/jpeg"
    assert simplejpeg.decode_jpeg(taken.content).shape == (HEIGHT, WIDTH, 3)


# ------------------------------------------------------------ frozen and lost cameras


@pytest.mark.parametrize("path", ["/stream", "/stall"])
def test_a_frozen_camera_is_a_fault_and_shows_nothing(create: CreateDriver, camera: MjpegCamera, path: str) -> None:
    driver = create("mjpeg", url=camera.url(path), stale_s=1.0)
    driver.connect()
    camera.frozen.set()
    stopped_s = time.monotonic()

    def fails() -> bool:
        try:
            driver.frame("colour")
        except SensorError:
            return True
        return False

    wait_until(fails, "the fault of a frozen camera")
    assert time.monotonic() - stopped_s >= 0.9
    for call in (driver.connect, lambda: driver.frame("colour"), lambda: driver.capture("image")):
        with pytest.raises(SensorError, match="no new picture"):
            call()


def test_the_fault_ends_when_the_camera_sends_again(create: CreateDriver, camera: MjpegCamera) -> None:
    camera.frozen.set()
    driver = create("mjpeg", url=camera.url(), stale_s=1.0)
    assert "no new picture" in failure(driver)
    camera.frozen.clear()
    wait_for_connection(driver)
    assert next_frame(driver)


def test_a_reset_connection_is_opened_again(create: CreateDriver, camera: MjpegCamera) -> None:
    driver = create("mjpeg", url=camera.url("/reset"))
    driver.connect()
    wait_until(lambda: len(camera.requests) >= 2, "the second connection")


def test_a_response_that_drips_is_aborted_and_requested_again(create: CreateDriver, camera: MjpegCamera) -> None:
    driver = create("mjpeg", url=camera.url("/drip"), stale_s=1.0)
    assert "no new picture for 1 s" in failure(driver)

    def again() -> bool:
        with pytest.raises(SensorError):
            driver.connect()
        return len(camera.requests) >= 2

    wait_until(again, "the second request")


def test_close_ends_the_thread_of_a_silent_camera(create: CreateDriver, camera: MjpegCamera) -> None:
    driver = create("mjpeg", url=camera.url("/stall"), stale_s=60.0)
    driver.connect()
    driver.close()
    assert not [thread for thread in threading.enumerate() if thread.name == "door-camera"]


def test_a_camera_that_is_off_is_named_without_its_path(create: CreateDriver, camera: MjpegCamera) -> None:
    camera.close()
    message = failure(create("mjpeg", url=camera.url("/stream?token=topsecret")))
    assert re.fullmatch(r"http://127\.0\.0\.1:\d+: Connection refused; check that the camera has power.*", message)


# ------------------------------------------------------------ hostile cameras


@pytest.mark.parametrize(
    ("path", "message"),
    [
        ("/wrong-boundary", "sends no part with the boundary"),
        ("/no-boundary", "names no boundary"),
        ("/giant-length", "a picture has more than 131 KB; choose a lower resolution"),
        ("/giant-part", "a picture has more than 131 KB; choose a lower resolution"),
        ("/giant-header", "the header of a part is too long"),
        ("/giant-picture", "a picture has more than 131 KB; choose a lower resolution"),
        ("/giant-refusal", "does not accept user and password"),
        ("/page", "sends no JPEG; check that option 'url' is the address"),
        ("/missing", "has no such path; check option 'url'"),
        ("/circle", "redirects in a circle"),
    ],
)
def test_invalid_responses_are_named_and_end_the_connection(
    create: CreateDriver, camera: MjpegCamera, path: str, message: str
) -> None:
    assert message in failure(create("mjpeg", url=camera.url(path)))
    assert camera.sent_bytes < _SOCKET_BUFFERS, "the agent reads no more than it needs"


# ------------------------------------------------------------ credentials


@pytest.fixture
def secret(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The password in a file and in an environment variable."""
    monkeypatch.setenv("CAMERA_PASSWORD", PASSWORD)
    path = tmp_path / "camera-password"
    path.write_text(PASSWORD + "\n")
    return path


@pytest.mark.parametrize("authentication", ["basic", "digest"])
@pytest.mark.parametrize("place", ["password_file", "password_env", "url"])
def test_credentials_are_sent_as_the_camera_requests(
    create: CreateDriver, camera: MjpegCamera, secret: Path, authentication: str, place: str
) -> None:
    camera.authentication = authentication
    options = {
        "password_file": {"url": camera.url(), "user": USER, "password_file": str(secret)},
        "password_env": {"url": camera.url(), "user": USER, "password_env": "CAMERA_PASSWORD"},
        "url": {"url": camera.url().replace("//", f"//{USER}:{quote(PASSWORD, safe='')}@")},
    }[place]
    driver = create("mjpeg", **options)
    driver.connect()
    assert next_frame(driver)
    assert camera.requests[0] == ("/stream", ""), "credentials are sent only after a challenge"
    assert camera.requests[1][1].lower().startswith(authentication)
    assert camera.sent_bytes < _SOCKET_BUFFERS, "the body of the challenge is not read"


@pytest.mark.parametrize("authentication", ["basic", "digest"])
def test_a_wrong_password_is_named_without_the_password(
    create: CreateDriver, camera: MjpegCamera, caplog: pytest.LogCaptureFixture, authentication: str
) -> None:
    camera.authentication = authentication
    url = camera.url("/stream?key=hidden-key").replace("//", f"//{USER}:hidden-word@")
    driver = create("mjpeg", url=url)
    message = failure(driver)
    assert message.endswith("does not accept user and password; check the device's options")
    assert "hidden" not in message + caplog.text


def test_a_camera_with_a_malformed_challenge_is_a_fault(
    create: CreateDriver, camera: MjpegCamera, secret: Path
) -> None:
    camera.authentication = "malformed"
    driver = create("mjpeg", url=camera.url(), user=USER, password_file=str(secret))
    assert "requires an unsupported kind of authentication" in failure(driver)
    assert driver._reader._thread.responsive  # type: ignore[union-attr]


def test_a_redirect_to_another_host_is_not_followed(create: CreateDriver, camera: MjpegCamera, secret: Path) -> None:
    other = MjpegCamera()
    camera.authentication = "basic"
    driver = create("mjpeg", url=camera.url(f"/elsewhere?{other.url()}"), user=USER, password_file=str(secret))
    message = failure(driver)
    requests = other.requests
    other.close()
    assert "redirects to another host" in message
    assert requests == []


def test_the_certificate_of_the_camera_is_verified(create: CreateDriver, tmp_path: Path) -> None:
    server_ca.create(tmp_path, server_ca.names((), ("127.0.0.1",)), now=dt.datetime.now(dt.UTC))
    camera = MjpegCamera((tmp_path / server_ca.CERTIFICATE, tmp_path / server_ca.KEY))
    try:
        assert "the certificate is not trusted" in failure(create("mjpeg", url=camera.url()))
        assert camera.requests == []
        driver = create("mjpeg", url=camera.url(), ca=str(tmp_path / server_ca.CA_CERTIFICATE))
        driver.connect()
        assert next_frame(driver)
    finally:
        camera.close()


def test_a_missing_password_file_is_named(create: CreateDriver, camera: MjpegCamera, tmp_path: Path) -> None:
    missing = tmp_path / "missing"
    message = failure(create("mjpeg", url=camera.url(), user=USER, password_file=str(missing)))
    assert message == f"password file {missing}: No such file or directory"
    assert camera.requests == []
