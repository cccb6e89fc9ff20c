"""A connection to the broker for programs that run for longer than their credentials are valid."""

import sys
import threading
import time
from collections.abc import Callable, Sequence
from typing import Any

import paho.mqtt.client as mqtt
from telescope_client import create_client

RENEW_AFTER = 0.5
"""Credentials are replaced after this share of their lifetime."""


class BrokerLink:
    """A connection to the broker, with new credentials before the present ones expire.

    Args:
        request: Body of ``POST /mqtt/credentials``.
        longest_s: Longest time between two renewals [s].
        subscriptions: Filters, and their quality of service.
        on_message: Called with topic and payload, by one thread at a time.
        on_lost: Called when the connection is lost.
    """

    def __init__(
        self,
        request: dict[str, Any],
        longest_s: float,
        *,
        subscriptions: Sequence[tuple[str, int]] = (),
        on_message: Callable[[str, bytes], None] = lambda _topic, _payload: None,
        on_lost: Callable[[], None] = lambda: None,
    ) -> None:
        self._request, self._longest_s = request, longest_s
        self._subscriptions, self._on_message, self._on_lost = list(subscriptions), on_message, on_lost
        self._lock = threading.Lock()
        self._client: mqtt.Client | None = None
        self.renew_s = 0.0
        """When new credentials are due [s]."""

    def renew(self) -> None:
        """Connect with new credentials. Exits with a text if they are rejected."""
        client, credentials = create_client(self._request)
        client.on_connect = lambda *_: self._subscriptions and client.subscribe(self._subscriptions)
        client.on_message = lambda _client, _data, message: self._receive(client, message)
        previous = None if self._subscriptions else self._client
        if previous is not None:
            previous.on_disconnect = None  # the broker allows one connection for each lease, so it may end this one
        try:
            client.connect(credentials["tcp"]["host"], credentials["tcp"]["port"])
        except OSError as error:
            if previous is not None:
                previous.on_disconnect = lambda *_: self._on_lost()
            sys.exit(f"the broker does not respond: {error}")
        self.renew_s = time.monotonic() + min(self._longest_s, RENEW_AFTER * credentials["lifetime_s"])
        client.on_disconnect = lambda *_: self._on_lost()
        client.loop_start()
        if not self._subscriptions:
            with self._lock:
                self._client = client
            _end(previous)

    def publish(self, name: str, payload: bytes) -> None:
        """Publish a setpoint."""
        if self._client is not None:
            self._client.publish(name, payload, qos=0)

    def close(self) -> None:
        """End the connection."""
        with self._lock:
            client, self._client = self._client, None
        _end(client)

    def _receive(self, client: mqtt.Client, message: mqtt.MQTTMessage) -> None:
        """The new connection replaces the previous one with its first message, so that none is missing."""
        with self._lock:
            previous = None
            if client is not self._client:
                if client.on_disconnect is None:
                    return  # it was replaced
                previous, self._client = self._client, client
                if previous is not None:
                    previous.on_disconnect = None
            self._on_message(message.topic, bytes(message.payload))
        _end(previous)


def _end(client: mqtt.Client | None) -> None:
    if client is not None:
        client.on_disconnect = None
        client.disconnect()
        client.loop_stop()
