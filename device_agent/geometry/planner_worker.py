"""The planner process (see ``planner_process``); its standard input is a connection to the agent."""

import os
import queue
import threading
from multiprocessing.connection import Connection

import msgspec

from device_agent.geometry.mujoco_geometry import MujocoGeometry
from device_agent.geometry.planner_process import PlannerScene, PlanRequest, PlanResponse
from device_agent.ports.geometry import GeometryError

_NICE = 10
"""The agent's control loops have priority."""


def main() -> None:
    """Serve plan requests until the agent closes the connection."""
    os.nice(_NICE)
    link = Connection(0)
    plan_queue: queue.SimpleQueue[PlanRequest] = queue.SimpleQueue()
    scene = msgspec.msgpack.decode(_receive(link), type=PlannerScene)
    threading.Thread(target=_listen, args=(link, plan_queue), daemon=True).start()
    geometry, error_text = None, ""
    try:
        geometry = MujocoGeometry(scene.robot_type, scene.scene_path, base_pose=scene.room)
    except GeometryError as error:
        error_text = str(error)
    while True:
        request = plan_queue.get()
        response = PlanResponse(error=error_text) if geometry is None else _respond(geometry, request)
        link.send_bytes(msgspec.msgpack.encode(response))


def _listen(link: Connection, plan_queue: queue.SimpleQueue[PlanRequest]) -> None:
    """Receive plan requests during planning, too, so that the process exits as soon as the agent does."""
    while True:
        plan_queue.put(msgspec.msgpack.decode(_receive(link), type=PlanRequest))


def _receive(link: Connection) -> bytes:
    try:
        return link.recv_bytes()
    except (EOFError, OSError):
        os._exit(0)


def _respond(geometry: MujocoGeometry, request: PlanRequest) -> PlanResponse:
    try:
        corners = geometry.plan_here(request.start_rad, request.goal_rad, seed=request.seed, within_s=request.within_s)
    except GeometryError as error:
        return PlanResponse(error=str(error))
    return PlanResponse(corners_rad=corners)


main()
