"""The switch: only with a permission, undone without a proof, and safe against a kill at each step."""

import contextlib
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from device_agent.cli.local_control import server as control
from device_agent.cli.local_control.server import ControlServer
from device_agent.cli.releases import switch as module
from device_agent.cli.releases.switch import Switch, SwitchError
from device_agent.config.errors import ConfigError
from device_agent.config.identity_store import IdentityStore
from device_agent.runtime.restart_permission import RestartPermission
from tests.harness.agent.device_harness import eventually
from tests.harness.agent.stub_installation import StubInstallation
from tests.harness.paths import ROOT


class Robot:
    """A running agent whose devices move as long as there is a reason; at its end, the launcher starts it again."""

    def __init__(self, stub: StubInstallation) -> None:
        self.reasons: list[str] = []
        self.suspended = False
        self.now_s = 0.0
        self.result = "passed"
        self.restarted = threading.Event()
        self.started = ""
        self._stub = stub
        self.permission = RestartPermission(self, clock_s=lambda: self.now_s)
        self.server = ControlServer(stub.home, self.permission, linked=lambda: True, restart=self._restart)

    def suspend(self, _why: str) -> str:
        if self.reasons:
            return self.reasons.pop(0)
        self.suspended = True
        return ""

    def resume(self) -> None:
        self.suspended = False

    def _restart(self) -> None:
        if not self.restarted.is_set():
            self.restarted.set()
            assert self.suspended
            self.started = self._stub.run().stdout
            self._stub.write_result(self.result)


