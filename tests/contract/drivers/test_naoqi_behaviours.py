"""Behaviours of ALBehaviorManager and the owner's scripts, over NAOqi's real protocol."""

import sys
import threading
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

import pytest

from device_agent.drivers import load
from device_agent.drivers.behaviour_names import encode
from device_agent.drivers.naoqi import driver as naoqi_driver
from device_agent.drivers.naoqi.driver import NaoqiDriver
from device_agent.ports.driver import REST, DriverError
from device_agent.ports.skills import SkillError
from device_agent.protocol import AckStatus, Description, MoveJoints, ResetStop, RunBehaviour, topics
from device_agent.protocol.manifests import robot_type
from tests.contract.drivers.test_naoqi_robot import HOME, NAMES, Action, until
from tests.harness.agent.device_harness import DeviceHarness, eventually
from tests.harness.paths import NAOQI_PYTHON, ROBOTS
from tests.harness.robots.naoqi.peer import NaoPeer

NAO = robot_type.load(ROBOTS / "nao")
HEAD = NAMES.index("HeadYaw")
HEY = encode("naoqi", "animations/Stand/Gestures/Hey_1")
LONG = encode("naoqi", "User/long wave.1/behavior_1")
WALK = encode("naoqi", "walk")
STILL_RAD_S = 0.02
ENDLESS = """
import os, pathlib, subprocess, sys, time
import qi
child = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(600)"])
session = qi.Session()
session.connect(os.environ["NAOQI_URL"])
motion = session.service("ALMotion")
motion.move(0.05, 0.0, 0.0)
pathlib.Path("pids").write_text(f"{os.getpid()} {child.pid} {os.environ['NAO_IP']} {os.environ['NAO_PORT']}")
while True:
    motion.setAngles(["HeadYaw"], [1.9], 0.1)
    time.sleep(0.02)
"""
TURN = """
import os, time
import qi
assert "SECRET" not in os.environ
session = qi.Session()
session.connect(os.environ["NAOQI_URL"])
motion = session.service("ALMotion")
motion.setAngles(["HeadYaw"], [0.3], 0.5)
while abs(motion.getAngles(["HeadYaw"], True)[0] - 0.3) > 0.01:
    time.sleep(0.02)
"""


class Agent:
    """The agent's control loop in a thread: it holds the head's command, or adopts what the driver applies."""

    def __init__(self, driver: NaoqiDriver) -> None:
        self.driver = driver
        self.command = list(driver.observe().position_rad)
        self.sent: list[float] = []
        self.handed_over = False
        self.ended = threading.Event()
        self.thread = threading.Thread(target=self.run)
        self.thread.start()

    def run(self) -> None:
        while not self.ended.wait(0.02):
            try:
                applied = self.driver.send(self.command)
                self.driver.drive(REST)
            except DriverError:
                continue
            if self.handed_over:
                self.command = list(applied)
            else:
                self.sent.append(applied[HEAD])

    def run_behaviour(self, name: str, action: Action | None = None) -> None:
        """As the agent does: hand over, run, take over."""
        self.handed_over = True
        try:
            self.driver.run_behaviour(name, action or Action())
        finally:
            self.handed_over = False

    def start(self, name: str, action: Action | None = None) -> tuple[threading.Thread, list[str]]:
        """Run a behaviour in a thread; returns it and the list of its error."""
        errors: list[str] = []

        def run() -> None:
            try:
                self.run_behaviour(name, action)
            except SkillError as error:
                errors.append(str(error))

        thread = threading.Thread(target=run)
        thread.start()
        return thread, errors

    def stop(self) -> None:
        self.ended.set()
        self.thread.join()


@pytest.fixture
def peer() -> Iterator[NaoPeer]:
    peer = NaoPeer(NAO, NAOQI_PYTHON)
    yield peer
    peer.close()


Make = Callable[..., NaoqiDriver]


@pytest.fixture
def make(peer: NaoPeer) -> Iterator[Make]:
    made: list[NaoqiDriver] = []

    def create(**options: object) -> NaoqiDriver:
        driver = load("naoqi")(NAO, ROBOTS / "nao", {**peer.options(), **options}, "nao")
        assert isinstance(driver, NaoqiDriver)
        made.append(driver)
        driver.connect()
        return driver

    yield create
    for driver in made:
        driver.close()


@pytest.fixture
def scripts(tmp_path: Path) -> Path:
    folder = tmp_path / "scripts"
    folder.mkdir(mode=0o700)
    for name, source in (("endless.py", ENDLESS), ("turn.py", TURN), ("fails.py", "raise ValueError('no arm')")):
        path = folder / name
        path.write_text(source)
        path.chmod(0o600)
    return folder


