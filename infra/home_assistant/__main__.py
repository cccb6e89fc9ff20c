"""``python -m infra.home_assistant``: show an account's room devices in Home Assistant.

Prints ``ready`` once both brokers are connected. Runs until SIGTERM or SIGINT and reconnects automatically.

The API key is in ``TELESCOPE_KEY`` and the password of Home Assistant's broker in ``HOME_ASSISTANT_PASSWORD``, so that
process lists do not show them. Exits with 4 if the key is rejected because it has expired or was revoked.
"""

import argparse
import logging
import os
import signal
import sys
import threading
from functools import partial
from pathlib import Path

import paho.mqtt.client as mqtt
from paho.mqtt.enums import CallbackAPIVersion

from device_agent.protocol.security import private_folder
from device_agent.transports import tls as trust
from infra import programs, viewer
from infra.home_assistant import discovery
from infra.home_assistant.bridge import Bridge
from infra.viewer import KeyRefusedError, Telescope

_REFUSED = 4
_RETRY_S = 5.0
_log = logging.getLogger("infra.home_assistant")


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
        viewer.check_ca(arguments.server, arguments.ca, arguments.broker_ca)
    except OSError as error:
        print(f"home assistant: {error}", file=sys.stderr)
        return programs.BAD_INPUT
    telescope = Telescope(arguments.server, key, arguments.ca)
    stopping = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: stopping.set())
    home_assistant = mqtt.Client(CallbackAPIVersion.VERSION2, "telescope-bridge")
    bridge = Bridge(
        lambda topic, content, retain: home_assistant.publish(topic, content, 0, retain),
        partial(_set_control, telescope),
    )
    try:
        _connect_home_assistant(home_assistant, bridge, arguments)
    except OSError as error:
        print(f"home assistant: its broker {arguments.broker}:{arguments.port}: {error}", file=sys.stderr)
        return programs.CANNOT_START
    try:
        while not stopping.is_set():
            try:
                credentials = telescope.view_credentials()
                ready = partial(print, "ready", flush=True)
                viewer.watch(telescope, credentials, bridge.on_device_message, stopping, ready)
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


def _set_control(telescope: Telescope, device: str, control: str, value: float) -> str:
    """Set a control; returns an error message, or an empty string."""
    request = {"kind": "set_control", "control": control, "value": value}
    try:
        result = telescope.post(
            f"/devices/{device}/actions", {"request": request, "wait_ms": 10_000, "wait_for": "done"}
        )
    except (OSError, ValueError) as error:
        return str(error)
    if result.get("status") == "done":
        return ""
    return str((result.get("reason") or {}).get("message") or result.get("status"))


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
