"""Load on the laboratory: clients that stream, start movements, stop robots, view telemetry and sign in."""

import contextlib
import math
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from typing import Any, Final, Self

import httpx

from benchmarks.baseline.product import LEASE_MS, TIMEOUT_S, MeasuredProduct, MqttClient
from device_agent.protocol import JointTarget, JointTelemetry, Setpoint, codec
from device_agent.protocol.manifests import robot_type
from tests.harness.browser.product import Api
from tests.harness.paths import ROOT

_MOVEMENTS: Final = {"nao": "wave", "qbo": "look_around", "hanson": "look_around"}
_STOPPED: Final = "hanson"
"""Robot that is stopped during every third movement and reset by a signed-in owner."""
_STOP_EVERY: Final = 3
_LOOKED_BACK_MS: Final = 60_000
_PERIOD_S: Final = 0.05
_SWING_RAD: Final = 0.15
_SWING_S: Final = 4.0
_RENEW_S: Final = 5.0
_AT_ONCE: Final = 8
"""Filters per SUBSCRIBE, a limit of the wire contract."""
_ENDS: Final = ("done", "failed", "expired", "cancelled")
_ERROR_LENGTH: Final = 160


class Load:
    """Runs the clients, each in its own thread, until the context ends.

    Args:
        stand: The product.
        hold_s: Time for which a client streams or views before it reconnects with new credentials [s].

    Attributes:
        done: Counts of completed operations by name.
        errors: Counts of failures by name; none are expected.
    """

    def __init__(self, stand: MeasuredProduct, *, hold_s: float) -> None:
        self._stand = stand
        self._hold_s = hold_s
        self._ending = threading.Event()
        self._lock = threading.Lock()
        self.done: Counter[str] = Counter()
        self.errors: Counter[str] = Counter()
        rounds: dict[str, Callable[[httpx.Client, int], None]] = {
            "operator": self._operate,
            "visitor": self._visit,
            "watcher 1": self._watch,
            "watcher 2": self._watch,
        }
        rounds |= {name: self._mover(name, movement) for name, movement in _MOVEMENTS.items()}
        self._threads = [threading.Thread(target=self._again, args=each, name=each[0]) for each in rounds.items()]

    def count(self, what: str, times: int = 1) -> None:
        """Counts a completed operation."""
        with self._lock:
            self.done[what] += times

    def __enter__(self) -> Self:
        for each in self._threads:
            each.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._ending.set()
        for each in self._threads:
            each.join(4 * TIMEOUT_S)

    def _again(self, name: str, work: Callable[[httpx.Client, int], None]) -> None:
        """Repeats an operation; a failure is counted and followed by a pause of one second."""
        number = 0
        while not self._ending.is_set():
            try:
                with self._http() as http:
                    while not self._ending.is_set():
                        work(http, number)
                        number += 1
            except Exception as error:  # noqa: BLE001 (the suite reports every error)
                number += 1
                with self._lock:
                    self.errors[f"{name}: {type(error).__name__} {error}"[:_ERROR_LENGTH]] += 1
                self._ending.wait(1.0)

    def _http(self) -> httpx.Client:
        key = {"Authorization": f"Bearer {self._stand.token}"}
        return httpx.Client(base_url=f"{self._stand.machine.url}/api/v1", headers=key, timeout=30)

    def _ask(self, http: httpx.Client, method: str, path: str, body: Any = None, **query: Any) -> Any:
        answer = http.request(method, path, json=body, params=query)
        if answer.is_error:
            raise RuntimeError(f"{method} {path}: {answer.status_code} {answer.text}")
        self.count("HTTP requests")
        return answer.json() if answer.content else None

    def _device(self, http: httpx.Client, name: str) -> dict[str, Any]:
        devices = self._ask(http, "GET", "/devices")["items"]
        found: dict[str, Any] = next(each for each in devices if each["name"] == name)
        return found

    @contextlib.contextmanager
    def _connected(self, http: httpx.Client, wanted: dict[str, Any], *topics: str) -> Iterator[MqttClient]:
        """Connects a client with its own credentials to these topics; without topics, to all permitted ones."""
        issued = self._ask(http, "POST", "/mqtt/credentials", wanted)
        filters = topics or tuple(issued["subscribe"])
        who = (issued["client_id"], issued["username"], issued["password"])
        with MqttClient(self._stand.mqtt_port, *who, subscribe=filters[:_AT_ONCE], qos=0) as line:
            line.client.on_disconnect = self._dropped
            for first in range(_AT_ONCE, len(filters), _AT_ONCE):
                line.client.subscribe([(each, 0) for each in filters[first : first + _AT_ONCE]])
            self.count("MQTT connections")
            try:
                yield line
            finally:
                line.client.on_disconnect = None

    def _dropped(self, *_: Any) -> None:
        with self._lock:
            self.errors["MQTT: connection lost"] += 1

    # ------------------------------------------------------------ streaming

    def _operate(self, http: httpx.Client, number: int) -> None:
        """Acquires the arm, streams, releases it and runs a movement."""
        device = self._device(http, "ur5")
        lease = f"/devices/{device['id']}/lease"
        granted = self._ask(http, "POST", lease, {"lease_ms": LEASE_MS, "wait_ms": 5000})
        epoch = granted["epoch"]
        try:
            control = {"purpose": "control", "device": device["id"], "epoch": epoch}
            ear = self._connected(http, {"purpose": "view"}, f"{device['topic']}/tele/joints")
            with ear as heard, self._connected(http, control) as line:
                self._stream(http, lease, StreamingResult(device, epoch, heard, line))
        finally:
            self._ask(http, "DELETE", lease, epoch=epoch)
        self.count("leases taken and given back")
        if number % 2 == 0:
            self._move(http, device, {"kind": "run_movement", "name": "wave"})

    def _stream(self, http: httpx.Client, lease: str, arm: "StreamingResult") -> None:
        ends_s, renew_s = time.monotonic() + self._hold_s, time.monotonic() + _RENEW_S
        while (now_s := time.monotonic()) < ends_s and not self._ending.is_set():
            arm.send(now_s)
            if now_s > renew_s:
                renew_s = now_s + _RENEW_S
                self._ask(http, "POST", lease, {"lease_ms": LEASE_MS, "epoch": arm.epoch})
                self.count("leases renewed")
            time.sleep(max(0.0, now_s + _PERIOD_S - time.monotonic()))
        self.count("setpoints", arm.sequence)
        if not arm.obeyed():
            raise RuntimeError("setpoints were not applied")

    # ------------------------------------------------------------ movements

    def _mover(self, name: str, movement: str) -> Callable[[httpx.Client, int], None]:
        def work(http: httpx.Client, number: int) -> None:
            device = self._device(http, name)
            request = {"kind": "run_movement", "name": movement}
            if name == _STOPPED and number % _STOP_EVERY == 1:
                self._stop(http, device, request)
            else:
                self._move(http, device, request)
            self._ending.wait(1.0)

        return work

    def _move(self, http: httpx.Client, device: dict[str, Any], request: dict[str, Any]) -> None:
        action = self._begin(http, device, request, "done")
        if action["status"] != "done":
            raise RuntimeError(f"{request['name']} ended as {action['status']}: {action.get('detail')}")
        self.count("actions")

    def _begin(self, http: httpx.Client, device: dict[str, Any], request: dict[str, Any], until: str) -> dict[str, Any]:
        asked = {"request": request, "wait_for": until, "wait_ms": 10_000}
        action: dict[str, Any] = self._ask(http, "POST", f"/devices/{device['id']}/actions", asked)
        while until == "done" and action["status"] not in _ENDS:
            action = self._ask(http, "GET", f"/actions/{action['id']}", wait_ms=10_000)
        return action

    def _stop(self, http: httpx.Client, device: dict[str, Any], request: dict[str, Any]) -> None:
        """Stops a robot during a movement, waits for the end and resets the latch as a signed-in owner."""
        action = self._begin(http, device, request, "started")
        if not self._ask(http, "POST", f"/devices/{device['id']}/stop", {"reason": "soak"})["confirmed"]:
            raise RuntimeError("a Stop was not confirmed")
        ended = self._ask(http, "GET", f"/actions/{action['id']}", wait_ms=10_000)
        if ended["status"] not in ("failed", "cancelled"):
            raise RuntimeError(f"stopped, and {ended['status']}")
        with Api(self._stand.machine) as api:
            if not api.post(f"/devices/{device['id']}/stop/reset")["confirmed"]:
                raise RuntimeError("a reset was not confirmed")
            api.post("/auth/sign-out")
        self.count("Stops and resets")

    # ------------------------------------------------------------ viewers and sign-ins

    def _watch(self, http: httpx.Client, _number: int) -> None:
        """Views all telemetry for some time."""
        with self._connected(http, {"purpose": "view"}) as line:
            self._ending.wait(self._hold_s)
            heard = line.received.qsize()
            line.reset()
            self.count("messages received", heard)
            if not heard:
                raise RuntimeError("nothing is heard")

    def _visit(self, _http: httpx.Client, _number: int) -> None:
        """Signs in, reads some resources and signs out."""
        with Api(self._stand.machine) as api:
            devices = api.get("/devices")["items"]
            arm = next(each for each in devices if each["name"] == "ur5")
            for path in ("/accounts/me", "/spaces", "/diagnostics"):
                api.get(path)
            for stream in api.get(f"/devices/{arm['id']}/data")["items"]:
                # Constant size: a response that grows with the stored data would look like a leak.
                since_ms = round(time.time() * 1000) - _LOOKED_BACK_MS
                api.get(f"/devices/{arm['id']}/data/{stream['name']}", resolution="10s", **{"from": since_ms})
            assert api.http.put(f"/devices/{arm['id']}/viewers").is_success
            api.post("/auth/sign-out")
            self.count("HTTP requests", 9)
            self.count("sign-ins and sign-outs")
        self._ending.wait(self._hold_s / 4)


