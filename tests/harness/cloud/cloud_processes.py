"""The cloud as separate processes: a server and a broker, with an agent's transport connected to them.

with start_cloud_processes("amqtt", folder) as processes:
    with Link(processes, {"transport": "http"}) as link:
        link.up()
        processes.send(link.robot, b'{"any": "command"}')
"""

import contextlib
import json
import socket
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Protocol, Self

from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

from device_agent.config.agent_config import AgentConfig, DeviceEntry
from device_agent.config.client_certificate import ClientCertificate
from device_agent.config.identity_store import Pairing
from device_agent.ports.clock import CloudClock, wall_ms
from device_agent.protocol import Command, Measurements, Presence, Request, codec, topics
from device_agent.protocol.security import signing
from device_agent.transports import factory, pairing_monitor
from device_agent.transports.http.client import CloudClient
from function_app.adapters.local.signing_keys import FileKeys
from function_app.domain.common.ids import command_id
from function_app.domain.devices.devices import Agent, Device
from function_app.ports.broker_access import Credentials
from function_app.services.devices.device_access import devices_of
from function_app.services.messaging.delivery import Delivery, SignedCommand
from function_app.services.storage import records
from tests.fakes.agent import Robot
from tests.harness.agent.pinned_keys import pinned
from tests.harness.cloud.cloud import Cloud, settings
from tests.harness.hosts.host import Program, environment_of, start_program
from tests.harness.network.brokers import HOST, BrokerKind, Client, Message, RunningBroker, start_broker, wait_until
from tests.harness.network.ports import free_port
from tests.harness.network.proxy import Proxy, start_proxy

COMMAND_TTL_MS = 30_000


class Endpoint(Protocol):
    """The server of a transport's connection; can be killed and restarted at the same port."""

    port: int

    def kill(self) -> None: ...

    def revive(self) -> None: ...


class Server:
    """``python -m function_app serve``."""

    def __init__(
        self, environment: Mapping[str, str], stack: contextlib.ExitStack, launcher: Sequence[str] = ()
    ) -> None:
        self.port = free_port()
        self._command = ["-m", *launcher, "function_app", "serve"]
        self._environment = environment_of({**environment, "TELESCOPE_PORT": str(self.port)})
        self._stack = stack
        self._program: Program | None = None
        self.revive()

    def kill(self) -> None:
        assert self._program is not None
        self._program.process.kill()
        self._program.process.wait()

    def revive(self) -> None:
        program = self._stack.enter_context(start_program(self._command, self._environment))
        self._program = program
        wait_until(lambda: _listens(self.port) or program.process.poll() is not None, "the server")
        assert program.process.poll() is None, program.stderr()


class BrokerEndpoint:
    """The broker's process."""

    def __init__(
        self, kind: BrokerKind, folder: Path, keys: Path, stack: contextlib.ExitStack, launcher: Sequence[str] = ()
    ) -> None:
        self._begin = lambda **ports: stack.enter_context(
            start_broker(kind, folder, keys=keys / "public.json", launcher=launcher, **ports)
        )
        self.running: RunningBroker = self._begin()
        self.port = self.running.tcp_port

    def kill(self) -> None:
        self.running.kill()

    def revive(self) -> None:
        self.running = self._begin(tcp_port=self.running.tcp_port, websocket_port=self.running.websocket_port)


