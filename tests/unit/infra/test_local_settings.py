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


def test_the_lab_is_started_unless_another_room_or_none_is_wanted() -> None:
    assert settings.read({}).room == "lab"
    assert settings.read({"TELESCOPE_ROOM": "none"}).room == ""


def test_an_unknown_room_is_named_with_those_that_there_are() -> None:
    with pytest.raises(settings.SettingsError, match="TELESCOPE_ROOM is 'attic'; it must be lab, or none"):
        settings.read({"TELESCOPE_ROOM": "attic"})