@pytest.fixture
def stub(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> StubInstallation:
    monkeypatch.setattr(module, "_POLL_S", 0.01)
    monkeypatch.setattr(module, "_RESULT_POLL_S", 0.01)
    monkeypatch.setattr(module, "_SPARE_S", 0.5)
    monkeypatch.setattr(control, "_POLL_S", 0.02)
    return StubInstallation(tmp_path, "1", "2")


@pytest.fixture
def robot(stub: StubInstallation) -> Iterator[Robot]:
    robot = Robot(stub)
    robot.server.start()
    yield robot
    robot.server.stop()


def switch(stub: StubInstallation, version: str = "2", *, wait_s: float = 20.0, trial_s: float = 20.0) -> str:
    return Switch(stub.installation, wait_s=wait_s, trial_s=trial_s).to(version)


def test_it_waits_for_rest_and_the_release_proves_itself(
    stub: StubInstallation, robot: Robot, capsys: pytest.CaptureFixture[str]
) -> None:
    robot.reasons = ["arm: it moves", "arm: it moves", "arm: ann has control"]
    assert switch(stub) == "release 2 is in use and works"
    assert robot.started.split()[::2] == ["2", "1"], "the link that the former release had is required"
    assert stub.links == ("2", "1")
    assert stub.installation.trial() is None
    assert capsys.readouterr().err.splitlines()[:2] == ["waiting: arm: it moves", "waiting: arm: ann has control"]


def test_without_rest_nothing_changes(stub: StubInstallation, robot: Robot) -> None:
    robot.reasons = ["arm: it moves"] * 1000
    with pytest.raises(SwitchError, match="not switched after 0 s: arm: it moves"):
        switch(stub, wait_s=0)
    assert (stub.links, robot.restarted.is_set()) == (("1", ""), False)


def test_a_failed_release_is_replaced_by_the_former_one(stub: StubInstallation, robot: Robot) -> None:
    robot.result = "failed it has no link to the cloud"
    with pytest.raises(
        SwitchError, match=r"release 2 failed \(it has no link to the cloud\); release 1 is in use again"
    ):
        switch(stub)
    assert stub.links == ("1", "")
    assert stub.started() == "1"


def test_a_permission_that_expired_during_the_switch_undoes_it(
    stub: StubInstallation, robot: Robot, monkeypatch: pytest.MonkeyPatch
) -> None:
    link = stub.installation.link
    expired: list[str] = []

    def slow(name: str, version: str) -> None:
        link(name, version)
        if name == "current" and not expired:
            expired.append(version)
            robot.now_s += 1000
            eventually(lambda: not robot.suspended)
            robot.reasons = ["arm: it moves"] * 1000

    monkeypatch.setattr(stub.installation, "link", slow)
    # A slow machine has no time left to ask for another permission.
    with pytest.raises(SwitchError, match=r"not switched after .*(it moves|permission to restart expired)"):
        switch(stub, wait_s=0.05)
    assert (expired, stub.links, robot.restarted.is_set()) == (["2"], ("1", ""), False)
    assert stub.installation.trial() is None


def test_an_agent_that_is_not_started_again_keeps_its_release_on_trial(stub: StubInstallation, robot: Robot) -> None:
    robot.result = "1"
    with pytest.raises(SwitchError, match="was not started again"):
        switch(stub, trial_s=0.01)
    assert stub.installation.trial() is not None
    assert [stub.started() for _ in range(3)] == ["2", "2", "1"]


def test_a_stopped_agent_starts_the_release_on_trial(stub: StubInstallation) -> None:
    IdentityStore(stub.home).private_key(create=True)
    assert "is in use from the next start" in switch(stub)
    assert stub.run().stdout.startswith("2 2-")


def test_an_agent_without_a_control_socket_is_not_replaced(stub: StubInstallation) -> None:
    store = IdentityStore(stub.home)
    store.private_key(create=True)
    with store.lock(), pytest.raises(ConfigError, match="already runs the agent"):
        switch(stub)
    assert stub.links == ("1", "")


UPDATER = """
import json, os, signal, sys
from pathlib import Path
from device_agent.cli.releases.installation import Installation
from device_agent.cli.releases.switch import Switch

steps = int(sys.argv[2])
def step(event, _):
    global steps
    if event in EVENTS:
        if steps == 0:
            os.kill(os.getpid(), signal.SIGKILL)
        steps -= 1
EVENTS = {"os.rename", "os.symlink", "os.remove", "socket.connect"}
installation = Installation(Path(sys.argv[1]))
sys.addaudithook(step)
with installation.lock():
    installation.settle()
    print(Switch(installation, wait_s=20, trial_s=20).to("2"))
"""
"""An updater that kills itself before a change of the installation, or before a message to the agent."""


@pytest.mark.slow
@pytest.mark.parametrize("result", ["passed", pytest.param("failed it does not work", marks=pytest.mark.long)])
def test_an_updater_killed_at_any_step_leaves_a_release_that_works(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, result: str
) -> None:
    monkeypatch.setattr(control, "_POLL_S", 0.02)
    kills = 0
    for at in range(40):
        stub = StubInstallation(tmp_path / str(at), "1", "2")
        robot = Robot(stub)
        robot.result = result
        robot.server.start()
        command = [sys.executable, "-c", UPDATER, str(stub.prefix), str(at)]
        with contextlib.closing(_Stopped(robot.server.stop)):
            code = subprocess.run(command, cwd=ROOT, capture_output=True, check=False).returncode
            if robot.permission.confirmed:
                assert robot.restarted.wait(20)
        if code != -signal.SIGKILL:
            assert code == (0 if result == "passed" else 1)
            break
        kills += 1
        _check_recovery(stub, robot)
    assert kills >= 8


def _check_recovery(stub: StubInstallation, robot: Robot) -> None:
    assert stub.started() == "1" or (robot.result == "passed" or not robot.restarted.is_set())
    stub.installation.settle()
    current, previous = stub.links
    expected = "2" if robot.restarted.is_set() and robot.result == "passed" else None
    if robot.restarted.is_set() and robot.result != "passed":
        expected = "1"
    assert expected in {None, current}
    assert current in {"1", "2"}
    assert stub.started() == current
    if current == "2":
        assert previous == "1", "the way back exists"


class _Stopped:
    def __init__(self, stop: Callable[[], None]) -> None:
        self.close = stop