@pytest.fixture
def agent(make: Make) -> Iterator[Agent]:
    agent = Agent(make())
    yield agent
    agent.stop()


@pytest.fixture
def scripted(make: Make, scripts: Path) -> Iterator[Agent]:
    agent = Agent(make(legacy_scripts=True, scripts=str(scripts)))
    yield agent
    agent.stop()


def head(peer: NaoPeer) -> float:
    return float(peer.state()["position"]["HeadYaw"])


def has_turned(peer: NaoPeer, start_rad: float) -> bool:
    return head(peer) > start_rad + 0.1


def holds(peer: NaoPeer) -> bool:
    """Whether the robot rests, where its target is."""
    state = peer.state()
    return (
        not any(state["twist"])
        and not state["running"]
        and state["target"]["HeadYaw"] == pytest.approx(state["position"]["HeadYaw"], abs=0.01)
        and max(map(abs, state["velocity"].values())) < STILL_RAD_S
    )


def alive(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


def pids(scripts: Path) -> list[str]:
    """Processes of the endless script, and its robot's address."""
    until(lambda: (scripts / "pids").exists() and (scripts / "pids").read_text().count(" ") == 3)
    return (scripts / "pids").read_text().split()


# ------------------------------------------------------------ behaviours


def test_installed_behaviours_are_listed_with_their_own_names(make: Make) -> None:
    titles = {each.name: each.title for each in make().behaviours}
    assert titles[HEY] == "animations/Stand/Gestures/Hey_1"
    assert titles[LONG] == "User/long wave.1/behavior_1"
    assert not any(each.recovery for each in make().behaviours)
    assert [each.name for each in make(behaviours=["animations/*"]).behaviours] == [HEY]


def test_a_behaviour_ends_when_the_robot_says_so_and_its_pose_is_held_without_a_jump(
    agent: Agent, peer: NaoPeer
) -> None:
    thread, errors = agent.start(HEY)
    until(lambda: peer.state()["running"])
    before = len(agent.sent)
    thread.join()
    assert not errors
    assert not peer.state()["running"]
    until(lambda: len(agent.sent) > before + 10)
    assert agent.sent[before + 1 :] == pytest.approx([0.2] * len(agent.sent[before + 1 :]), abs=0.01)
    assert head(peer) == pytest.approx(0.2, abs=0.01)


def test_the_agent_adopts_the_robots_command_and_not_the_angle_of_a_loaded_joint(agent: Agent, peer: NaoPeer) -> None:
    position = peer.state()["position"]
    peer.state(set={"commanded": {**position, "LKneePitch": position["LKneePitch"] + 0.05}})
    agent.run_behaviour(HEY)
    assert agent.command[NAMES.index("LKneePitch")] == pytest.approx(position["LKneePitch"] + 0.05, abs=1e-6)


@pytest.mark.parametrize("name", [LONG, WALK])
def test_the_end_of_the_action_ends_the_behaviour_at_rest(agent: Agent, peer: NaoPeer, name: str) -> None:
    action = Action()
    thread, errors = agent.start(name, action)
    until(lambda: head(peer) > 0.1 or any(peer.state()["twist"]))
    action.end.set()
    thread.join()
    assert holds(peer)
    assert errors == ["it was ended before its own end"]
    assert head(peer) < 1.8
    calls = peer.state()["calls"]
    assert {"stopMove", "killAll"} < set(calls)
    assert any(call.startswith("stopBehavior") for call in calls)


def test_a_halt_and_a_hung_agent_end_a_behaviour(agent: Agent, peer: NaoPeer) -> None:
    thread, errors = agent.start(LONG)
    until(lambda: head(peer) > 0.1)
    agent.driver.halt()
    thread.join()
    assert errors
    until(lambda: holds(peer))
    agent.driver.connect()
    agent.command = list(agent.driver.observe().position_rad)
    thread, errors = agent.start(LONG)
    until(lambda: peer.state()["running"])
    agent.stop()  # nothing feeds the bridge's watchdog
    thread.join()
    assert errors == ["it was ended before its own end"]
    assert holds(peer)


def test_a_behaviour_of_a_killed_bridge_is_ended_by_the_next_one(agent: Agent, peer: NaoPeer) -> None:
    thread, errors = agent.start(WALK)
    until(lambda: any(peer.state()["twist"]))
    assert agent.driver._connection is not None
    agent.driver._connection._bridge.process.kill()
    thread.join()
    assert "lost" in errors[0]
    assert any(peer.state()["twist"]), "NAOqi continues alone"
    agent.driver.connect()
    until(lambda: holds(peer))


def test_a_behaviour_that_the_robot_does_not_end_halts_the_device(
    agent: Agent, peer: NaoPeer, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(naoqi_driver, "_BEHAVIOUR_END_S", 0.5)
    peer.state(set={"stubborn": True})
    action = Action()
    thread, errors = agent.start(LONG, action)
    until(lambda: peer.state()["running"])
    action.end.set()
    thread.join()
    assert "does not end" in errors[0]
    with pytest.raises(DriverError, match="halted"):
        agent.driver.send(HOME)
    peer.state(set={"stubborn": False})


def test_unknown_excluded_and_failing_behaviours_are_described(make: Make) -> None:
    agent = Agent(make(behaviours=["animations/*", "broken"]))
    try:
        for name in (encode("naoqi", "missing"), LONG, "x"):
            with pytest.raises(SkillError, match="the robot has: animations/Stand/Gestures/Hey_1, broken"):
                agent.run_behaviour(name)
        with pytest.raises(SkillError, match="cannot be loaded"):
            agent.run_behaviour(encode("naoqi", "broken"))
    finally:
        agent.stop()


# ------------------------------------------------------------ scripts


def test_scripts_need_the_owners_permission(agent: Agent) -> None:
    with pytest.raises(SkillError, match=r"legacy_scripts = true in agent\.toml"):
        agent.run_behaviour(encode("script", "turn.py"))
    assert not any(each.name.startswith("script-") for each in agent.driver.behaviours)


def test_a_permitted_script_moves_the_robot_and_its_pose_is_held(
    scripted: Agent, monkeypatch: pytest.MonkeyPatch
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
    scripted: Agent, peer: NaoPeer, scripts: Path, ending: str
) -> None:
    action = Action()
    thread, errors = scripted.start(encode("script", "endless.py"), action)
    script, child, host, port = pids(scripts)
    assert f"tcp://{host}:{port}" == peer.url
    until(lambda: head(peer) > 0.05)
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
    until(lambda: holds(peer))
    assert head(peer) < 1.8


@pytest.mark.parametrize("exposed", ["file", "folder", "parent", "link"])
def test_scripts_that_another_user_may_change_do_not_run(scripted: Agent, scripts: Path, exposed: str) -> None:
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


# ------------------------------------------------------------ the whole device


@pytest.fixture
def harness(tmp_path: Path, scripts: Path) -> Iterator[tuple[DeviceHarness, NaoPeer]]:
    """A device of the agent at the simulated NAO."""
    peer = NaoPeer(NAO, NAOQI_PYTHON, simulated=True)
    options = {**peer.options(), "legacy_scripts": True, "scripts": str(scripts)}
    driver = load("naoqi")(NAO, ROBOTS / "nao", options, "arm")
    harness = DeviceHarness(tmp_path, driver=driver, kind=NAO)  # type: ignore[arg-type]
    harness.start()
    yield harness, peer
    harness.stop()
    peer.close()


def test_the_agent_runs_and_stops_behaviours_of_the_simulated_nao(
    harness: tuple[DeviceHarness, NaoPeer], scripts: Path
) -> None:
    device, peer = harness
    newest = eventually(lambda: [each for each in device.published(topics.DESC, Description) if each.robot_behaviours])
    assert {each.name: each.label for each in newest[-1].robot_behaviours}[LONG] == "User/long wave.1/behavior_1"
    device.done(RunBehaviour(name=HEY), epoch=1)
    commanded = device.telemetry().commanded_rad[HEAD]
    assert commanded == pytest.approx(0.2, abs=0.05)
    until(lambda: head(peer) == pytest.approx(commanded, abs=0.05))
    device.done(MoveJoints(position_rad={"HeadYaw": 0.0}, speed=0.5), epoch=1)
    for epoch, name in ((2, LONG), (4, encode("script", "endless.py"))):
        start = head(peer)
        running = device.running(RunBehaviour(name=name), epoch=epoch)
        until(partial(has_turned, peer, start))
        device.receive_stop()
        end = device.end(running)
        assert end.status is AckStatus.FAILED
        assert end.reason is not None
        assert end.reason.code == "stopped"
        until(lambda: not peer.state()["running"] and not any(abs(value) > 0.02 for value in peer.state()["twist"]))
        at_rest = head(peer)
        assert at_rest < 1.5
        time.sleep(0.5)
        assert head(peer) == pytest.approx(at_rest, abs=0.05)
        assert device.failed(RunBehaviour(name=name), epoch=epoch).code in {"stopped", "lease_ended"}
        device.done(ResetStop(), epoch=epoch + 1)
    script, child, *_ = pids(scripts)
    until(lambda: not alive(int(script)) and not alive(int(child)))
