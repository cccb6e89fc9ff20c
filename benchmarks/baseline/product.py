"""What suites measure at: the product as ``make up`` starts it, bare peers beside it, and clients with any rights."""

import contextlib
import http.client
import json
import queue
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Final, Self

import msgspec
import paho.mqtt.client as paho
from paho.mqtt.enums import CallbackAPIVersion

from benchmarks.baseline.echo_servers import HOST, send_at_once
from device_agent.protocol import JointTarget, Setpoint, codec
from device_agent.protocol.manifests import robot_type
from device_agent.protocol.security.grants import Grant
from function_app import settings
from tests.harness.browser.product import Api, Machine, start_machine
from tests.harness.cloud.cloud import Cloud
from tests.harness.network.brokers import BrokerKind
from tests.harness.paths import ROOT

PATIENCE_S: Final = 10.0
LEASE_MS: Final = 60_000
PERIOD_S: Final = 0.025
"""Between two setpoints, as the console sends them."""
PAYLOAD: Final = json.dumps({"text": "x" * 139}).encode()
"""150 bytes of JSON, as in the facts that these figures are to be compared with."""


class MeasuredProduct:
    """One started product. ``start`` gives one.

    Attributes:
        machine: It.
        api: Its API, asked with ``token``, an API key of who owns all.
        kind: Its broker.
    """

    def __init__(self, machine: Machine, kind: BrokerKind, cloud: Cloud) -> None:
        self.machine = machine
        self.kind = kind
        self.api = Api(machine)
        self.token: str = self.api.post("/api-keys", {"name": "bench", "role": "operator", "days": 1})["token"]
        self.api.http.headers["Authorization"] = f"Bearer {self.token}"
        self.api.http.cookies.clear()
        self._cloud = cloud
        self._number = 0

    @property
    def mqtt_port(self) -> int:
        """Where its broker takes TCP."""
        return self.machine.port + 1

    def rights(self, *, publish: tuple[str, ...] = (), subscribe: tuple[str, ...] = ()) -> tuple[str, str, str]:
        """Client id, user name and password of a new client with exactly these rights."""
        self._number += 1
        return broker_credentials(self._cloud, f"bench-{self._number}", publish, subscribe)

    def line(self, *, publish: tuple[str, ...] = (), subscribe: tuple[str, ...] = (), qos: int = 0) -> "MqttClient":
        """A connected client that has subscribed."""
        return MqttClient(
            self.mqtt_port, *self.rights(publish=publish, subscribe=subscribe), subscribe=subscribe, qos=qos
        )


def broker_credentials(
    cloud: Cloud, name: str, publish: tuple[str, ...], subscribe: tuple[str, ...]
) -> tuple[str, str, str]:
    """Client id, user name and password of a client with exactly these rights, for two hours."""
    grant = Grant(
        principal=f"account:{name}",
        client_id=name,
        publish=publish,
        subscribe=subscribe,
        token_id=f"{name}{time.time_ns():x}",
        expires_at=int(time.time() + 7200),
    )
    issued = cloud.run(cloud.functions.access.issue(grant))
    return name, issued.username, issued.password


class MqttClient:
    """A warm paho client, as an app would have one. ``with`` closes it.

    Attributes:
        heard: Payloads in the order in which they came.
    """

    def __init__(
        self, port: int, client_id: str, user: str, password: str, *, subscribe: tuple[str, ...], qos: int
    ) -> None:
        self.forget()
        self._filters = [(each, qos) for each in subscribe]
        self._ready = threading.Event()
        self.client = paho.Client(CallbackAPIVersion.VERSION2, client_id, protocol=paho.MQTTv311)
        self.client.username_pw_set(user, password)
        self.client.on_socket_open = send_at_once
        self.client.on_message = lambda _c, _u, message: self.hear(bytes(message.payload))
        self.client.on_connect = self._connected
        self.client.on_subscribe = lambda *_: self._ready.set()
        self.client.connect(HOST, port, keepalive=60)
        self.client.loop_start()
        if not self._ready.wait(PATIENCE_S):
            raise TimeoutError("the broker does not let the bench's client in")

    def forget(self) -> None:
        """Let go of what has been heard: a client is in a cycle with its callbacks, and may stay for long."""
        self.heard: queue.SimpleQueue[bytes] = queue.SimpleQueue()
        self.hear: Callable[[bytes], None] = self.heard.put_nowait

    def _connected(self, *_: Any) -> None:
        if self._filters:
            self.client.subscribe(self._filters)
        else:
            self._ready.set()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.client.disconnect()
        with contextlib.suppress(AttributeError):  # paho's thread may end by itself, and be gone, just then
            self.client.loop_stop()


class _TelemetryFields(msgspec.Struct):
    """What a hand needs to know of telemetry."""

    tick_ms: int
    commanded_rad: tuple[float, ...]
    epoch: int
    setpoint_sequence: int


