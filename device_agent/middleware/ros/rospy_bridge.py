"""Connects the driver to ROS 1 without rosbridge. Runs as a process of its own, under a Python that has ``rospy``.

It imports nothing of the agent. Its standard input is a socket on which both sides send JSON objects, one a line, with
the operations ``advertise``, ``subscribe``, ``publish`` and ``status`` of the rosbridge protocol. A base brakes when
the agent's side closes, or when no velocity follows for ``WATCHDOG_S``. The process ends when the ROS master ends or
is replaced, because the new master does not know its topics.
"""

from __future__ import annotations

import base64
import importlib
import json
import math
import os
import signal
import socket
import sys
import threading
import time
import urllib.parse
import xmlrpc.client  # nosec B411 (only the configured master is called, as rospy itself does)
from typing import Any

WATCHDOG_S = 0.3
"""Longest time between two velocities of a base [s]."""
_CHECK_S = 0.05
_MASTER_S = 0.5
_SUBSCRIBER_S = 3.0
"""Time until a topic has a subscriber after its first message [s]."""
_MASTER_TIMEOUT_S = 2.0
_BRAKE_S = 0.1
_MAX_LINE = 1 << 20
_VELOCITIES = ("geometry_msgs/Twist", "geometry_msgs/TwistStamped")


class Bridge:
    """Executes the operations of the agent, and forwards messages.

    Args:
        link: Socket to the agent.
        rospy: The library. It is imported after its folders are known.
        genpy: The library of its messages.
        needs_subscribers: Whether the process ends when a topic that it publishes has no subscriber.
    """

    def __init__(self, link: socket.socket, rospy: Any, genpy: Any, *, needs_subscribers: bool) -> None:
        self._link = link
        self._rospy = rospy
        self._genpy = genpy
        self._needs_subscribers = needs_subscribers
        self._sending = threading.Lock()
        self._publishers: dict[str, Any] = {}
        self._subscribed: set[str] = set()
        self._first_s: dict[str, float] = {}
        self._driven_s: dict[str, float] = {}
        self._forwarded_s: dict[str, float] = {}

    def run(self) -> None:
        """Execute operations until the agent's side closes; then brake."""
        threading.Thread(target=self._watch, daemon=True).start()
        lines = self._link.makefile("rb")
        for line in iter(lambda: lines.readline(_MAX_LINE), b""):
            try:
                self._execute(json.loads(line))
            except Exception as error:  # noqa: BLE001 (every error of the library is shown to operators)
                self.report("error", f"{type(error).__name__}: {error}")
        self._brake(newest_s=math.inf)
        time.sleep(_BRAKE_S)

    def report(self, level: str, text: str) -> None:
        """Send a status message."""
        self._send({"op": "status", "level": level, "msg": text})

    def _execute(self, request: dict[str, Any]) -> None:
        operation, topic = request["op"], request["topic"]
        if operation == "publish":
            self._publish(topic, request["msg"])
        elif operation == "advertise":
            kind = message_class(request["type"])
            self._publishers[topic] = self._rospy.Publisher(topic, kind, queue_size=1, tcp_nodelay=True)
        elif operation == "subscribe":
            kind, period_s = message_class(request["type"]), request.get("throttle_rate", 0) / 1000
            self._rospy.Subscriber(topic, kind, self._forward, (topic, period_s), queue_size=10, tcp_nodelay=True)

    def _publish(self, topic: str, values: dict[str, Any]) -> None:
        publisher = self._publishers[topic]
        message = publisher.data_class()
        self._genpy.message.fill_message_args(message, [values])
        if "header" in message.__slots__ and "header" not in values:
            message.header.stamp = self._rospy.Time.now()
        self._first_s.setdefault(topic, time.monotonic())
        if publisher.type in _VELOCITIES:
            self._driven_s[topic] = time.monotonic()
        publisher.publish(message)

    def _forward(self, message: Any, subscription: tuple[str, float]) -> None:
        topic, period_s = subscription
        now_s = time.monotonic()
        if now_s - self._forwarded_s.get(topic, -math.inf) < period_s:
            return
        self._forwarded_s[topic] = now_s
        self._send({"op": "publish", "topic": topic, "msg": to_json(message, self._genpy)})

    def _send(self, message: dict[str, Any]) -> None:
        data = json.dumps(message, allow_nan=False).encode() + b"\n"
        try:
            with self._sending:
                self._link.sendall(data)
        except OSError:
            return  # the main thread notices it too

    def _watch(self) -> None:
        while True:
            time.sleep(_CHECK_S)
            self._brake(newest_s=time.monotonic() - WATCHDOG_S)
            if self._needs_subscribers:
                self._check_subscribers()

    def _check_subscribers(self) -> None:
        for topic, publisher in list(self._publishers.items()):
            if publisher.get_num_connections():
                self._subscribed.add(topic)
            elif topic in self._subscribed or self._is_unheard(topic):
                self.report("error", f"{topic} has no subscriber; check the robot's controllers")
                os._exit(1)

    def _is_unheard(self, topic: str) -> bool:
        """Whether no subscriber has connected since the first message. ``rospy`` does not try again."""
        return time.monotonic() - self._first_s.get(topic, math.inf) > _SUBSCRIBER_S

    def _brake(self, *, newest_s: float) -> None:
        """Publish zero on each topic whose last velocity is older than this time [s]."""
        for topic, driven_s in list(self._driven_s.items()):
            if driven_s < newest_s:
                self._publish(topic, {})
                self._driven_s.pop(topic, None)


