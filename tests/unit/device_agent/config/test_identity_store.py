"""The agent's folder: private key, pairing, certificate authority and lock."""

import datetime as dt
import stat
from pathlib import Path

import pytest
from cryptography.hazmat.primitives.asymmetric import ec

from device_agent.config import release
from device_agent.config.agent_config import AgentConfig, DeviceEntry
from device_agent.config.errors import ConfigError
from device_agent.config.identity_store import IdentityStore, Pairing
from device_agent.protocol.security import signing
from infra.tls import server_ca


@pytest.fixture
def store(tmp_path: Path) -> IdentityStore:
    return IdentityStore(tmp_path / "agent")


def test_files_are_private(store: IdentityStore) -> None:
    store.private_key(create=True)
    AgentConfig(server="http://s", name="n", devices=(DeviceEntry(name="arm", type="ur5"),)).save(store.folder)
    assert stat.S_IMODE(store.folder.stat().st_mode) == 0o700
    assert {stat.S_IMODE(path.stat().st_mode) for path in store.folder.iterdir()} == {0o600}


def test_key_and_pairing_are_saved(store: IdentityStore) -> None:
    key = store.private_key(create=True)
    assert store.private_key(create=True).private_bytes_raw() == store.private_key().private_bytes_raw()
    keys = {signing.key_id(key.public_key()): signing.public_text(key.public_key())}
    for pairing in (None, Pairing(agent="a", space="s", account="ann", keys=keys), None):
        store.save_pairing(pairing)
        assert store.pairing() == pairing


def test_a_missing_agent_is_named_with_the_remedy(store: IdentityStore) -> None:
    for access in (store.private_key, lambda: AgentConfig.load(store.folder), store.lock().__enter__):
        with pytest.raises(ConfigError, match="enroll` first"):
            access()


@pytest.mark.parametrize(
    ("file", "content", "message"),
    [
        ("identity.pem", b"nonsense", "cannot be read as a private key"),
        ("identity.pem", server_ca.key_pem(ec.generate_private_key(ec.SECP256R1())), "not an Ed25519 key"),
        ("pairing.json", b"{", "delete it and enroll again"),
    ],
)
def test_damaged_files_are_named_with_the_remedy(store: IdentityStore, file: str, content: bytes, message: str) -> None:
    store.folder.mkdir()
    (store.folder / file).write_bytes(content)
    with pytest.raises(ConfigError, match=message):
        _ = store.pairing() if file == "pairing.json" else store.private_key()


def test_unwritable_files_are_named(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(ConfigError, match="cannot be written"):
        IdentityStore(tmp_path / "file").save_pairing(Pairing(agent="a", space="s", account="ann", keys={}))
    (tmp_path / "running.lock").mkdir()
    with pytest.raises(ConfigError, match=r"running\.lock cannot be written"), IdentityStore(tmp_path).lock():
        pass


def test_certificate_authority_is_pinned(store: IdentityStore, tmp_path: Path) -> None:
    server_ca.create(tmp_path / "tls", server_ca.names(("site.example",), ()), now=dt.datetime.now(dt.UTC))
    source = tmp_path / "tls" / server_ca.CA_CERTIFICATE
    assert store.certificate_authority("") is None
    name = store.pin_certificate_authority(source)
    pinned = store.certificate_authority(name)
    assert pinned is not None
    assert pinned.read_bytes() == source.read_bytes()
    pinned.unlink()
    with pytest.raises(ConfigError, match="enroll --ca"):
        store.certificate_authority(name)


@pytest.mark.parametrize("content", [b"no certificate", b"\xff\xfe", None])
def test_invalid_certificate_authority_is_rejected(store: IdentityStore, tmp_path: Path, content: bytes | None) -> None:
    source = tmp_path / "given.pem"
    if content is not None:
        source.write_bytes(content)
    with pytest.raises(ConfigError, match=r"--ca: .*given\.pem cannot be read as a certificate"):
        store.pin_certificate_authority(source)


def test_lock_is_exclusive_and_released(store: IdentityStore) -> None:
    store.private_key(create=True)
    with store.lock(), pytest.raises(ConfigError, match="already"), store.lock():
        pytest.fail("two processes hold the lock")
    with store.lock():
        pass


def test_key_readable_by_others_is_made_private_with_a_warning(
    store: IdentityStore, caplog: pytest.LogCaptureFixture
) -> None:
    store.private_key(create=True)
    path = store.folder / "identity.pem"
    path.chmod(0o644)
    store.private_key()
    assert path.stat().st_mode & 0o777 == 0o600
    assert "enroll again" in caplog.text
    caplog.clear()
    store.private_key()
    assert caplog.text == ""


def test_a_pairing_of_a_newer_release_is_not_read_and_not_declared_damaged(store: IdentityStore) -> None:
    store.save_pairing(Pairing(agent="a", space="s", account="ann", keys={}, format=release.PAIRING_FORMAT + 1))
    with pytest.raises(ConfigError, match="newer release; use that release"):
        store.pairing()
    assert release.present_formats(store.folder) == {"pairing.json": release.PAIRING_FORMAT + 1}
