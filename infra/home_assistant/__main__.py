"""``python -m infra.home_assistant``: show an account's room devices in Home Assistant.

Prints ``ready`` once both brokers are there. Runs until SIGTERM or SIGINT, and makes lost connections anew.

Its API key stands in ``TELESCOPE_KEY``, the password of Home Assistant's broker in ``HOME_ASSISTANT_PASSWORD``: a list
of processes shows neither. Exits 4 when the key is refused: it was revoked, or has run out.
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

from device_agent.transports import tls as trust
from infra import programs
from infra.home_assistant import discovery
from infra.home_assistant.bridge import Bridge

_WITHIN_S = 15.0
_REFUSED = 4
_AGAIN_S = 5.0
_RENEW_SHARE = 0.8
"""Credentials are renewed after this share of their life."""
_log = logging.getLogger("infra.home_assistant")


class KeyRefusedError(OSError):
    """The API key is no good, or no longer."""


class Telescope:
    """What an API key may see of the HTTP API.

    Args:
        server: ``https://host``.
        key: ``ts_…``.
        ca: The authority (PEM) that alone may speak for the server and its broker; ``None``: those of the machine.
    """

    def __init__(self, server: str, key: str, ca: Path | None = None) -> None:
        self._server = server
        self._base = server.rstrip("/") + "/api/v1"
        self._ca = ca
        self._http = requests.Session()
        self._http.trust_env = ca is None  # else a variable of the environment would name other authorities
        self._http.verify = True if ca is None else str(ca)
        self._http.headers["Authorization"] = f"Bearer {key}"

    def watch(self) -> dict[str, Any]:
        """Credentials to hear all that the account may see.

        Raises:
            OSError: Not reached, or refused.
        """
        return self._post("/mqtt/credentials", {"purpose": "view"})

    def tls(self, given: dict[str, Any]) -> ssl.SSLContext | None:
        """How to connect to the broker that the credentials name.

        Raises:
            OSError: The authority cannot be read.
            ValueError: The broker does not speak TLS, though the server does.
        """
        return trust.broker(tls=given["tcp"]["tls"], server=self._server, ca=self._ca, own=None)

    def set(self, device: str, control: str, value: float) -> str:
        """Set a control; why not, or nothing."""
        order = {"kind": "set_control", "control": control, "value": value}
        try:
            done = self._post(f"/devices/{device}/actions", {"request": order, "wait_ms": 10_000, "wait_for": "done"})
        except (OSError, ValueError) as error:
            return str(error)
        if done.get("status") == "done":
            return ""
        return str((done.get("reason") or {}).get("message") or done.get("status"))

    def _post(self, path: str, body: dict[str, Any]) -> dict[str, Any]:
        answer = self._http.post(self._base + path, json=body, timeout=_WITHIN_S)
        found: dict[str, Any] = answer.json() if answer.content else {}
        if answer.status_code == requests.codes.unauthorized:
            raise KeyRefusedError(str(found.get("detail") or answer.reason))
        if not answer.ok:
            raise OSError(str(found.get("detail") or answer.reason))
        return found


def main() -> int:
    """Run; the exit code."""
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(levelname)s %(message)s")
    arguments = _arguments()
    key = os.environ.get("TELESCOPE_KEY", "").strip()
    if not key.isascii() or not key:
        print("home assistant: TELESCOPE_KEY is empty; make a key with `function_app api-key`", file=sys.stderr)
        return programs.BAD_INPUT
    try:
        _check(arguments)
    except OSError as error:
        print(f"home assistant: {error}", file=sys.stderr)
        return programs.BAD_INPUT
    telescope = Telescope(arguments.server, key, arguments.ca)
    ending = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: ending.set())
    there = mqtt.Client(CallbackAPIVersion.VERSION2, "telescope-bridge")
    bridge = Bridge(lambda topic, content, retain: there.publish(topic, content, 0, retain), telescope.set)
    try:
        _connect_there(there, bridge, arguments)
    except OSError as error:
        print(f"home assistant: its broker {arguments.broker}:{arguments.port}: {error}", file=sys.stderr)
        return programs.CANNOT_START
    try:
        while not ending.is_set():
            try:
                _watch(telescope, bridge, ending)
            except KeyRefusedError as error:
                print(f"home assistant: {error}", file=sys.stderr)
                return _REFUSED
            except (OSError, ValueError) as error:
                _log.warning("telescope: %s; trying again in %.0f s", error, _AGAIN_S)
                ending.wait(_AGAIN_S)
    finally:
        bridge.close()
        there.disconnect()
        there.loop_stop()
    return 0


def _check(arguments: argparse.Namespace) -> None:
    """See at the start that the authorities can be used.

    Raises:
        OSError: One cannot, or does not fit.
    """
    if arguments.ca is not None and not arguments.server.startswith("https://"):
        raise OSError("--ca says who may speak for an https server; this one speaks http, which nobody vouches for")
    for ca in (arguments.ca, arguments.broker_ca):
        if ca is not None:
            try:
                trust.context(ca)
            except FileNotFoundError as error:
                raise OSError(f"there is no file {ca}") from error


def _connect_there(there: mqtt.Client, bridge: Bridge, arguments: argparse.Namespace) -> None:
    """Home Assistant's broker; paho makes the connection anew where it is lost."""

    def connected(client: mqtt.Client, *_: object) -> None:
        client.subscribe([(f"{discovery.ROOT}/+/set/+", 1), (f"{discovery.DISCOVERY}/status", 1)])
        bridge.again()

    def heard(_client: mqtt.Client, _data: object, message: mqtt.MQTTMessage) -> None:
        if message.topic == f"{discovery.DISCOVERY}/status":
            bridge.again()  # it has just started
        else:
            bridge.told(message.topic, bytes(message.payload))

    there.on_connect = connected
    there.on_message = heard
    if arguments.user:
        there.username_pw_set(arguments.user, os.environ.get("HOME_ASSISTANT_PASSWORD", ""))
    if arguments.broker_ca is not None:
        there.tls_set_context(trust.context(arguments.broker_ca))
    there.connect(arguments.broker, arguments.port)
    there.loop_start()


