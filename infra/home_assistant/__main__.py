"""``python -m infra.home_assistant``: show an account's room devices in Home Assistant.

Prints ``ready`` once both brokers are connected. Runs until SIGTERM or SIGINT and reconnects automatically.

The API key is in ``TELESCOPE_KEY`` and the password of Home Assistant's broker in ``HOME_ASSISTANT_PASSWORD``, so that
process lists do not show them. Exits with 4 if the key is rejected because it has expired or was revoked.
"""

import argparse
import logging
import os
import signal
import ssl
import sys
import threading
from pathlib import Path
from typing import Any

import paho.mqtt.client as mqtt
import requests
from paho.mqtt.enums import CallbackAPIVersion

from device_agent.protocol.security import private_folder
from device_agent.transports import tls as trust
from infra import programs
from infra.home_assistant import discovery
from infra.home_assistant.bridge import Bridge

_TIMEOUT_S = 15.0
_REFUSED = 4
_RETRY_S = 5.0
_RENEW_SHARE = 0.8
"""Credentials are renewed after this share of their lifetime."""
_log = logging.getLogger("infra.home_assistant")


class KeyRefusedError(OSError):
    """The API key is invalid, expired or revoked."""


class Telescope:
    """Client of the HTTP API.

    Args:
        server: ``https://host``.
        key: ``ts_…``.
        ca: CA certificate (PEM) of the server and its broker; ``None`` uses the machine's CAs.
    """

    def __init__(self, server: str, key: str, ca: Path | None = None) -> None:
        self._server = server
        self._base = server.rstrip("/") + "/api/v1"
        self._ca = ca
        self._http = requests.Session()
        self._http.trust_env = ca is None  # otherwise environment variables could replace the CA
        self._http.verify = True if ca is None else str(ca)
        self._http.headers["Authorization"] = f"Bearer {key}"

    def watch(self) -> dict[str, Any]:
        """Broker credentials for everything that the account may view.

        Raises:
            OSError: The server cannot be reached or rejects the request.
        """
        return self._post("/mqtt/credentials", {"purpose": "view"})

    def tls(self, credentials: dict[str, Any]) -> ssl.SSLContext | None:
        """TLS context for the broker of these credentials.

        Raises:
            OSError: The CA certificate cannot be read.
            ValueError: The server uses TLS, but the broker does not.
        """
        return trust.broker(tls=credentials["tcp"]["tls"], server=self._server, ca=self._ca, own=None)

    def set(self, device: str, control: str, value: float) -> str:
        """Set a control; returns an error message, or an empty string."""
        request = {"kind": "set_control", "control": control, "value": value}
        try:
            result = self._post(
                f"/devices/{device}/actions", {"request": request, "wait_ms": 10_000, "wait_for": "done"}
            )
        except (OSError, ValueError) as error:
            return str(error)
        if result.get("status") == "done":
            return ""
        return str((result.get("reason") or {}).get("message") or result.get("status"))

    def _post(self, path: str, body: dict[str, Any]) -> dict[str, Any]:
        response = self._http.post(self._base + path, json=body, timeout=_TIMEOUT_S)
        content: dict[str, Any] = response.json() if response.content else {}
        if response.status_code == requests.codes.unauthorized:
            raise KeyRefusedError(str(content.get("detail") or response.reason))
        if not response.ok:
            raise OSError(str(content.get("detail") or response.reason))
        return content


def main() -> int:
    """Run the bridge; returns the exit code."""
    os.umask(private_folder.UMASK)
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(levelname)s %(message)s")
    arguments = _arguments()
    key = os.environ.get("TELESCOPE_KEY", "").strip()
    if not key.isascii() or not key:
        print("home assistant: TELESCOPE_KEY is empty; create a key with `function_app api-key`", file=sys.stderr)
        return programs.BAD_INPUT
    try:
        _check(arguments)
    except OSError as error:
        print(f"home assistant: {error}", file=sys.stderr)
        return programs.BAD_INPUT
    telescope = Telescope(arguments.server, key, arguments.ca)
    stopping = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: stopping.set())
    home_assistant = mqtt.Client(CallbackAPIVersion.VERSION2, "telescope-bridge")
    bridge = Bridge(lambda topic, content, retain: home_assistant.publish(topic, content, 0, retain), telescope.set)
    try:
        _connect_home_assistant(home_assistant, bridge, arguments)
    except OSError as error:
        print(f"home assistant: its broker {arguments.broker}:{arguments.port}: {error}", file=sys.stderr)
        return programs.CANNOT_START
    try:
        while not stopping.is_set():
            try:
                _watch(telescope, bridge, stopping)
            except KeyRefusedError as error:
                print(f"home assistant: {error}", file=sys.stderr)
                return _REFUSED
            except (OSError, ValueError) as error:
                _log.warning("telescope: %s; reconnecting in %.0f s", error, _RETRY_S)
                stopping.wait(_RETRY_S)
    finally:
        bridge.close()
        home_assistant.disconnect()
        home_assistant.loop_stop()
    return 0


