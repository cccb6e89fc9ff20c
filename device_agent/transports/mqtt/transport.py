"""MQTT transport: one connection at a time, each with new credentials, session number and will."""

import contextlib
import logging
import ssl
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import paho.mqtt.client as mqtt
from paho.mqtt.enums import CallbackAPIVersion, MQTTProtocolVersion
from paho.mqtt.properties import Properties
from paho.mqtt.reasoncodes import ReasonCode

from device_agent.ports.threads import Recovery, SupervisedThread
from device_agent.ports.transport import LinkChanged, Receive
from device_agent.protocol import topics
from device_agent.transports import presence, tls
from device_agent.transports.backoff import BackOff
from device_agent.transports.http.client import CloudClient
from device_agent.transports.http.responses import MqttCredentials
from device_agent.transports.mqtt.confirmations import Confirmations
from device_agent.transports.mqtt.connection import Connection

KEEP_ALIVE_S = 4
"""MQTT keep-alive interval [s]."""
SILENCE_TIMEOUT_S = 1.5 * KEEP_ALIVE_S
"""The agent treats the broker as disconnected after this time without traffic [s] (as in MQTT 5, 3.1.2.10)."""
_CONNECT_TIMEOUT_S = 5.0
_POLL_S = 0.25
_DISCONNECT_S = 0.5
_MAX_INTERRUPTION_S = 0.25
"""Maximum interruption by a reconnection with new credentials that is not reported as a lost link [s]. No Stop arrives
meanwhile; the setpoint watchdog has about the same timeout."""
_RENEWAL_RETRY_S = 5.0
_REFRESH_AT = 0.8
"""Share of the credentials' lifetime after which they are renewed at a quiet moment."""
_REFRESH_LATEST = 0.97
_REFRESH_DEADLINE = 0.99
"""Share of the lifetime after which the connection ends even without new credentials."""
_RESPONSE_S, _CONNECT_RESPONSE_S = 5.0, 60.0
"""A connection, or an attempt to connect, without progress for this time hangs [s]."""
_MAX_QUEUED = 2000
_MAX_FILTERS = 8
"""Maximum number of filters per SUBSCRIBE; the limit of AWS IoT Core."""
_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class BrokerAccess:
    """Address and credentials of the broker.

    Attributes:
        subscribe: Filters to subscribe to.
        confirmations: Topics on which the cloud confirms stored messages; ``None``: it does not.
        lifetime_s: Validity of the credentials from now on [s].
        tls: TLS context; ``None`` for a connection without TLS.
    """

    host: str
    port: int
    client_id: str
    username: str
    password: str
    subscribe: tuple[str, ...]
    lifetime_s: float
    confirmations: str | None = None
    tls: ssl.SSLContext | None = None


def broker_access(
    credentials: MqttCredentials, api: CloudClient, *, own: tuple[Path, Path] | None = None
) -> BrokerAccess:
    """The access that the cloud grants; ``own``: client certificate and key.

    Raises:
        OSError: The pinned authority cannot be read.
        ValueError: The server uses TLS, but the broker does not.
    """
    return BrokerAccess(
        host=credentials.tcp.host,
        port=credentials.tcp.port,
        client_id=credentials.client_id,
        username=credentials.username,
        password=credentials.password,
        subscribe=credentials.subscribe,
        lifetime_s=credentials.lifetime_s,
        confirmations=credentials.confirmations,
        tls=tls.broker(tls=credentials.tcp.tls, server=api.server, ca=api.ca, own=own),
    )


def new_client(
    access: BrokerAccess,
    version: MQTTProtocolVersion,
    will: tuple[str, bytes],
    *,
    connect_timeout_s: float,
    manual_ack: bool = False,
) -> mqtt.Client:
    """A client with a retained will (topic and payload), without callbacks."""
    client = mqtt.Client(
        CallbackAPIVersion.VERSION2,
        access.client_id,
        protocol=version,
        reconnect_on_failure=False,
        manual_ack=manual_ack,
        clean_session=None if version is MQTTProtocolVersion.MQTTv5 else True,
    )
    client.username_pw_set(access.username, access.password)
    if access.tls is not None:
        client.tls_set_context(access.tls)
    client.will_set(*will, qos=1, retain=True)
    client.max_inflight_messages_set(100)
    client.connect_timeout = connect_timeout_s
    return client


