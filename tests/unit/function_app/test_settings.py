"""Settings: sensible defaults, and one clear line for an invalid variable."""

from pathlib import Path
from typing import Any

import pytest

from function_app import settings
from function_app.settings import ROOT, SettingsError
from tests.harness.terminal import command_runner

ISSUER = {"TELESCOPE_OIDC_ISSUER": "https://id.example/tenant", "TELESCOPE_OIDC_CLIENT_ID": "app"}
PORTS = ("TELESCOPE_PORT", "TELESCOPE_MQTT_PORT", "TELESCOPE_WEBSOCKET_PORT", "TELESCOPE_XMPP_PORT")


@pytest.mark.parametrize(
    ("environment", "expected"),
    [
        (
            {},
            {
                "host": "127.0.0.1",
                "port": 8080,
                "mqtt_host": "127.0.0.1",
                "mqtt_port": 8081,
                "websocket_port": 8082,
                "broker": "amqtt",
                "public_url": "http://127.0.0.1:8080",
                "websocket_url": "ws://127.0.0.1:8082/mqtt",
                "home": Path.cwd() / ".telescope",
                "robots": ROOT / "robots",
                "console": ROOT / "web" / "dist",
                "trusted_proxies": 0,
                "oidc": None,
            },
        ),
        (
            {"TELESCOPE_PORT": "9000", "TELESCOPE_TRUSTED_PROXIES": "2"},
            {
                "mqtt_port": 9001,
                "websocket_port": 9002,
                "public_url": "http://127.0.0.1:9000",
                "websocket_url": "ws://127.0.0.1:9002/mqtt",
                "trusted_proxies": 2,
            },
        ),
        (
            {"TELESCOPE_HOST": "::1"},
            {"host": "::1", "public_url": "http://[::1]:8080", "websocket_url": "ws://[::1]:8082/mqtt"},
        ),
        (
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
            },
            {
                "home": Path.home() / "robots",
                "port": 1,
                "mqtt_host": "broker.lab",
                "mqtt_port": 65535,
                "websocket_port": 2,
                "broker": "mosquitto",
                "public_url": "https://telescope.example",
                "websocket_url": "wss://telescope.example/mqtt",
                "robots": Path("/srv/robots"),
                "console": Path("/srv/console"),
            },
        ),
    ],
    ids=["defaults", "port", "IPv6", "all"],
)
def test_settings_and_their_defaults(environment: dict[str, str], expected: dict[str, Any]) -> None:
    found = settings.read(environment)
    assert {name: getattr(found, name) for name in expected} == expected


@pytest.mark.parametrize(
    ("names", "values"),
    [
        (PORTS, ["", "0", "65536", "-1", "80.0", "http", " 80", "٣", "1e3", "9" * 5000]),
        (("TELESCOPE_TRUSTED_PROXIES",), ["11"]),
        (("TELESCOPE_BROKER",), ["", "rabbitmq", "AMQTT"]),
        (
            ("TELESCOPE_PUBLIC_URL",),
            ["", "telescope.example", "ftp://x", "http://", "http://[bad", "http://a b", "http://a:b"],
        ),
        (("TELESCOPE_WEBSOCKET_URL",), ["", "http://x", "ws://", "ws://a;script-src *", "ws://a b", "wss://x:99999"]),
        (("TELESCOPE_XMPP_DOMAIN",), ["Lab", "a b", "lab.", "-lab", "lab/x", "a@b", "lab\n", "x" * 254]),
        (
            ("TELESCOPE_XMPP_WEBSOCKET_URL",),
            ["https://x", "wss://", "wss://u:p@x/ws", "wss://x/ws?token=1", "wss://x/#a", "wss://x; script-src *"],
        ),
        (("TELESCOPE_HOST", "TELESCOPE_MQTT_HOST", "TELESCOPE_XMPP_HOST"), ["", "a b"]),
        (("TELESCOPE_HOME",), ["", "~no-such-user/x"]),
        (("TELESCOPE_ROBOTS", "TELESCOPE_CONSOLE"), [""]),
    ],
    ids=str,
)
def test_an_invalid_variable_is_named_in_one_line(names: tuple[str, ...], values: list[str]) -> None:
    for name in names:
        for value in values:
            assert_invalid(name, value, name)


