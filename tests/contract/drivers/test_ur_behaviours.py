"""Recoveries and stored programs of Universal Robots over the dashboard server, at an emulated controller."""

import threading
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from device_agent import drivers
from device_agent.drivers.behaviour_names import encode
from device_agent.drivers.ur.dashboard import Dashboard
from device_agent.drivers.ur.driver import Controller, UrDriver
from device_agent.ports.driver import DriverError, UnreachableError
from device_agent.ports.skills import SkillError
from device_agent.protocol import ResetStop, RunBehaviour
from tests.contract.drivers.test_ur_controller import HOME, TYPE, until
from tests.harness.agent.device_harness import DeviceHarness, eventually
from tests.harness.paths import UR5
from tests.harness.robots.universal_robots import controller as emulated
from tests.harness.robots.universal_robots.peer import UrPeer

UNLOCK, CLOSE, POWER, BRAKES = (
    f"recovery-{command}" for command in ("unlock_protective_stop", "close_safety_popup", "power_on", "brake_release")
)
PICK, ENDLESS = encode("program", "pick.urp"), encode("program", "endless.urp")
CYCLE_RAD = 0.03
"""Largest change of a joint in a cycle, at 3 rad/s [rad]."""


class Action:
    """The context of a behaviour."""

    def __init__(self) -> None:
        self.end = threading.Event()

    @property
    def ended(self) -> bool:
        return self.end.is_set()

    def wait(self, timeout_s: float) -> bool:
        return self.end.wait(timeout_s)


@pytest.fixture
def peer() -> Iterator[UrPeer]:
    peer = UrPeer(TYPE)
    yield peer
    peer.close()


def controller_of(peer: UrPeer) -> Controller:
    return Controller(
        "127.0.0.1",
        peer.rtde_port,
        peer.script_port,
        125.0,
        dashboard_port=peer.dashboard_port,
        programs=("pick.urp", "endless.urp", "missing.urp"),
    )


@pytest.fixture
def driver(peer: UrPeer) -> Iterator[UrDriver]:
    driver = UrDriver(TYPE, UR5, controller_of(peer), "arm")
    yield driver
    driver.close()


class Loop:
    """The agent's control loop in a thread: it adopts what the driver applies during a behaviour, and holds there."""

    def __init__(self, driver: UrDriver) -> None:
        self.driver = driver
        self.command = driver.observe().position_rad
        self.handed_over = False
        self.ended = threading.Event()
        self.faults: set[str] = set()
        self.thread = threading.Thread(target=self.run)
        self.thread.start()

    def run(self) -> None:
        while not self.ended.wait(0.008):
            self.faults |= {fault.code for fault in self.driver.faults()}
            try:
                applied = self.driver.send(self.command)
            except DriverError:
                continue
            if self.handed_over:
                self.command = applied

    def run_behaviour(self, name: str, action: Action | None = None) -> None:
        self.handed_over = True
        try:
            self.driver.run_behaviour(name, action or Action())
        finally:
            self.handed_over = False

    def stop(self) -> None:
        self.ended.set()
        self.thread.join()


@pytest.fixture
def loop(driver: UrDriver) -> Iterator[Loop]:
    driver.connect()
    loop = Loop(driver)
    yield loop
    loop.stop()


def start(run: Callable[[], None]) -> tuple[threading.Thread, list[str]]:
    """Run in a thread; returns it and the list of its error."""
    errors: list[str] = []

    def call() -> None:
        try:
            run()
        except SkillError as error:
            errors.append(str(error))

    thread = threading.Thread(target=call)
    thread.start()
    return thread, errors


def protect(peer: UrPeer, driver: UrDriver) -> None:
    peer.change(lambda controller: controller.set_safety_mode(emulated.PROTECTIVE_STOP))
    until(lambda: [fault.code for fault in driver.faults()] == ["protective-stop"])


def holds(peer: UrPeer) -> None:
    """The arm rests for half a second, under the agent's program."""
    peer.wait(lambda controller: controller.at_rest)
    before = peer.joint_positions()
    now_s = peer.controller.time_s
    peer.wait(lambda controller: controller.time_s > now_s + 0.5)
    assert peer.joint_positions() == pytest.approx(before, abs=2e-3)


# ------------------------------------------------------------ recoveries


def test_the_list_names_recoveries_and_permitted_programs(driver: UrDriver) -> None:
    assert [(each.name, each.title, each.recovery) for each in driver.behaviours] == [
        (UNLOCK, "Unlock protective stop", True),
        (CLOSE, "Close safety popup", True),
        (POWER, "Power on", True),
        (BRAKES, "Release brakes", True),
        (PICK, "pick.urp", False),
        (ENDLESS, "endless.urp", False),
        (encode("program", "missing.urp"), "missing.urp", False),
    ]