class StreamingOperator:
    """An operator who holds one robot's joints where they are, setpoint by setpoint. ``with`` gives control up.

    Args:
        stand: The product.
        name: The device's name at its agent.

    Attributes:
        sent: The newest setpoint, as it went out.
        heard: The newest telemetry, as it came.
    """

    def __init__(self, stand: MeasuredProduct, name: str = "ur5") -> None:
        self._stand = stand
        self.sent = self.heard = b""
        self.device = stand.api.device(name)
        self._path = f"/devices/{self.device['id']}/lease"
        self._seen = threading.Condition()
        self._newest: _TelemetryFields | None = None
        self._sequence = 0
        self._next_s = 0.0
        self._ending = threading.Event()
        topic = self.device["topic"]
        self.line = stand.line(publish=(f"{topic}/ctl/+",), subscribe=(f"{topic}/tele/joints",))
        self.line.hear = self._hear
        granted = stand.api.post(self._path, {"lease_ms": LEASE_MS, "wait_ms": 5000})
        self.epoch: int = granted["epoch"]
        self._topic = f"{topic}/ctl/{self.epoch}"
        self._renewing = threading.Thread(target=self._renew, daemon=True)
        self._renewing.start()
        with self._seen:
            self._seen.wait_for(lambda: self._newest is not None, PATIENCE_S)
        joints = [each.name for each in robot_type.load(ROOT / "robots" / self.device["robot_type"]).joints]
        self.target_rad: dict[str, float] = dict(zip(joints, self._latest().commanded_rad, strict=True))

    def exchange(self) -> float:
        """A setpoint, until telemetry says that the driver has applied it [ms]; as many a second as a page sends.

        Raises:
            TimeoutError: It does not.
        """
        time.sleep(max(0.0, self._next_s - time.monotonic()))
        self._next_s = time.monotonic() + PERIOD_S
        with self._seen:
            self._sequence += 1
            setpoint = Setpoint(
                epoch=self.epoch,
                sequence=self._sequence,
                echo_tick_ms=self._latest().tick_ms,
                sent_ms=time.monotonic() * 1000,
                target=JointTarget(position_rad=self.target_rad),
            )
            self.sent = codec.encode(setpoint)
            began = time.perf_counter()
            self.line.client.publish(self._topic, self.sent)
            if not self._seen.wait_for(self._applied, PATIENCE_S):
                raise TimeoutError(f"setpoint {self._sequence} is not seen again in telemetry")
        return (time.perf_counter() - began) * 1000

    def act(self, caller: "HttpConnection") -> float:
        """An action to where the arm is, until it has started [ms]; it ends by itself, which is waited for after that.

        Raises:
            RuntimeError: It did not start.
        """
        request = {"kind": "move_joints", "position_rad": self.target_rad}
        asked = {"request": request, "epoch": self.epoch, "wait_for": "started", "wait_ms": 10_000}
        body = json.dumps(asked).encode()
        began = time.perf_counter()
        started = caller.ask("POST", f"/api/v1/devices/{self.device['id']}/actions", body)
        took_ms = (time.perf_counter() - began) * 1000
        if started["status"] not in ("started", "done"):
            raise RuntimeError(f"not started: {started}")
        caller.ask("GET", f"/api/v1/actions/{started['id']}?wait_ms=10000")
        return took_ms

    def _latest(self) -> _TelemetryFields:
        if self._newest is None:
            raise TimeoutError("the robot tells nothing")
        return self._newest

    def _applied(self) -> bool:
        newest = self._newest
        return newest is not None and newest.epoch == self.epoch and newest.setpoint_sequence >= self._sequence

    def _hear(self, payload: bytes) -> None:
        newest = codec.decode(payload, _TelemetryFields)
        with self._seen:
            self._newest, self.heard = newest, payload
            self._seen.notify()

    def _renew(self) -> None:
        while not self._ending.wait(LEASE_MS / 4000):
            self._stand.api.post(self._path, {"lease_ms": LEASE_MS, "epoch": self.epoch})

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._ending.set()
        self._renewing.join(PATIENCE_S)
        self._stand.api.http.delete(self._path, params={"epoch": self.epoch})
        self.line.__exit__()


class HttpConnection:
    """One warm HTTP connection of the standard library: the client that costs least. ``with`` closes it."""

    def __init__(self, port: int, headers: dict[str, str] | None = None) -> None:
        self._line = http.client.HTTPConnection(HOST, port, timeout=PATIENCE_S)
        self._headers = {"Content-Type": "application/json", **(headers or {})}
        self._line.connect()
        self._line.sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)

    def ask(self, method: str, path: str, body: bytes | None = None) -> Any:
        """The answer's JSON. Raises: RuntimeError: It is a refusal."""
        self._line.request(method, path, body, self._headers)
        answer = self._line.getresponse()
        read = answer.read()
        if answer.status >= http.client.BAD_REQUEST:
            raise RuntimeError(f"{method} {path}: {answer.status} {read[:300]!r}")
        return json.loads(read) if read else None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._line.close()


@contextlib.contextmanager
def start(home: Path, kind: BrokerKind, **more: str) -> Iterator[MeasuredProduct]:
    """The product with one simulated UR5, and this broker; ``more`` are settings."""
    with start_machine(home, port=0, TELESCOPE_BROKER=kind, **more) as machine:
        if machine.process.poll() is not None:
            raise RuntimeError("".join(machine.lines))
        given = {"TELESCOPE_HOME": str(home), "TELESCOPE_PORT": str(machine.port), "TELESCOPE_BROKER": kind, **more}
        with Cloud(settings.read(given)) as cloud:
            yield MeasuredProduct(machine, kind, cloud)


@contextlib.contextmanager
def start_peer(module: str, *arguments: str) -> Iterator["subprocess.Popen[str]"]:
    """A program beside the product that says ``ready`` when it is, to the end of the ``with``."""
    with subprocess.Popen(
        [sys.executable, "-m", module, *arguments], cwd=ROOT, stdout=subprocess.PIPE, text=True
    ) as process:
        try:
            assert process.stdout is not None
            if process.stdout.readline().strip() != "ready":
                raise RuntimeError(f"{module} {arguments[0]} did not start")
            yield process
        finally:
            process.terminate()


def free_port() -> int:
    """A port that nobody listens on."""
    with socket.socket() as found:
        found.bind((HOST, 0))
        port: int = found.getsockname()[1]
        return port
