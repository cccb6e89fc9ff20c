"""The agent's own certificate: asked for when there is none that counts, and never without its key."""

import datetime as dt
from collections.abc import Callable
from pathlib import Path

import pytest
from cryptography import x509
from cryptography.hazmat.primitives import hashes
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.hazmat.primitives.serialization import Encoding
from cryptography.x509.oid import NameOID

from device_agent.config.client_certificate import ClientCertificate
from device_agent.config.errors import ConfigError

DAY_MS = 86_400_000
BEGIN = dt.datetime(2026, 1, 1, tzinfo=dt.UTC)
BEGIN_MS = BEGIN.timestamp() * 1000
LIFE = dt.timedelta(days=30)


class Signer:
    """What the cloud does with a request; counts how often it was asked."""

    def __init__(self) -> None:
        self.asked = 0
        self._key = ec.generate_private_key(ec.SECP256R1())

    def __call__(self, request: str) -> str:
        self.asked += 1
        return self.certificate(x509.load_pem_x509_csr(request.encode()).public_key())

    def certificate(self, key: object) -> str:
        name = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, "agent")])
        made = x509.CertificateBuilder().subject_name(name).issuer_name(name).public_key(key)  # type: ignore[arg-type]
        made = made.serial_number(self.asked + 1).not_valid_before(BEGIN).not_valid_after(BEGIN + LIFE)
        return made.sign(self._key, hashes.SHA256()).public_bytes(Encoding.PEM).decode()

    def another(self, request: str) -> str:
        del request
        return self.certificate(ec.generate_private_key(ec.SECP256R1()).public_key())


@pytest.fixture
def signer() -> Signer:
    return Signer()


@pytest.fixture
def own(tmp_path: Path) -> ClientCertificate:
    return ClientCertificate(tmp_path)


def ready(own: ClientCertificate, ask: Callable[[str], str], *, after_ms: float = BEGIN_MS, days: float = 1) -> Path:
    certificate, key = own.ready(after_ms=after_ms, now_ms=BEGIN_MS + days * DAY_MS, request_chain=ask)
    assert key.stat().st_mode & 0o777 == 0o600
    return certificate


def test_it_is_asked_for_once_and_again_after_two_thirds_of_its_life(own: ClientCertificate, signer: Signer) -> None:
    first = ready(own, signer).read_bytes()
    assert ready(own, signer, days=19.9).read_bytes() == first
    assert signer.asked == 1
    assert ready(own, signer, days=20.1).read_bytes() != first
    assert signer.asked == 2


def test_one_of_an_earlier_pairing_does_not_count(own: ClientCertificate, signer: Signer) -> None:
    ready(own, signer)
    ready(own, signer, after_ms=BEGIN_MS + DAY_MS, days=2)
    assert signer.asked == 2


@pytest.mark.parametrize("name", ["device.crt", "device.key"])
@pytest.mark.parametrize("content", [b"damaged", None])
def test_what_is_damaged_or_lost_is_made_again(
    tmp_path: Path, own: ClientCertificate, signer: Signer, name: str, content: bytes | None
) -> None:
    ready(own, signer)
    if content is None:
        (tmp_path / name).unlink()
    else:
        (tmp_path / name).write_bytes(content)
    ready(own, signer)
    assert signer.asked == 2


def test_a_key_and_a_certificate_that_do_not_fit_are_made_again(
    tmp_path: Path, own: ClientCertificate, signer: Signer
) -> None:
    """As after a kill between the two writes."""
    ready(own, signer)
    (tmp_path / "device.crt").write_text(signer.another(""))
    ready(own, signer)
    assert signer.asked == 2


def test_a_certificate_for_another_key_is_refused_and_nothing_written(
    tmp_path: Path, own: ClientCertificate, signer: Signer
) -> None:
    with pytest.raises(ValueError, match="another key"):
        ready(own, signer.another)
    assert not list(tmp_path.iterdir())


def test_a_folder_that_cannot_be_written_is_named(tmp_path: Path, signer: Signer) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(ConfigError, match="cannot be written"):
        ready(ClientCertificate(tmp_path / "file"), signer)
