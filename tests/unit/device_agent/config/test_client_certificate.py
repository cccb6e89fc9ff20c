"""The agent's client certificate is requested if none is valid, and always has its key."""

import datetime as dt
from collections.abc import Callable
from pathlib import Path

import pytest
from cryptography import x509
from cryptography.hazmat.primitives import hashes
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.hazmat.primitives.serialization import Encoding

from device_agent.config.client_certificate import ClientCertificate
from device_agent.config.errors import ConfigError

DAY_MS = 86_400_000
BEGIN = dt.datetime(2026, 1, 1, tzinfo=dt.UTC)
BEGIN_MS = BEGIN.timestamp() * 1000


class Signer:
    """Signs certificates that are valid for 30 days, as the cloud does, and counts requests."""

    def __init__(self) -> None:
        self.requests = 0
        self._key = ec.generate_private_key(ec.SECP256R1())

    def __call__(self, request: str) -> str:
        self.requests += 1
        return self._certificate(x509.load_pem_x509_csr(request.encode()).public_key())

    def for_another_key(self, _: str) -> str:
        return self._certificate(ec.generate_private_key(ec.SECP256R1()).public_key())

    def _certificate(self, key: object) -> str:
        name = x509.Name([])
        builder = x509.CertificateBuilder(name, name, key, self.requests + 1)  # type: ignore[arg-type]
        builder = builder.not_valid_before(BEGIN).not_valid_after(BEGIN + dt.timedelta(days=30))
        return builder.sign(self._key, hashes.SHA256()).public_bytes(Encoding.PEM).decode()


@pytest.fixture
def signer() -> Signer:
    return Signer()


def ready(folder: Path, request: Callable[[str], str], *, after_ms: float = BEGIN_MS, days: float = 1) -> bytes:
    """The certificate that is valid this long after the first one was signed."""
    certificate, key = ClientCertificate(folder).ready(
        after_ms=after_ms, now_ms=BEGIN_MS + days * DAY_MS, request_chain=request
    )
    assert key.stat().st_mode & 0o777 == 0o600
    return certificate.read_bytes()


def test_it_is_requested_once_and_renewed_after_two_thirds_of_its_life(tmp_path: Path, signer: Signer) -> None:
    first = ready(tmp_path, signer)
    assert ready(tmp_path, signer, days=19.9) == first
    assert signer.requests == 1
    assert ready(tmp_path, signer, days=20.1) != first
    assert signer.requests == 2


def test_a_certificate_of_an_earlier_pairing_is_not_valid(tmp_path: Path, signer: Signer) -> None:
    ready(tmp_path, signer)
    ready(tmp_path, signer, after_ms=BEGIN_MS + DAY_MS, days=2)
    assert signer.requests == 2


@pytest.mark.parametrize("name", ["device.crt", "device.key"])
@pytest.mark.parametrize("content", [b"damaged", None])
def test_damaged_and_lost_files_are_replaced(tmp_path: Path, signer: Signer, name: str, content: bytes | None) -> None:
    ready(tmp_path, signer)
    (tmp_path / name).unlink()
    if content is not None:
        (tmp_path / name).write_bytes(content)
    ready(tmp_path, signer)
    assert signer.requests == 2


def test_after_a_crash_between_both_writes_the_files_are_replaced(tmp_path: Path, signer: Signer) -> None:
    ready(tmp_path, signer)
    (tmp_path / "device.crt").write_text(signer.for_another_key(""))
    ready(tmp_path, signer)
    assert signer.requests == 2


def test_a_certificate_for_another_key_is_rejected_and_not_stored(tmp_path: Path, signer: Signer) -> None:
    with pytest.raises(ValueError, match="another key"):
        ready(tmp_path, signer.for_another_key)
    assert not list(tmp_path.iterdir())


def test_an_unwritable_folder_is_named(tmp_path: Path, signer: Signer) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(ConfigError, match="cannot be written"):
        ready(tmp_path / "file", signer)
