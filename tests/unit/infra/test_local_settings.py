from pathlib import Path

import pytest

from infra.local import settings
from infra.local.settings import SettingsError


def test_xmpp_is_optional() -> None:
    assert settings.read({}).environment()["TELESCOPE_XMPP_DOMAIN"] == ""
    environment = settings.read({"TELESCOPE_XMPP": "1", "TELESCOPE_PORT": "9000"}).environment()
    assert environment["TELESCOPE_XMPP_DOMAIN"] == settings.XMPP_DOMAIN
    assert environment["TELESCOPE_XMPP_PORT"] == "9003"
    assert environment["TELESCOPE_XMPP_WEBSOCKET_URL"] == "ws://127.0.0.1:9004/xmpp-websocket"
    assert settings.read({}).environment()["TELESCOPE_XMPP_WEBSOCKET_URL"] == ""


def test_the_default_room_is_the_laboratory() -> None:
    assert settings.read({}).room == "lab"
    assert settings.read({"TELESCOPE_ROOM": "none"}).room == ""


@pytest.mark.parametrize(
    ("environment", "message"),
    [
        *(({"TELESCOPE_XMPP": value}, "TELESCOPE_XMPP is") for value in ("", "yes", "2")),
        ({"TELESCOPE_XMPP": "1", "TELESCOPE_TLS": "1"}, r"^TELESCOPE_XMPP=1 .*TELESCOPE_TLS=1 use MQTT$"),
        ({"TELESCOPE_ROOM": "attic"}, "TELESCOPE_ROOM is 'attic'; it must be lab, or none"),
    ],
)
def test_invalid_settings_are_named(environment: dict[str, str], message: str) -> None:
    with pytest.raises(SettingsError, match=message):
        settings.read(environment)


def test_other_commands_use_the_settings_of_the_last_start(tmp_path: Path) -> None:
    home = {"TELESCOPE_HOME": str(tmp_path)}
    started = {**home, "TELESCOPE_TLS": "1", "TELESCOPE_PORT": "9000", "TELESCOPE_OIDC_SECRET": "secret"}
    settings.save_started(settings.read(started), started)
    loaded = settings.read(settings.load_started(home))
    assert loaded == settings.read(started)
    assert loaded.environment()["TELESCOPE_TLS_CERTIFICATE"] == str(tmp_path / "tls" / "server.crt")
    assert settings.read(settings.load_started(home | {"TELESCOPE_PORT": "9100"})).port == 9100
    assert "secret" not in (tmp_path / "started.json").read_text()
    settings.save_started(settings.read(home), home)
    assert settings.load_started(home) == home


def test_a_folder_in_which_nothing_was_started_is_reported(tmp_path: Path) -> None:
    with pytest.raises(SettingsError, match=r"never started in .*absent; run `make up`, or set TELESCOPE_HOME"):
        settings.load_started({"TELESCOPE_HOME": str(tmp_path / "absent")})
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("text", ["", "{", "[]", '"x"'])
def test_invalid_stored_settings_are_reported(tmp_path: Path, text: str) -> None:
    home = {"TELESCOPE_HOME": str(tmp_path)}
    (tmp_path / "started.json").write_text(text)
    with pytest.raises(SettingsError, match=r"started.json .*; delete it and run `make up` once"):
        settings.load_started(home)
