"""The command ``cameras``: discovery, digests, hostile responses, and an entry that the agent accepts."""

import datetime as dt
import tomllib
from collections.abc import Iterator
from pathlib import Path

import pytest

from device_agent import bootstrap
from device_agent.__main__ import main
from device_agent.config.agent_config import CONFIG_FILE, AgentConfig
from device_agent.protocol.manifests.room import Watch
from device_agent.sensors.camera.onvif import discovery
from tests.harness.network.cameras.onvif import PASSWORD, USER, OnvifCamera

_WAIT_S = "0.6"
_GROUP = "239.255.255.250"


@pytest.fixture
def onvif() -> Iterator[OnvifCamera]:
    camera = OnvifCamera()
    yield camera
    camera.close()


@pytest.fixture
def login(tmp_path: Path) -> list[str]:
    secret = tmp_path / "password"
    secret.write_text(PASSWORD + "\n")
    return ["--user", USER, "--password-file", str(secret)]


def cameras(camera: OnvifCamera, *arguments: str) -> int:
    return main(["cameras", "--host", f"127.0.0.1:{camera.port}", "--wait-s", _WAIT_S, *arguments])


def test_a_search_finds_the_cameras_of_the_network() -> None:
    camera = OnvifCamera(_GROUP)
    found = discovery.find((_GROUP, camera.port), interface="127.0.0.1", wait_s=1.0)
    camera.close()
    assert found == [discovery.FoundCamera("127.0.0.1", "Door Camera DC-7", camera.service)]
    assert camera.requests == [], "a search sends no other request"


def test_the_printed_entry_is_accepted_by_the_agent(
    onvif: OnvifCamera, login: list[str], capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    assert cameras(onvif, *login) == 0
    output = capsys.readouterr().out
    (tmp_path / CONFIG_FILE).write_text(f'server = "http://s"\nname = "n"\n{output[output.index("[[devices]]") :]}')
    (entry,) = AgentConfig.load(tmp_path).devices
    assert (entry.name, entry.type, entry.driver, entry.label) == (
        "door-camera-dc-7", "camera", "rtsp", "Door Camera DC-7",
    )  # fmt: skip
    assert entry.options == {"url": "rtsp://127.0.0.1:554/sub&1?a=1&b=2", "user": USER, "password_file": login[-1]}
    assert "position_m" not in output, "defaults are left out"
    device = bootstrap.create_room_device(entry, {}, home=tmp_path)
    assert device is not None
    assert (device.cameras, device.manifest.captures) == (("colour",), ("image",))
    assert device.manifest.watch == (Watch(source="colour", silent_s=10.0, stuck_s=60.0),)


def test_the_password_is_sent_only_as_a_digest(onvif: OnvifCamera, login: list[str]) -> None:
    assert cameras(onvif, *login) == 0
    assert len(onvif.requests) > 3
    assert not any(word in request for request in onvif.requests for word in (b"quiet&word", b"quiet&amp;word"))


@pytest.mark.parametrize("days", [-400, 400])
def test_digests_use_the_clock_of_the_camera(onvif: OnvifCamera, login: list[str], days: int) -> None:
    onvif.clock_offset = dt.timedelta(days=days)
    assert cameras(onvif, *login) == 0


@pytest.mark.parametrize("given", [True, False])
def test_rejected_requests_name_the_credentials(
    onvif: OnvifCamera, tmp_path: Path, capsys: pytest.CaptureFixture[str], given: bool
) -> None:
    (tmp_path / "wrong").write_text("wrong")
    assert cameras(onvif, *(["--user", USER, "--password-file", str(tmp_path / "wrong")] if given else [])) == 1
    assert ("check the address, and user and password" if given else "need --user") in capsys.readouterr().err


def test_a_password_needs_a_named_camera(login: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["cameras", *login]) == 1
    assert "name the camera with --host: a password is not sent to every device" in capsys.readouterr().err


def test_no_camera_is_a_message_that_says_what_to_check(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["cameras", "--host", "127.0.0.1:9", "--wait-s", "0.2"]) == 1
    assert "has not responded within 0.2 s; check the address, enable ONVIF" in capsys.readouterr().err


# ------------------------------------------------------------ hostile cameras


_BOMB = b"""<?xml version="1.0"?><!DOCTYPE b [<!ENTITY a "aaaaaaaaaa"><!ENTITY b "&a;&a;&a;&a;">]><b>&b;</b>"""
_FILE = b"""<?xml version="1.0"?><!DOCTYPE b [<!ENTITY a SYSTEM "file:///etc/passwd">]><b>&a;</b>"""


@pytest.mark.parametrize("raw", [b"", b"<a", _BOMB, _FILE, b"\xff\xfe\x00", b"<a/>", b"x" * 2000])
def test_invalid_probe_matches_are_ignored(onvif: OnvifCamera, raw: bytes, capsys: pytest.CaptureFixture[str]) -> None:
    onvif.raw = raw or b" "
    assert cameras(onvif) == 1
    assert "has not responded" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("raw", "message"),
    [
        (_BOMB, "it does not send valid XML"),
        (_FILE, "it does not send valid XML"),
        (b"<a/>", "it has no media service"),
        (b"x" * 300_000, "its response is too long"),
    ],
)
def test_invalid_responses_are_named(
    onvif: OnvifCamera, login: list[str], capsys: pytest.CaptureFixture[str], raw: bytes, message: str
) -> None:
    found = discovery.find(("127.0.0.1", onvif.port), wait_s=0.6)
    assert found
    onvif.raw_response = raw
    assert cameras(onvif, *login) == 1
    assert message in capsys.readouterr().err


def test_an_address_at_another_host_is_not_requested(
    onvif: OnvifCamera, login: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    onvif.addresses = "http://192.0.2.1/onvif/device_service"
    assert cameras(onvif, *login) == 1
    assert "has not responded" in capsys.readouterr().err
    onvif.addresses = None
    onvif.media = "http://192.0.2.1/onvif/media_service"
    assert cameras(onvif, *login) == 1
    assert "it names a service at another host, 192.0.2.1" in capsys.readouterr().err
    onvif.media = None
    onvif.uri = "rtsp://192.0.2.1/live"
    assert cameras(onvif, *login) == 1
    assert "its stream is at another host, 192.0.2.1" in capsys.readouterr().err


def test_names_cannot_control_the_terminal_or_the_file(
    onvif: OnvifCamera, login: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    onvif.scopes = "onvif://www.onvif.org/name/A%1b%5b2J%22%0a%5b%5bdevices%5d%5d"
    assert cameras(onvif, *login) == 0
    output = capsys.readouterr().out
    assert "\x1b" not in output
    (entry,) = tomllib.loads(output[output.index("\n[[devices]]") :])["devices"]
    assert entry["name"] == "a-2j-devices"
