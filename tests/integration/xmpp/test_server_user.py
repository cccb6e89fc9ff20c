"""The operating-system user of Prosody."""

import os
import pwd
from pathlib import Path

import pytest

from tests.harness.cloud.identity import make_certificate
from tests.harness.network.xmpp import DOMAIN, start_prosody


@pytest.mark.skipif(os.geteuid() != 0, reason="only root can start a process of another user")
def test_started_as_root_it_runs_as_its_own_user_without_access_to_the_folders_above(tmp_path: Path) -> None:
    own = pwd.getpwnam("prosody").pw_uid
    tmp_path.chmod(0o700)
    pem = make_certificate(tmp_path, DOMAIN)
    options = ("--certificate", str(pem), "--key", str(tmp_path / "key.pem"))
    for _ in range(2):
        with start_prosody(tmp_path / "prosody", "http://127.0.0.1:9/verify", more=options) as prosody:
            pid = prosody.process.pid
            (child,) = Path(f"/proc/{pid}/task/{pid}/children").read_text().split()
            status = Path(f"/proc/{child}/status").read_text()
            assert f"Uid:\t{own}\t{own}\t{own}\t{own}\n" in status
            assert "Groups:\t \n" in status
        for path in (tmp_path / "prosody").rglob("*"):
            os.chown(path, 0, 0)  # as an earlier version, which ran as root
    assert "error" not in prosody.stderr()
