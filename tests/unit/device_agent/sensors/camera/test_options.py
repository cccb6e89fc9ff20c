"""Options of cameras in ``agent.toml``."""

from pathlib import Path
from typing import Any

import pytest
from msgspec.structs import replace

from device_agent import bootstrap
from device_agent.config.errors import ConfigError
from device_agent.protocol import Stream
from tests.harness.network.cameras.mjpeg import PASSWORD, USER, MjpegCamera
from tests.harness.network.cameras.steps import CreateDriver, entry, failure, next_frame


@pytest.mark.parametrize(
    ("driver", "options", "message"),
    [
        ("mjpeg", {}, "options of 'door': Object missing required field `url`"),
        ("mjpeg", {"url": "rtsp://host/live"}, "option 'url' must be an address such as http://host/path or https:"),
        ("rtsp", {"url": "http://host/live"}, "option 'url' must be an address such as rtsp://host/path"),
        ("rtsp", {"url": "rtsp:///live"}, "option 'url' must be an address"),
        ("rtsp", {"url": "rtsp://host:99999/live"}, "option 'url' must be an address"),
        ("rtsp", {"url": "rtsp://host/live\r\nX: y"}, "option 'url' must be an address"),
        ("rtsp", {"url": "rtsp://host/live", "adress": 1}, "driver 'rtsp' has no option 'adress'; it has: "),
        ("rtsp", {"url": "rtsp://host/live", "rate_hz": 50}, "rate_hz"),
        ("rtsp", {"url": "rtsp://host/live", "stale_s": 0}, "stale_s"),
        ("v4l2", {"device": "video0"}, "device"),
        ("mjpeg", {"url": "http://host/x", "password_file": "~no-such-user/x"}, "option 'password_file': the user"),
        ("v4l2", {"url": "rtsp://host/live"}, "driver 'v4l2' has no option 'url'; it has: "),
        ("lens", {}, "no sensor driver 'lens'; there are: mjpeg, "),
    ],
)
def test_a_wrong_option_is_named(create: CreateDriver, driver: str, options: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError) as error:
        create(driver, **options)
    assert message in str(error.value)


@pytest.mark.parametrize(
    "url",
    [
        "ftp://viewer:hidden@host/live",  # pragma: allowlist secret
        "http://viewer:hidden@host:port/x",  # pragma: allowlist secret
        "hidden",
    ],
)
def test_a_rejected_address_is_not_repeated_in_the_message(create: CreateDriver, url: str) -> None:
    with pytest.raises(ConfigError) as error:
        create("mjpeg", url=url)
    assert "hidden" not in str(error.value)


def test_files_are_relative_to_the_folder_of_the_agent(
    create: CreateDriver, camera: MjpegCamera, tmp_path: Path
) -> None:
    camera.authentication = "digest"
    message = failure(create("mjpeg", url=camera.url(), user=USER, password_file="secret"))
    assert message == f"password file {tmp_path / 'secret'}: No such file or directory"
    (tmp_path / "secret").write_text(PASSWORD)
    driver = create("mjpeg", url=camera.url(), user=USER, password_file="secret")
    driver.connect()
    assert next_frame(driver)


@pytest.mark.parametrize("name", ["mjpeg", "rtsp"])
def test_a_description_beside_one_camera_and_its_image_is_rejected(name: str, tmp_path: Path) -> None:
    stream = Stream(name="air", rate_hz=1.0)
    camera = entry(name, url=f"{'http' if name == 'mjpeg' else name}://host/")
    for wrong in (
        replace(camera, cameras=(), watch=(), streams=(stream,)),
        replace(camera, streams=(stream,)),
        replace(camera, captures=("image", "depth")),
    ):
        with pytest.raises(ConfigError, match=f"'door': driver '{name}' has one camera in `cameras`"):
            bootstrap.create_room_device(wrong, {}, home=tmp_path)
