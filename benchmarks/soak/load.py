"""Load on the laboratory: clients that stream, start movements, stop robots, view telemetry, sign in and share."""

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
from device_agent.protocol.security import setpoints
from tests.harness.browser.product import Api
from tests.harness.paths import ROOT

_MOVEMENTS: Final = {"nao": "wave", "qbo": "look_around", "hanson": "look_around"}
_STOPPED: Final = "hanson"
"""Robot that is stopped during every third movement and reset by a signed-in owner."""
_STOP_EVERY: Final = 3
_HISTORY_MS: Final = 60_000
_SHARED: Final = "qbo"
_GUEST: Final = "guest"
_PAGE: Final = 50
"""Rows per list: a response that grows with the stored data would look like a leak."""
_LISTS: Final = ("actions", "events", "faults", "shares", "invitations", "movements")
_ACCOUNT_LISTS: Final = ("/devices", "/agents", "/spaces", "/api-keys", "/accounts/me/sessions", "/accounts/me/audit")
_PERIOD_S: Final = 0.05
_SWING_RAD: Final = 0.15
_SWING_S: Final = 4.0
_RENEW_S: Final = 5.0
_MAX_FILTERS: Final = 8
"""Filters per SUBSCRIBE, a limit of the wire contract."""
_TERMINAL: Final = ("done", "failed", "expired", "cancelled")
_ERROR_LENGTH: Final = 160


