"""What the driver of NAO robots does beyond the driver contract."""

import itertools
import os
import signal
import threading
import time
from collections.abc import Callable, Iterator

import msgspec
import pytest

from device_agent.drivers import load
from device_agent.drivers.naoqi.driver import NaoqiDriver
from device_agent.ports.driver import REST, DriverError, Twist, UnreachableError
from device_agent.ports.skills import SkillError
from device_agent.protocol import RunBehaviour, Say, SetStiffness
from device_agent.protocol.manifests import robot_type
from tests.harness.paths import NAOQI_PYTHON, ROBOTS
from tests.harness.robots.naoqi.peer import NaoPeer

NAO = robot_type.load(ROBOTS / "nao")
NAMES = [joint.name for joint in NAO.joints]
HOME = tuple(NAO.home_rad[name] for name in NAMES)
KNEE, HEAD = NAMES.index("LKneePitch"), NAMES.index("HeadYaw")
WALK = Twist(forward_m_s=0.05)


class Action:
    """The context of a skill."""

    def __init__(self) -> None:
        self.end = threading.Event()

    @property
    def ended(self) -> bool:
        return self.end.is_set()

    def wait(self, timeout_s: float) -> bool:
        return self.end.wait(timeout_s)

    def move_joints(self, position_rad: dict[str, float], speed: float) -> None:
        raise NotImplementedError


def until(condition: Callable[[], object], within_s: float = 60.0) -> None:
    end_s = time.monotonic() + within_s
    while not condition():
        assert time.monotonic() < end_s
        time.sleep(0.01)


@pytest.fixture
def peer() -> Iterator[NaoPeer]:
    peer = NaoPeer(NAO, NAOQI_PYTHON)
    yield peer
    peer.close()


@pytest.fixture
def driver(peer: NaoPeer) -> Iterator[NaoqiDriver]:
    driver = load("naoqi")(NAO, ROBOTS / "nao", peer.options(), "nao")
    assert isinstance(driver, NaoqiDriver)
    driver.connect()
    yield driver
    driver.close()


def lost(driver: NaoqiDriver) -> bool:
    try:
        driver.observe()
    except UnreachableError:
        return True
    return False


def reconnects(driver: NaoqiDriver) -> bool:
    try:
        driver.connect()
    except UnreachableError:
        return False
    return True


def walks(driver: NaoqiDriver, peer: NaoPeer) -> bool:
    driver.send(HOME)
    driver.drive(WALK)
    return bool(any(peer.state()["twist"]))


# ------------------------------------------------------------ motion


def test_the_fraction_of_the_speed_follows_the_lowest_velocity_limit(peer: NaoPeer) -> None:
    joints = tuple(
        msgspec.structs.replace(joint, max_velocity_rad_s=joint.max_velocity_rad_s / 4) for joint in NAO.joints
    )
    slow = msgspec.structs.replace(NAO, joints=joints)
    driver = load("naoqi")(slow, ROBOTS / "nao", peer.options(), "nao")
    driver.connect()
    try:
        assert peer.state()["fraction"] == pytest.approx(0.25)
    finally:
        driver.close()


def test_naoqi_moves_the_legs_of_a_walk_and_they_return_slowly(driver: NaoqiDriver, peer: NaoPeer) -> None:
    until(lambda: walks(driver, peer))
    bent = list(HOME)
    bent[KNEE] += 0.4
    bent[HEAD] += 0.2
    applied = driver.send(bent)
    assert applied[KNEE] == pytest.approx(HOME[KNEE], abs=0.01)
    assert applied[HEAD] == pytest.approx(bent[HEAD])
    steps = []

    def arrives() -> bool:
        driver.drive(REST)
        steps.append(driver.send(bent)[KNEE])
        return steps[-1] == pytest.approx(bent[KNEE])

    until(arrives)
    assert max(after - before for before, after in itertools.pairwise(steps)) <= 0.0201


def test_holding_keeps_a_command_near_the_measured_angle_and_gives_in_otherwise(
    driver: NaoqiDriver, peer: NaoPeer
) -> None:
    position = peer.state()["position"]
    commanded = {**position, "LKneePitch": position["LKneePitch"] + 0.05, "HeadYaw": position["HeadYaw"] + 0.5}
    peer.state(set={"commanded": commanded})
    driver.connect()
    target = peer.state()["target"]
    assert target["LKneePitch"] == pytest.approx(commanded["LKneePitch"])
    assert target["HeadYaw"] == pytest.approx(position["HeadYaw"])


