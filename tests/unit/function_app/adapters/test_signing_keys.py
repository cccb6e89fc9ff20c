"""Signing keys in files: made once, private, and never replaced when damaged."""

import asyncio
import json
import logging
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
from cryptography.hazmat.primitives import serialization
from cryptography.hazmat.primitives.asymmetric.x25519 import X25519PrivateKey

from device_agent.protocol.security import signing
from function_app.adapters.local.signing_keys import FileKeys
from function_app.adapters.shared import key_ring
from function_app.adapters.shared.key_ring import Ring
from function_app.ports.tables import StoreError

WRONG_KIND = (
    X25519PrivateKey.generate()
    .private_bytes(serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption())
    .decode()
)


def mode(path: Path) -> int:
    return path.stat().st_mode & 0o777


def test_a_key_is_made_at_first_use_for_its_owner_only(tmp_path: Path) -> None:
    folder = tmp_path / "keys"
    first = FileKeys(folder).load()
    assert FileKeys(folder).load().private_bytes_raw() == first.private_bytes_raw()
    public = json.loads((folder / "public.json").read_text())
    assert public == {signing.key_id(first.public_key()): signing.public_text(first.public_key())}
    assert {"public.json", "ring.json"} == {path.name for path in folder.glob("*.json")}
    assert not list(folder.glob("*.part"))
    assert [mode(path) for path in (folder, folder / "ring.json", folder / "public.json")] == [0o700, 0o600, 0o644]


def test_too_wide_permissions_are_corrected_at_the_next_start_with_a_warning(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    folder = tmp_path / "keys"
    FileKeys(folder).load()
    folder.chmod(0o755)
    (folder / "ring.json").chmod(0o640)
    (folder / "public.json").chmod(0o666)
    with caplog.at_level(logging.WARNING):
        FileKeys(folder).load()
    assert [mode(path) for path in (folder, folder / "ring.json", folder / "public.json")] == [0o700, 0o600, 0o644]
    expected = [folder, folder / "ring.json", folder / "public.json"]
    assert [record.args[0] for record in caplog.records if isinstance(record.args, tuple)] == expected
    assert "rotate-keys --leaked" in caplog.text
    caplog.clear()
    FileKeys(folder).load()
    assert caplog.text == ""


def test_concurrent_first_uses_get_the_same_key(tmp_path: Path) -> None:
    for round_ in range(5):
        folder = tmp_path / str(round_)
        with ThreadPoolExecutor(8) as pool:
            keys = list(pool.map(lambda _, folder=folder: FileKeys(folder).load().private_bytes_raw(), range(8)))
        assert len(set(keys)) == 1


def test_one_of_many_concurrent_rotations_succeeds(tmp_path: Path) -> None:
    def rotate(_: int) -> bool:
        try:
            asyncio.run(FileKeys(tmp_path).rotate())
        except Exception as error:  # noqa: BLE001 (any error is counted)
            return type(error).__name__ != "RotationRefused"
        return True

    FileKeys(tmp_path).load()
    with ThreadPoolExecutor(4) as pool:
        assert sum(pool.map(rotate, range(4))) == 1
    assert asyncio.run(FileKeys(tmp_path).announcement()).serial == 2


def test_the_single_key_of_earlier_versions_becomes_the_first(tmp_path: Path) -> None:
    key = signing.generate()
    (tmp_path / "signing.pem").write_text(key_ring.pem(key))
    assert FileKeys(tmp_path).load().private_bytes_raw() == key.private_bytes_raw()
    assert not (tmp_path / "signing.pem").exists()


def test_the_brokers_file_has_the_new_key_and_the_old_one_until_its_end(tmp_path: Path) -> None:
    now = [1_000_000]
    keys = FileKeys(tmp_path, now_ms=lambda: now[0])
    old = signing.key_id(keys.load().public_key())
    news = asyncio.run(keys.rotate(learn_ms=10, overlap_ms=20))

    def announced() -> set[str]:
        return set(json.loads((tmp_path / "public.json").read_text()))

    assert announced() == {old, news.pins[-1].id}
    now[0] += 20
    keys.signer()
    assert announced() == {news.pins[-1].id}


def test_secrets_of_the_old_key_outlive_a_rotation(tmp_path: Path) -> None:
    keys = FileKeys(tmp_path)
    old = keys.load().private_bytes_raw()
    asyncio.run(keys.rotate())
    assert keys.secrets()[0] == keys.signer().private_bytes_raw()
    assert keys.secrets()[1:] == (old,)


@pytest.mark.parametrize(
    ("name", "contents"),
    [
        ("ring.json", ["", "no ring", '{"keys": []}']),
        ("public.json", ["", "no json"]),
        ("signing.pem", ["", "no key", WRONG_KIND]),
    ],
)
def test_damaged_files_are_named_and_left_as_they_are(tmp_path: Path, name: str, contents: list[str]) -> None:
    if name != "signing.pem":  # which is read where there is no ring
        FileKeys(tmp_path).load()
    for content in contents:
        (tmp_path / name).write_text(content)
        with pytest.raises(StoreError, match="cannot be used") as caught:
            FileKeys(tmp_path).load()
        assert str(tmp_path) in str(caught.value)
        assert "\n" not in str(caught.value)
        assert (tmp_path / name).read_text() == content
        assert (tmp_path / "ring.json").exists() == (name != "signing.pem")


def test_a_ring_with_mismatched_halves_is_rejected() -> None:
    text = Ring.first(signing.generate()).text
    other = signing.public_text(signing.generate().public_key())
    own = Ring.read(text).newest.public
    with pytest.raises(key_ring.RingError, match="do not match"):
        Ring.read(text.replace(own, other))