class CloudProcesses:
    """The started processes.

    Attributes:
        endpoints: ``server`` and ``broker``; a test of another transport adds its endpoint.
        home: Home folder of the functions.
        environment: Settings of the server, for further programs of the test.
    """

    def __init__(
        self,
        kind: BrokerKind,
        folder: Path,
        stack: contextlib.ExitStack,
        more: Mapping[str, str] | None = None,
        launcher: Sequence[str] = (),
    ) -> None:
        home = folder / "home"
        FileKeys(home / "keys").load()
        self.stack = stack
        self.folder = folder
        self.broker = BrokerEndpoint(kind, folder / "broker", home / "keys", stack, launcher)
        if kind == "mosquitto":
            (home / "mosquitto").symlink_to(folder / "broker")
        self.environment: dict[str, str] = {
            "TELESCOPE_HOME": str(home),
            "TELESCOPE_BROKER": kind,
            "TELESCOPE_MQTT_PORT": str(self.broker.port),
            **(more or {}),
        }
        self.endpoints: dict[str, Endpoint] = {
            "broker": self.broker,
            "server": Server(self.environment, stack, launcher),
        }
        self.url = f"http://{HOST}:{self.endpoints['server'].port}"
        self.home = home
        self._last_ms = 0
        self.cloud = stack.enter_context(Cloud(settings(home, self.broker.running)))
        self.cloud.start_ingest()
        self.anna = self.cloud.sign_in("anna")

    def devices(self, agent: str) -> tuple[Device, ...]:
        """The stored devices of an agent."""
        row = self.cloud.run(self.cloud.functions.tables.get(records.AGENTS, agent, "agent"))
        assert row is not None
        return tuple(devices_of(records.read(row, Agent)))

    def send(self, robot: Robot, payload: bytes, *, in_ms: int = COMMAND_TTL_MS, first: bool = False) -> str:
        """Send any payload as a command; returns its id."""
        self._last_ms = max(self._last_ms + 1, self.cloud.clock.now_ms())
        command = command_id(robot.device, self._last_ms)
        self.deliver(robot.id, SignedCommand(command, payload, self.cloud.clock.now_ms() + in_ms, first))
        return command

    def command(
        self, agent: str, request: Request, *, epoch: int, key: Ed25519PrivateKey | None = None
    ) -> SignedCommand:
        """A command of Anna to an agent's only device; default ``key``: that of the cloud."""
        (device,) = self.devices(agent)
        now_ms = self.cloud.clock.now_ms()
        command = Command(
            id=command_id(device.id, now_ms),
            space=device.space,
            agent=agent,
            device=device.name,
            issued_at_ms=now_ms,
            ttl_ms=COMMAND_TTL_MS,
            caller="anna",
            epoch=epoch,
            request=request,
        )
        payload = signing.sign(codec.encode(command), key or FileKeys(self.home / "keys").load())
        return SignedCommand(command.id, payload, now_ms + COMMAND_TTL_MS)

    def deliver(self, agent: str, command: SignedCommand) -> None:
        """Send a command to an agent's only device."""
        (device,) = self.devices(agent)
        self.cloud.run(self.delivery.send(device, command))

    def publish_retained(self, topic: str, payload: bytes) -> None:
        self.cloud.run(self.delivery._bus.publish(topic, payload, retain=True))

    def viewer(self, agent: str) -> Client:
        """A broker connection with Anna's view credentials, subscribed to all topics of an agent."""
        issued = self.anna.post("/mqtt/credentials", {"purpose": "view"}).json()
        credentials = Credentials(issued["username"], issued["password"])
        client = self.broker.running.connect(issued["client_id"], credentials)
        filters = [pattern for pattern in issued["subscribe"] if pattern.split("/")[3] == agent]
        assert filters
        assert client.subscribe(*filters) == [1] * len(filters)
        return client

    @property
    def delivery(self) -> Delivery:
        return self.cloud.functions.stop._delivery


@contextlib.contextmanager
def start_cloud_processes(
    kind: BrokerKind, folder: Path, more: Mapping[str, str] | None = None, *, launcher: Sequence[str] = ()
) -> Iterator[CloudProcesses]:
    """Start server, broker and functions with these additional settings; the context stops them.

    ``launcher``: module and arguments of a program that runs server and broker.
    """
    with contextlib.ExitStack() as stack:
        yield CloudProcesses(kind, folder, stack, more, launcher)


