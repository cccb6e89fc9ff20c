"""Client of the planner process: planning holds the interpreter lock, which would delay the control loops.

The process starts with the first request and keeps running, because starting it takes as long as several plans. The
client kills it when a request is cancelled. It exits when the connection to the agent closes. Messages are
MessagePack, which unlike JSON can encode infinities.
"""

import os
import signal
import subprocess
import sys
import threading
import time
import weakref
from collections.abc import Callable, Sequence
from multiprocessing import Pipe
from multiprocessing.connection import Connection
from pathlib import Path

import msgspec

from device_agent.geometry.base_pose import BasePose
from device_agent.ports.geometry import GeometryError, PlannerLostError
from device_agent.protocol.manifests.robot_type import RobotType

_ROOT = Path(__file__).resolve().parents[2]
_POLL_S = 0.02
"""Interval at which cancellation is checked."""
_STARTUP_S = 30.0
"""Time for start-up and response, in addition to the planning time."""
CANCELLED = "the plan was cancelled"


class PlannerScene(msgspec.Struct, frozen=True, kw_only=True):
    """The scene to plan in: the first message to the process.

    Attributes:
        robot_type: Joints, margin.
        scene: MJCF file that contains the robot.
        base_pose: The room around it, if any: its model, the robot's position [m] and yaw [rad].
    """

    robot_type: RobotType
    scene: str
    base_pose: tuple[str, tuple[float, float, float], float] | None = None

    @classmethod
    def of(cls, robot_type: RobotType, scene: Path, base_pose: BasePose | None) -> "PlannerScene":
        """The scene in serializable form."""
        around = None if base_pose is None else (str(base_pose.room), base_pose.position_m, base_pose.yaw_rad)
        return cls(robot_type=robot_type, scene=str(scene), base_pose=around)

    @property
    def scene_path(self) -> Path:
        """The scene file."""
        return Path(self.scene)

    @property
    def room(self) -> BasePose | None:
        """The room as a ``BasePose``."""
        if self.base_pose is None:
            return None
        room, position_m, yaw_rad = self.base_pose
        return BasePose(room=Path(room), position_m=position_m, yaw_rad=yaw_rad)


class PlanRequest(msgspec.Struct, frozen=True, kw_only=True):
    """One planning request, see ``RobotGeometry.plan``."""

    start_rad: tuple[float, ...]
    goal_rad: tuple[float, ...]
    seed: int
    within_s: float


class PlanResponse(msgspec.Struct, frozen=True, kw_only=True):
    """The corners of a path, or the reason for the failure."""

    corners_rad: tuple[tuple[float, ...], ...] = ()
    error: str = ""


class _Process:
    """The planner process, if it runs."""

    def __init__(self) -> None:
        self.running: subprocess.Popen[bytes] | None = None
        self.link: Connection | None = None

    def start(self, scene: PlannerScene) -> Connection:
        """Start the process unless it runs.

        Raises:
            PlannerLostError: It cannot be started.
        """
        if self.link is not None and self.running is not None and self.running.poll() is None:
            return self.link
        self.stop()
        own_end, child_end = Pipe()
        with child_end:
            try:
                self.running = subprocess.Popen(
                    [sys.executable, "-m", "device_agent.geometry.planner_worker"],
                    stdin=child_end.fileno(),
                    stdout=subprocess.DEVNULL,
                    env=os.environ | {"PYTHONPATH": str(_ROOT)},
                    start_new_session=True,
                )
            except OSError as error:
                own_end.close()
                raise PlannerLostError(f"the planner process does not start: {error}") from error
        self.link = own_end
        own_end.send_bytes(msgspec.msgpack.encode(scene))
        return own_end

    def stop(self) -> int:
        """Kill the process if it runs; returns its exit code."""
        running, link, self.running, self.link = self.running, self.link, None, None
        if link is not None:
            link.close()
        if running is None:
            return 0
        running.kill()
        return running.wait()


class PlannerProcess:
    """Plans for one robot in its scene. Thread-safe; requests run one after the other.

    Args:
        scene: The scene.
    """

    def __init__(self, scene: PlannerScene) -> None:
        self._scene = scene
        self._lock = threading.Lock()
        self._process = _Process()
        weakref.finalize(self, self._process.stop)

    def plan(
        self,
        start_rad: Sequence[float],
        goal_rad: Sequence[float],
        *,
        seed: int,
        within_s: float,
        ended: Callable[[], bool],
    ) -> tuple[tuple[float, ...], ...]:
        """See ``RobotGeometry.plan``."""
        request = PlanRequest(start_rad=tuple(start_rad), goal_rad=tuple(goal_rad), seed=seed, within_s=within_s)
        with self._lock:
            if ended():
                raise GeometryError(CANCELLED)
            try:
                response = self._request(request, ended)
            except BaseException:
                self._process.stop()
                raise
        if response.error:
            raise GeometryError(response.error)
        return response.corners_rad

    def _request(self, request: PlanRequest, ended: Callable[[], bool]) -> PlanResponse:
        until_s = time.monotonic() + request.within_s + _STARTUP_S
        try:
            link = self._process.start(self._scene)
            link.send_bytes(msgspec.msgpack.encode(request))
            while not link.poll(_POLL_S):
                if ended():
                    raise GeometryError(CANCELLED)
                if time.monotonic() > until_s:
                    raise PlannerLostError("the planner process does not respond; try again")
            return msgspec.msgpack.decode(link.recv_bytes(), type=PlanResponse)
        except (EOFError, OSError) as error:
            reason = _exit_reason(self._process.stop())
            raise PlannerLostError(f"the planner process has ended ({reason}); try again") from error


def _exit_reason(code: int) -> str:
    return f"signal {signal.Signals(-code).name}" if code < 0 else f"code {code}; see the agent's log"