class MqttTransport:
    """``ports.transport.Transport`` over MQTT.

    The broker's acknowledgement does not prove that the cloud has stored a message: brokers drop messages while no
    worker is connected. Acks, events and late measurements are therefore delivered when the cloud confirms them. Other
    messages, and all messages to a server that does not confirm, are delivered when the broker acknowledges them.

    Args:
        access: Requests credentials; raises ``OSError`` or ``ValueError`` if none are available now.
        presence_topic: Topic of presence and will.
        next_session: Next session number; it rises across restarts.
        software: Name and version, for presence.
        listen: Topics of other agents to subscribe to, as far as the broker allows. The link does not depend on them.
        quiet: Whether a short interruption is harmless now.
    """

    def __init__(
        self,
        *,
        access: Callable[[], BrokerAccess],
        presence_topic: str,
        next_session: Callable[[], int],
        software: str,
        listen: tuple[str, ...] = (),
        quiet: Callable[[], bool] = lambda: True,
    ) -> None:
        self._access = access
        self._presence_topic = presence_topic
        self._next_session = next_session
        self._software = software
        self._listen = listen
        self._quiet = quiet
        self._version = MQTTProtocolVersion.MQTTv5
        self._connection: Connection | None = None
        self._up = False
        self._stopping = threading.Event()
        self._thread = SupervisedThread(
            self._run, name="mqtt", part="MQTT connection", stopping=self._stopping, recovery=Recovery.RESTART_OR_EXIT
        )
        self._frames: dict[str, mqtt.MQTTMessageInfo] = {}
        self._confirmations = Confirmations()
        self._session = 0
        self._command_subscription: int | None = None
        self._lost = threading.Event()
        self._interruption: threading.Timer | None = None
        self._interruption_lock = threading.Lock()

    def start(self, receive: Receive, link_changed: LinkChanged) -> None:
        """Implements ``Transport.start``."""
        self._receive = receive
        self._link_changed = link_changed
        self._thread.start()

    def publish(
        self, topic: str, payload: bytes, *, qos: int, retain: bool = False, delivered: Callable[[], None] | None = None
    ) -> bool:
        """Implements ``Transport.publish``."""
        connection = self._connection
        if connection is None or not self._up:
            return False
        frame = f"/{topics.CAM}/" in topic
        if frame and (before := self._frames.get(topic)) is not None and not before.is_published():
            return False  # on a slow link, queued frames would delay all live messages
        if qos == 0:
            delivered = None
        if delivered is not None and self._confirmations.expect(topic, payload, delivered):
            delivered = None
        sent = connection.publish(topic, payload, qos=qos, retain=retain, delivered=delivered)
        if sent is None:
            return False
        if frame:
            self._frames[topic] = sent
        return True

    def stop(self) -> None:
        """Implements ``Transport.stop``."""
        self._stopping.set()
        if (connection := self._connection) is not None:
            connection.wake()
        if not self._thread.is_current():
            self._thread.join(timeout=3)

    # ------------------------------------------------------------ connections

    def _run(self) -> None:
        back_off = BackOff()
        next_access: BrokerAccess | None = None
        while not self._stopping.is_set():
            back_off.attempt()
            self._thread.beat(_CONNECT_RESPONSE_S)
            version, access, next_access = self._version, next_access, None
            try:
                next_access = self._connect_once(access or self._access())
            except (OSError, ValueError) as error:
                _log.warning("no link: %s", error)
            except Exception:  # noqa: BLE001 (the transport must keep reconnecting after any error)
                _log.exception("no link")
            if next_access is not None:
                continue
            self._report_link_lost()
            if self._version is not version:
                continue  # the broker is reachable, but supports only MQTT 3.1.1
            wait_s = back_off.wait_s()
            self._thread.beat(wait_s + _RESPONSE_S)
            if self._stopping.wait(wait_s):
                break
        self._report_link_lost()

    def _connect_once(self, access: BrokerAccess) -> BrokerAccess | None:
        """Run one connection until it ends. Returns new credentials if they are why it ended."""
        next_access: BrokerAccess | None = None
        renewal = _Renewal(self._access)
        self._session = self._next_session()
        self._frames = {}
        self._lost.clear()
        self._confirmations.filter = access.confirmations or ""
        connection = self._connection = Connection(self._new_client(access), self._on_message)
        try:
            connection.open(access.host, access.port, keep_alive_s=KEEP_ALIVE_S)
            started_s = time.monotonic()
            while not self._lost.is_set() and not self._stopping.is_set():
                self._thread.beat(_RESPONSE_S)
                connection.turn(_POLL_S)
                if self._up and connection.silent_s > SILENCE_TIMEOUT_S:
                    raise OSError(f"{access.host}:{access.port} sent nothing for {SILENCE_TIMEOUT_S:g} s")
                age_s = time.monotonic() - started_s
                if not self._up and age_s > _CONNECT_TIMEOUT_S:
                    self._fall_back()
                    raise OSError(f"{access.host}:{access.port} does not respond as an MQTT broker")
                share = age_s / access.lifetime_s
                if self._up and (share > _REFRESH_LATEST or (share > _REFRESH_AT and self._quiet())):
                    renewal.begin()
                if renewal.access is not None or share > _REFRESH_DEADLINE:
                    next_access = renewal.access
                    break
        finally:
            was_up, self._up = self._up, False
            if next_access is not None:
                connection.settle(_MAX_INTERRUPTION_S)
            if self._stopping.is_set() and was_up:
                with contextlib.suppress(ValueError, RuntimeError, OSError):
                    self._publish_offline(connection)
            confirmed = connection.close()
            self._connection = None
            if next_access is not None and confirmed:
                self._start_interruption()
            elif was_up:
                self._link_changed(False)
        return next_access

    def _start_interruption(self) -> None:
        with self._interruption_lock:
            self._interruption = threading.Timer(_MAX_INTERRUPTION_S, self._report_link_lost)
            self._interruption.daemon = True
            self._interruption.start()

    def _report_link_lost(self) -> None:
        """Report the lost link: the next connection was not established in time."""
        with self._interruption_lock:
            if self._interruption is not None:
                self._interruption.cancel()
                self._interruption = None
                self._link_changed(False)

    def _report_link_up(self) -> None:
        with self._interruption_lock:
            if self._interruption is not None:
                self._interruption.cancel()
                self._interruption = None
            self._link_changed(True)

    def _on_message(self, topic: str, payload: bytes) -> None:
        if not self._confirmations.receive(topic, payload):
            self._receive(topic, payload)

    def _publish_offline(self, connection: Connection) -> None:
        offline = connection.publish(self._presence_topic, self._presence(online=False), qos=1, retain=True)
        until_s = time.monotonic() + _DISCONNECT_S
        while offline is not None and not offline.is_published() and time.monotonic() < until_s:
            connection.turn(_DISCONNECT_S / 10)

    def _new_client(self, access: BrokerAccess) -> mqtt.Client:
        will = (self._presence_topic, self._presence(online=False))
        client = new_client(access, self._version, will, connect_timeout_s=_CONNECT_TIMEOUT_S, manual_ack=True)
        client.max_queued_messages_set(_MAX_QUEUED)
        client.on_connect = self._on_connect
        client.on_disconnect = self._on_disconnect
        client.on_subscribe = self._on_subscribe
        client.user_data_set(access)
        return client

    # ------------------------------------------------------------ paho callbacks, in the reader's thread

    def _on_connect(
        self,
        client: mqtt.Client,
        access: BrokerAccess,
        _flags: object,
        code: ReasonCode,
        _properties: Properties | None,
    ) -> None:
        if code.is_failure:
            if "protocol" in str(code).lower() and self._version is MQTTProtocolVersion.MQTTv5:
                self._fall_back()
            else:
                _log.warning("the broker rejected the connection: %s", code)
            client.disconnect()
            return
        filters = [(pattern, 1) for pattern in access.subscribe]
        if access.confirmations is not None:
            filters.append((access.confirmations, 0))
        _, self._command_subscription = client.subscribe(filters)

    def _on_subscribe(
        self, client: mqtt.Client, _access: object, mid: int, codes: list[ReasonCode], _properties: Properties | None
    ) -> None:
        if mid != self._command_subscription:
            if any(code.is_failure for code in codes):
                _log.warning("the broker rejected subscriptions to room measurements of agent.toml")
            return
        if any(code.is_failure for code in codes):
            _log.error("the broker rejected a subscription; check the agent's permissions")
            client.disconnect()
            return
        self._up = True
        client.publish(self._presence_topic, self._presence(online=True), qos=1, retain=True)
        for first in range(0, len(self._listen), _MAX_FILTERS):
            client.subscribe([(topic, 0) for topic in self._listen[first : first + _MAX_FILTERS]])
        if (connection := self._connection) is not None:
            connection.later(self._report_link_up)

    def _on_disconnect(
        self, _client: mqtt.Client, _access: object, _flags: object, _code: ReasonCode, _properties: Properties | None
    ) -> None:
        self._lost.set()
        if (connection := self._connection) is not None:
            connection.wake()

    def _fall_back(self) -> None:
        if self._version is MQTTProtocolVersion.MQTTv5:
            _log.info("the broker does not support MQTT 5; using 3.1.1")
            self._version = MQTTProtocolVersion.MQTTv311

    def _presence(self, *, online: bool) -> bytes:
        return presence.encode(online=online, session=self._session, software=self._software)


class _Renewal:
    """Requests the next credentials while the current connection continues, until it succeeds."""

    def __init__(self, access: Callable[[], BrokerAccess]) -> None:
        self._access = access
        self._thread = SupervisedThread(self._request, name="mqtt-renewal", part="renewal of credentials")
        self._next_s = float("-inf")
        self.access: BrokerAccess | None = None

    def begin(self) -> None:
        """Request credentials, unless a request is running or failed recently."""
        if self.access is None and not self._thread.is_alive() and time.monotonic() >= self._next_s:
            self._next_s = time.monotonic() + _RENEWAL_RETRY_S
            self._thread.start()

    def _request(self) -> None:
        try:
            self.access = self._access()
        except (OSError, ValueError) as error:
            _log.warning("no new credentials yet: %s", error)
        except Exception:  # noqa: BLE001 (the current credentials remain valid; the request is repeated)
            _log.exception("no new credentials yet")
