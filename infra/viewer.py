"""Connection of programs that show what an account may view: HTTP API, and the broker with a view grant."""

import logging
import ssl
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import paho.mqtt.client as mqtt
import requests
from paho.mqtt.enums import CallbackAPIVersion

from device_agent.transports import tls as trust

_TIMEOUT_S = 15.0
_POLL_S = 0.25
_RENEW_SHARE = 0.8
"""Credentials are renewed after this share of their lifetime."""
_PAGE = 100

_log = logging.getLogger(__name__)

Receive = Callable[[str, bytes], None]
"""Processes a message: topic, content. It runs in the thread of the connection and must not block."""


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

    def view_credentials(self) -> dict[str, Any]:
        """Broker credentials for everything that the account may view.

        Raises:
            OSError: The server cannot be reached or rejects the request.
        """
        return self.post("/mqtt/credentials", {"purpose": "view"})

    def devices(self) -> list[dict[str, Any]]:
        """All devices that the account may view.

        Raises:
            OSError: The server cannot be reached or rejects the request.
        """
        devices: list[dict[str, Any]] = []
        query: dict[str, str | int] = {"limit": _PAGE}
        while True:
            page = self._content(self._http.get(f"{self._base}/devices", params=query, timeout=_TIMEOUT_S))
            devices += page["items"]
            if page["cursor"] is None:
                return devices
            query["cursor"] = page["cursor"]

    def tls(self, credentials: dict[str, Any]) -> ssl.SSLContext | None:
        """TLS context for the broker of these credentials.

        Raises:
            OSError: The CA certificate cannot be read.
            ValueError: The server uses TLS, but the broker does not.
        """
        return trust.broker(tls=credentials["tcp"]["tls"], server=self._server, ca=self._ca, own=None)

    def post(self, path: str, body: dict[str, Any]) -> dict[str, Any]:
        """Send a POST request; returns the response.

        Raises:
            OSError: The server cannot be reached or rejects the request.
        """
        return self._content(self._http.post(self._base + path, json=body, timeout=_TIMEOUT_S))

    def _content(self, response: requests.Response) -> dict[str, Any]:
        content: dict[str, Any] = response.json() if response.content else {}
        if response.status_code == requests.codes.unauthorized:
            raise KeyRefusedError(str(content.get("detail") or response.reason))
        if not response.ok:
            raise OSError(str(content.get("detail") or response.reason))
        return content


def check_ca(server: str, *authorities: Path | None) -> None:
    """Check CA options at start-up; the first one is that of the server.

    Raises:
        OSError: A CA file cannot be used or does not apply.
    """
    if authorities[0] is not None and not server.startswith("https://"):
        raise OSError("--ca requires an https server")
    for ca in authorities:
        if ca is not None:
            try:
                trust.context(ca)
            except FileNotFoundError as error:
                raise OSError(f"{ca} does not exist") from error


def watch(
    telescope: Telescope,
    credentials: dict[str, Any],
    receive: Receive,
    stopping: threading.Event,
    connected: Callable[[], None],
) -> None:
    """One connection to Telescope's broker, until it is lost, its credentials expire, or the program stops.

    Args:
        telescope: Client of the HTTP API.
        credentials: Result of ``Telescope.view_credentials``.
        receive: Processes each message. An exception from it is logged and ends the connection.
        stopping: Ends the connection when it is set.
        connected: Called when all topics are requested.

    Raises:
        OSError: The broker cannot be reached, rejects the credentials, or ended the connection, or ``receive`` failed.
        ValueError: The server uses TLS, but the broker does not.
    """
    lost = threading.Event()
    client = _client(credentials, receive, lost, connected)
    tls = telescope.tls(credentials)
    if tls is not None:
        client.tls_set_context(tls)
    client.connect(credentials["tcp"]["host"], credentials["tcp"]["port"])
    client.loop_start()
    try:
        waited_s = 0.0
        while not (stopping.is_set() or lost.is_set()) and waited_s < credentials["lifetime_s"] * _RENEW_SHARE:
            stopping.wait(_POLL_S)
            waited_s += _POLL_S
        was_lost = lost.is_set()  # read before the own disconnect, which sets it too
    finally:
        client.disconnect()
        client.loop_stop()
    if was_lost and not stopping.is_set():
        raise OSError("the connection to the broker was lost")


def _client(
    credentials: dict[str, Any], receive: Receive, lost: threading.Event, connected: Callable[[], None]
) -> mqtt.Client:
    """An MQTT client that sets ``lost`` when its connection ends or a message cannot be processed."""
    client = mqtt.Client(CallbackAPIVersion.VERSION2, credentials["client_id"], reconnect_on_failure=False)
    client.username_pw_set(credentials["username"], credentials["password"])

    def on_connect(client: mqtt.Client, _data: object, _flags: object, code: Any, _properties: object) -> None:
        if code.is_failure:
            lost.set()
            return
        for topic in credentials["subscribe"]:
            client.subscribe(topic, 0)
        connected()

    def on_message(_client: mqtt.Client, _data: object, message: mqtt.MQTTMessage) -> None:
        try:
            receive(message.topic, bytes(message.payload))
        except Exception:  # noqa: BLE001 (it would end the client's thread, and nothing would be received any more)
            _log.exception("%s: the message could not be processed", message.topic)
            lost.set()

    client.on_connect = on_connect
    client.on_disconnect = lambda *_: lost.set()
    client.on_message = on_message
    return client
