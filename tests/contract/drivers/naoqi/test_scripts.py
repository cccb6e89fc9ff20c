"""The owner's scripts for NAOqi, over its real protocol."""

import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from device_agent.drivers import load
from device_agent.drivers.behaviour_names import encode
from device_agent.ports.driver import DriverError
from device_agent.ports.skills import SkillError
from device_agent.protocol.manifests import robot_type
from tests.contract.drivers.naoqi.test_robot import NAMES, until
from tests.harness.paths import ROBOTS
from tests.harness.robots.naoqi.control_thread import Action, ControlThread, MakeNao, alive, head, holds, pids
from tests.harness.robots.naoqi.peer import NaoPeer

NAO = robot_type.load(ROBOTS / "nao")
HEAD = NAMES.index("HeadYaw")


@pytest.fixture
def scripted(nao: NaoPeer, make_nao: MakeNao, scripts: Path) -> Iterator[ControlThread]:
    """An agent at a robot without a watchdog, which may stop a script on a busy machine."""
    nao.end_watchdog()
    agent = ControlThread(make_nao(legacy_scripts=True, scripts=str(scripts)))
    yield agent
    agent.stop()


def test_scripts_need_the_owners_permission(make_nao: MakeNao) -> None:
    driver = make_nao()
    with pytest.raises(SkillError, match=r"legacy_scripts = true in agent\.toml"):
        driver.run_behaviour(encode("script", "turn.py"), Action())
    assert not any(each.name.startswith("script-") for each in driver.behaviours)


def test_a_permitted_script_moves_the_robot_and_its_pose_is_held(
    scripted: ControlThread, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("SECRET", "of the agent")
    scripted.driver.connect()
    assert [each.title for each in scripted.driver.behaviours if each.name.startswith("script-")] == [
        "endless.py",
        "fails.py",
        "turn.py",
    ]
    scripted.run_behaviour(encode("script", "turn.py"))
    assert scripted.command[HEAD] == pytest.approx(0.3, abs=0.02)
    with pytest.raises(SkillError, match="exit code 1: ValueError: no arm"):
        scripted.run_behaviour(encode("script", "fails.py"))
    for name in ("missing.py", "../turn.py", "turn.txt"):
        with pytest.raises(SkillError, match=r"no script|cannot be read"):
            scripted.run_behaviour(encode("script", name))


@pytest.mark.parametrize("ending", ["action", "halt", "agent hangs", "bridge killed"])
def test_a_script_and_its_children_are_killed_and_the_robot_holds(
    scripted: ControlThread, nao: NaoPeer, scripts: Path, ending: str
) -> None:
    action = Action()
    thread, errors = scripted.start(encode("script", "endless.py"), action)
    script, child, host, port = pids(scripts)
    assert f"tcp://{host}:{port}" == nao.url
    until(lambda: head(nao) > 0.05)
    if ending == "action":
        action.end.set()
    elif ending == "halt":
        scripted.driver.halt()
    elif ending == "agent hangs":
        scripted.stop()
    else:
        assert scripted.driver._connection is not None
        scripted.driver._connection._bridge.process.kill()
    thread.join()
    assert errors
    until(lambda: not alive(int(script)) and not alive(int(child)))
    if ending == "bridge killed":
        scripted.driver.connect()
    until(lambda: holds(nao))
    assert head(nao) < 1.8


@pytest.mark.parametrize("exposed", ["file", "folder", "parent", "link"])
def test_scripts_that_another_user_may_change_do_not_run(scripted: ControlThread, scripts: Path, exposed: str) -> None:
    turn = scripts / "turn.py"
    if exposed == "link":
        turn.rename(scripts / "other")
        turn.symlink_to(scripts / "other")
    else:
        {"file": turn, "folder": scripts, "parent": scripts.parent}[exposed].chmod(0o777)
    with pytest.raises(SkillError, match=r"another user|links are not followed"):
        scripted.run_behaviour(encode("script", "turn.py"))
    scripted.driver.connect()
    assert encode("script", "turn.py") not in {each.name for each in scripted.driver.behaviours}


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"legacy_scripts": True}, "belong together"),
        ({"scripts": "/home/robot/scripts"}, "belong together"),
        ({"legacy_scripts": "yes", "scripts": "/scripts"}, "true or false"),
        ({"legacy_scripts": True, "scripts": "/scripts", "script_python": ""}, "must be paths"),
        ({"behaviours": "animations/*"}, "list of texts"),
    ],
)
def test_wrong_options_of_behaviours_are_described(options: dict[str, object], message: str) -> None:
    with pytest.raises(DriverError, match=message):
        load("naoqi")(NAO, ROBOTS / "nao", {"address": "nao.local", "python": sys.executable, **options}, "nao")