def test_a_walk_starts_only_while_the_robot_stands(driver: NaoqiDriver, peer: NaoPeer) -> None:
    peer.state(set={"posture": "Sitting"})
    until(lambda: driver._connection and driver._connection.status and driver._connection.status.posture == "Sitting")
    assert driver.drive(WALK) == REST
    assert not any(peer.state()["twist"])
    peer.state(set={"posture": "Standing"})
    until(lambda: driver.drive(WALK) == WALK)


def test_an_ended_bridge_is_a_lost_device_and_reconnecting_stops_the_walk(driver: NaoqiDriver, peer: NaoPeer) -> None:
    assert driver._connection is not None
    until(lambda: walks(driver, peer))
    driver._connection._bridge.process.kill()
    until(lambda: lost(driver))
    with pytest.raises(DriverError):
        driver.send(HOME)
    driver.connect()
    until(lambda: not any(peer.state()["twist"]))


def test_the_robot_stops_by_itself_without_the_bridge(driver: NaoqiDriver, peer: NaoPeer) -> None:
    assert driver._connection is not None
    until(lambda: walks(driver, peer))
    driver._connection._bridge.process.kill()
    until(lambda: not any(peer.state()["twist"]))


def test_a_robot_walks_only_while_its_watchdog_runs(driver: NaoqiDriver, peer: NaoPeer) -> None:
    until(lambda: walks(driver, peer))
    peer.end_watchdog()
    until(lambda: not any(peer.state()["twist"]))
    until(driver.faults)
    assert [(fault.code, fault.stops) for fault in driver.faults()] == [("no-watchdog", False)]
    assert driver.drive(WALK) == REST
    driver.connect()
    assert [fault.code for fault in driver.faults()] == ["no-watchdog"], "an old echo is none"
    assert driver.drive(WALK) == REST
    peer.start_watchdog()
    until(lambda: not driver.faults())
    until(lambda: walks(driver, peer))


def test_an_orderly_end_releases_the_watchdog(driver: NaoqiDriver, peer: NaoPeer) -> None:
    until(lambda: walks(driver, peer))
    driver.close()
    until(lambda: not any(peer.state()["twist"]))
    peer.state(set={"walk": list(WALK)})
    time.sleep(0.5)
    assert any(peer.state()["twist"]), "another program may move the robot"


def test_a_hung_bridge_is_a_lost_device_and_is_replaced(driver: NaoqiDriver, peer: NaoPeer) -> None:
    assert driver._connection is not None
    process = driver._connection._bridge.process
    until(lambda: walks(driver, peer))
    os.kill(process.pid, signal.SIGSTOP)
    until(lambda: lost(driver))
    driver.connect()
    assert process.poll() is not None
    until(lambda: not any(peer.state()["twist"]))


def test_a_suspended_robot_is_lost_and_stops_when_it_continues(driver: NaoqiDriver, peer: NaoPeer) -> None:
    until(lambda: walks(driver, peer))
    os.kill(peer.process.pid, signal.SIGSTOP)
    try:
        until(lambda: lost(driver))
        with pytest.raises(UnreachableError):
            driver.connect()
    finally:
        os.kill(peer.process.pid, signal.SIGCONT)
    until(lambda: not any(peer.state()["twist"]))
    until(lambda: reconnects(driver))
    assert not any(peer.state()["twist"])


def test_a_robot_that_was_switched_off_is_lost(driver: NaoqiDriver, peer: NaoPeer) -> None:
    peer.process.kill()
    until(lambda: lost(driver))
    with pytest.raises(UnreachableError, match=r"power|restart NAOqi"):
        driver.connect()


def test_a_missing_interpreter_or_library_is_described(peer: NaoPeer) -> None:
    for python in ("/missing/python", "/usr/bin/python3"):
        options = {**peer.options(), "python": python}
        with pytest.raises(UnreachableError, match=r"Python|package qi"):
            load("naoqi")(NAO, ROBOTS / "nao", options, "nao").connect()


