"""The cloud as agents meet it: a server that is a process, a broker that is another, and people beside them.

with start_ground("amqtt", folder) as ground:
    with Link(ground, {"transport": "http"}) as link:
        link.up()
        ground.send(link.robot, b'{"any": "order"}')
"""

import contextlib
import json
import socket
import threading
import time
from collections.abc import Callable, Iterator, Mapping
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
from tests.harness.network.proxy import Proxy, start_proxy

ORDER_MS = 30_000


class Endpoint(Protocol):
    """What a transport's connection ends at: can be killed, and come back at the same port."""

    port: int

    def kill(self) -> None: ...

    def revive(self) -> None: ...


class Server:
    """``python -m function_app serve``."""

    def __init__(self, environment: Mapping[str, str], stack: contextlib.ExitStack) -> None:
        self.port = _free_port()
        self._environment = environment_of({**environment, "TELESCOPE_PORT": str(self.port)})
        self._stack = stack
        self._program: Program | None = None
        self.revive()

    def kill(self) -> None:
        assert self._program is not None
        self._program.process.kill()
        self._program.process.wait()

    def revive(self) -> None:
        program = self._stack.enter_context(start_program(["-m", "function_app", "serve"], self._environment))
        self._program = program
        wait_until(lambda: _listens(self.port) or program.process.poll() is not None, "the server")
        assert program.process.poll() is None, program.stderr()


class BrokerEnd:
    """The broker's process."""

    def __init__(self, kind: BrokerKind, folder: Path, keys: Path, stack: contextlib.ExitStack) -> None:
        self._begin = lambda **ports: stack.enter_context(
            start_broker(kind, folder, keys=keys / "public.json", **ports)
        )
        self.now: RunningBroker = self._begin()
        self.port = self.now.tcp_port

    def kill(self) -> None:
        self.now.kill()

    def revive(self) -> None:
        self.now = self._begin(tcp_port=self.now.tcp_port, websocket_port=self.now.websocket_port)


class Ground:
    """Everything that runs.

    Attributes:
        endpoints: ``server`` and ``broker``; who adds a transport adds what it ends at.
        home: The cloud's folder.
        environment: The server's settings, for further programs of the test.
    """

    def __init__(
        self, kind: BrokerKind, folder: Path, stack: contextlib.ExitStack, more: Mapping[str, str] | None = None
    ) -> None:
        home = folder / "home"
        FileKeys(home / "keys").load()
        self.stack = stack
        self.folder = folder
        self.broker = BrokerEnd(kind, folder / "broker", home / "keys", stack)
        if kind == "mosquitto":
            (home / "mosquitto").symlink_to(folder / "broker")
        self.environment: dict[str, str] = {
            "TELESCOPE_HOME": str(home),
            "TELESCOPE_BROKER": kind,
            "TELESCOPE_MQTT_PORT": str(self.broker.port),
            **(more or {}),
        }
        self.endpoints: dict[str, Endpoint] = {"broker": self.broker, "server": Server(self.environment, stack)}
        self.url = f"http://{HOST}:{self.endpoints['server'].port}"
        self.home = home
        self._last_ms = 0
        self.cloud = stack.enter_context(Cloud(settings(home, self.broker.now)))
        self.cloud.start_ingest()
        self.anna = self.cloud.sign_in("anna")

    def devices(self, agent: str) -> tuple[Device, ...]:
        """The devices of an agent, as the functions know them."""
        row = self.cloud.run(self.cloud.functions.tables.get(records.AGENTS, agent, "agent"))
        assert row is not None
        return tuple(devices_of(records.read(row, Agent)))

    def send(self, robot: Robot, payload: bytes, *, in_ms: int = ORDER_MS, first: bool = False) -> str:
        """Send anything the way commands go; its id."""
        self._last_ms = max(self._last_ms + 1, self.cloud.clock.now_ms())
        command = command_id(robot.device, self._last_ms)
        self.deliver(robot.id, SignedCommand(command, payload, self.cloud.clock.now_ms() + in_ms, first))
        return command

    def order(self, agent: str, request: Request, *, epoch: int, key: Ed25519PrivateKey | None = None) -> SignedCommand:
        """A command of Anna's to an agent's only device; signed by the cloud's key where no other is given."""
        (device,) = self.devices(agent)
        now_ms = self.cloud.clock.now_ms()
        command = Command(
            id=command_id(device.id, now_ms),
            space=device.space,
            agent=agent,
            device=device.name,
            issued_at_ms=now_ms,
            ttl_ms=ORDER_MS,
            caller="anna",
            epoch=epoch,
            request=request,
        )
        payload = signing.sign(codec.encode(command), key or FileKeys(self.home / "keys").load())
        return SignedCommand(command.id, payload, now_ms + ORDER_MS)

    def deliver(self, agent: str, order: SignedCommand) -> None:
        """Send an order to an agent's only device."""
        (device,) = self.devices(agent)
        self.cloud.run(self.delivery.send(device, order))

    def keep(self, topic: str, payload: bytes) -> None:
        """Have the broker keep a message."""
        self.cloud.run(self.delivery._bus.publish(topic, payload, retain=True))

    def ear(self, agent: str) -> Client:
        """What a page hears at the broker of an agent."""
        issued = self.anna.post("/mqtt/credentials", {"purpose": "view"}).json()
        credentials = Credentials(issued["username"], issued["password"])
        client = self.broker.now.connect(issued["client_id"], credentials)
        filters = [pattern for pattern in issued["subscribe"] if pattern.split("/")[3] == agent]
        assert filters
        assert client.subscribe(*filters) == [1] * len(filters)
        return client

    @property
    def delivery(self) -> Delivery:
        return self.cloud.functions.stop._delivery


