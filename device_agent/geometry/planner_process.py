"""Plans in a process of its own: a search keeps the interpreter busy, and control loops of this one must not wait.

It is started when the first plan is asked for and kept, because starting it takes as long as several plans. It is
killed when its work is no longer wanted, and ends by itself when the agent is gone, however that ended: what is
between them is a socket.
"""

import os
import signal
import socket
import subprocess
import sys
import threading
import time
import weakref
from collections.abc import Callable, Sequence
from pathlib import Path

import msgspec

from device_agent.geometry.base_pose import BasePose
from device_agent.ports.geometry import GeometryError, PlannerLostError
from device_agent.protocol.manifests.robot_type import RobotType

_ROOT = Path(__file__).resolve().parents[2]
_LOOK_S = 0.02
"""How often it is asked whether the plan is still wanted."""
_SLOW_S = 30.0
"""For starting and answering, besides the search: no machine that can run an agent takes longer."""
_LENGTH = 4
"""Bytes of a message's length, before it."""
NOBODY = "nobody waits for a way any more"


class Site(msgspec.Struct, frozen=True, kw_only=True):
    """What is to be planned in: the first message to the process.

    Attributes:
        robot_type: Joints, margin.
        scene: MJCF file that holds the robot.
        standing: The room around it, if any: its model, the robot's place [m] and yaw [rad].
    """

    robot_type: RobotType
    scene: str
    standing: tuple[str, tuple[float, float, float], float] | None = None

    @classmethod
    def of(cls, robot_type: RobotType, scene: Path, standing: BasePose | None) -> "Site":
        """As it is handed over."""
        around = None if standing is None else (str(standing.room), standing.position_m, standing.yaw_rad)
        return cls(robot_type=robot_type, scene=str(scene), standing=around)

    @property
    def scene_path(self) -> Path:
        """The scene's file."""
        return Path(self.scene)

    @property
    def room(self) -> BasePose | None:
        """The room, as geometry takes it."""
        if self.standing is None:
            return None
        room, position_m, yaw_rad = self.standing
        return BasePose(room=Path(room), position_m=position_m, yaw_rad=yaw_rad)


class Order(msgspec.Struct, frozen=True, kw_only=True):
    """One plan that is asked for: see ``Geometry.plan``."""

    start_rad: tuple[float, ...]
    goal_rad: tuple[float, ...]
    seed: int
    within_s: float


class Answer(msgspec.Struct, frozen=True, kw_only=True):
    """The corners of a way; where there is none, why."""

    corners_rad: tuple[tuple[float, ...], ...] = ()
    error: str = ""


class Link:
    """Messages over a socket: the length, then MessagePack, which has the infinite numbers that JSON has not."""

    def __init__(self, end: socket.socket) -> None:
        self._socket = end
        self._heard = b""

    def send(self, message: msgspec.Struct) -> None:
        """Send all of it."""
        content = msgspec.msgpack.encode(message)
        self._socket.settimeout(None)
        self._socket.sendall(len(content).to_bytes(_LENGTH, "big") + content)

    def receive(self, timeout_s: float | None) -> bytes | None:
        """The next message; ``None`` when it was not there in time.

        Raises:
            EOFError: The other side has gone.
        """
        self._socket.settimeout(timeout_s)
        while True:
            length = _LENGTH + int.from_bytes(self._heard[:_LENGTH], "big")
            if len(self._heard) >= max(length, _LENGTH + 1):
                content, self._heard = self._heard[_LENGTH:length], self._heard[length:]
                return content
            try:
                heard = self._socket.recv(1 << 16)
            except TimeoutError:
                return None
            except OSError as error:
                raise EOFError from error
            if not heard:
                raise EOFError
            self._heard += heard

    def close(self) -> None:
        """Let go."""
        self._socket.close()


class _Process:
    """The process, while there is one."""

    def __init__(self) -> None:
        self.running: subprocess.Popen[bytes] | None = None
        self.link: Link | None = None

    def begin(self, site: Site) -> Link:
        """Start it unless it runs.

        Raises:
            PlannerLostError: It cannot be started.
        """
        if self.link is not None and self.running is not None and self.running.poll() is None:
            return self.link
        self.end()
        ours, theirs = socket.socketpair()
        with theirs:
            try:
                self.running = subprocess.Popen(
                    [sys.executable, "-m", "device_agent.geometry.planner_worker"],
                    stdin=theirs.fileno(),
                    stdout=subprocess.DEVNULL,
                    env=os.environ | {"PYTHONPATH": str(_ROOT)},
                    start_new_session=True,
                )
            except OSError as error:
                ours.close()
                raise PlannerLostError(f"the program that looks for ways does not start: {error}") from error
        self.link = Link(ours)
        self.link.send(site)
        return self.link

    def end(self) -> int:
        """Kill it, if it runs; gives how it ended."""
        running, link, self.running, self.link = self.running, self.link, None, None
        if link is not None:
            link.close()
        if running is None:
            return 0
        running.kill()
        return running.wait()


class PlanningProcess:
    """Plans for one robot in its scene, elsewhere. Thread-safe: one plan after the other.

    Args:
        site: What to plan in.
    """

    def __init__(self, site: Site) -> None:
        self._site = site
        self._one = threading.Lock()
        self._process = _Process()
        weakref.finalize(self, self._process.end)

    def plan(
        self,
        start_rad: Sequence[float],
        goal_rad: Sequence[float],
        *,
        seed: int,
        within_s: float,
        ended: Callable[[], bool],
    ) -> tuple[tuple[float, ...], ...]:
        """See ``Geometry.plan``."""
        order = Order(start_rad=tuple(start_rad), goal_rad=tuple(goal_rad), seed=seed, within_s=within_s)
        with self._one:
            if ended():
                raise GeometryError(NOBODY)
            try:
                answer = self._ask(order, ended)
            except BaseException:
                self._process.end()
                raise
        if answer.error:
            raise GeometryError(answer.error)
        return answer.corners_rad

    def _ask(self, order: Order, ended: Callable[[], bool]) -> Answer:
        until_s = time.monotonic() + order.within_s + _SLOW_S
        try:
            link = self._process.begin(self._site)
            link.send(order)
            while (heard := link.receive(_LOOK_S)) is None:
                if ended():
                    raise GeometryError(NOBODY)
                if time.monotonic() > until_s:
                    raise PlannerLostError("the program that looks for ways does not answer; try again")
        except (EOFError, OSError) as error:
            how = _how(self._process.end())
            raise PlannerLostError(f"the program that looks for ways has ended ({how}); try again") from error
        return msgspec.msgpack.decode(heard, type=Answer)


def _how(code: int) -> str:
    """How a process ended."""
    return f"signal {signal.Signals(-code).name}" if code < 0 else f"code {code}; see the agent's log"
