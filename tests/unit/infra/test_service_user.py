import os
import pwd
from pathlib import Path

import pytest

from infra import service_user


@pytest.mark.parametrize(
    ("users", "uid", "notice"),
    [
        ({"mosquitto": 103}, 103, ""),
        ({}, 65_534, "no user 'mosquitto' exists"),
        ({"mosquitto": 103}, 0, "this container has no other user"),
    ],
)
def test_root_runs_a_server_as_a_user_without_rights(
    users: dict[str, int], uid: int, notice: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    def find(name: str) -> pwd.struct_passwd:
        return pwd.struct_passwd((name, "x", users[name], 106, "", "/", "/bin/false"))

    uid_map = tmp_path / "uid_map"
    uid_map.write_text("0 1000 1\n" if "container" in notice else "0 0 4294967295\n")
    monkeypatch.setattr(service_user, "_UID_MAP", uid_map)
    monkeypatch.setattr(pwd, "getpwnam", find)
    monkeypatch.setattr(os, "geteuid", lambda: 0)
    chosen = service_user.choose("mosquitto")
    assert chosen.uid == uid
    assert notice in chosen.notice
    assert bool(notice) == bool(chosen.notice)
