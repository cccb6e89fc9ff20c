"""Lateness of control loops during motion planning.

``python -m benchmarks.agent.planning [SECONDS]`` runs the control loops of the four laboratory robots in one process
with their controllers and geometry. A fifth thread plans paths of the arm around a post, as an action does. It prints
the lateness without and with planning, the planning time and the memory of the planner process.
"""

import argparse
import os
import threading
import time
from pathlib import Path

import mujoco

from benchmarks.reporting.report import percentile
from device_agent.geometry.mujoco_geometry import MujocoGeometry
from device_agent.protocol.manifests import robot_type
from device_agent.protocol.manifests.robot_type import RobotType
from device_agent.runtime.authority.lease_gate import LeaseGate
from device_agent.runtime.control.controller import Controller
from device_agent.runtime.planning.motion_planner import MotionPlanner

ROBOTS = Path(__file__).resolve().parents[2] / "robots"
NAMES = ("ur5", "nao", "qbo", "hanson")
POST_SIZE_M, POST_M = (0.04, 0.35, 0.0), (-0.249, -0.414, 0.35)
TARGET_RAD = 1.6
"""Target of the arm's first joint [rad]; the post is halfway."""
_SHARES = (0.5, 0.95, 0.99, 1.0)


class Loop:
    """Control loop of one robot without a driver; records when each period runs and how long it takes."""

    def __init__(self, kind: RobotType, shape: MujocoGeometry, stopping: threading.Event) -> None:
        self._kind = kind
        self._stopping = stopping
        self._controller = Controller(kind, LeaseGate(), geometry=shape)
        home = [kind.home_rad[joint.name] for joint in kind.joints]
        self._controller.start_at(home)
        self._tenure = self._controller.reserve(epoch=1, on_revoked=lambda _: None)
        self._ends = home, [rad + 0.2 * (joint.upper_rad - rad) for rad, joint in zip(home, kind.joints, strict=True)]
        self.late_s: list[float] = []
        self.thread = threading.Thread(target=self._run, daemon=True)

    def _run(self) -> None:
        period_s, joint = self._kind.period_ms / 1000, self._kind.joints[0].name
        due_s, turn, move = time.monotonic(), 0, None
        while not self._stopping.is_set():
            now_s = time.monotonic()
            self.late_s.append(max(0.0, now_s - due_s))
            if move is None or move.finished.is_set():
                turn += 1
                move = self._controller.start_joint_goal(self._tenure, {joint: self._ends[turn % 2][0]}, speed=0.3)
            self._controller.update(now_s)
            due_s = max(due_s + period_s, time.monotonic() - period_s)
            time.sleep(max(0.0, due_s - time.monotonic()))


def scene(folder: Path) -> Path:
    """Writes a scene of the arm's table with a post and returns its path."""
    kind = robot_type.load(folder)
    spec = mujoco.MjSpec.from_file(str(folder / kind.scene))
    spec.worldbody.add_geom(name="post", type=mujoco.mjtGeom.mjGEOM_CYLINDER, size=POST_SIZE_M, pos=POST_M)
    path = folder / f".post-{os.getpid()}.xml"
    path.write_text(spec.to_xml(), encoding="utf-8")
    return path


def measure(for_s: float, *, planning: bool) -> None:
    """Runs the loops for a time and prints the result."""
    stopping = threading.Event()
    loops = {}
    for name in NAMES:
        kind = robot_type.load(ROBOTS / name)
        loops[name] = Loop(kind, MujocoGeometry(kind, ROBOTS / name / kind.scene), stopping)
    kind = robot_type.load(ROBOTS / "ur5")
    path = scene(ROBOTS / "ur5")
    try:
        shape = MujocoGeometry(kind, path)
        home = [kind.home_rad[joint.name] for joint in kind.joints]
        durations_s: list[float] = []
        if planning:  # the first plan starts the planner process
            MotionPlanner(kind, shape).plan(home, [TARGET_RAD, *home[1:]], speed=1.0, ended=stopping.is_set)
        for loop in loops.values():
            loop.thread.start()
        started_s, seed = time.monotonic(), 0
        while (now_s := time.monotonic()) - started_s < for_s:
            if not planning:
                time.sleep(0.1)
                continue
            seed += 1
            MotionPlanner(kind, shape, seed=seed).plan(home, [TARGET_RAD, *home[1:]], speed=1.0, ended=stopping.is_set)
            durations_s.append(time.monotonic() - now_s)
            time.sleep(0.2)
        stopping.set()
    finally:
        path.unlink()
    for loop in loops.values():
        loop.thread.join()
    print("with planning" if planning else "without planning")
    for name, loop in loops.items():
        late_ms = " ".join(f"{percentile(loop.late_s, share) * 1000:8.2f}" for share in _SHARES)
        print(f"  {name:8} {len(loop.late_s):6} periods, late p50, p95, p99, max ms {late_ms}")
    if durations_s:
        p50_ms, max_ms = percentile(durations_s, 0.5) * 1000, max(durations_s) * 1000
        print(f"  {len(durations_s)} plans, p50 {p50_ms:.0f} ms, max {max_ms:.0f} ms")
        print(f"  memory of the planner process: {_planner_mb():.0f} MB")


def _planner_mb() -> float:
    """Returns the resident memory of the child processes [MB]."""
    total = 0.0
    for task in Path("/proc/self/task").iterdir():
        for child in (task / "children").read_text(encoding="ascii").split():
            status = Path(f"/proc/{child}/status").read_text(encoding="ascii")
            total += float(status.partition("VmRSS:")[2].split()[0]) / 1024
    return total


def main() -> None:
    """Runs the command line."""
    parser = argparse.ArgumentParser(description="Lateness of control loops during motion planning.")
    parser.add_argument("seconds", type=float, nargs="?", default=30.0)
    seconds = parser.parse_args().seconds
    for planning in (False, True):
        measure(seconds, planning=planning)


if __name__ == "__main__":
    main()