def test_browsers_reach_an_xmpp_server_only_with_its_domain() -> None:
    url = {"TELESCOPE_XMPP_WEBSOCKET_URL": "wss://xmpp.lab.example/xmpp-websocket"}
    with pytest.raises(SettingsError, match="set TELESCOPE_XMPP_DOMAIN too"):
        settings.read(url)
    known = settings.read(url | {"TELESCOPE_XMPP_DOMAIN": "lab.example"})
    assert known.xmpp.websocket_url == "wss://xmpp.lab.example/xmpp-websocket"
    assert settings.read({"TELESCOPE_XMPP_DOMAIN": "lab.example"}).xmpp.websocket_url == ""


def test_the_port_leaves_room_for_the_two_that_follow() -> None:
    assert_invalid("TELESCOPE_PORT", "65535", "TELESCOPE_")


def assert_invalid(name: str, value: str, start: str) -> None:
    with pytest.raises(SettingsError) as caught:
        settings.read({name: value})
    text = str(caught.value)
    assert text.startswith(start)
    assert "must" in text
    assert "\n" not in text
    assert len(text) < 300


def test_a_terminal_gets_that_line_and_no_traceback(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    run = command_runner(monkeypatch, capsys)
    for command in ("serve", "work", "sign-in-link"):
        ended = run(command, TELESCOPE_HOME=str(tmp_path), TELESCOPE_PORT="http")
        line = "telescope-server: TELESCOPE_PORT is 'http'; it must be a number from 1 to 65535\n"
        assert ended == (1, "", line)
    ended = run("xmpp", TELESCOPE_HOME=str(tmp_path))
    assert (ended.code, ended.out, ended.err.count("\n")) == (1, "", 1)
    assert ended.err.startswith("telescope-server: TELESCOPE_XMPP_DOMAIN is empty. Set it to")


@pytest.mark.parametrize(
    ("name", "field", "default", "most"),
    [
        ("ACTIONS_DAYS", "actions_days", 30, 3650),
        ("UPLOADS_DAYS", "uploads_days", 30, 36_500),
        ("RAW_HOURS", "raw_hours", 24, 9_600),
        ("10S_DAYS", "level_10s_days", 7, 36_500),
        ("1MIN_DAYS", "level_1min_days", 90, 36_500),
        ("10MIN_DAYS", "level_10min_days", 730, 36_500),
    ],
)
def test_retention_periods(name: str, field: str, default: int, most: int) -> None:
    assert getattr(settings.read({}).retention, field) == default
    assert getattr(settings.read({f"TELESCOPE_KEEP_{name}": str(most)}).retention, field) == most
    for wrong in ("0", "-1", str(most + 1), "1e2", "", "99999999999"):
        assert_invalid(f"TELESCOPE_KEEP_{name}", wrong, f"TELESCOPE_KEEP_{name}")


def test_an_oidc_provider_has_a_name_and_its_secret_is_not_shown() -> None:
    for accounts, anyone in (({}, False), ({"TELESCOPE_OIDC_ACCOUNTS": "anyone"}, True)):
        found = settings.read({**ISSUER, **accounts, "TELESCOPE_OIDC_CLIENT_SECRET": "hush"}).oidc
        assert found is not None
        assert (found.issuer, found.client_id, found.name) == ("https://id.example/tenant", "app", "id.example")
        assert (found.client_secret, found.anyone) == ("hush", anyone)
        assert "hush" not in repr(found)


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
def test_an_incomplete_oidc_provider_is_refused_by_name(changes: dict[str, str], named: str) -> None:
    with pytest.raises(SettingsError, match=named) as refused:
        settings.read({**ISSUER, **changes})
    assert "hush" not in str(refused.value)
