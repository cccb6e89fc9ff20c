import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from infra import programs
from infra.mosquitto import admission
from infra.mosquitto import configuration as mosquitto
from infra.prosody import configuration
from infra.prosody.configuration import ConfigurationError
from infra.service_user import ServiceUser


def text(tmp_path: Path, **changes: Any) -> str:
    defaults: dict[str, Any] = {
        "domain": "lab.example",
        "host": "127.0.0.1",
        "port": 5222,
        "websocket_port": None,
        "verify_url": "http://127.0.0.1:8080/api/v1/xmpp/verify",
        "certificate": None,
        "key": None,
        "user": ServiceUser(os.geteuid(), os.getegid()),
    }
    configuration.write(tmp_path, **{**defaults, **changes})
    return (tmp_path / configuration.CONFIGURATION_FILE).read_text()


def test_encryption_is_required_except_on_loopback(tmp_path: Path) -> None:
    assert "c2s_require_encryption = false" in text(tmp_path)
    for name in ("c.pem", "k.pem"):
        (tmp_path / name).touch()
    secure = text(tmp_path, host="192.168.1.5", certificate=tmp_path / "c.pem", key=tmp_path / "k.pem")
    assert "c2s_require_encryption = true" in secure
    assert "allow_unencrypted_plain_auth = false" in secure
    assert '"tls"' in secure


def test_browsers_are_served_only_on_request_and_with_the_encryption_of_the_others(tmp_path: Path) -> None:
    without = text(tmp_path)
    assert "websocket" not in without
    assert "http" not in without.replace("http://127.0.0.1:8080", "").replace("https://prosody", "")
    plain = text(tmp_path, websocket_port=5280)
    assert '"websocket"' in plain
    assert "http_ports = { 5280 }\n" in plain
    assert "https_ports = {}\n" in plain
    assert 'http_interfaces = { "127.0.0.1" }\n' in plain
    assert "http_cors_override = { websocket = { enabled = false } }\n" in plain
    for name in ("c.pem", "k.pem"):
        (tmp_path / name).touch()
    files = {"certificate": tmp_path / "c.pem", "key": tmp_path / "k.pem"}
    secure = text(tmp_path, host="192.168.1.5", websocket_port=5281, **files)
    assert "https_ports = { 5281 }\n" in secure
    assert "http_ports = {}\n" in secure
    assert 'https_interfaces = { "192.168.1.5" }\n' in secure
    assert f'https_ssl = {{ certificate = "{tmp_path}/domain.crt", key = "{tmp_path}/domain.key" }}\n' in secure


@pytest.mark.parametrize("changes", [{"host": "0.0.0.0"}, {"host": "192.168.1.5"}, {"key": Path("k.pem")}])  # noqa: S104 (rejected)
def test_a_missing_certificate_is_rejected(tmp_path: Path, changes: dict[str, Any]) -> None:
    with pytest.raises(ConfigurationError, match="certificate"):
        text(tmp_path, **changes)


@pytest.mark.parametrize("domain", ["", "Lab", 'lab"', "lab..org", "-lab", "a" * 64, "lab\n"])
def test_invalid_domains_are_rejected(tmp_path: Path, domain: str) -> None:
    with pytest.raises(ConfigurationError, match="domain"):
        text(tmp_path, domain=domain)


def test_arguments_are_quoted(tmp_path: Path) -> None:
    hostile = 'http://x/"; os.exit() --'
    assert 'telescope_verify_url = "http://x/\\"; os.exit() --"' in text(tmp_path, verify_url=hostile)


@pytest.mark.parametrize(
    ("find", "package"),
    [
        (mosquitto.binary, "mosquitto haproxy"),
        (mosquitto.plugin, "mosquitto haproxy"),
        (admission.binary, "mosquitto haproxy"),
        (configuration.binary, "prosody"),
    ],
)
def test_a_missing_installation_names_the_package(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, find: Callable[[], object], package: str
) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.setattr(programs, "_PATH_BESIDE", str(tmp_path))
    monkeypatch.setattr(mosquitto, "_PLUGIN_FOLDERS", ("no/such/folder",))
    with pytest.raises(programs.NotInstalledError, match=f"apt-get install {package}"):
        find()