class Load:
    """Runs the clients, each in its own thread, until the context ends.

    Args:
        product: The product.
        hold_s: Time for which a client streams or views before it reconnects with new credentials [s].

    Attributes:
        done: Counts of completed operations by name.
        errors: Counts of failures by name; none are expected.
    """

    def __init__(self, product: MeasuredProduct, *, hold_s: float) -> None:
        self._product = product
        self._hold_s = hold_s
        self._stopping = threading.Event()
        self._lock = threading.Lock()
        self.done: Counter[str] = Counter()
        self.errors: Counter[str] = Counter()
        clients: dict[str, Callable[[httpx.Client, int], None]] = {
            "operator": self._operate,
            "visitor": self._visit,
            "owner": self._share,
            "watcher 1": self._watch,
            "watcher 2": self._watch,
        }
        clients |= {name: self._mover(name, movement) for name, movement in _MOVEMENTS.items()}
        self._threads = [threading.Thread(target=self._repeat, args=each, name=each[0]) for each in clients.items()]

    def count(self, what: str, times: int = 1) -> None:
        """Counts a completed operation."""
        with self._lock:
            self.done[what] += times

    def __enter__(self) -> Self:
        for each in self._threads:
            each.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stopping.set()
        for each in self._threads:
            each.join(4 * TIMEOUT_S)

    def _repeat(self, name: str, work: Callable[[httpx.Client, int], None]) -> None:
        """Repeats an operation; a failure is counted and followed by a pause of one second."""
        number = 0
        while not self._stopping.is_set():
            try:
                with self._http() as http:
                    while not self._stopping.is_set():
                        work(http, number)
                        number += 1
            except Exception as error:  # noqa: BLE001 (the suite reports every error)
                number += 1
                with self._lock:
                    self.errors[f"{name}: {type(error).__name__} {error}"[:_ERROR_LENGTH]] += 1
                self._stopping.wait(1.0)

    def _http(self) -> httpx.Client:
        key = {"Authorization": f"Bearer {self._product.token}"}
        return httpx.Client(base_url=f"{self._product.machine.url}/api/v1", headers=key, timeout=30)

    def _request(self, http: httpx.Client, method: str, path: str, body: Any = None, **query: Any) -> Any:
        response = http.request(method, path, json=body, params=query)
        if response.is_error:
            raise RuntimeError(f"{method} {path}: {response.status_code} {response.text}")
        self.count("HTTP requests")
        return response.json() if response.content else None

    def _device(self, http: httpx.Client, name: str) -> dict[str, Any]:
        devices = self._request(http, "GET", "/devices")["items"]
        device: dict[str, Any] = next(each for each in devices if each["name"] == name)
        return device

    @contextlib.contextmanager
    def _connected(self, http: httpx.Client, request: dict[str, Any], *topics: str) -> Iterator[MqttClient]:
        """Connects a client with its own credentials to these topics; without topics, to all permitted ones."""
        issued = self._request(http, "POST", "/mqtt/credentials", request)
        filters = topics or tuple(issued["subscribe"])
        login = (issued["client_id"], issued["username"], issued["password"])
        with MqttClient(self._product.mqtt_port, *login, subscribe=filters[:_MAX_FILTERS], qos=0) as client:
            client.client.on_disconnect = self._on_disconnect
            for first in range(_MAX_FILTERS, len(filters), _MAX_FILTERS):
                client.client.subscribe([(each, 0) for each in filters[first : first + _MAX_FILTERS]])
            self.count("MQTT connections")
            try:
                yield client
            finally:
                client.client.on_disconnect = None

    def _on_disconnect(self, *_: Any) -> None:
        with self._lock:
            self.errors["MQTT: connection lost"] += 1

    # ------------------------------------------------------------ streaming

    def _operate(self, http: httpx.Client, number: int) -> None:
        """Acquires the arm, streams, releases it and runs a movement."""
        device = self._device(http, "ur5")
        lease = f"/devices/{device['id']}/lease"
        granted = self._request(http, "POST", lease, {"lease_ms": LEASE_MS, "wait_ms": 5000})
        epoch = granted["epoch"]
        try:
            control = {"purpose": "control", "device": device["id"], "epoch": epoch}
            viewer = self._connected(http, {"purpose": "view"}, f"{device['topic']}/tele/joints")
            with viewer as telemetry, self._connected(http, control) as client:
                self._stream(http, lease, StreamedArm(device, granted, telemetry, client))
        finally:
            self._request(http, "DELETE", lease, epoch=epoch)
        self.count("leases acquired and released")
        if number % 2 == 0:
            self._move(http, device, {"kind": "run_movement", "name": "wave"})

    def _stream(self, http: httpx.Client, lease: str, arm: "StreamedArm") -> None:
        deadline_s, renew_s = time.monotonic() + self._hold_s, time.monotonic() + _RENEW_S
        while (now_s := time.monotonic()) < deadline_s and not self._stopping.is_set():
            arm.send(now_s)
            if now_s > renew_s:
                renew_s = now_s + _RENEW_S
                self._request(http, "POST", lease, {"lease_ms": LEASE_MS, "epoch": arm.epoch})
                self.count("leases renewed")
            time.sleep(max(0.0, now_s + _PERIOD_S - time.monotonic()))
        self.count("setpoints", arm.sequence)
        self.count("holds after a gap in the setpoints", arm.inputs - 1)
        if not arm.applied():
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
            self._stopping.wait(1.0)

        return work

    def _move(self, http: httpx.Client, device: dict[str, Any], request: dict[str, Any]) -> None:
        action = self._start(http, device, request, "done")
        if action["status"] != "done":
            raise RuntimeError(f"{request['name']} ended as {action['status']}: {action['reason']}")
        self.count("actions")

    def _start(self, http: httpx.Client, device: dict[str, Any], request: dict[str, Any], until: str) -> dict[str, Any]:
        body = {"request": request, "wait_for": until, "wait_ms": 10_000}
        action: dict[str, Any] = self._request(http, "POST", f"/devices/{device['id']}/actions", body)
        while until == "done" and action["status"] not in _TERMINAL:
            action = self._request(http, "GET", f"/actions/{action['id']}", wait_ms=10_000)
        return action

    def _stop(self, http: httpx.Client, device: dict[str, Any], request: dict[str, Any]) -> None:
        """Stops a robot during a movement, waits for the end and resets the latch as a signed-in owner."""
        action = self._start(http, device, request, "started")
        try:
            if not self._request(http, "POST", f"/devices/{device['id']}/stop", {"reason": "soak"})["confirmed"]:
                raise RuntimeError("a Stop was not confirmed")
            ended = self._request(http, "GET", f"/actions/{action['id']}", wait_ms=10_000)
            if ended["status"] not in ("failed", "cancelled"):
                raise RuntimeError(f"the stopped action ended as {ended['status']}")
        finally:
            with Api(self._product.machine) as api:
                reset = api.post(f"/devices/{device['id']}/stop/reset")["confirmed"]
                api.post("/auth/sign-out")
        if not reset:
            raise RuntimeError("a reset was not confirmed")
        self.count("Stops and resets")

    # ------------------------------------------------------------ viewers and sign-ins

    def _watch(self, http: httpx.Client, _number: int) -> None:
        """Views all telemetry for some time."""
        with self._connected(http, {"purpose": "view"}) as client:
            self._stopping.wait(self._hold_s)
            received = client.received.qsize()
            client.reset()
            self.count("messages received", received)
            if not received:
                raise RuntimeError("no telemetry received")

    def _visit(self, _http: httpx.Client, _number: int) -> None:
        """Signs in, reads some resources and signs out."""
        with Api(self._product.machine) as api:
            devices = api.get("/devices")["items"]
            arm = next(each for each in devices if each["name"] == "ur5")
            for path in ("/accounts/me", "/spaces", "/diagnostics"):
                api.get(path)
            for stream in api.get(f"/devices/{arm['id']}/data")["items"]:
                # Constant size: a response that grows with the stored data would look like a leak.
                since_ms = round(time.time() * 1000) - _HISTORY_MS
                api.get(f"/devices/{arm['id']}/data/{stream['name']}", resolution="10s", **{"from": since_ms})
            assert api.http.put(f"/devices/{arm['id']}/viewers").is_success
            api.post("/auth/sign-out")
            self.count("HTTP requests", 9)
            self.count("sign-ins and sign-outs")
        self._stopping.wait(self._hold_s / 2)

    def _share(self, _http: httpx.Client, _number: int) -> None:
        """Shares a robot with another account, which reads it; reads all lists; removes the share."""
        with Api(self._product.machine) as owner, Api(self._product.machine, _GUEST) as guest:
            device = owner.device(_SHARED)
            path = f"/devices/{device['id']}"
            account = owner.post(f"{path}/shares", {"account": _GUEST, "role": "operator"})["account"]["id"]
            if [each["id"] for each in guest.get("/devices")["items"]] != [device["id"]]:
                raise RuntimeError("the shared device is not in the list of the other account")
            paths = [*(f"{path}/{name}" for name in _LISTS), *_ACCOUNT_LISTS]
            for each in paths:
                owner.get(each, limit=_PAGE)
            removed = owner.http.delete(f"{path}/shares/{account}")
            if removed.status_code != httpx.codes.NO_CONTENT or guest.get("/devices")["items"]:
                raise RuntimeError(f"the share was not removed: {removed.status_code}")
            owner.post("/auth/sign-out")
            guest.post("/auth/sign-out")
            self.count("HTTP requests", len(paths) + 9)
            self.count("shares given and removed")
        self._stopping.wait(self._hold_s)


