"""Robots behind connections that can be cut: the driver, its peer, and a TCP proxy between them."""

import itertools
import math
import os
import signal
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from enum import Enum
from typing import Any, Protocol

from device_agent import drivers
from device_agent.drivers.naoqi.driver import NaoqiDriver
from device_agent.drivers.ros import RosDriver
from device_agent.ports.driver import Driver, DriverError, MobileDriver, Twist
from device_agent.ports.threads import SupervisedThread
from device_agent.protocol.manifests import robot_type as robot_types
from tests.harness.network.proxy import Proxy
from tests.harness.paths import NAOQI_PYTHON, ROBOTS, UR5
from tests.harness.robots.naoqi.peer import NaoPeer
from tests.harness.robots.ros.peer import RosPeer
from tests.harness.robots.ros.ros_system import RosRobot, RosSystem
from tests.harness.robots.universal_robots.peer import UrPeer

ARM = robot_types.load(UR5)
NAO = robot_types.load(ROBOTS / "nao")
_FAST_RAD_S = 2.0
_MAX_RAD_S = max(joint.max_velocity_rad_s for joint in ARM.joints)
_CHECK_S = 0.04
"""Longest time between two checks of the watchdog on a machine that is not busy [s]."""
_UNDERWAY_S = 0.2
_WALK = Twist(forward_m_s=0.05, turn_rad_s=0.1)


class Cut(Enum):
    """What happens to a TCP connection."""

    CLOSED = "closed"
    """It is closed, and new ones are refused."""
    SILENT = "silent"
    """It stays open and everything is lost, as after a cable was pulled."""
    LATE = "late"
    """It stalls. What was sent arrives after the repair."""


class Robot(Protocol):
    """A robot, seen at its peer. Times are those of the peer's clock [s].

    Attributes:
        cuts: What can happen to its connection.
        late_rad: How far it may move when its network delivers late [rad, m].
        period_s: Time between two commands [s].
    """

    cuts: tuple[Cut, ...]
    late_rad: float
    period_s: float

    @property
    def driver(self) -> Driver:
        """The driver, which is not connected at first."""

    def far(self) -> list[float]:
        """A target that takes more than a second, shape (n,) [rad]."""

    def moves(self) -> bool:
        """Whether it moves fast."""

    def now_s(self) -> float:
        """The present time."""

    def moved_s(self) -> float:
        """When it moved last."""

    def place(self) -> list[float]:
        """True positions of the joints [rad], and the pose of the base [m, rad]."""

    def cut(self, cut: Cut) -> float:
        """Cut the connections; returns when."""

    def restore(self, cut: Cut) -> None:
        """Repair the connections."""

    def close(self) -> None:
        """End driver and peer."""


class Operator:
    """Commands a robot as the agent does, until the driver has noticed that it is lost."""

    def __init__(self, robot: Robot) -> None:
        self._robot = robot
        self._target = robot.far()
        self.error: DriverError | None = None
        self._thread = SupervisedThread(self._run, name="operator", part="operator")
        self._thread.start()

    def wait(self, within_s: float = 60.0) -> DriverError:
        """The driver's error."""
        self._thread.join(within_s)
        assert self.error is not None, "the driver does not notice the cut"
        return self.error

    def _run(self) -> None:
        driver = self._robot.driver
        try:
            while True:
                driver.observe()
                driver.send(self._target)
                if isinstance(driver, MobileDriver):
                    driver.drive(_WALK)
                time.sleep(self._robot.period_s)
        except DriverError as error:
            self.error = error


def until(condition: Callable[[], object], within_s: float = 60.0) -> None:
    end_s = time.monotonic() + within_s
    while not condition():
        assert time.monotonic() < end_s
        time.sleep(0.002)


def connect(robot: Robot) -> None:
    """Connect as the agent does."""

    def connects() -> bool:
        with suppress(DriverError):
            robot.driver.connect()
            robot.driver.observe()
            return True
        return False

    until(connects)


