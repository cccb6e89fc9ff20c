"""Behaviours of ALBehaviorManager, over NAOqi's real protocol."""

import time
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import pytest

from device_agent.drivers import load
from device_agent.drivers.behaviour_names import encode
from device_agent.drivers.naoqi import driver as naoqi_driver
from device_agent.ports.driver import DriverError
from device_agent.ports.skills import SkillError
from device_agent.protocol import AckStatus, Description, MoveJoints, ResetStop, RunBehaviour, topics
from device_agent.protocol.manifests import robot_type
from tests.contract.drivers.naoqi.test_robot import HOME, NAMES, until
from tests.harness.agent.device_harness import DeviceHarness, eventually
from tests.harness.paths import NAOQI_PYTHON, ROBOTS
from tests.harness.robots.naoqi.control_thread import (
    Action,
    ControlThread,
    MakeNao,
    alive,
    has_turned,
    head,
    holds,
    pids,
)
from tests.harness.robots.naoqi.peer import NaoPeer

NAO = robot_type.load(ROBOTS / "nao")
HEAD = NAMES.index("HeadYaw")
HEY = encode("naoqi", "animations/Stand/Gestures/Hey_1")
LONG = encode("naoqi", "User/long wave.1/behavior_1")
WALK = encode("naoqi", "walk")


@pytest.fixture
def guarded_agent(make_nao: MakeNao) -> Iterator[ControlThread]:
    """An agent at a robot whose watchdog runs: it may stop a behaviour on a busy machine."""
    agent = ControlThread(make_nao())
    yield agent
    agent.stop()


@pytest.fixture
def agent(nao: NaoPeer, make_nao: MakeNao) -> Iterator[ControlThread]:
    """An agent at a robot without a watchdog."""
    nao.end_watchdog()
    agent = ControlThread(make_nao())
    yield agent
    agent.stop()


# ------------------------------------------------------------ behaviours


def test_installed_behaviours_are_listed_with_their_own_names(make_nao: MakeNao) -> None:
    titles = {each.name: each.title for each in make_nao().behaviours}
    assert titles[HEY] == "animations/Stand/Gestures/Hey_1"
    assert titles[LONG] == "User/long wave.1/behavior_1"
    assert not any(each.recovery for each in make_nao().behaviours)
    assert [each.name for each in make_nao(behaviours=["animations/*"]).behaviours] == [HEY]


def test_a_behaviour_ends_when_the_robot_says_so_and_its_pose_is_held_without_a_jump(
    agent: ControlThread, nao: NaoPeer
) -> None:
    thread, errors = agent.start(HEY)
    until(lambda: nao.state()["running"])
    before = len(agent.sent)
    thread.join()
    assert not errors
    assert not nao.state()["running"]
    until(lambda: len(agent.sent) > before + 10)
    assert agent.sent[before + 1 :] == pytest.approx([0.2] * len(agent.sent[before + 1 :]), abs=0.01)
    assert head(nao) == pytest.approx(0.2, abs=0.01)


def test_the_agent_adopts_the_command_and_not_the_angle_of_a_loaded_joint(agent: ControlThread, nao: NaoPeer) -> None:
    position = nao.state()["position"]
    nao.state(set={"commanded": {**position, "LKneePitch": position["LKneePitch"] + 0.05}})
    agent.run_behaviour(HEY)
    assert agent.command[NAMES.index("LKneePitch")] == pytest.approx(position["LKneePitch"] + 0.05, abs=1e-6)


@pytest.mark.parametrize("name", [LONG, WALK])
def test_the_end_of_the_action_ends_the_behaviour_at_rest(agent: ControlThread, nao: NaoPeer, name: str) -> None:
    action = Action()
    thread, errors = agent.start(name, action)
    until(lambda: head(nao) > 0.1 or any(nao.state()["twist"]))
    action.end.set()
    thread.join()
    assert holds(nao)
    assert errors == ["it was ended before its own end"]
    assert head(nao) < 1.8
    calls = nao.state()["calls"]
    assert {"stopMove", "killAll"} < set(calls)
    assert any(call.startswith("stopBehavior") for call in calls)


def test_a_halt_and_a_hung_agent_end_a_behaviour(agent: ControlThread, nao: NaoPeer) -> None:
    thread, errors = agent.start(LONG)
    until(lambda: head(nao) > 0.1)
    agent.driver.halt()
    thread.join()
    assert errors
    until(lambda: holds(nao))
    agent.driver.connect()
    agent.command = list(agent.driver.observe().position_rad)
    thread, errors = agent.start(LONG)
    until(lambda: nao.state()["running"])
    agent.stop()  # nothing feeds the bridge's watchdog
    thread.join()
    assert errors == ["the agent sent no commands for 0.25 s"]
    assert holds(nao)


def test_a_behaviour_ends_at_an_agent_that_has_sent_nothing_before_it_either(make_nao: MakeNao, nao: NaoPeer) -> None:
    nao.end_watchdog()
    driver = make_nao()
    with pytest.raises(SkillError, match=r"^the agent sent no commands for 0\.25 s$"):
        driver.run_behaviour(LONG, Action())
    assert holds(nao)


def test_a_behaviour_is_done_while_the_program_on_the_robot_works(guarded_agent: ControlThread) -> None:
    def done() -> bool:
        thread, errors = guarded_agent.start(HEY)
        thread.join()
        return not errors

    until(done)