class StreamedArm:
    """The arm under one lease with slow motion of one wrist."""

    def __init__(
        self, device: dict[str, Any], lease: dict[str, Any], telemetry: MqttClient, control: MqttClient
    ) -> None:
        joints = robot_type.load(ROOT / "robots" / device["robot_type"]).joints
        self._names = [each.name for each in joints]
        self.epoch: int = lease["epoch"]
        self._topic = f"{device['topic']}/ctl/{self.epoch}"
        self._key = bytes.fromhex(lease["setpoint_key"])
        self._control = control
        self._newest = codec.decode(telemetry.received.get(timeout=TIMEOUT_S), JointTelemetry)
        self._started_s = time.monotonic()
        self._home_rad = list(self._newest.commanded_rad)
        self.sequence, self.inputs = 0, 1
        telemetry.on_payload = self._on_telemetry

    def _on_telemetry(self, payload: bytes) -> None:
        self._newest = codec.decode(payload, JointTelemetry)

    def send(self, now_s: float) -> None:
        """Sends the next setpoint; after a hold of the watchdog with a new input, as an operator does."""
        self.sequence += 1
        if self._newest.epoch == self.epoch and self._newest.ended_input >= self.inputs:
            self.inputs = self._newest.ended_input + 1
        target = dict(zip(self._names, self._home_rad, strict=True))
        target[self._names[-1]] += _SWING_RAD * math.sin((now_s - self._started_s) / _SWING_S * math.tau)
        setpoint = Setpoint(
            epoch=self.epoch,
            sequence=self.sequence,
            echo_tick_ms=self._newest.tick_ms,
            sent_ms=now_s * 1000,
            target=JointTarget(position_rad=target),
            input=self.inputs,
        )
        self._control.client.publish(self._topic, setpoints.seal(codec.encode(setpoint), self._key, self._topic))

    def applied(self) -> bool:
        """Returns True if one of the last setpoints was applied."""
        deadline_s = time.monotonic() + 1.0
        while time.monotonic() < deadline_s:
            if self._newest.epoch == self.epoch and self._newest.setpoint_sequence > self.sequence - 20:
                return True
            time.sleep(0.02)
        return False