def far(position_rad: Sequence[float]) -> list[float]:
    """A target of the arm 1 rad beyond its home position, on the other side of it [rad]."""
    home = [ARM.home_rad[joint.name] for joint in ARM.joints]
    sign = -1.0 if position_rad[0] > home[0] else 1.0
    return [value + sign for value in home]


class _BehindProxies:
    """The part that all robots with a proxy have in common."""

    cuts = tuple(Cut)

    def __init__(self, *ports: int) -> None:
        self._proxies = [Proxy(port) for port in ports]

    def _cut(self, cut: Cut) -> None:
        for proxy in self._proxies:
            if cut is Cut.CLOSED:
                proxy.refuse()
            elif cut is Cut.LATE:
                proxy.freeze()
            else:
                proxy.swallow()
                proxy.refuse()

    def restore(self, cut: Cut) -> None:
        for proxy in self._proxies:
            if cut is Cut.LATE:
                proxy.thaw()
            else:
                proxy.admit()

    def _end(self) -> None:
        for proxy in self._proxies:
            proxy.end()


class _Arm(_BehindProxies):
    """An arm whose peer has a clock of its own."""

    driver: Driver
    peer: Any
    period_s = ARM.period_ms / 1000

    def far(self) -> list[float]:
        return far(self.peer.joint_positions())

    def moves(self) -> bool:
        return bool(max(map(abs, self.peer.joint_velocities())) > _FAST_RAD_S)

    def place(self) -> list[float]:
        return list(self.peer.joint_positions())

    def close(self) -> None:
        self.driver.close()
        self._end()
        self.peer.close()


class RtdeArm(_Arm):
    """A UR5 with its own controller. Its program ends before it executes what arrives late."""

    late_rad = 5e-3

    def __init__(self) -> None:
        self.peer = UrPeer(ARM)
        super().__init__(self.peer.rtde_port, self.peer.script_port)
        rtde, script = self._proxies
        options = {"address": "127.0.0.1", "rtde_port": rtde.port, "script_port": script.port}
        self.driver = drivers.load("ur")(ARM, UR5, options, "arm")
        self._moved_s = 0.0
        self.peer.change(lambda controller: setattr(controller, "each_cycle", self._watch))

    def _watch(self, controller: Any) -> None:
        if not controller.at_rest:
            self._moved_s = controller.time_s

    def now_s(self) -> float:
        return float(self.peer.controller.time_s)

    def moved_s(self) -> float:
        return self._moved_s

    def cut(self, cut: Cut) -> float:
        with self.peer._lock:
            self._cut(cut)
            return self.now_s()


class RosbridgeArm(_Arm):
    """A UR5 with ROS behind rosbridge. Late commands lead the last measurement by at most 0.25 s."""

    late_rad = 0.25 * 1.1 * _MAX_RAD_S

    def __init__(self) -> None:
        self.peer = RosPeer(ARM)
        super().__init__(self.peer.server.port)
        options = {**self.peer.options(), "address": f"127.0.0.1:{self._proxies[0].port}"}
        self.driver = drivers.load("ros")(ARM, UR5, options, "arm")
        self._moved_s = 0.0
        step = self.peer.robot.step

        def watched() -> None:
            step()
            if not self.peer.robot.joints.at_rest:
                self._moved_s = self.now_s()

        self.peer.change(lambda robot, _: setattr(robot, "step", watched))

    def now_s(self) -> float:
        return float(self.peer.robot.joints.time_s)

    def moved_s(self) -> float:
        return self._moved_s

    def cut(self, cut: Cut) -> float:
        with self.peer._lock:
            self._cut(cut)
            return self.now_s()


