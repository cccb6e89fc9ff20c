"""Signing keys in files: made once, kept private, and never made anew over damaged ones."""

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


def test_a_key_is_made_at_first_use_and_stays(tmp_path: Path) -> None:
    first = FileKeys(tmp_path / "keys").load()
    again = FileKeys(tmp_path / "keys").load()
    assert first.private_bytes_raw() == again.private_bytes_raw()
    public = json.loads((tmp_path / "keys" / "public.json").read_text())
    assert public == {signing.key_id(first.public_key()): signing.public_text(first.public_key())}
    assert {"public.json", "ring.json"} == {path.name for path in (tmp_path / "keys").glob("*.json")}
    assert not list((tmp_path / "keys").glob("*.part"))


def test_only_their_owner_can_read_them(tmp_path: Path) -> None:
    FileKeys(tmp_path / "keys").load()
    assert mode(tmp_path / "keys") == 0o700
    assert mode(tmp_path / "keys" / "ring.json") == 0o600
    assert mode(tmp_path / "keys" / "public.json") == 0o644


def test_rights_that_were_opened_are_closed_at_the_next_start_and_said(
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
    assert [record.message.split(" was open")[0] for record in caplog.records] == [
        str(folder),
        str(folder / "ring.json"),
        str(folder / "public.json"),
    ]
    assert "rotate-keys --leaked" in caplog.text
    caplog.clear()
    FileKeys(folder).load()
    assert caplog.text == ""


def test_many_who_make_it_at_once_get_the_same(tmp_path: Path) -> None:
    for round_ in range(10):
        folder = tmp_path / str(round_)
        with ThreadPoolExecutor(8) as pool:
            found = list(pool.map(lambda _, folder=folder: FileKeys(folder).load().private_bytes_raw(), range(8)))
        assert len(set(found)) == 1


def test_of_many_who_rotate_at_once_one_does(tmp_path: Path) -> None:
    def rotate(_: int) -> bool:
        try:
            asyncio.run(FileKeys(tmp_path).rotate())
        except Exception as error:  # noqa: BLE001 (any error is counted)
            return type(error).__name__ != "RotationRefused"
        return True

    FileKeys(tmp_path).load()
    with ThreadPoolExecutor(4) as pool:
        assert sum(pool.map(rotate, range(4))) == 1
    assert asyncio.run(FileKeys(tmp_path).news()).serial == 2


def test_the_key_of_a_time_before_rings_is_the_first_of_one(tmp_path: Path) -> None:
    key = signing.generate()
    (tmp_path / "signing.pem").write_text(key_ring.pem(key))
    assert FileKeys(tmp_path).load().private_bytes_raw() == key.private_bytes_raw()
    assert not (tmp_path / "signing.pem").exists()


def test_the_broker_is_told_of_a_new_key_and_of_the_end_of_an_old_one(tmp_path: Path) -> None:
    now = [1_000_000]
    keys = FileKeys(tmp_path, now_ms=lambda: now[0])
    old = signing.key_id(keys.load().public_key())
    news = asyncio.run(keys.rotate(learn_ms=10, overlap_ms=20))

    def told() -> set[str]:
        return set(json.loads((tmp_path / "public.json").read_text()))

    assert told() == {old, news.pins[-1].id}
    now[0] += 20
    keys.signer()
    assert told() == {news.pins[-1].id}


def test_addresses_made_with_a_key_outlive_it_for_a_while(tmp_path: Path) -> None:
    keys = FileKeys(tmp_path)
    old = keys.load().private_bytes_raw()
    asyncio.run(keys.rotate())
    assert keys.secrets()[0] == keys.signer().private_bytes_raw()
    assert keys.secrets()[1:] == (old,)


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("ring.json", ""),
        ("ring.json", "no ring"),
        ("ring.json", '{"keys": []}'),
        ("public.json", ""),
        ("public.json", "no json"),
    ],
)
def test_damaged_files_are_named_and_left_as_they_are(tmp_path: Path, name: str, content: str) -> None:
    FileKeys(tmp_path).load()
    (tmp_path / name).write_text(content)
    with pytest.raises(StoreError, match="cannot be used") as caught:
        FileKeys(tmp_path).load()
    assert str(tmp_path) in str(caught.value)
    assert "\n" not in str(caught.value)
    if name == "ring.json":
        assert (tmp_path / name).read_text() == content


@pytest.mark.parametrize("content", ["", "no key", WRONG_KIND])
def test_a_damaged_former_key_is_named_and_left_as_it_is(tmp_path: Path, content: str) -> None:
    (tmp_path / "signing.pem").write_text(content)
    with pytest.raises(StoreError, match="cannot be used"):
        FileKeys(tmp_path).load()
    assert (tmp_path / "signing.pem").read_text() == content
    assert not (tmp_path / "ring.json").exists()


def test_a_ring_whose_halves_do_not_belong_together_is_none() -> None:
    text = Ring.first(signing.generate()).text
    other = signing.public_text(signing.generate().public_key())
    own = Ring.read(text).newest.public
    with pytest.raises(key_ring.RingError, match="belong together"):
        Ring.read(text.replace(own, other))
