"""Options of cameras in ``agent.toml``."""

from typing import Any

import pytest

from device_agent.config.errors import ConfigError
from tests.harness.network.cameras.steps import CreateDriver


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