class RospyArm:
    """A UR5 with ROS 1: the robot is a node, and so is the driver's bridge process, which can be stopped."""

    cuts = tuple(Cut)
    late_rad = RosbridgeArm.late_rad
    period_s = ARM.period_ms / 1000

    def __init__(self, system: RosSystem) -> None:
        self._robot = RosRobot(system, ARM)
        options = {
            "connection": "rospy",
            "master": system.uri,
            "names": {joint.name: f"{joint.name}_joint" for joint in ARM.joints},
            "command": {"topic": "/arm_controller/command"},
        }
        driver = drivers.load("ros")(ARM, UR5, options, "arm")
        assert isinstance(driver, RosDriver)
        self.driver: RosDriver = driver
        self._stopped: int | None = None

    def far(self) -> list[float]:
        return far(self._robot.positions())

    def moves(self) -> bool:
        return bool(max(map(abs, self._robot.state()["velocity"].values())) > _FAST_RAD_S)

    def now_s(self) -> float:
        return float(self._robot.state()["time_s"])

    def moved_s(self) -> float:
        return float(self._robot.state()["moved_s"])

    def place(self) -> list[float]:
        return self._robot.positions()

    def cut(self, cut: Cut) -> float:
        if cut is Cut.CLOSED:
            return float(self._robot.request(cut=True)["cut_s"])
        assert self.driver._connection is not None
        self._stopped = self.driver._connection._channel.process.pid  # type: ignore[attr-defined]
        os.kill(self._stopped, signal.SIGSTOP)
        return self.now_s()

    def restore(self, cut: Cut) -> None:
        if cut is Cut.LATE and self._stopped is not None:
            os.kill(self._stopped, signal.SIGCONT)

    def close(self) -> None:
        self.driver.close()
        self._robot.kill()


class WalkingNao(_BehindProxies):
    """A NAO that walks and moves its head. At most one command of each kind is in its network."""

    late_rad = 0.3
    period_s = NAO.period_ms / 1000

    def __init__(self) -> None:
        self._peer = NaoPeer(NAO, NAOQI_PYTHON)
        super().__init__(int(self._peer.url.rpartition(":")[2]))
        url = f"tcp://127.0.0.1:{self._proxies[0].port}"
        self.driver = NaoqiDriver(NAO, ROBOTS / "nao", url=url, python=str(NAOQI_PYTHON), device="nao")
        self._changed_s, self._is_cut = math.inf, False

    def far(self) -> list[float]:
        target = list(self._peer.joint_positions())
        target[0] = 2.0 if target[0] < 0 else -2.0
        return target

    def moves(self) -> bool:
        state = self._peer.state()
        return bool(any(state["twist"]) and abs(state["velocity"]["HeadYaw"]) > 1.0)

    def now_s(self) -> float:
        return time.monotonic()

    def moved_s(self) -> float:
        """As if the machine was not busy.

        A beat counts as the last one if it reached the robot within 0.2 s of the cut. The time in which the robot's own
        program, the watchdog, was not run is excluded.
        """
        state = self._peer.state()
        rest_s = time.monotonic() if state["rest_s"] is None else float(state["rest_s"])
        checks = [check_s for check_s in state["checks"] if self._changed_s < check_s < rest_s]
        gaps_s = [after - before - _CHECK_S for before, after in itertools.pairwise([self._changed_s, *checks, rest_s])]
        beat_s = min(max(state["inserted_s"] - self._changed_s, 0.0), _UNDERWAY_S) if self._is_cut else 0.0
        return float(rest_s - beat_s - sum(max(gap_s, 0.0) for gap_s in gaps_s))

    def place(self) -> list[float]:
        state = self._peer.state()
        return [*state["position"].values(), *state["pose"]]

    def cut(self, cut: Cut) -> float:
        self._cut(cut)
        self._changed_s, self._is_cut = self.now_s(), True
        return self._changed_s

    def restore(self, cut: Cut) -> None:
        self._changed_s, self._is_cut = self.now_s(), False
        super().restore(cut)

    def close(self) -> None:
        self.driver.close()
        self._end()
        self._peer.close()
