"""Emulator of the template's device, for tests. It speaks the device's protocol over a real connection."""

import contextlib
import json
import math
import socket
import threading
import time
from collections.abc import Mapping
from typing import Any

from device_agent.drivers.testing.peer import Disturbance
from device_agent.ports.driver import REST, Twist
from device_agent.ports.threads import SupervisedThread
from device_agent.protocol.manifests.robot_type import RobotType

_PERIOD_S = 0.005
_SPEED_RAD_S = 2.0
_BROKEN = {Disturbance.GARBAGE: b"\x00\xffgarbage\n", Disturbance.TRUNCATED: b'{"time_s": 1e9, "names": ["a\n'}


class TemplatePeer:
    """The device. Joints move at a constant speed; the base keeps its velocity until the next command.

    Args:
        robot_type: Joints, which start at their home positions.
    """

    def __init__(self, robot_type: RobotType) -> None:
        self._names = [joint.name for joint in robot_type.joints]
        self._lock = threading.Lock()
        self._position = dict(robot_type.home_rad)
        self._target = dict(robot_type.home_rad)
        self._velocity = dict.fromkeys(self._names, 0.0)
        self._twist = REST
        self._disturbance: Disturbance | None = None
        self._old_time_s = 0.0
        self._stopping = threading.Event()
        self._clients: list[socket.socket] = []
        self._server = self._listen(0)
        self.address: tuple[str, int] = self._server.getsockname()
        self._thread = SupervisedThread(self._run, name="peer", part="peer", stopping=self._stopping)
        self._thread.start()

    def joint_positions(self) -> tuple[float, ...]:
        """See ``Peer``."""
        with self._lock:
            return tuple(self._position[name] for name in self._names)

    def joint_velocities(self) -> tuple[float, ...]:
        """See ``Peer``."""
        with self._lock:
            return tuple(self._velocity[name] for name in self._names)

    def base_twist(self) -> Twist:
        """See ``Peer``."""
        return self._twist

    def disturb(self, disturbance: Disturbance) -> None:
        """See ``Peer``."""
        with self._lock:
            self._old_time_s = time.monotonic()
            self._disturbance = disturbance
            if disturbance is Disturbance.SAFETY:
                self._hold()
            if disturbance is Disturbance.CONNECTION:
                self._hold()
                self._server.close()
                self._disconnect()

    def restore(self) -> None:
        """See ``Peer``."""
        with self._lock:
            if self._disturbance is Disturbance.CONNECTION:
                self._server = self._listen(self.address[1])
            self._disturbance = None

    def close(self) -> None:
        """Switch the device off."""
        self._stopping.set()
        self._thread.join()
        with self._lock:
            self._server.close()
            self._disconnect()

    def _listen(self, port: int) -> socket.socket:
        server = socket.create_server(("127.0.0.1", port))
        server.setblocking(False)
        return server

    def _disconnect(self) -> None:
        for client in self._clients:
            client.close()
        self._clients = []

    def _hold(self) -> None:
        self._target, self._twist = dict(self._position), REST

    def _run(self) -> None:
        received: dict[socket.socket, bytes] = {}
        while not self._stopping.wait(_PERIOD_S):
            with self._lock:
                with contextlib.suppress(OSError):
                    client, _ = self._server.accept()
                    client.setblocking(False)
                    self._clients.append(client)
                for client in self._clients:
                    with contextlib.suppress(OSError):
                        *lines, received[client] = (received.get(client, b"") + client.recv(65536)).split(b"\n")
                        for line in lines:
                            self._accept(json.loads(line))
                self._move()
                self._send()

    def _accept(self, message: Mapping[str, Any]) -> None:
        if self._disturbance is Disturbance.SAFETY:
            return
        if "hold" in message:
            self._target = dict(self._position)
        if "names" in message:
            self._target = dict(zip(message["names"], map(math.radians, message["position_deg"]), strict=True))
        if "velocity" in message:
            self._twist = Twist(*message["velocity"])

    def _move(self) -> None:
        for name, target in self._target.items():
            step = _SPEED_RAD_S * _PERIOD_S
            change = min(max(target - self._position[name], -step), step)
            self._position[name] += change
            self._velocity[name] = change / _PERIOD_S

    def _send(self) -> None:
        kind = self._disturbance
        if kind is Disturbance.SILENCE:
            return
        names = self._names[::-1] if kind is Disturbance.ORDER else self._names
        position_deg = [math.degrees(self._position[name]) for name in names]
        message = {
            "time_s": self._old_time_s if kind is Disturbance.CLOCK else time.monotonic(),
            "names": names,
            "position_deg": [math.nan] * len(names) if kind is Disturbance.NAN else position_deg,
            "velocity_deg_s": [math.degrees(self._velocity[name]) for name in names],
            "effort_nm": [0.0] * len(names),
            "safety": "protective stop" if kind is Disturbance.SAFETY else "normal",
        }
        payload = _BROKEN.get(kind) if kind else None
        for client in self._clients:
            with contextlib.suppress(OSError):
                client.send(payload or json.dumps(message).encode() + b"\n")
