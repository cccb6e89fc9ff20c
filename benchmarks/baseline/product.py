"""Starts the product as ``make up`` does, with reference programs and clients with any permissions."""

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

from benchmarks.baseline.echo_servers import HOST, disable_nagle
from device_agent.protocol import JointTarget, Setpoint, codec
from device_agent.protocol.manifests import robot_type
from device_agent.protocol.security import setpoints
from device_agent.protocol.security.grants import Grant
from function_app import settings
from tests.harness.browser.product import Api, Machine, start_machine
from tests.harness.cloud.cloud import Cloud
from tests.harness.network.brokers import BrokerKind
from tests.harness.paths import ROOT

TIMEOUT_S: Final = 10.0
LEASE_MS: Final = 60_000
PERIOD_S: Final = 0.025
"""Time between two setpoints of the console [s]."""
PAYLOAD: Final = json.dumps({"text": "x" * 139}).encode()
"""150 bytes of JSON, the payload of the published reference measurements."""


class MeasuredProduct:
    """A running product; ``start`` creates it.

    Attributes:
        machine: The processes.
        api: HTTP client with ``token``, an API key of the owner of all devices.
        kind: The broker in use.
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
        """TCP port of the broker."""
        return self.machine.port + 1

    def credentials(self, *, publish: tuple[str, ...] = (), subscribe: tuple[str, ...] = ()) -> tuple[str, str, str]:
        """Returns client id, user name and password of a new client with exactly these permissions."""
        self._number += 1
        return broker_credentials(self._cloud, f"bench-{self._number}", publish, subscribe)

    def connect(self, *, publish: tuple[str, ...] = (), subscribe: tuple[str, ...] = (), qos: int = 0) -> "MqttClient":
        """Returns a connected and subscribed client."""
        return MqttClient(
            self.mqtt_port, *self.credentials(publish=publish, subscribe=subscribe), subscribe=subscribe, qos=qos
        )


def broker_credentials(
    cloud: Cloud, name: str, publish: tuple[str, ...], subscribe: tuple[str, ...]
) -> tuple[str, str, str]:
    """Returns client id, user name and password of a client with exactly these permissions for two hours."""
    grant = Grant(
        principal=f"agent:{name}",  # the broker permits it a longer lifetime than an account
        client_id=name,
        publish=publish,
        subscribe=subscribe,
        token_id=f"{name}{time.time_ns():x}",
        expires_at=int(time.time() + 7200),
    )
    issued = cloud.run(cloud.functions.access.issue(grant))
    return name, issued.username, issued.password


class MqttClient:
    """A connected paho client, as an application has one. Leaving the context closes it.

    Attributes:
        received: Payloads in order of arrival.
        on_payload: Called with each payload; by default it appends to ``received``.
    """

    def __init__(
        self, port: int, client_id: str, user: str, password: str, *, subscribe: tuple[str, ...], qos: int
    ) -> None:
        self.reset()
        self._filters = [(each, qos) for each in subscribe]
        self._ready = threading.Event()
        self.client = paho.Client(CallbackAPIVersion.VERSION2, client_id, protocol=paho.MQTTv311)
        self.client.username_pw_set(user, password)
        self.client.on_socket_open = disable_nagle
        self.client.on_message = lambda _c, _u, message: self.on_payload(bytes(message.payload))
        self.client.on_connect = self._connected
        self.client.on_subscribe = lambda *_: self._ready.set()
        self.client.connect(HOST, port, keepalive=60)
        self.client.loop_start()
        if not self._ready.wait(TIMEOUT_S):
            raise TimeoutError("the broker did not accept the benchmark's client")

    def reset(self) -> None:
        """Discards received payloads. The client and its callbacks form a cycle, so they may stay in memory."""
        self.received: queue.SimpleQueue[bytes] = queue.SimpleQueue()
        self.on_payload: Callable[[bytes], None] = self.received.put_nowait

    def _connected(self, *_: Any) -> None:
        if self._filters:
            self.client.subscribe(self._filters)
        else:
            self._ready.set()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.client.disconnect()
        with contextlib.suppress(AttributeError):  # paho's thread may end at the same time
            self.client.loop_stop()


class _TelemetryFields(msgspec.Struct):
    """The telemetry fields that the operator needs."""

    tick_ms: int
    commanded_rad: tuple[float, ...]
    epoch: int
    setpoint_sequence: int


class StreamingOperator:
    """An operator who streams setpoints that keep one robot in place. Leaving the context releases control.

    Args:
        product: The running product.
        name: Name of the device at its agent.

    Attributes:
        sent: Payload of the newest setpoint.
        received: Payload of the newest telemetry.
    """

    def __init__(self, product: MeasuredProduct, name: str = "ur5") -> None:
        self._product = product
        self.sent = self.received = b""
        self.device = product.api.device(name)
        self._path = f"/devices/{self.device['id']}/lease"
        self._telemetry_changed = threading.Condition()
        self._latest_telemetry: _TelemetryFields | None = None
        self._sequence = 0
        self._next_s = 0.0
        self._stopping = threading.Event()
        topic = self.device["topic"]
        self.mqtt = product.connect(publish=(f"{topic}/ctl/+",), subscribe=(f"{topic}/tele/joints",))
        self.mqtt.on_payload = self._on_telemetry
        lease = product.api.post(self._path, {"lease_ms": LEASE_MS, "wait_ms": 5000})
        self.epoch: int = lease["epoch"]
        self._topic = f"{topic}/ctl/{self.epoch}"
        self._key = bytes.fromhex(lease["setpoint_key"])
        self._renewal = threading.Thread(target=self._renew, daemon=True)
        self._renewal.start()
        with self._telemetry_changed:
            self._telemetry_changed.wait_for(lambda: self._latest_telemetry is not None, TIMEOUT_S)
        joints = [each.name for each in robot_type.load(ROOT / "robots" / self.device["robot_type"]).joints]
        self.target_rad: dict[str, float] = dict(zip(joints, self._require_telemetry().commanded_rad, strict=True))

    def exchange(self) -> float:
        """Sends a setpoint at the console's rate and returns the time until telemetry reports it as applied [ms].

        Raises:
            TimeoutError: Telemetry does not report the setpoint.
        """
        time.sleep(max(0.0, self._next_s - time.monotonic()))
        self._next_s = time.monotonic() + PERIOD_S
        with self._telemetry_changed:
            self._sequence += 1
            setpoint = Setpoint(
                epoch=self.epoch,
                sequence=self._sequence,
                echo_tick_ms=self._require_telemetry().tick_ms,
                sent_ms=time.monotonic() * 1000,
                target=JointTarget(position_rad=self.target_rad),
            )
            self.sent = setpoints.seal(codec.encode(setpoint), self._key, self._topic)
            started_s = time.perf_counter()
            self.mqtt.client.publish(self._topic, self.sent)
            if not self._telemetry_changed.wait_for(self._applied, TIMEOUT_S):
                raise TimeoutError(f"telemetry did not report setpoint {self._sequence}")
        return (time.perf_counter() - started_s) * 1000

    def run_action(self, connection: "HttpConnection") -> float:
        """Starts an action to the present pose, waits for its end, and returns the time until it started [ms].

        Raises:
            RuntimeError: The action did not start.
        """
        request = {"kind": "move_joints", "position_rad": self.target_rad}
        body = {"request": request, "epoch": self.epoch, "wait_for": "started", "wait_ms": 10_000}
        payload = json.dumps(body).encode()
        started_s = time.perf_counter()
        action = connection.request("POST", f"/api/v1/devices/{self.device['id']}/actions", payload)
        duration_ms = (time.perf_counter() - started_s) * 1000
        if action["status"] not in ("started", "done"):
            raise RuntimeError(f"the action did not start: {action}")
        connection.request("GET", f"/api/v1/actions/{action['id']}?wait_ms=10000")
        return duration_ms

    def _require_telemetry(self) -> _TelemetryFields:
        if self._latest_telemetry is None:
            raise TimeoutError("the robot publishes no telemetry")
        return self._latest_telemetry

    def _applied(self) -> bool:
        latest = self._latest_telemetry
        return latest is not None and latest.epoch == self.epoch and latest.setpoint_sequence >= self._sequence

    def _on_telemetry(self, payload: bytes) -> None:
        latest = codec.decode(payload, _TelemetryFields)
        with self._telemetry_changed:
            self._latest_telemetry, self.received = latest, payload
            self._telemetry_changed.notify()

    def _renew(self) -> None:
        while not self._stopping.wait(LEASE_MS / 4000):
            self._product.api.post(self._path, {"lease_ms": LEASE_MS, "epoch": self.epoch})

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._stopping.set()
        self._renewal.join(TIMEOUT_S)
        self._product.api.http.delete(self._path, params={"epoch": self.epoch})
        self.mqtt.__exit__()


class HttpConnection:
    """One open HTTP connection of the standard library, the cheapest client. Leaving the context closes it."""

    def __init__(self, port: int, headers: dict[str, str] | None = None) -> None:
        self._connection = http.client.HTTPConnection(HOST, port, timeout=TIMEOUT_S)
        self._headers = {"Content-Type": "application/json", **(headers or {})}
        self._connection.connect()
        self._connection.sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)

    def request(self, method: str, path: str, body: bytes | None = None) -> Any:
        """Sends a request and returns the JSON of the response.

        Raises:
            RuntimeError: The response is an error.
        """
        self._connection.request(method, path, body, self._headers)
        response = self._connection.getresponse()
        content = response.read()
        if response.status >= http.client.BAD_REQUEST:
            raise RuntimeError(f"{method} {path}: {response.status} {content[:300]!r}")
        return json.loads(content) if content else None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._connection.close()


@contextlib.contextmanager
def start(home: Path, kind: BrokerKind, **more: str) -> Iterator[MeasuredProduct]:
    """Runs the product with one simulated UR5 and this broker; ``more`` are further settings."""
    with start_machine(home, port=0, TELESCOPE_BROKER=kind, **more) as machine:
        if machine.process.poll() is not None:
            raise RuntimeError("".join(machine.lines))
        environment = {
            "TELESCOPE_HOME": str(home),
            "TELESCOPE_PORT": str(machine.port),
            "TELESCOPE_BROKER": kind,
            **more,
        }
        with Cloud(settings.read(environment)) as cloud:
            yield MeasuredProduct(machine, kind, cloud)


@contextlib.contextmanager
def start_peer(module: str, *arguments: str) -> Iterator["subprocess.Popen[str]"]:
    """Runs a reference program that prints ``ready`` when it accepts requests."""
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
