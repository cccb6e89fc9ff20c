from pathlib import Path
from typing import Any

import pytest

from infra import programs
from infra.prosody import configuration
from infra.prosody.configuration import ConfigurationError


def text(tmp_path: Path, **changes: Any) -> str:
    known: dict[str, Any] = {
        "domain": "lab.example",
        "host": "127.0.0.1",
        "port": 5222,
        "verify_url": "http://127.0.0.1:8080/api/v1/xmpp/verify",
        "certificate": None,
        "key": None,
    }
    return configuration.configuration(tmp_path, **{**known, **changes})


def test_on_loopback_it_speaks_in_the_clear(tmp_path: Path) -> None:
    assert "c2s_require_encryption = false" in text(tmp_path)


@pytest.mark.parametrize("host", ["0.0.0.0", "192.168.1.5"])  # noqa: S104 (what must not be)
def test_beyond_loopback_it_wants_a_certificate(tmp_path: Path, host: str) -> None:
    with pytest.raises(ConfigurationError, match="certificate"):
        text(tmp_path, host=host)


def test_with_a_certificate_nothing_is_in_the_clear(tmp_path: Path) -> None:
    secure = text(tmp_path, host="192.168.1.5", certificate=tmp_path / "c.pem", key=tmp_path / "k.pem")
    assert "c2s_require_encryption = true" in secure
    assert "allow_unencrypted_plain_auth = false" in secure
    assert '"tls"' in secure


def test_a_key_alone_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigurationError, match="certificate"):
        text(tmp_path, key=tmp_path / "k.pem")


@pytest.mark.parametrize("domain", ["", "Lab", 'lab"', "lab..org", "-lab", "a" * 64, "lab\n"])
def test_what_is_no_domain_is_refused(tmp_path: Path, domain: str) -> None:
    with pytest.raises(ConfigurationError, match="domain"):
        text(tmp_path, domain=domain)


def test_no_argument_ends_its_string(tmp_path: Path) -> None:
    hostile = 'http://x/"; os.exit() --'
    assert 'telescope_verify_url = "http://x/\\"; os.exit() --"' in text(tmp_path, verify_url=hostile)


def test_a_missing_prosody_is_named_with_its_package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.setattr(programs, "_PATH_BESIDE", str(tmp_path))
    with pytest.raises(programs.NotInstalledError, match="apt-get install prosody"):
        configuration.binary()
