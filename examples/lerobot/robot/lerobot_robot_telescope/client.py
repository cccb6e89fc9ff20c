"""One device of Telescope: HTTP for the lease, MQTT for telemetry and setpoints."""

import contextlib
import hmac
import json
import math
import os
import threading
import time
import uuid
from collections.abc import Callable
from typing import Any

import paho.mqtt.client as mqtt
import requests

RENEW_S = 10.0
"""Period in which the lease is renewed [s]."""
LEASE_S = 30.0
"""Duration of the lease [s]."""
RENEW_AFTER = 0.5
"""Credentials of the broker are replaced after this share of their lifetime."""
START_S = 10.0
"""Time for the first telemetry, and for the device's confirmation of the lease [s]."""
OLD_S = 1.0
"""Older telemetry is not an observation [s]."""
ACCEPT_S = 0.3
"""Time in which the device accepts a setpoint; then it is sent again with the newest telemetry [s]."""
ATTEMPTS = 4
INPUT = 1
"""Each lease has one input: after a hold only a person decides to continue, by connecting again."""


class TelescopeError(ConnectionError):
    """The device cannot be observed or moved. The message says what to do."""


class UnreachableError(TelescopeError):
    """Telescope does not respond."""


class Device:
    """A device, seen and moved by an API key.

    Args:
        url: Address of Telescope.
        name: Name of the device.
    """

    def __init__(self, url: str, name: str) -> None:
        self.name = name
        self._url = url
        self._row: dict[str, Any] = {}
        self._changed = threading.Condition()
        self._telemetry: dict[str, Any] | None = None
        self._received_s = 0.0
        self._watcher: mqtt.Client | None = None
        self._watcher_due_s = math.inf
        self._lease: dict[str, Any] | None = None
        self._lease_ends_s = 0.0
        self._control: mqtt.Client | None = None
        self._control_due_s = math.inf
        self._closing = threading.Event()
        self._renewing = threading.Lock()
        self._sequence = 0
        self._lost = ""

    @property
    def connected(self) -> bool:
        """Whether telemetry is received."""
        return self._watcher is not None

    def joints(self) -> list[dict[str, Any]]:
        """The joints with their limits. Raises ``TelescopeError``."""
        robot_type = self._device()["robot_type"]
        return list(self._call("GET", f"/robot-types/{robot_type}")["joints"])

    def watch(self) -> None:
        """Receive telemetry. Raises ``TelescopeError`` if there is none."""
        self._closing = threading.Event()
        self._open_watcher()
        threading.Thread(target=self._renew, args=(self._closing,), daemon=True).start()
        try:
            self._wait(bool, START_S, f"'{self.name}' sends no telemetry; check that it is online")
        except TelescopeError:
            self.close()
            raise

    def take_control(self) -> None:
        """Take the lease. Raises ``TelescopeError`` if another operator has it, or the device does not confirm it."""
        lease = self._call("POST", f"/devices/{self._device()['id']}/lease", {})
        self._sequence, self._lost, self._lease_ends_s = 0, "", time.monotonic() + LEASE_S
        self._lease = lease
        try:
            with self._renewing:
                self._open_control(lease)
            message = f"'{self.name}' does not confirm the lease; check that it is online"
            self._wait(lambda telemetry: telemetry.get("epoch", 0) == lease["epoch"], START_S, message)
        except TelescopeError:
            self.release()
            raise

    def position_rad(self) -> list[float]:
        """Measured positions of all joints [rad]. Raises ``TelescopeError``."""
        return list(self._newest()["position_rad"])

    def move(self, position_rad: dict[str, float]) -> list[float]:
        """Send a setpoint; returns the positions that the device commands now, after its limits [rad].

        Raises:
            TelescopeError: There is no lease, the device holds, or does not accept the setpoint.
        """
        for _ in range(ATTEMPTS):
            telemetry = self._check_control(self._newest())
            self._sequence += 1
            self._publish(telemetry, position_rad)
            with contextlib.suppress(TelescopeError):
                accepted = self._wait(self._accepted, ACCEPT_S, "")
                return list(self._check_control(accepted)["commanded_rad"])
        self._check_control(self._newest())
        raise TelescopeError(f"'{self.name}' does not accept setpoints; see its page in the console")

    def release(self) -> None:
        """Release the lease. May be called repeatedly."""
        with self._renewing:
            lease, self._lease = self._lease, None
            control, self._control = self._control, None
        if lease is not None:
            with contextlib.suppress(TelescopeError):  # it expires by itself
                self._call("DELETE", f"/devices/{self._device()['id']}/lease?epoch={lease['epoch']}")
        _end(control)

    def close(self) -> None:
        """Release the lease and end the connections. May be called repeatedly."""
        self._closing.set()
        self.release()
        with self._renewing:
            watcher, self._watcher = self._watcher, None
        self._telemetry = None
        _end(watcher)

    # ------------------------------------------------------------ telemetry and setpoints

    def _receive(self, payload: bytes) -> None:
        with self._changed:
            self._telemetry, self._received_s = json.loads(payload), time.monotonic()
            self._changed.notify_all()

    def _wait(self, condition: Callable[[dict[str, Any]], bool], within_s: float, message: str) -> dict[str, Any]:
        with self._changed:
            found = self._changed.wait_for(lambda: self._telemetry is not None and condition(self._telemetry), within_s)
            if not found or self._telemetry is None:
                raise TelescopeError(message)
            return self._telemetry

    def _newest(self) -> dict[str, Any]:
        telemetry = self._telemetry
        if telemetry is None:
            raise TelescopeError(f"'{self.name}' is not connected; call connect")
        if time.monotonic() - self._received_s > OLD_S:
            raise TelescopeError(f"'{self.name}' sends no telemetry; check that it is online")
        return telemetry

    def _accepted(self, telemetry: dict[str, Any]) -> bool:
        lease = self._lease
        ended = lease is None or telemetry.get("epoch", 0) != lease["epoch"] or telemetry.get("ended_input", 0) >= INPUT
        return ended or telemetry.get("setpoint_sequence", 0) >= self._sequence

    def _check_control(self, telemetry: dict[str, Any]) -> dict[str, Any]:
        lease = self._lease
        if lease is None:
            raise TelescopeError(f"no control of '{self.name}': connect takes the lease")
        if self._lost or telemetry.get("epoch", 0) != lease["epoch"]:
            raise TelescopeError(f"control of '{self.name}' was lost; connect again to take it. {self._lost}".rstrip())
        if telemetry.get("ended_input", 0) >= INPUT:
            raise TelescopeError(f"'{self.name}' holds, because setpoints were late; check it, and connect again")
        return telemetry

    def _publish(self, telemetry: dict[str, Any], position_rad: dict[str, float]) -> None:
        lease, control = self._lease, self._control
        if lease is None or control is None:
            raise TelescopeError(f"no control of '{self.name}': connect takes the lease")
        name = self._topic(f"ctl/{lease['epoch']}")
        setpoint = {
            "epoch": lease["epoch"],
            "sequence": self._sequence,
            "echo_tick_ms": telemetry["tick_ms"],
            "sent_ms": time.time() * 1000,
            "input": INPUT,
            "target": {"kind": "joints", "position_rad": position_rad},
        }
        body = json.dumps(setpoint)
        text = f"telescope/v1/setpoint\n{name}\n{body}"
        tag = hmac.new(bytes.fromhex(lease["setpoint_key"]), text.encode(), "sha256").hexdigest()[:32]
        control.publish(name, f'{{"tag":"{tag}","body":{body}}}', qos=0)

    # ------------------------------------------------------------ renewal

    def _renew(self, closing: threading.Event) -> None:
        """Renew the lease, and the connections to the broker before their credentials expire."""
        while not closing.wait(RENEW_S):
            with self._renewing:
                if closing.is_set():
                    return
                self._renew_lease()
                with contextlib.suppress(TelescopeError):  # the present credentials are still valid
                    if self._lease is not None and time.monotonic() >= self._control_due_s:
                        self._open_control(self._lease)
                    if time.monotonic() >= self._watcher_due_s:
                        self._open_watcher()

    def _renew_lease(self) -> None:
        if self._lease is None or self._lost:
            return
        try:
            self._call("POST", f"/devices/{self._device()['id']}/lease", {"epoch": self._lease["epoch"]})
            self._lease_ends_s = time.monotonic() + LEASE_S
        except UnreachableError as error:
            if time.monotonic() >= self._lease_ends_s:
                self._lost = str(error)
        except TelescopeError as error:
            self._lost = str(error)

    def _open_control(self, lease: dict[str, Any]) -> None:
        """Replace the connection for setpoints."""
        request = {"purpose": "control", "device": self._device()["id"], "epoch": lease["epoch"]}
        client, lifetime_s = self._connect_to_broker(request)
        client.loop_start()
        previous, self._control = self._control, client
        self._control_due_s = time.monotonic() + RENEW_AFTER * lifetime_s
        _end(previous)

    def _open_watcher(self) -> None:
        """Replace the connection for telemetry."""
        name = self._topic("tele/joints")
        client, lifetime_s = self._connect_to_broker({"purpose": "view"})
        client.on_message = lambda _client, _data, message: self._receive(message.payload)
        client.on_connect = lambda client, *_: client.subscribe([(name, 0)])
        client.loop_start()
        previous, self._watcher = self._watcher, client
        self._watcher_due_s = time.monotonic() + RENEW_AFTER * lifetime_s
        _end(previous)

    # ------------------------------------------------------------ requests

    def _device(self) -> dict[str, Any]:
        if not self._row:
            rows = self._call("GET", "/devices")["items"]
            found = [row for row in rows if row["name"] == self.name]
            if not found:
                names = ", ".join(row["name"] for row in rows) or "none"
                raise TelescopeError(f"no device '{self.name}'; this API key sees: {names}")
            self._row = found[0]
        return self._row

    def _topic(self, suffix: str) -> str:
        row = self._device()
        return f"ts/v1/{row['space']}/{row['agent']}/{row['name']}/{suffix}"

    def _call(self, method: str, path: str, body: dict[str, Any] | None = None) -> Any:
        token = os.environ.get("TELESCOPE_TOKEN", "")
        if not token:
            raise TelescopeError("set TELESCOPE_TOKEN to an API key of Telescope")
        headers = {"Authorization": f"Bearer {token}", "Idempotency-Key": str(uuid.uuid4())}
        try:
            response = requests.request(method, f"{self._url}/api/v1{path}", json=body, headers=headers, timeout=30)
        except requests.RequestException as error:
            raise UnreachableError(f"Telescope at {self._url} cannot be reached; check the address") from error
        if not response.ok:
            raise TelescopeError(f"Telescope has rejected the request: {_detail(response)}")
        return response.json() if response.content else None

    def _connect_to_broker(self, request: dict[str, Any]) -> tuple[mqtt.Client, float]:
        """A connection whose loop does not run yet, and the lifetime of its credentials [s]."""
        credentials = self._call("POST", "/mqtt/credentials", request)
        client = mqtt.Client(
            mqtt.CallbackAPIVersion.VERSION2, client_id=credentials["client_id"], protocol=mqtt.MQTTv311
        )
        client.username_pw_set(credentials["username"], credentials["password"])
        if credentials["tcp"]["tls"]:
            client.tls_set()
        try:
            client.connect(credentials["tcp"]["host"], credentials["tcp"]["port"])
        except OSError as error:
            raise UnreachableError("the broker of Telescope cannot be reached; check the network") from error
        return client, float(credentials["lifetime_s"])


def _end(client: mqtt.Client | None) -> None:
    if client is not None:
        client.disconnect()
        client.loop_stop()


def _detail(response: requests.Response) -> str:
    """The text of a problem, or the status."""
    with contextlib.suppress(ValueError):
        problem = response.json()
        if isinstance(problem, dict) and problem.get("detail"):
            return str(problem["detail"])
    return f"status {response.status_code}"
