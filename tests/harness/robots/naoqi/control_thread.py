"""The agent's control loop at a NAO, in a thread, and what its robot does."""

import threading
import time
from collections.abc import Callable
from pathlib import Path

from device_agent.drivers.naoqi.driver import NaoqiDriver
from device_agent.ports.driver import REST, DriverError
from device_agent.ports.skills import SkillError
from tests.harness.robots.naoqi.peer import NaoPeer

STILL_RAD_S = 0.02
NEAR_RAD = 0.01
MakeNao = Callable[..., NaoqiDriver]


class Action:
    """The context of a skill or behaviour."""

    def __init__(self) -> None:
        self.end = threading.Event()

    @property
    def ended(self) -> bool:
        return self.end.is_set()

    def wait(self, timeout_s: float) -> bool:
        return self.end.wait(timeout_s)

    def move_joints(self, position_rad: dict[str, float], speed: float) -> None:
        raise NotImplementedError


class ControlThread:
    """The agent's control loop in a thread: it holds the head's command, or adopts what the driver applies."""

    def __init__(self, driver: NaoqiDriver) -> None:
        self.driver = driver
        self.command = list(driver.observe().position_rad)
        self.head = driver._names.index("HeadYaw")
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
                self.sent.append(applied[self.head])

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
        and abs(state["target"]["HeadYaw"] - state["position"]["HeadYaw"]) < NEAR_RAD
        and max(map(abs, state["velocity"].values())) < STILL_RAD_S
    )


def alive(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


def pids(scripts: Path) -> list[str]:
    """Processes of the endless script, and its robot's address."""
    while not ((scripts / "pids").exists() and (scripts / "pids").read_text().count(" ") == 3):
        time.sleep(0.01)
    return (scripts / "pids").read_text().split()