class _Transport(xmlrpc.client.Transport):
    """Calls of the master that end in time."""

    def make_connection(self, host: Any) -> Any:
        connection = super().make_connection(host)
        connection.timeout = _MASTER_TIMEOUT_S
        return connection


def master_id(address: str) -> int:
    """Process id of the ROS master. Raises ``OSError`` or ``xmlrpc.client.Error`` if it does not answer."""
    with xmlrpc.client.ServerProxy(address, transport=_Transport()) as proxy:
        answer: Any = proxy.getPid("/telescope")
    return int(answer[2])


def message_class(name: str) -> Any:
    """The class of a message type. Raises ``ImportError`` or ``AttributeError``: its package is not installed."""
    package, _, message = name.partition("/")
    return getattr(importlib.import_module(package + ".msg"), message)


def to_json(value: Any, genpy: Any) -> Any:
    """A message as rosbridge writes it: binary data as Base64, values that are not finite as null."""
    if isinstance(value, genpy.Message):
        return {field: to_json(getattr(value, field), genpy) for field in value.__slots__}
    if isinstance(value, genpy.rostime.TVal):
        return {"secs": value.secs, "nsecs": value.nsecs}
    if isinstance(value, bytes):
        return base64.b64encode(value).decode("ascii")
    if isinstance(value, (list, tuple)):
        return [to_json(each, genpy) for each in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def watch_master(bridge: Bridge, address: str, first: int) -> None:
    """End the process when the master ends or is replaced."""
    while True:
        time.sleep(_MASTER_S)
        try:
            if master_id(address) == first:
                continue
            text = "the ROS master was replaced"
        except (OSError, xmlrpc.client.Error) as error:
            text = f"the ROS master does not answer: {error}"
        bridge.report("error", text)
        os._exit(1)


def main() -> None:
    """Arguments: name of the node, address of the master, needs_subscribers, folders of ROS's Python packages.

    ``needs_subscribers`` is empty if topics may have no subscriber.
    """
    name, master, needs_subscribers, *folders = sys.argv[1:]
    sys.path[:0] = folders
    link = socket.socket(fileno=os.dup(0))

    def fail(text: str) -> None:
        link.sendall(json.dumps({"op": "status", "level": "error", "msg": text}).encode() + b"\n")
        os._exit(1)

    os.environ["ROS_MASTER_URI"] = master
    try:
        first = master_id(master)
    except (OSError, xmlrpc.client.Error) as error:
        host = urllib.parse.urlsplit(master).netloc
        fail(f"no ROS master at {host}: {error}; is roscore running?")
    try:
        rospy, genpy = importlib.import_module("rospy"), importlib.import_module("genpy")
        importlib.import_module("genpy.message")
        rospy.init_node(name, anonymous=True, disable_signals=True)
    except Exception as error:  # noqa: BLE001 (as above)
        fail(f"rospy cannot be used: {type(error).__name__}: {error}")
    bridge = Bridge(link, rospy, genpy, needs_subscribers=bool(needs_subscribers))
    threading.Thread(target=watch_master, args=(bridge, master, first), daemon=True).start()
    bridge.report("none", "ready")
    bridge.run()
    rospy.signal_shutdown("the agent has closed the connection")


if __name__ == "__main__":
    for ending in (signal.SIGTERM, signal.SIGINT, signal.SIGHUP):
        signal.signal(ending, signal.SIG_IGN)  # it ends after the agent, when the base brakes
    main()
    os._exit(0)  # threads of the library may hang