# ------------------------------------------------------------ faults, streams, skills


def test_a_fall_and_limp_joints_stop_and_a_disabled_fall_manager_is_shown(driver: NaoqiDriver, peer: NaoPeer) -> None:
    assert not driver.faults()
    peer.state(set={"fall_manager": False})
    until(driver.faults)
    assert [(fault.code, fault.stops) for fault in driver.faults()] == [("fall-manager-off", False)]
    driver.send(HOME)
    peer.state(set={"fall_manager": True, "fallen": True})
    until(lambda: [(fault.code, fault.stops) for fault in driver.faults()] == [("fallen", True)])
    peer.state(set={"fallen": False, "stiffness": dict.fromkeys(NAMES, 1.0) | {"LElbowRoll": 0.0}})
    until(lambda: [(fault.code, fault.stops) for fault in driver.faults()] == [("stiffness-off", True)])
    assert "LElbowRoll" in driver.faults()[0].message
    with pytest.raises(DriverError, match="stopped itself"):
        driver.drive(WALK)


def test_stiffness_that_an_operator_has_removed_is_no_fault(driver: NaoqiDriver, peer: NaoPeer) -> None:
    driver.perform(SetStiffness(value=0.0, joints=("LElbowRoll",)), Action())
    assert peer.state()["stiffness"]["LElbowRoll"] == 0.0
    assert peer.state()["stiffness"]["HeadYaw"] == 1.0
    status = driver._connection.status if driver._connection else None
    until(lambda: driver._connection is not None and driver._connection.status is not status)
    assert not driver.faults()


def test_it_reports_health_and_odometry(driver: NaoqiDriver, peer: NaoPeer) -> None:
    health = driver.report("health")
    assert health["battery_percent"] == 81
    assert health["temperature_c.HeadYaw"] == 30 + NAMES.index("HeadYaw")
    assert len(health) == len(NAMES) + 1
    until(lambda: walks(driver, peer) and driver.report("odometry")["forward_m_s"] == WALK.forward_m_s)
    until(lambda: driver.report("odometry")["x_m"] > 0)
    assert driver.report("other") == {}


def test_it_speaks_in_the_requested_language(driver: NaoqiDriver, peer: NaoPeer) -> None:
    driver.perform(Say(text="Guten Tag", language="de"), Action())
    driver.perform(Say(text="Hello"), Action())
    assert peer.state()["spoken"] == [["German", "Guten Tag"], ["English", "Hello"]]
    with pytest.raises(SkillError, match="not installed"):
        driver.perform(Say(text="Dobrý deň", language="sk"), Action())
    with pytest.raises(SkillError, match="there are: cs, de"):
        driver.perform(Say(text="Saluton", language="eo"), Action())
    with pytest.raises(SkillError):
        driver.perform(RunBehaviour(name="wave"), Action())


def test_speech_ends_with_its_action(driver: NaoqiDriver, peer: NaoPeer) -> None:
    action = Action()
    threading.Timer(0.2, action.end.set).start()
    driver.perform(Say(text="x" * 2000), action)
    until(lambda: "stopAll" in peer.state()["calls"])


def test_a_skill_fails_if_the_robot_is_lost(driver: NaoqiDriver, peer: NaoPeer) -> None:
    threading.Timer(0.5, peer.process.kill).start()
    with pytest.raises(SkillError):
        driver.perform(Say(text="x" * 2000), Action())


# ------------------------------------------------------------ options


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"address": "nao.local", "python": "/venv/bin/python", "speed": "1"}, "no option 'speed'"),
        ({"address": "nao.local:x", "python": "/venv/bin/python"}, "address"),
        ({"python": "/venv/bin/python"}, "address"),
        ({"address": "nao.local"}, "python"),
    ],
)
def test_wrong_options_are_described(options: dict[str, object], message: str) -> None:
    with pytest.raises(DriverError, match=message):
        load("naoqi")(NAO, ROBOTS / "nao", options, "nao")


def test_the_port_of_naoqi_is_the_default() -> None:
    options = {"address": "nao.local", "python": "/venv/bin/python"}
    driver = load("naoqi")(NAO, ROBOTS / "nao", options, "nao")
    assert isinstance(driver, NaoqiDriver)
    assert driver._settings.url == "tcp://nao.local:9559"
