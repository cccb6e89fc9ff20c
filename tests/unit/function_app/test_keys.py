"""Signing keys in files: made once, kept private, and never made anew over damaged ones."""

import json
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
from cryptography.hazmat.primitives import serialization
from cryptography.hazmat.primitives.asymmetric.x25519 import X25519PrivateKey

from device_agent.protocol import signing
from function_app.adapters.local.keys import FileKeys
from function_app.ports.tables import StoreError

WRONG_KIND = (
    X25519PrivateKey.generate()
    .private_bytes(serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption())
    .decode()
)


def test_a_key_is_made_at_first_use_and_stays(tmp_path: Path) -> None:
    first = FileKeys(tmp_path / "keys").load()
    again = FileKeys(tmp_path / "keys").load()
    assert first.private_bytes_raw() == again.private_bytes_raw()
    assert (tmp_path / "keys" / "signing.pem").stat().st_mode & 0o077 == 0
    public = json.loads((tmp_path / "keys" / "public.json").read_text())
    assert public == {signing.key_id(first.public_key()): signing.public_text(first.public_key())}
    assert sorted(path.name for path in (tmp_path / "keys").iterdir()) == ["public.json", "signing.pem"]


def test_many_who_make_it_at_once_get_the_same(tmp_path: Path) -> None:
    for round_ in range(10):
        folder = tmp_path / str(round_)
        with ThreadPoolExecutor(8) as pool:
            found = list(pool.map(lambda _, folder=folder: FileKeys(folder).load().private_bytes_raw(), range(8)))
        assert len(set(found)) == 1


def test_an_earlier_key_still_counts_beside_a_new_one(tmp_path: Path) -> None:
    old = FileKeys(tmp_path).load().public_key()
    (tmp_path / "signing.pem").unlink()
    keys = FileKeys(tmp_path)
    new = keys.load().public_key()
    assert set(keys._public) == {signing.key_id(old), signing.key_id(new)}


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("signing.pem", ""),
        ("signing.pem", "no key"),
        ("signing.pem", WRONG_KIND),
        ("public.json", ""),
        ("public.json", "no json"),
        ("public.json", "[]"),
        ("public.json", '{"a": "b"}'),
        ("public.json", '{"a": 1}'),
    ],
)
def test_damaged_files_are_named_and_left_as_they_are(tmp_path: Path, name: str, content: str) -> None:
    FileKeys(tmp_path).load()
    (tmp_path / name).write_text(content)
    with pytest.raises(StoreError, match="cannot be used") as caught:
        FileKeys(tmp_path).load()
    assert str(tmp_path) in str(caught.value)
    assert "\n" not in str(caught.value)
    if name == "signing.pem":
        assert (tmp_path / name).read_text() == content
