"""The emulated controller on loopback: RTDE, secondary interface and dashboard on free ports, run by one thread."""

import contextlib
import socket
import threading
import time
from collections.abc import Callable

from device_agent.drivers.testing.peer import Disturbance
from device_agent.drivers.ur.driver import ORDER
from device_agent.ports.driver import REST, Twist
from device_agent.ports.threads import SupervisedThread
from device_agent.protocol.manifests.robot_type import RobotType
from tests.harness.network.ports import free_port
from tests.harness.robots.universal_robots.controller import CYCLE_S, NORMAL, PROTECTIVE_STOP, Controller
from tests.harness.robots.universal_robots.dashboard_server import GREETING, DashboardSession
from tests.harness.robots.universal_robots.rtde_server import RtdeServer, RtdeSession

_WAIT_S = 60.0
_STATE = b"\x00\x00\x00\x05\x10"
"""The secondary interface sends states that the driver does not read."""


class UrPeer:
    """The device of the driver contract. See ``Peer``."""

    def __init__(self, robot_type: RobotType) -> None:
        self._order = [ORDER.index(joint.name) for joint in robot_type.joints]
        self._lock = threading.Lock()
        self.controller = Controller([robot_type.home_rad[name] for name in ORDER])
        self.rtde = RtdeServer(self.controller)
        self._disturbance: Disturbance | None = None
        self._rtde_clients: dict[socket.socket, RtdeSession] = {}
        self._script_clients: dict[socket.socket, bytes] = {}
        self._dashboard_clients: dict[socket.socket, DashboardSession] = {}
        self.dashboard_commands: list[str] = []
        self._servers = [self._listen(free_port()) for _ in range(3)]
        self.rtde_port, self.script_port, self.dashboard_port = (server.getsockname()[1] for server in self._servers)
        self._stopping = threading.Event()
        self._thread = SupervisedThread(self._run, name="peer", part="peer", stopping=self._stopping)
        self._thread.start()

    def joint_positions(self) -> tuple[float, ...]:
        """See ``Peer``."""
        with self._lock:
            return tuple(self.controller.position[index] for index in self._order)

    def joint_velocities(self) -> tuple[float, ...]:
        """See ``Peer``."""
        with self._lock:
            return tuple(self.controller.velocity[index] for index in self._order)

    def base_twist(self) -> Twist:
        """See ``Peer``."""
        return REST

    def disturb(self, disturbance: Disturbance) -> None:
        """See ``Peer``. Returns when the arm has braked: its program needs time to notice a lost connection."""
        with self._lock:
            self._disturbance = disturbance
            if disturbance is Disturbance.SAFETY:
                self.controller.set_safety_mode(PROTECTIVE_STOP)
            if disturbance is Disturbance.CONNECTION:
                self._disconnect()
        if disturbance in {Disturbance.SAFETY, Disturbance.CONNECTION}:
            self.wait(lambda controller: controller.at_rest)

    def cut(self) -> float:
        """Close all connections and refuse new ones. Returns the controller's time [s]."""
        with self._lock:
            self._disturbance = Disturbance.CONNECTION
            self._disconnect()
            return self.controller.time_s

    def restore(self) -> None:
        """See ``Peer``."""
        with self._lock:
            if self._disturbance is Disturbance.CONNECTION:
                self._servers = [*map(self._listen, (self.rtde_port, self.script_port, self.dashboard_port))]
            if self._disturbance is Disturbance.SAFETY:
                self.controller.set_safety_mode(NORMAL)
            self._disturbance = None

    def change(self, change: Callable[[Controller], None]) -> None:
        """Change the controller between two cycles."""
        with self._lock:
            change(self.controller)

    def wait(self, condition: Callable[[Controller], bool]) -> float:
        """Wait until a condition is true between two cycles. Returns the controller's time then [s]."""
        end_s = time.monotonic() + _WAIT_S
        while time.monotonic() < end_s:
            with self._lock:
                if condition(self.controller):
                    return self.controller.time_s
            time.sleep(CYCLE_S / 4)
        raise TimeoutError

    def close(self) -> None:
        """Switch the device off."""
        self._stopping.set()
        self._thread.join()
        self._disconnect()

    def _listen(self, port: int) -> socket.socket:
        server = socket.create_server(("127.0.0.1", port))
        server.setblocking(False)
        return server

    def _disconnect(self) -> None:
        for opened in (*self._servers, *self._rtde_clients, *self._script_clients, *self._dashboard_clients):
            opened.close()
        self._rtde_clients, self._script_clients, self._dashboard_clients = {}, {}, {}

    def _run(self) -> None:
        while not self._stopping.wait(CYCLE_S):
            with self._lock:
                self._accept()
                self._receive()
                self.controller.step()
                for client, session in self._rtde_clients.items():
                    with contextlib.suppress(OSError):
                        client.send(session.data(self._disturbance))

    def _accept(self) -> None:
        with contextlib.suppress(OSError):
            client, _ = self._servers[0].accept()
            client.setblocking(False)
            self._rtde_clients[client] = RtdeSession(self.rtde)
        with contextlib.suppress(OSError):
            client, _ = self._servers[1].accept()
            client.setblocking(False)
            client.send(_STATE)
            self._script_clients[client] = b""
        with contextlib.suppress(OSError):
            client, _ = self._servers[2].accept()
            client.setblocking(False)
            client.send(GREETING.encode())
            self._dashboard_clients[client] = DashboardSession(self.controller, self.dashboard_commands)

    def _receive(self) -> None:
        for client, session in self._rtde_clients.items():
            with contextlib.suppress(OSError):
                client.send(session.receive(client.recv(65536)))
        for client, dashboard in list(self._dashboard_clients.items()):
            with contextlib.suppress(OSError):
                received = client.recv(65536)
                if received:
                    client.send(dashboard.receive(received))
                else:
                    client.close()
                    del self._dashboard_clients[client]
        for client, text in list(self._script_clients.items()):
            with contextlib.suppress(OSError):
                script = text + client.recv(65536)
                program, end, rest = script.partition(b"\nend\n")
                self._script_clients[client] = rest if end else script
                if end:
                    self.controller.run((program + end).decode())