@contextlib.contextmanager
def start_ground(kind: BrokerKind, folder: Path, more: Mapping[str, str] | None = None) -> Iterator[Ground]:
    """Everything, with these settings more, until the end of the ``with``."""
    with contextlib.ExitStack() as stack:
        yield Ground(kind, folder, stack, more)


class Link:
    """A transport of an agent that was paired, built as ``bootstrap`` does, and what it has told. ``with`` ends it.

    Args:
        ground: Where.
        configuration: The transport's part of ``agent.toml``.
        through: A proxy that stands before this endpoint.
    """

    def __init__(self, ground: Ground, configuration: Mapping[str, Any], *, through: str = "") -> None:
        self.ground = ground
        self.received: list[tuple[str, bytes]] = []
        self.changes: list[bool] = []
        self.changed_s: list[float] = []
        self.sessions = 0
        self.quiet = True
        self.proxy: Proxy | None = None
        self._heard: list[Message] = []
        self._stack = contextlib.ExitStack()
        self._through = through
        self.robot = ground.cloud.robot("arm")
        self.robot.pair(ground.anna)
        self.ear = self._stack.enter_context(ground.ear(self.robot.id))
        self.known = set(threading.enumerate())
        told = AgentConfig(
            server=ground.url, name="lab", devices=(DeviceEntry(name="arm", type="ur5"),), **configuration
        )
        pairing = Pairing(agent=self.robot.id, space=self.robot.space, account="anna", keys={})
        entry = {"name": "arm", "kind": "arm", "robot_type": "ur5", "label": "Arm"}
        self.membership = pairing_monitor.PairingMonitor(pairing, told, [entry], pinned(pairing))
        if through:
            self.proxy = self._stack.enter_context(start_proxy(ground.endpoints[through].port))
        self.transport = factory.make(
            factory.Wiring(
                configuration=told,
                pairing=pairing,
                pairing_monitor=self.membership,
                open_api=self._open_api,
                next_session=self._next_session,
                quiet=lambda: self.quiet,
                certificate=ClientCertificate(ground.folder),
                now_ms=lambda: None,
            )
        )

    def start(self) -> Self:
        self.known |= set(threading.enumerate())
        self.transport.start(lambda topic, payload: self.received.append((topic, payload)), self._changed)
        return self

    def up(self, times: int = 1) -> Self:
        """Wait for the link to come up for this time."""
        wait_until(lambda: self.changes.count(True) >= times, f"link number {times}")
        return self

    def topic(self, kind: str, name: str = "") -> str:
        return topics.device(self.robot.space, self.robot.id, "arm", kind, name)

    def publish(self, kind: str, payload: bytes, delivered: Callable[[], None] | None = None) -> bool:
        return self.transport.publish(self.topic(kind), payload, qos=1, delivered=delivered)

    def publish_measurement(self, sequence: int) -> None:
        message = Measurements(tick_ms=1, at_ms=wall_ms(), sequence=sequence, values={"temperature_c": 20.0 + sequence})
        self.transport.publish(self.topic(topics.TELE, "load"), codec.encode(message), qos=0)

    def heard(self, kind: str) -> list[bytes]:
        """Payloads of a class that the broker's subscribers have heard of this agent so far."""
        self._heard += self.ear.pending()
        return [message.payload for message in self._heard if topics.parse(message.topic).kind == kind]

    def presences(self) -> list[tuple[bool, int]]:
        """Presence that was told: online or not, and in which session."""
        told = [codec.decode(payload, Presence) for payload in self.heard(topics.CONN)]
        return [(each.online, each.session) for each in told]

    def threads(self) -> list[str]:
        """Threads that the transport has left running."""
        return [each.name for each in threading.enumerate() if each not in self.known]

    def _changed(self, up: bool) -> None:
        self.changed_s.append(time.monotonic())
        self.changes.append(up)

    def _next_session(self) -> int:
        self.sessions += 1
        return self.sessions

    def _open_api(self) -> CloudClient:
        ends = self.ground.endpoints
        if self.proxy is None:
            return CloudClient(self.ground.url, self.robot.key, CloudClock())
        if self._through == "server":
            return CloudClient(f"http://{HOST}:{self.proxy.port}", self.robot.key, CloudClock())
        return _Rerouted(self.ground.url, self.robot.key, {ends[self._through].port: self.proxy.port})

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.transport.stop()
        self._stack.close()


class _Rerouted(CloudClient):
    """The API of a cloud whose other addresses are behind proxies."""

    def __init__(self, server: str, key: Any, ports: Mapping[int, int]) -> None:
        super().__init__(server, key, CloudClock())
        self._ports = ports

    def _call(self, method: str, path: str, **request: Any) -> dict[str, Any]:
        answer = json.dumps(super()._call(method, path, **request))
        rerouted: dict[str, Any] = json.loads(answer, parse_int=self._reroute)
        return rerouted

    def _reroute(self, number: str) -> int:
        return self._ports.get(int(number), int(number))


def _free_port() -> int:
    with socket.socket() as found:
        found.bind((HOST, 0))
        port: int = found.getsockname()[1]
        return port


def _listens(port: int) -> bool:
    with socket.socket() as caller:
        return caller.connect_ex((HOST, port)) == 0