def test_a_protective_stop_is_unlocked_after_five_seconds_and_nothing_moves(loop: Loop, peer: UrPeer) -> None:
    loop.command = tuple(value + 0.5 for value in HOME)
    peer.wait(lambda controller: max(map(abs, controller.velocity)) > 0.5)
    protect(peer, loop.driver)
    stopped_s = peer.controller.protective_s
    peer.wait(lambda controller: controller.at_rest)
    loop.command = peer.joint_positions()
    before = loop.command
    loop.driver.run_behaviour(UNLOCK, Action())
    assert peer.controller.safety_mode == emulated.NORMAL
    assert peer.controller.time_s - stopped_s >= 5.0
    assert peer.dashboard_commands == ["unlock protective stop"]
    until(lambda: not loop.driver.faults())
    holds(peer)
    assert peer.joint_positions() == pytest.approx(before, abs=2e-3)


def test_the_controller_rejects_an_early_unlock_in_words(peer: UrPeer) -> None:
    peer.change(lambda controller: controller.set_safety_mode(emulated.PROTECTIVE_STOP))
    dashboard = Dashboard("127.0.0.1", peer.dashboard_port)
    with pytest.raises(SkillError, match="rejects 'unlock protective stop': Cannot unlock protective stop until 5s"):
        dashboard.execute("unlock protective stop", accepts="protective stop releasing")


def test_the_end_of_the_action_ends_the_wait_before_unlocking(loop: Loop, peer: UrPeer) -> None:
    protect(peer, loop.driver)
    action = Action()
    thread, errors = start(lambda: loop.driver.run_behaviour(UNLOCK, action))
    action.end.set()
    thread.join()
    assert not errors
    assert not peer.dashboard_commands
    assert peer.controller.safety_mode == emulated.PROTECTIVE_STOP


def test_an_arm_is_switched_on_and_its_brakes_are_released(driver: UrDriver, peer: UrPeer) -> None:
    peer.controller.robot_mode = emulated.POWERED_OFF
    driver.connect()
    driver.run_behaviour(CLOSE, Action())
    driver.run_behaviour(POWER, Action())
    assert peer.controller.robot_mode == emulated.IDLE
    assert [fault.code for fault in driver.faults()] == ["not-running"]
    driver.run_behaviour(BRAKES, Action())
    until(lambda: not driver.faults())
    assert peer.dashboard_commands == ["close safety popup", "power on", "brake release"]
    holds(peer)


