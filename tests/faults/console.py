"""An operator without a browser: takes control and streams setpoints by the rules of the console, with one exception.

It continues its input after a gap, which the console does not, because the agent must refuse that by itself.

``python -m tests.faults.console`` is a warm parent process. For each ``OperatorConfig`` (a line of JSON) it forks an
operator and prints the process id. An operator receives the requests ``take``, ``sweep``, ``rest`` and ``status`` over
its Unix socket, and sends the events ``granted``, ``moving``, ``lost`` and ``ended``, and its status.
"""

import contextlib
import json
import os
import signal
import socket
import sys
import threading
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import msgspec
import paho.mqtt.client as paho
import requests
from paho.mqtt.enums import CallbackAPIVersion

from device_agent.protocol import JointTarget, JointTelemetry, Mode, Setpoint, State, codec
from device_agent.protocol.security import setpoints

PERIOD_S = 0.025
FRESH_S = 0.2
ABANDON_S = 1.0
RETRY_S = 1.0
_BACK_OFF_S = 0.25
_NEAR_RAD = 0.3
"""Distance to an end of the range at which the operator reverses, so that the arm rarely rests."""
_MOVING_RAD_S = 0.3


class OperatorConfig(msgspec.Struct):
    """Configuration of one operator process.

    Attributes:
        socket: Path of the Unix socket of the test that controls it.
        api: Address of the API.
        token: Access token.
        mqtt_port: Port of the broker.
        device: Id of the device.
        joint: Index of the joint that it moves, between ``low_rad`` and ``high_rad``.
        stubborn: Whether it streams on after its lease has expired, and after any gap, like a page with a wrong clock.
    """

    socket: str
    api: str
    token: str
    mqtt_port: int
    device: str
    topic: str
    joints: list[str]
    joint: int
    low_rad: float
    high_rad: float
    lease_ms: int
    stubborn: bool = False


class Link:
    """A connection to the broker that reconnects with new credentials until it is closed."""

    def __init__(
        self, config: OperatorConfig, obtain: Callable[[], dict[str, Any]], receive: Callable[[str, bytes], None]
    ) -> None:
        self._seat = config
        self._obtain = obtain
        self._receive = receive
        self._closed = threading.Event()
        self._client: paho.Client | None = None
        threading.Thread(target=self._run, daemon=True).start()

    def publish(self, topic: str, payload: bytes) -> bool:
        client = self._client
        return client is not None and client.is_connected() and client.publish(topic, payload).rc == 0

    def close(self) -> None:
        self._closed.set()
        if self._client is not None:
            self._client.disconnect()

    def _run(self) -> None:
        while not self._closed.is_set():
            with contextlib.suppress(OSError, ValueError, requests.RequestException):
                self._run_connection(self._obtain())
            self._closed.wait(_BACK_OFF_S)

    def _run_connection(self, issued: dict[str, Any]) -> None:
        disconnected = threading.Event()
        client = paho.Client(
            CallbackAPIVersion.VERSION2, issued["client_id"], protocol=paho.MQTTv311, reconnect_on_failure=False
        )
        client.username_pw_set(issued["username"], issued["password"])
        client.connect_timeout = 5
        client.on_socket_open = _disable_nagle
        client.on_disconnect = lambda *_: disconnected.set()
        client.on_message = lambda _c, _u, message: self._receive(message.topic, bytes(message.payload))
        filters = [(topic, 0) for topic in issued["subscribe"] if topic.startswith(self._seat.topic + "/")]

        def subscribe(*_: Any) -> None:
            if filters:
                client.subscribe(filters)

        client.on_connect = subscribe
        client.connect("127.0.0.1", self._seat.mqtt_port, keepalive=60)
        self._client = client
        client.loop_start()
        while not disconnected.wait(0.5) and not self._closed.is_set():
            pass
        client.disconnect()
        client.loop_stop()
        client._reset_sockets()  # see function_app/adapters/shared/mqtt_client.py


def _disable_nagle(_client: paho.Client, _userdata: Any, opened: Any) -> None:
    opened.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)