def test_a_behaviour_that_the_program_on_the_robot_has_stopped_is_not_done(
    guarded_agent: ControlThread, nao: NaoPeer
) -> None:
    thread, errors = guarded_agent.start(LONG)
    until(lambda: head(nao) > 0.1)
    nao.state(disturb="beats")
    start_s = time.monotonic()
    until(lambda: sum(each > start_s for each in nao.state()["checks"]) > 10)
    nao.restore()
    thread.join()
    assert errors == [
        "the program telescope_watchdog.py on the robot stopped it: the connection to the robot had failed"
    ]
    assert holds(nao)


def test_a_behaviour_is_not_done_if_the_program_on_the_robot_does_not_respond_at_its_end(
    guarded_agent: ControlThread, nao: NaoPeer
) -> None:
    thread, errors = guarded_agent.start(HEY)
    until(lambda: nao.state()["running"])
    nao.state(disturb="beats")
    thread.join()
    nao.restore()
    assert errors == ["the program telescope_watchdog.py on the robot does not respond, and may have stopped it"]


def test_a_behaviour_of_a_killed_bridge_is_ended_by_the_next_one(agent: ControlThread, nao: NaoPeer) -> None:
    thread, errors = agent.start(WALK)
    until(lambda: any(nao.state()["twist"]))
    assert agent.driver._connection is not None
    agent.driver._connection._bridge.process.kill()
    thread.join()
    assert "lost" in errors[0]
    assert any(nao.state()["twist"]), "NAOqi continues alone"
    agent.driver.connect()
    until(lambda: holds(nao))


def test_the_watchdog_on_the_robot_ends_the_walk_of_a_behaviour(guarded_agent: ControlThread, nao: NaoPeer) -> None:
    thread, errors = guarded_agent.start(WALK)
    until(lambda: any(nao.state()["twist"]))
    time.sleep(0.3)
    assert any(nao.state()["twist"]), "it does not disturb a behaviour while the bridge works"
    assert guarded_agent.driver._connection is not None
    guarded_agent.driver._connection._bridge.process.kill()
    thread.join()
    assert "lost" in errors[0]
    until(lambda: not any(nao.state()["twist"]))
    assert nao.state()["running"], "only the next bridge ends the behaviour"
    guarded_agent.driver.connect()
    until(lambda: holds(nao))
    assert not nao.state()["running"]


def test_a_behaviour_that_the_robot_does_not_end_halts_the_device(
    agent: ControlThread, nao: NaoPeer, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(naoqi_driver, "_BEHAVIOUR_END_S", 0.5)
    nao.state(set={"stubborn": True})
    action = Action()
    thread, errors = agent.start(LONG, action)
    until(lambda: nao.state()["running"])
    action.end.set()
    thread.join()
    assert "does not end" in errors[0]
    with pytest.raises(DriverError, match="halted"):
        agent.driver.send(HOME)
    nao.state(set={"stubborn": False})


def test_unknown_excluded_and_failing_behaviours_are_described(make_nao: MakeNao) -> None:
    agent = ControlThread(make_nao(behaviours=["animations/*", "broken"]))
    try:
        for name in (encode("naoqi", "missing"), LONG, "x"):
            with pytest.raises(SkillError, match="the robot has: animations/Stand/Gestures/Hey_1, broken"):
                agent.run_behaviour(name)
        with pytest.raises(SkillError, match="cannot be loaded"):
            agent.run_behaviour(encode("naoqi", "broken"))
    finally:
        agent.stop()


# ------------------------------------------------------------ the whole device


@pytest.fixture
def harness(tmp_path: Path, scripts: Path) -> Iterator[tuple[DeviceHarness, NaoPeer]]:
    """A device of the agent at the simulated NAO."""
    nao = NaoPeer(NAO, NAOQI_PYTHON, simulated=True, watchdog=False)
    options = {**nao.options(), "legacy_scripts": True, "scripts": str(scripts)}
    driver = load("naoqi")(NAO, ROBOTS / "nao", options, "arm")
    harness = DeviceHarness(tmp_path, driver=driver, kind=NAO)  # type: ignore[arg-type]
    harness.start()
    yield harness, nao
    harness.stop()
    nao.close()


def test_the_agent_runs_and_stops_behaviours_of_the_simulated_nao(
    harness: tuple[DeviceHarness, NaoPeer], scripts: Path
) -> None:
    device, nao = harness
    newest = eventually(lambda: [each for each in device.published(topics.DESC, Description) if each.robot_behaviours])
    assert {each.name: each.label for each in newest[-1].robot_behaviours}[LONG] == "User/long wave.1/behavior_1"
    device.done(RunBehaviour(name=HEY), epoch=1)
    commanded = device.telemetry().commanded_rad[HEAD]
    assert commanded == pytest.approx(0.2, abs=0.05)
    until(lambda: head(nao) == pytest.approx(commanded, abs=0.05))
    device.done(MoveJoints(position_rad={"HeadYaw": 0.0}, speed=0.5), epoch=1)
    for epoch, name in ((2, LONG), (4, encode("script", "endless.py"))):
        start = head(nao)
        running = device.running(RunBehaviour(name=name), epoch=epoch)
        until(partial(has_turned, nao, start))
        device.receive_stop()
        end = device.end(running)
        assert end.status is AckStatus.FAILED
        assert end.reason is not None
        assert end.reason.code == "stopped"
        until(lambda: not nao.state()["running"] and not any(abs(value) > 0.02 for value in nao.state()["twist"]))
        at_rest = head(nao)
        assert at_rest < 1.5
        time.sleep(0.5)
        assert head(nao) == pytest.approx(at_rest, abs=0.05)
        assert device.failed(RunBehaviour(name=name), epoch=epoch).code in {"stopped", "lease_ended"}
        device.done(ResetStop(), epoch=epoch + 1)
    script, child, *_ = pids(scripts)
    until(lambda: not alive(int(script)) and not alive(int(child)))