def test_a_recovery_without_effect_is_not_reported_as_done(
    driver: UrDriver, peer: UrPeer, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("device_agent.drivers.ur.behaviours._CONFIRM_S", 0.3)
    peer.controller.robot_mode = 8  # it accepts the command and does not execute it
    driver.connect()
    with pytest.raises(SkillError, match="'Power on' had no effect"):
        driver.run_behaviour(POWER, Action())


def test_local_control_and_a_missing_server_are_described(loop: Loop, peer: UrPeer) -> None:
    peer.controller.remote = False
    for name in (CLOSE, PICK):
        with pytest.raises(SkillError, match="select remote control at the robot"):
            loop.run_behaviour(name)
    assert peer.controller.remote is False
    peer.controller.remote = True
    loop.driver.run_behaviour(CLOSE, Action())  # with a connection of its own
    peer.cut()
    with pytest.raises(SkillError, match=r"no response from the dashboard server .* security settings"):
        loop.driver.run_behaviour(CLOSE, Action())
    until(lambda: lost(loop.driver))
    with pytest.raises(SkillError, match="not connected"):
        loop.driver.run_behaviour(POWER, Action())


def lost(driver: UrDriver) -> bool:
    try:
        driver.observe()
    except UnreachableError:
        return True
    return False


# ------------------------------------------------------------ programs


def test_a_program_runs_to_its_end_and_its_pose_is_held_without_a_jump(loop: Loop, peer: UrPeer) -> None:
    started = peer.controller.started_programs
    loop.run_behaviour(PICK)
    assert peer.dashboard_commands == ["stop", "load pick.urp", "play"]
    assert peer.controller.started_programs == started + 2
    assert peer.joint_positions()[0] > HOME[0] + 0.4
    steps: list[float] = []
    peer.controller.each_cycle = lambda controller: steps.append(max(map(abs, controller.velocity)))
    holds(peer)
    assert max(steps) < 0.1
    assert loop.faults == set(), "the missing program of the agent is no fault meanwhile"
    loop.command = HOME
    peer.wait(lambda controller: controller.position == pytest.approx(list(HOME), abs=0.01))


@pytest.mark.parametrize("ending", ["action", "halt", "protective stop", "person"])
def test_a_program_ends_with_its_action(loop: Loop, peer: UrPeer, ending: str) -> None:
    action = Action()
    thread, errors = start(lambda: loop.run_behaviour(ENDLESS, action))
    peer.wait(lambda controller: controller.position[0] > HOME[0] + 0.1)
    if ending == "action":
        action.end.set()
    elif ending == "halt":
        loop.driver.halt()
    elif ending == "protective stop":
        peer.change(lambda controller: controller.set_safety_mode(emulated.PROTECTIVE_STOP))
    else:
        peer.change(emulated.Controller.end_program)
    thread.join()
    assert errors == ([] if ending == "person" else ["the program was stopped before its end"])
    peer.wait(lambda controller: controller.at_rest)
    assert peer.controller.position[0] < HOME[0] + 2.0
    holds(peer)


def test_a_lost_connection_fails_a_program_and_the_next_session_replaces_it(loop: Loop, peer: UrPeer) -> None:
    thread, errors = start(lambda: loop.run_behaviour(ENDLESS))
    peer.wait(lambda controller: controller.position[0] > HOME[0] + 0.1)
    peer.cut()
    thread.join()
    assert errors == ["the connection is lost; the program may still run"]
    peer.restore()
    loop.handed_over = False
    loop.driver.connect()
    loop.command = loop.driver.observe().position_rad
    holds(peer)


def test_a_setpoint_counter_shows_a_program_that_the_agent_is_alive(loop: Loop, peer: UrPeer) -> None:
    action = Action()
    thread, _ = start(lambda: loop.run_behaviour(ENDLESS, action))
    peer.wait(lambda controller: controller.position[0] > HOME[0] + 0.1)
    counter = peer.controller.integer_inputs[25]
    peer.wait(lambda controller: controller.integer_inputs[25] > counter + 10)
    action.end.set()
    thread.join()


def test_unknown_missing_and_unpermitted_programs_fail_and_the_arm_holds(loop: Loop, peer: UrPeer) -> None:
    with pytest.raises(SkillError, match=r"no behaviour 'program-other-_urp'; .*endless\.urp.*agent\.toml"):
        loop.run_behaviour(encode("program", "other.urp"))
    assert not peer.dashboard_commands
    with pytest.raises(SkillError, match=r"rejects 'load missing\.urp': File not found"):
        loop.run_behaviour(encode("program", "missing.urp"))
    holds(peer)
    assert not loop.driver.faults()
    protect(peer, loop.driver)
    with pytest.raises(SkillError, match="protective stop"):
        loop.run_behaviour(PICK)


@pytest.mark.parametrize("programs", ["pick.urp", [1], ["a.urp\npower off"], ["pick.script"], [""]])
def test_wrong_programs_are_rejected(programs: object) -> None:
    with pytest.raises(DriverError, match=r"must be a list of paths that end with \.urp"):
        drivers.load("ur")(TYPE, UR5, {"address": "arm", "programs": programs}, "arm")


# ------------------------------------------------------------ the whole device


def test_an_operator_unlocks_a_protective_stop_while_stop_is_latched(tmp_path: Path, peer: UrPeer) -> None:
    driver = UrDriver(TYPE, UR5, controller_of(peer), "arm")
    harness = DeviceHarness(tmp_path, driver=driver, kind=TYPE)  # type: ignore[arg-type]
    harness.start()
    try:
        controller = harness.device._controller
        peer.change(lambda each: each.set_safety_mode(emulated.PROTECTIVE_STOP))
        eventually(lambda: controller.latch)
        assert harness.failed(RunBehaviour(name=PICK), epoch=1).code == "stopped"
        assert harness.failed(ResetStop(), epoch=2).code == "device_stopped"
        before = peer.joint_positions()
        harness.done(RunBehaviour(name=UNLOCK), epoch=3)
        eventually(lambda: controller.fault is None)
        assert controller.latch is not None
        holds(peer)
        assert peer.joint_positions() == pytest.approx(before, abs=1e-3)
        harness.done(ResetStop(), epoch=4)
        harness.done(RunBehaviour(name=PICK), epoch=5)
        assert peer.joint_positions()[0] > before[0] + 0.4
    finally:
        harness.stop()
