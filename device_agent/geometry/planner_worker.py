"""The process that plans for an agent (``planning``): its standard input is a socket to it. Not for people."""

import os
import queue
import socket
import threading

import msgspec

from device_agent.geometry.mujoco_geometry import MujocoGeometry
from device_agent.geometry.planner_process import Answer, Link, Order, Site
from device_agent.ports.geometry import GeometryError

_NICE = 10
"""The agent's control loops go first where there are few cores."""


def main() -> None:
    """Serve until the agent goes."""
    os.nice(_NICE)
    link = Link(socket.socket(fileno=0))
    orders: queue.SimpleQueue[Order] = queue.SimpleQueue()
    site = msgspec.msgpack.decode(_heard(link), type=Site)
    threading.Thread(target=_listen, args=(link, orders), daemon=True).start()
    shape, wrong = None, ""
    try:
        shape = MujocoGeometry(site.robot_type, site.scene_path, standing=site.room)
    except GeometryError as error:
        wrong = str(error)
    while True:
        order = orders.get()
        link.send(Answer(error=wrong) if shape is None else _answer(shape, order))


def _listen(link: Link, orders: queue.SimpleQueue[Order]) -> None:
    """Also while a way is looked for: nobody is left to look for when the agent has gone."""
    while True:
        orders.put(msgspec.msgpack.decode(_heard(link), type=Order))


def _heard(link: Link) -> bytes:
    try:
        heard = link.receive(None)
    except EOFError:
        os._exit(0)
    return heard or b""


def _answer(shape: MujocoGeometry, order: Order) -> Answer:
    try:
        corners = shape.plan_here(order.start_rad, order.goal_rad, seed=order.seed, within_s=order.within_s)
    except GeometryError as error:
        return Answer(error=str(error))
    return Answer(corners_rad=corners)


main()