class StreamingResult:
    """The arm under one lease with slow motion of one wrist."""

    def __init__(self, device: dict[str, Any], epoch: int, heard: MqttClient, line: MqttClient) -> None:
        joints = robot_type.load(ROOT / "robots" / device["robot_type"]).joints
        self._names = [each.name for each in joints]
        self._topic = f"{device['topic']}/ctl/{epoch}"
        self._line = line
        self._newest = codec.decode(heard.received.get(timeout=TIMEOUT_S), JointTelemetry)
        self._began_s = time.monotonic()
        self._home_rad = list(self._newest.commanded_rad)
        self.epoch = epoch
        self.sequence = 0
        heard.on_payload = self._hear

    def _hear(self, payload: bytes) -> None:
        self._newest = codec.decode(payload, JointTelemetry)

    def send(self, now_s: float) -> None:
        """Sends the next setpoint."""
        self.sequence += 1
        target = dict(zip(self._names, self._home_rad, strict=True))
        target[self._names[-1]] += _SWING_RAD * math.sin((now_s - self._began_s) / _SWING_S * math.tau)
        setpoint = Setpoint(
            epoch=self.epoch,
            sequence=self.sequence,
            echo_tick_ms=self._newest.tick_ms,
            sent_ms=now_s * 1000,
            target=JointTarget(position_rad=target),
        )
        self._line.client.publish(self._topic, codec.encode(setpoint))

    def obeyed(self) -> bool:
        """Returns True if one of the last setpoints was applied."""
        patience_s = time.monotonic() + 1.0
        while time.monotonic() < patience_s:
            if self._newest.epoch == self.epoch and self._newest.setpoint_sequence > self.sequence - 20:
                return True
            time.sleep(0.02)
        return False
