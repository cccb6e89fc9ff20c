"""Settings: sensible where nothing is said, one clear line where something wrong is."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from function_app import settings
from function_app.settings import ROOT, SettingsError


def test_without_any_it_is_this_machine_on_loopback() -> None:
    found = settings.read({})
    assert (found.host, found.port, found.mqtt_port, found.websocket_port) == ("127.0.0.1", 8080, 8081, 8082)
    assert (found.broker, found.mqtt_host) == ("amqtt", "127.0.0.1")
    assert found.public_url == "http://127.0.0.1:8080"
    assert found.websocket_url == "ws://127.0.0.1:8082/mqtt"
    assert found.home == Path.cwd() / ".telescope"
    assert (found.robots, found.console) == (ROOT / "robots", ROOT / "web" / "dist")


def test_the_other_ports_follow_the_first() -> None:
    found = settings.read({"TELESCOPE_PORT": "9000"})
    assert (found.mqtt_port, found.websocket_port) == (9001, 9002)
    assert (found.public_url, found.websocket_url) == ("http://127.0.0.1:9000", "ws://127.0.0.1:9002/mqtt")


def test_each_can_be_said() -> None:
    found = settings.read(
        {
            "TELESCOPE_HOME": "~/robots",
            "TELESCOPE_HOST": "0.0.0.0",  # noqa: S104 (a setting)
            "TELESCOPE_PORT": "1",
            "TELESCOPE_MQTT_HOST": "broker.lab",
            "TELESCOPE_MQTT_PORT": "65535",
            "TELESCOPE_WEBSOCKET_PORT": "2",
            "TELESCOPE_BROKER": "mosquitto",
            "TELESCOPE_PUBLIC_URL": "https://telescope.example/",
            "TELESCOPE_WEBSOCKET_URL": "wss://telescope.example/mqtt",
            "TELESCOPE_ROBOTS": "/srv/robots",
            "TELESCOPE_CONSOLE": "/srv/console",
        }
    )
    assert found.home == Path.home() / "robots"
    assert (found.port, found.mqtt_port, found.websocket_port) == (1, 65535, 2)
    assert (found.mqtt_host, found.broker) == ("broker.lab", "mosquitto")
    assert found.public_url == "https://telescope.example"
    assert found.websocket_url == "wss://telescope.example/mqtt"
    assert (found.robots, found.console) == (Path("/srv/robots"), Path("/srv/console"))


def test_an_ipv6_address_is_bracketed_in_urls() -> None:
    found = settings.read({"TELESCOPE_HOST": "::1"})
    assert (found.host, found.public_url) == ("::1", "http://[::1]:8080")
    assert found.websocket_url == "ws://[::1]:8082/mqtt"


WRONG = [
    *(
        (name, value)
        for name in ("TELESCOPE_PORT", "TELESCOPE_MQTT_PORT", "TELESCOPE_WEBSOCKET_PORT", "TELESCOPE_XMPP_PORT")
        for value in ("", "0", "65536", "-1", "80.0", "http", " 80", "٣", "1e3", "9" * 5000)
    ),
    ("TELESCOPE_PORT", "65535"),  # no room for the two that follow
    ("TELESCOPE_BROKER", ""),
    ("TELESCOPE_BROKER", "rabbitmq"),
    ("TELESCOPE_BROKER", "AMQTT"),
    *(
        ("TELESCOPE_PUBLIC_URL", value)
        for value in ("", "telescope.example", "ftp://x", "http://", "http://[bad", "http://a b", "http://a:b")
    ),
    *(
        ("TELESCOPE_WEBSOCKET_URL", value)
        for value in ("", "http://x", "ws://", "ws://a;script-src *", "ws://a b", "wss://x:99999")
    ),
    *(("TELESCOPE_XMPP_DOMAIN", value) for value in ("Lab", "a b", "lab.", "-lab", "lab/x", "a@b", "lab\n", "x" * 254)),
    ("TELESCOPE_XMPP_HOST", ""),
    ("TELESCOPE_HOST", ""),
    ("TELESCOPE_HOST", "a b"),
    ("TELESCOPE_MQTT_HOST", ""),
    ("TELESCOPE_HOME", ""),
    ("TELESCOPE_HOME", "~no-such-user/x"),
    ("TELESCOPE_ROBOTS", ""),
    ("TELESCOPE_CONSOLE", ""),
]


@pytest.mark.parametrize(("name", "value"), WRONG, ids=lambda text: text[:32])
def test_a_wrong_one_is_named_in_one_line(name: str, value: str) -> None:
    with pytest.raises(SettingsError) as caught:
        settings.read({name: value})
    text = str(caught.value)
    assert text.startswith(name if (name, value) != ("TELESCOPE_PORT", "65535") else "TELESCOPE_")
    assert "must" in text
    assert "\n" not in text
    assert len(text) < 300


@pytest.mark.parametrize("command", ["serve", "work", "sign-in-link"])
def test_a_terminal_gets_that_line_and_no_traceback(tmp_path: Path, command: str) -> None:
    environment = {**os.environ, "TELESCOPE_HOME": str(tmp_path), "TELESCOPE_PORT": "http"}
    done = subprocess.run(
        [sys.executable, "-m", "function_app", command],
        cwd=ROOT,
        env=environment,
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert done.returncode == 1
    assert done.stderr == "telescope-server: TELESCOPE_PORT is 'http'; it must be a number from 1 to 65535\n"
    assert done.stdout == ""


@pytest.mark.parametrize(
    ("name", "field", "usual", "most"),
    [
        ("ACTIONS_DAYS", "actions_days", 30, 3650),
        ("UPLOADS_DAYS", "uploads_days", 30, 36_500),
        ("RAW_HOURS", "raw_hours", 24, 9_600),
        ("10S_DAYS", "level_10s_days", 7, 36_500),
        ("1MIN_DAYS", "level_1min_days", 90, 36_500),
        ("10MIN_DAYS", "level_10min_days", 730, 36_500),
    ],
)
def test_retention_periods(name: str, field: str, usual: int, most: int) -> None:
    assert getattr(settings.read({}).retention, field) == usual
    assert getattr(settings.read({f"TELESCOPE_KEEP_{name}": str(most)}).retention, field) == most
    for wrong in ("0", "-1", str(most + 1), "1e2", "", "99999999999"):
        with pytest.raises(SettingsError, match=f"TELESCOPE_KEEP_{name}"):
            settings.read({f"TELESCOPE_KEEP_{name}": wrong})


def test_how_many_proxies_are_believed() -> None:
    assert settings.read({}).trusted_proxies == 0
    assert settings.read({"TELESCOPE_TRUSTED_PROXIES": "2"}).trusted_proxies == 2
    with pytest.raises(SettingsError, match="TELESCOPE_TRUSTED_PROXIES"):
        settings.read({"TELESCOPE_TRUSTED_PROXIES": "11"})


def test_speaking_xmpp_without_a_server_is_one_line(tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-m", "function_app", "xmpp"],
        cwd=ROOT,
        env={**os.environ, "TELESCOPE_HOME": str(tmp_path)},
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert (done.returncode, done.stdout) == (1, "")
    assert done.stderr.splitlines()[-1].startswith("telescope-server: TELESCOPE_XMPP_DOMAIN is empty. Set it to")
    assert "Traceback" not in done.stderr


ISSUER = {"TELESCOPE_OIDC_ISSUER": "https://id.example/tenant", "TELESCOPE_OIDC_CLIENT_ID": "app"}


def test_an_oidc_provider_is_as_it_calls_itself_and_its_secret_is_not_shown() -> None:
    found = settings.read({**ISSUER, "TELESCOPE_OIDC_CLIENT_SECRET": "hush"}).oidc
    assert found is not None
    assert (found.issuer, found.client_id, found.name) == ("https://id.example/tenant", "app", "id.example")
    assert found.client_secret == "hush"
    assert "hush" not in repr(found)
    assert not found.anyone
    for said, meant in (("anyone", True), ("invited", False)):
        found = settings.read({**ISSUER, "TELESCOPE_OIDC_ACCOUNTS": said}).oidc
        assert found is not None
        assert found.anyone is meant
    assert settings.read({}).oidc is None


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"TELESCOPE_OIDC_CLIENT_ID": ""}, "TELESCOPE_OIDC_CLIENT_ID"),
        ({"TELESCOPE_OIDC_ISSUER": ""}, "TELESCOPE_OIDC_ISSUER"),
        ({"TELESCOPE_OIDC_ISSUER": "id.example"}, "TELESCOPE_OIDC_ISSUER"),
        ({"TELESCOPE_OIDC_ISSUER": "http://id.example"}, "TELESCOPE_OIDC_ISSUER"),
        ({"TELESCOPE_OIDC_CLIENT_ID": "a b"}, "TELESCOPE_OIDC_CLIENT_ID"),
        ({"TELESCOPE_OIDC_NAME": ""}, "TELESCOPE_OIDC_NAME"),
        ({"TELESCOPE_OIDC_ACCOUNTS": "all"}, "TELESCOPE_OIDC_ACCOUNTS"),
        ({"TELESCOPE_OIDC_ACCOUNTS": ""}, "TELESCOPE_OIDC_ACCOUNTS"),
        (dict.fromkeys(ISSUER, "") | {"TELESCOPE_OIDC_CLIENT_SECRET": "hush"}, "TELESCOPE_OIDC_CLIENT_SECRET"),
    ],
    ids=str,
)
def test_half_an_oidc_provider_is_refused_by_name(changes: dict[str, str], named: str) -> None:
    with pytest.raises(SettingsError, match=named) as refused:
        settings.read({**ISSUER, **changes})
    assert "hush" not in str(refused.value)
