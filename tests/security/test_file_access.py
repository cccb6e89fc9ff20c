"""Files of the server and of agents are private to their user: another user of the machine cannot read them."""

import asyncio
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest

from device_agent.config.agent_config import AgentConfig, DeviceEntry
from device_agent.config.identity_store import IdentityStore
from function_app.adapters.local.blobs import FileBlobs
from tests.harness.paths import ROOT

OTHER_USER = 65_534
SCRIPT = "movements/anna/ur5/wave/1"

pytestmark = pytest.mark.skipif(os.geteuid() != 0, reason="only root can start a process of another user")


@pytest.fixture
def place() -> Iterator[Path]:
    """A folder that every user can enter."""
    place = Path(tempfile.mkdtemp(prefix="telescope-"))
    place.chmod(0o755)
    yield place
    shutil.rmtree(place)


def readable(folder: Path) -> list[str]:
    """Files and folders that another user can read."""
    command = ["find", str(folder), "-readable"]
    found = subprocess.run(
        command,
        cwd="/",
        user=OTHER_USER,
        group=OTHER_USER,
        extra_groups=[],
        capture_output=True,
        text=True,
        check=False,
    )
    return found.stdout.splitlines()


def sign_in_link(home: Path) -> None:
    command = [sys.executable, "-m", "function_app", "sign-in-link", "--account", "anna"]
    subprocess.run(command, cwd=ROOT, env=os.environ | {"TELESCOPE_HOME": str(home)}, capture_output=True, check=True)


def test_the_server_creates_a_private_home_and_repairs_the_home_of_an_earlier_version(place: Path) -> None:
    new, earlier = place / "new", place / "earlier"
    asyncio.run(FileBlobs(earlier / "blobs").put(SCRIPT, b"the script of another account"))
    for folder, mode in ((earlier, 0o755), (earlier / "blobs", 0o755)):
        folder.chmod(mode)
    for path in earlier.rglob("*.blob"):
        path.chmod(0o644)
    assert len(readable(earlier)) == 3
    for home in (new, earlier):
        sign_in_link(home)
        home.chmod(0o755)  # each file is private, too, for a copy of the folder
        assert readable(home) == [str(home)]


def test_the_agent_repairs_the_home_of_an_earlier_version(place: Path) -> None:
    store = IdentityStore(place / "agent")
    store.private_key(create=True)
    AgentConfig(server="http://127.0.0.1:1", name="lab", devices=(DeviceEntry(name="arm", type="ur5"),)).save(
        store.folder
    )
    (store.folder / "models").mkdir()
    (store.folder / "models" / "arm.xml").write_text("<mujoco/>")
    for path in (store.folder, *store.folder.rglob("*")):
        path.chmod(0o755)
    with store.lock():
        pass
    store.folder.chmod(0o755)
    assert readable(store.folder) == [str(store.folder)]