def _check(arguments: argparse.Namespace) -> None:
    """Check the CA options at start-up.

    Raises:
        OSError: A CA file cannot be used or does not apply.
    """
    if arguments.ca is not None and not arguments.server.startswith("https://"):
        raise OSError("--ca requires an https server")
    for ca in (arguments.ca, arguments.broker_ca):
        if ca is not None:
            try:
                trust.context(ca)
            except FileNotFoundError as error:
                raise OSError(f"{ca} does not exist") from error


def _connect_home_assistant(home_assistant: mqtt.Client, bridge: Bridge, arguments: argparse.Namespace) -> None:
    """Connect to Home Assistant's broker; paho reconnects."""

    def connected(client: mqtt.Client, *_: object) -> None:
        client.subscribe([(f"{discovery.ROOT}/+/set/+", 1), (f"{discovery.DISCOVERY}/status", 1)])
        bridge.announce_all()

    def received(_client: mqtt.Client, _data: object, message: mqtt.MQTTMessage) -> None:
        if message.topic == f"{discovery.DISCOVERY}/status":
            bridge.announce_all()  # Home Assistant has restarted
        else:
            bridge.on_command(message.topic, bytes(message.payload))

    home_assistant.on_connect = connected
    home_assistant.on_message = received
    if arguments.user:
        home_assistant.username_pw_set(arguments.user, os.environ.get("HOME_ASSISTANT_PASSWORD", ""))
    if arguments.broker_ca is not None:
        home_assistant.tls_set_context(trust.context(arguments.broker_ca))
    home_assistant.connect(arguments.broker, arguments.port)
    home_assistant.loop_start()


def _watch(telescope: Telescope, bridge: Bridge, stopping: threading.Event) -> None:
    """One connection to Telescope's broker, until it is lost, its credentials expire, or the program stops."""
    credentials = telescope.watch()
    lost = threading.Event()
    client = mqtt.Client(CallbackAPIVersion.VERSION2, credentials["client_id"], reconnect_on_failure=False)
    client.username_pw_set(credentials["username"], credentials["password"])
    tls = telescope.tls(credentials)
    if tls is not None:
        client.tls_set_context(tls)

    def connected(client: mqtt.Client, _data: object, _flags: object, code: Any, _properties: object) -> None:
        if code.is_failure:
            lost.set()
            return
        for topic in credentials["subscribe"]:
            client.subscribe(topic, 0)
        print("ready", flush=True)

    client.on_connect = connected
    client.on_disconnect = lambda *_: lost.set()
    client.on_message = lambda _client, _data, message: bridge.on_device_message(message.topic, bytes(message.payload))
    client.connect(credentials["tcp"]["host"], credentials["tcp"]["port"])
    client.loop_start()
    try:
        waited_s = 0.0
        while not (stopping.is_set() or lost.is_set()) and waited_s < credentials["lifetime_s"] * _RENEW_SHARE:
            stopping.wait(0.25)
            waited_s += 0.25
    finally:
        client.disconnect()
        client.loop_stop()
    if lost.is_set() and not stopping.is_set():
        raise OSError("the connection to the broker was lost")


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        prog="python -m infra.home_assistant", description="Shows an account's room devices in Home Assistant."
    )
    parser.add_argument("--server", required=True, help="Telescope server, https://host")
    parser.add_argument("--ca", type=Path, metavar="FILE", help="CA certificate (PEM) of the server and its broker")
    parser.add_argument("--broker", default="127.0.0.1", help="host of Home Assistant's MQTT broker")
    parser.add_argument("--port", type=int, default=1883, help="its port")
    parser.add_argument("--user", default="", help="its user; the password is in HOME_ASSISTANT_PASSWORD")
    parser.add_argument("--broker-ca", type=Path, metavar="FILE", help="use TLS with this CA certificate (PEM)")
    return parser.parse_args()


if __name__ == "__main__":
    sys.exit(main())