def _watch(telescope: Telescope, bridge: Bridge, ending: threading.Event) -> None:
    """One connection to Telescope's broker, until it is lost, its credentials grow old, or the program ends."""
    given = telescope.watch()
    lost = threading.Event()
    here = mqtt.Client(CallbackAPIVersion.VERSION2, given["client_id"], reconnect_on_failure=False)
    here.username_pw_set(given["username"], given["password"])
    tls = telescope.tls(given)
    if tls is not None:
        here.tls_set_context(tls)

    def connected(client: mqtt.Client, _data: object, _flags: object, code: Any, _properties: object) -> None:
        if code.is_failure:
            lost.set()
            return
        for topic in given["subscribe"]:
            client.subscribe(topic, 0)
        print("ready", flush=True)

    here.on_connect = connected
    here.on_disconnect = lambda *_: lost.set()
    here.on_message = lambda _client, _data, message: bridge.hear(message.topic, bytes(message.payload))
    here.connect(given["tcp"]["host"], given["tcp"]["port"])
    here.loop_start()
    try:
        waited_s = 0.0
        while not (ending.is_set() or lost.is_set()) and waited_s < given["lifetime_s"] * _RENEW_SHARE:
            ending.wait(0.25)
            waited_s += 0.25
    finally:
        here.disconnect()
        here.loop_stop()
    if lost.is_set() and not ending.is_set():
        raise OSError("the connection to the broker was lost")


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        prog="python -m infra.home_assistant", description="Shows an account's room devices in Home Assistant."
    )
    parser.add_argument("--server", required=True, help="Telescope, https://host")
    parser.add_argument(
        "--ca", type=Path, metavar="FILE", help="the authority (PEM) that alone may speak for an https server"
    )
    parser.add_argument("--broker", default="127.0.0.1", help="host of Home Assistant's MQTT broker")
    parser.add_argument("--port", type=int, default=1883, help="its port")
    parser.add_argument("--user", default="", help="its user; the password is in HOME_ASSISTANT_PASSWORD")
    parser.add_argument(
        "--broker-ca",
        type=Path,
        metavar="FILE",
        help="speak TLS to it; the authority (PEM) that speaks for it",
    )
    return parser.parse_args()


if __name__ == "__main__":
    sys.exit(main())