class Link:
    """The transport of a paired agent, built as ``bootstrap`` does; a context manager that stops it.

    Args:
        processes: The cloud.
        configuration: The transport's part of ``agent.toml``.
        through: Endpoint to which it connects through a proxy.
    """

    def __init__(self, processes: CloudProcesses, configuration: Mapping[str, Any], *, through: str = "") -> None:
        self.processes = processes
        self.received: list[tuple[str, bytes]] = []
        self.changes: list[bool] = []
        self.changed_s: list[float] = []
        self.sessions = 0
        self.quiet = True
        self.proxy: Proxy | None = None
        self._published: list[Message] = []
        self._stack = contextlib.ExitStack()
        self._through = through
        self.robot = processes.cloud.robot("arm")
        self.robot.pair(processes.anna)
        self.viewer = self._stack.enter_context(processes.viewer(self.robot.id))
        self._other_threads = set(threading.enumerate())
        config = AgentConfig(
            server=processes.url, name="lab", devices=(DeviceEntry(name="arm", type="ur5"),), **configuration
        )
        pairing = Pairing(agent=self.robot.id, space=self.robot.space, account="anna", keys={})
        entry = {"name": "arm", "kind": "arm", "robot_type": "ur5", "label": "Arm"}
        self.membership = pairing_monitor.PairingMonitor(pairing, config, [entry], pinned(pairing))
        if through:
            self.proxy = self._stack.enter_context(start_proxy(processes.endpoints[through].port))
        self.transport = factory.make(
            factory.Wiring(
                configuration=config,
                pairing=pairing,
                pairing_monitor=self.membership,
                open_api=self._open_api,
                next_session=self._next_session,
                quiet=lambda: self.quiet,
                certificate=ClientCertificate(processes.folder),
                now_ms=lambda: None,
            )
        )

    def start(self) -> Self:
        self._other_threads |= set(threading.enumerate())
        self.transport.start(lambda topic, payload: self.received.append((topic, payload)), self._changed)
        return self

    def up(self, times: int = 1) -> Self:
        """Wait until the link has come up this number of times."""
        wait_until(lambda: self.changes.count(True) >= times, f"link number {times}")
        return self

    def topic(self, kind: str, name: str = "") -> str:
        return topics.device(self.robot.space, self.robot.id, "arm", kind, name)

    def publish(self, kind: str, payload: bytes, delivered: Callable[[], None] | None = None) -> bool:
        return self.transport.publish(self.topic(kind), payload, qos=1, delivered=delivered)

    def publish_measurement(self, sequence: int) -> None:
        message = Measurements(tick_ms=1, at_ms=wall_ms(), sequence=sequence, values={"temperature_c": 20.0 + sequence})
        self.transport.publish(self.topic(topics.TELE, "load"), codec.encode(message), qos=0)

    def published(self, kind: str) -> list[bytes]:
        """Payloads of a class that a subscriber of the broker has received from this agent."""
        self._published += self.viewer.pending()
        return [message.payload for message in self._published if topics.parse(message.topic).kind == kind]

    def presences(self) -> list[tuple[bool, int]]:
        """Published presences: whether online, and the session."""
        presences = [codec.decode(payload, Presence) for payload in self.published(topics.CONN)]
        return [(each.online, each.session) for each in presences]

    def threads(self) -> list[str]:
        """Names of running threads of the transport."""
        return [each.name for each in threading.enumerate() if each not in self._other_threads]

    def _changed(self, up: bool) -> None:
        self.changed_s.append(time.monotonic())
        self.changes.append(up)

    def _next_session(self) -> int:
        self.sessions += 1
        return self.sessions

    def _open_api(self) -> CloudClient:
        ends = self.processes.endpoints
        if self.proxy is None:
            return CloudClient(self.processes.url, self.robot.key, CloudClock())
        if self._through == "server":
            return CloudClient(f"http://{HOST}:{self.proxy.port}", self.robot.key, CloudClock())
        return _Rerouted(self.processes.url, self.robot.key, {ends[self._through].port: self.proxy.port})

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.transport.stop()
        self._stack.close()


class _Rerouted(CloudClient):
    """The API, with ports in its responses replaced by those of proxies."""

    def __init__(self, server: str, key: Any, ports: Mapping[int, int]) -> None:
        super().__init__(server, key, CloudClock())
        self._ports = ports

    def _call(self, method: str, path: str, **request: Any) -> dict[str, Any]:
        answer = json.dumps(super()._call(method, path, **request))
        rerouted: dict[str, Any] = json.loads(answer, parse_int=self._reroute)
        return rerouted

    def _reroute(self, number: str) -> int:
        return self._ports.get(int(number), int(number))


def _listens(port: int) -> bool:
    with socket.socket() as caller:
        return caller.connect_ex((HOST, port)) == 0