class Operator:
    """An operator of one device."""

    def __init__(self, config: OperatorConfig) -> None:
        self.config = config
        self._http = requests.Session()
        self._http.headers["Authorization"] = f"Bearer {config.token}"
        self._calls = ThreadPoolExecutor(2)
        self._controller = socket.socket(socket.AF_UNIX)
        self._controller.connect(config.socket)
        self._telemetry: tuple[JointTelemetry, float] | None = None
        self._state_epoch = 0
        self._link: Link | None = None
        self._watch = Link(config, lambda: self._post("/mqtt/credentials", purpose="view"), self._receive)
        self.epoch: int | None = None
        self._confirmed = False
        self._ends_s = 0.0
        self._renew_s = 0.0
        self._sweeping = False
        self._motion_reported = True
        self._key = b""
        self._sequence = self._input = 0
        self._target_rad: list[float] = []
        self._sent_s = 0.0

    def run(self) -> None:
        """Process requests and tick at 40 Hz until the controlling test disconnects."""
        self._controller.settimeout(PERIOD_S)
        requests_read = b""
        next_s = time.monotonic()
        while True:
            self._controller.settimeout(max(0.001, next_s - time.monotonic()))
            try:
                read = self._controller.recv(4096)
                if not read:
                    return
                requests_read += read
            except TimeoutError:
                pass
            while b"\n" in requests_read:
                line, _, requests_read = requests_read.partition(b"\n")
                getattr(self, line.decode())()
            if time.monotonic() >= next_s:
                next_s = max(next_s + PERIOD_S, time.monotonic())
                self._tick()

    # ------------------------------------------------------------ requests

    def take(self) -> None:
        """Release a remaining lease and take control."""
        if self.epoch is not None:
            self._lose("retaken", report=False)
        requested_s = time.monotonic()
        try:
            granted = self._lease(None)
        except (ValueError, requests.RequestException) as error:
            self._report(rejected=str(error)[:200])
            return
        epoch = self.epoch = granted["epoch"]
        self._key = bytes.fromhex(granted["setpoint_key"])
        self._confirmed, self._sequence, self._input, self._sweeping = False, 0, 0, False
        self._renewed(granted, requested_s)
        self._link = Link(
            self.config,
            lambda: self._post("/mqtt/credentials", purpose="control", device=self.config.device, epoch=epoch),
            lambda _t, _p: None,
        )
        self._report(granted=epoch, confirmed=granted["confirmed"])

    def sweep(self) -> None:
        """Press the slider and sweep it between both ends."""
        telemetry = self._telemetry
        if self.epoch is None or telemetry is None:
            self._report(ended="no-telemetry")
            return
        self._input += 1
        self._target_rad = list(telemetry[0].commanded_rad)
        self._turn()
        self._sent_s = time.monotonic()
        self._sweeping, self._motion_reported = True, False

    def rest(self) -> None:
        """Release the slider."""
        self._sweeping = False

    def status(self) -> None:
        """Report the lease and whether the agent has ended the input."""
        message = self._telemetry[0] if self._telemetry else None
        ended = message is not None and message.epoch == self.epoch and message.ended_input >= self._input
        self._report(epoch=self.epoch, input_ended=ended)

    # ------------------------------------------------------------ the page's rules

    def _tick(self) -> None:
        self._keep_lease()
        telemetry, now_s = self._telemetry, time.monotonic()
        if self.epoch is None or not self._sweeping or telemetry is None:
            return
        message, received_s = telemetry
        if now_s - received_s > FRESH_S:
            if now_s - self._sent_s > ABANDON_S:
                self._end("stale-telemetry")
        elif message.mode in (Mode.STOPPED, Mode.FAULT, Mode.ACTION):
            self._end(str(message.mode))
        else:
            self._stream(message, now_s)

    def _stream(self, message: JointTelemetry, now_s: float) -> None:
        assert self.epoch is not None
        at_rad = message.commanded_rad[self.config.joint]
        if abs(at_rad - self._target_rad[self.config.joint]) < _NEAR_RAD:
            self._turn()
        if message.epoch == self.epoch:
            self._sequence = max(self._sequence, message.setpoint_sequence)
        self._sequence += 1
        target = JointTarget(position_rad=dict(zip(self.config.joints, self._target_rad, strict=True)))
        setpoint = Setpoint(
            epoch=self.epoch,
            sequence=self._sequence,
            echo_tick_ms=message.tick_ms,
            sent_ms=now_s * 1000,
            target=target,
            input=self._input,
        )
        topic = f"{self.config.topic}/ctl/{self.epoch}"
        sealed = setpoints.seal(codec.encode(setpoint), self._key, topic)
        if self._link is not None and self._link.publish(topic, sealed):
            self._sent_s = now_s
        elif now_s - self._sent_s > ABANDON_S:
            self._end("no-connection")
        if not self._motion_reported and abs(message.velocity_rad_s[self.config.joint]) > _MOVING_RAD_S:
            self._motion_reported = True
            self._report(moving=True)

    def _turn(self) -> None:
        at_rad = self._target_rad[self.config.joint]
        middle = (self.config.low_rad + self.config.high_rad) / 2
        self._target_rad[self.config.joint] = self.config.low_rad if at_rad > middle else self.config.high_rad

    def _keep_lease(self) -> None:
        epoch, now_s = self.epoch, time.monotonic()
        if epoch is None:
            return
        telemetry = self._telemetry
        newest_epoch = max(telemetry[0].epoch if telemetry else 0, self._state_epoch)
        if newest_epoch > epoch:
            self._lose("another operator has control")
        elif telemetry and telemetry[0].epoch == epoch:
            self._confirmed = True
        elif telemetry and self._confirmed and telemetry[0].epoch == 0:
            self._lose("the robot ended the lease")
        if self.epoch is None:
            return
        if now_s > self._ends_s and not self.config.stubborn:
            self._lose("expired")
        elif now_s > self._renew_s:
            self._renew_s = float("inf")
            self._calls.submit(self._renew, epoch)

    def _renew(self, epoch: int) -> None:
        requested_s = time.monotonic()
        try:
            granted = self._lease(epoch)
            if self.epoch == epoch:
                self._renewed(granted, requested_s)
        except ValueError:
            self._renew_s = float("inf")  # rejected; the robot's state decides
        except requests.RequestException:
            self._renew_s = time.monotonic() + RETRY_S

    def _renewed(self, granted: dict[str, Any], requested_s: float) -> None:
        self._ends_s = requested_s + granted["lease_ms"] / 1000
        self._renew_s = time.monotonic() + granted["lease_ms"] / 3000

    def _lose(self, reason: str, *, report: bool = True) -> None:
        self.epoch = None
        self._sweeping = False
        if self._link is not None:
            self._link.close()
            self._link = None
        if report:
            self._report(lost=reason)

    def _end(self, reason: str) -> None:
        if self.config.stubborn:
            return
        self._sweeping = False
        self._report(ended=reason)

    # ------------------------------------------------------------ connections

    def _receive(self, topic: str, payload: bytes) -> None:
        if topic.endswith("/tele/joints"):
            self._telemetry = (codec.decode(payload, JointTelemetry), time.monotonic())
        elif topic.endswith("/state"):
            self._state_epoch = codec.decode(payload, State).epoch

    def _lease(self, epoch: int | None) -> dict[str, Any]:
        request = {"lease_ms": self.config.lease_ms, "wait_ms": 2000} | ({} if epoch is None else {"epoch": epoch})
        return self._post(f"/devices/{self.config.device}/lease", **request)

    def _post(self, path: str, **body: Any) -> dict[str, Any]:
        answer = self._http.post(self.config.api + path, json=body, timeout=5)
        if answer.status_code >= 400:
            raise ValueError(f"{path}: {answer.status_code} {answer.text}")
        found: dict[str, Any] = answer.json()
        return found

    def _report(self, **message: Any) -> None:
        self._controller.sendall(json.dumps(message).encode() + b"\n")


def main() -> None:
    signal.signal(signal.SIGCHLD, signal.SIG_IGN)
    for line in sys.stdin:
        config = msgspec.json.decode(line, type=OperatorConfig)
        child = os.fork()
        if child == 0:
            with contextlib.suppress(ConnectionError):  # the controlling test has disconnected
                Operator(config).run()
            os._exit(0)
        print(child, flush=True)


if __name__ == "__main__":
    main()
