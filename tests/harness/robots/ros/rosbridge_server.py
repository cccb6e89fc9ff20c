"""rosbridge server, protocol version 2, on one thread: WebSocket without the library's own connections."""

import contextlib
import json
import math
import socket
from collections.abc import Callable, Mapping
from typing import Any

from websockets.exceptions import InvalidState
from websockets.frames import Frame
from websockets.http11 import Request
from websockets.server import ServerProtocol

from tests.harness.network.ports import free_port
from tests.harness.robots.ros import definitions

Receive = Callable[[str, Mapping[str, Any]], None]
ReceiveGoal = Callable[[str, Mapping[str, Any] | None], None]
_GOAL = "control_msgs/FollowJointTrajectoryGoal"


class RosbridgeServer:
    """The server. ``step`` accepts clients and processes their messages.

    Args:
        types: Topic → type, of all topics that the robot publishes or subscribes to.
        receive: Called with each valid message that a client publishes.
        ros: Version of ROS.
        receive_goal: Called with the id of a goal of ROS 2, and the goal; ``None``: it is cancelled.

    Attributes:
        latched: Topic → message that each new subscriber receives.
        actions: Action → type, of the action servers of ROS 2.
        errors: Messages of the clients that were rejected.
    """

    def __init__(self, types: Mapping[str, str], receive: Receive, ros: int, receive_goal: ReceiveGoal) -> None:
        self.types = types
        self._receive = receive
        self._ros = ros
        self._receive_goal = receive_goal
        self._clients: list[_Client] = []
        self.port = free_port()
        self._server = _listen(self.port)
        self.latched: dict[str, Any] = {}
        self.actions: dict[str, str] = {}
        self.errors: list[str] = []

    def step(self) -> None:
        """Process what has arrived."""
        with contextlib.suppress(OSError):
            opened, _ = self._server.accept()
            self._clients.append(_Client(opened))
        for client in self._clients:
            for text in client.receive():
                try:
                    self._process(client, json.loads(text))
                except (definitions.FieldError, LookupError, TypeError, AttributeError) as error:
                    self.errors.append(repr(error))
                    client.send_text(json.dumps({"op": "status", "level": "error", "msg": repr(error)}).encode())

    def publish(self, topic: str, message: Any, corrupt: Callable[[bytes], bytes | None] = lambda data: data) -> None:
        """Send a message to the subscribers of a topic. Values that are not finite become ``null``.

        Args:
            topic: The topic.
            message: The message.
            corrupt: Changes the data; ``None``: nothing is sent.
        """
        data = corrupt(json.dumps({"op": "publish", "topic": topic, "msg": _finite(message)}).encode())
        for client in self._clients:
            if topic in client.subscribed and data is not None:
                with contextlib.suppress(InvalidState):  # the client has closed it
                    client.send(data)

    def send_result(self, result: Mapping[str, Any]) -> None:
        """Send the end of a goal of ROS 2 to the client that has sent the goal."""
        for client in self._clients:
            if result["id"] in client.goals:
                client.goals.discard(result["id"])
                with contextlib.suppress(InvalidState):
                    client.send(json.dumps({"op": "action_result", **result}).encode())

    def subscribers(self, topic: str) -> int:
        """Number of subscribers of a topic."""
        return sum(topic in client.subscribed for client in self._clients)

    def send_bytes(self, data: bytes) -> None:
        """Send bytes that are no frame to all clients."""
        for client in self._clients:
            client.write(data)

    def stop(self) -> None:
        """Close all connections, and refuse new ones."""
        self._server.close()
        for client in self._clients:
            client.close()
        self._clients = []

    def restart(self) -> None:
        """Accept connections again."""
        self._server = _listen(self.port)

    def _process(self, client: "_Client", message: Mapping[str, Any]) -> None:
        if self._ros == 2 and message["op"] in {"send_action_goal", "cancel_action_goal"}:
            self._process_goal(client, message)
            return
        operation, topic = message["op"], message["topic"]
        if operation in {"advertise", "subscribe"} and message["type"] != self.types[topic]:
            raise definitions.FieldError(f"{topic} has the type {self.types[topic]}, not {message['type']}")
        if operation == "advertise":
            client.advertised.add(topic)
        elif operation == "subscribe":
            client.subscribed.add(topic)
            if topic in self.latched:
                client.send(json.dumps({"op": "publish", "topic": topic, "msg": self.latched[topic]}).encode())
        elif operation == "publish" and topic in client.advertised:
            definitions.check(message["msg"], self.types[topic].replace("/msg/", "/"), self._ros)
            self._receive(topic, message["msg"])
        else:
            raise LookupError(f"{operation} {topic}")

    def _process_goal(self, client: "_Client", message: Mapping[str, Any]) -> None:
        number = message["id"]
        if message["op"] == "cancel_action_goal":
            if number in client.goals:
                self._receive_goal(number, None)
        elif message["action"] not in self.actions:
            text = "no action server"
            failed = {"action": message["action"], "id": number, "values": text, "status": 0, "result": False}
            client.send(json.dumps({"op": "action_result", **failed}).encode())
        elif message["action_type"] != self.actions[message["action"]]:
            raise definitions.FieldError(f"{message['action']} has another type than {message['action_type']}")
        else:
            definitions.check(message["args"], _GOAL, self._ros)
            client.goals.add(number)
            self._receive_goal(number, message["args"])


class _Client:
    def __init__(self, opened: socket.socket) -> None:
        opened.setblocking(False)
        self._socket = opened
        self._protocol = ServerProtocol()
        self.subscribed: set[str] = set()
        self.advertised: set[str] = set()
        self.goals: set[str] = set()

    def receive(self) -> list[bytes]:
        try:
            data = self._socket.recv(65536)
        except OSError:
            return []
        if not data:
            self.subscribed = set()
            return []
        self._protocol.receive_data(data)
        texts = []
        for event in self._protocol.events_received():
            if isinstance(event, Request):
                self._protocol.send_response(self._protocol.accept(event))
            elif isinstance(event, Frame) and event.opcode.name == "TEXT":
                texts.append(bytes(event.data))
        self._flush()
        return texts

    def send(self, data: bytes) -> None:
        """Text, or binary data if it is no text."""
        if data.isascii():
            self.send_text(data)
        else:
            self._protocol.send_binary(data)
            self._flush()

    def send_text(self, data: bytes) -> None:
        self._protocol.send_text(data)
        self._flush()

    def write(self, data: bytes) -> None:
        with contextlib.suppress(OSError):
            self._socket.send(data)

    def close(self) -> None:
        self._socket.close()

    def _flush(self) -> None:
        for data in self._protocol.data_to_send():
            self.write(data)


def _listen(port: int) -> socket.socket:
    server = socket.create_server(("127.0.0.1", port))
    server.setblocking(False)
    return server


def _finite(value: Any) -> Any:
    if isinstance(value, float) and not math.isfinite(value):
        return None
    if isinstance(value, list | tuple):
        return [_finite(each) for each in value]
    if isinstance(value, dict):
        return {name: _finite(each) for name, each in value.items()}
    return value
