from pathlib import Path

import pytest

from infra.local import settings


def test_an_xmpp_server_is_started_only_when_asked_for() -> None:
    assert settings.read({}).xmpp is False
    assert settings.read({}).environment()["TELESCOPE_XMPP_DOMAIN"] == ""
    asked = settings.read({"TELESCOPE_XMPP": "1", "TELESCOPE_PORT": "9000"})
    assert asked.environment()["TELESCOPE_XMPP_DOMAIN"] == settings.XMPP_DOMAIN
    assert asked.environment()["TELESCOPE_XMPP_PORT"] == "9003"


@pytest.mark.parametrize("value", ["", "yes", "2"])
def test_a_wrong_wish_is_named(value: str) -> None:
    with pytest.raises(settings.SettingsError, match="TELESCOPE_XMPP is"):
        settings.read({"TELESCOPE_XMPP": value})


def test_xmpp_and_tls_together_are_refused_in_one_line() -> None:
    with pytest.raises(settings.SettingsError, match=r"^TELESCOPE_XMPP=1 asks .*TELESCOPE_TLS=1 use MQTT$"):
        settings.read({"TELESCOPE_XMPP": "1", "TELESCOPE_TLS": "1"})


def test_the_lab_is_started_unless_another_room_or_none_is_wanted() -> None:
    assert settings.read({}).room == "lab"
    assert settings.read({"TELESCOPE_ROOM": "none"}).room == ""


def test_an_unknown_room_is_named_with_those_that_there_are() -> None:
    with pytest.raises(settings.SettingsError, match="TELESCOPE_ROOM is 'attic'; it must be lab, or none"):
        settings.read({"TELESCOPE_ROOM": "attic"})


def test_another_command_at_the_same_folder_finds_how_it_was_started(tmp_path: Path) -> None:
    alone = {"TELESCOPE_HOME": str(tmp_path)}
    given = {**alone, "TELESCOPE_TLS": "1", "TELESCOPE_PORT": "9000", "TELESCOPE_OIDC_SECRET": "secret"}
    settings.remember(settings.read(given), given)
    found = settings.read(settings.recall(alone))
    assert found == settings.read(given)
    assert found.environment()["TELESCOPE_TLS_CERTIFICATE"] == str(tmp_path / "tls" / "server.crt")
    assert settings.read(settings.recall(alone | {"TELESCOPE_PORT": "9100"})).port == 9100, "what is said now counts"
    assert "secret" not in (tmp_path / "started.json").read_text()
    settings.remember(settings.read(alone), alone)
    assert settings.recall(alone) == alone, "it was started without TLS since"


@pytest.mark.parametrize("text", ["", "{", "[]", '"x"'])
def test_a_spoiled_note_says_what_to_do(tmp_path: Path, text: str) -> None:
    alone = {"TELESCOPE_HOME": str(tmp_path)}
    assert settings.recall(alone) == alone
    (tmp_path / "started.json").write_text(text)
    with pytest.raises(settings.SettingsError, match=r"started.json .*; delete it, and run `make up` once"):
        settings.recall(alone)
