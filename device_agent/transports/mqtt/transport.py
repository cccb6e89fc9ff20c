"""The MQTT transport: one connection at a time, each made afresh with new credentials, session number and will."""

import contextlib
import logging
import ssl
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import paho.mqtt.client as mqtt
from paho.mqtt.enums import CallbackAPIVersion, MQTTProtocolVersion
from paho.mqtt.properties import Properties
from paho.mqtt.reasoncodes import ReasonCode

from device_agent.ports.clock import wall_ms
from device_agent.ports.transport import LinkChanged, Receive
from device_agent.protocol import Presence, codec, topics
from device_agent.transports.backoff import BackOff
from device_agent.transports.mqtt.connection import Connection

KEEP_ALIVE_S = 4
"""At rest it costs one ping."""
NOTICED_WITHIN_S = 1.5 * KEEP_ALIVE_S
"""A broker that is silent for so long is gone: as long as brokers wait for a client (MQTT 5, 3.1.2.10)."""
_CONNECT_TIMEOUT_S = 5.0
_LOOK_EVERY_S = 0.25
_FAREWELL_S = 0.5
_UNNOTICED_S = 0.25
"""A connection that makes room for the next one, with new credentials, is no loss of the link if that is up so soon:
meanwhile no Stop arrives, and setpoints that stop coming are noticed after about as long."""
_ASK_AGAIN_S = 5.0
_REFRESH_AT = 0.8
"""Credentials are renewed after this share of their life, at a quiet moment; at the last moment in any case."""
_REFRESH_LATEST = 0.97
_REFRESH_LAST_CALL = 0.99
"""From here on a connection ends even where the cloud has given no credentials for the next one."""
_MOST_QUEUED = 2000
_MOST_FILTERS = 8
"""In one SUBSCRIBE: AWS IoT Core takes no more."""
_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class BrokerAccess:
    """Where and as whom to connect. ``subscribe`` are the filters to ask for; ``lifetime_s`` from now [s].

    ``tls``: how to check who the broker is; ``None`` where the cloud says that it speaks no TLS.
    """

    host: str
    port: int
    client_id: str
    username: str
    password: str
    subscribe: tuple[str, ...]
    lifetime_s: float
    tls: ssl.SSLContext | None = None


class MqttTransport:
    """``ports.transport.Transport`` over MQTT.

    Args:
        access: Asks the cloud for credentials; raises ``OSError`` or ``ValueError`` when it has none now.
        presence_topic: Where presence and will go.
        next_session: The next session number, rising across restarts.
        software: Name and version, for presence.
        listen: Topics of other agents to hear as well, as far as the broker lets it. Without them the link is up, too.
        quiet: Whether a short break would disturb nothing.
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
        self._thread: threading.Thread | None = None
        self._pictures: dict[str, mqtt.MQTTMessageInfo] = {}
        self._session = 0
        self._orders: int | None = None
        self._gone = threading.Event()
        self._break: threading.Timer | None = None
        self._break_lock = threading.Lock()

    def start(self, receive: Receive, link_changed: LinkChanged) -> None:
        """See ``Transport.start``."""
        self._receive = receive
        self._link_changed = link_changed
        self._thread = threading.Thread(target=self._run, name="mqtt", daemon=True)
        self._thread.start()

    def publish(
        self,
        topic: str,
        payload: bytes,
        *,
        qos: int,
        retain: bool = False,
        delivered: Callable[[], None] | None = None,
    ) -> bool:
        """See ``Transport.publish``."""
        connection = self._connection
        if connection is None or not self._up:
            return False
        picture = f"/{topics.CAM}/" in topic
        if picture and (before := self._pictures.get(topic)) is not None and not before.is_published():
            return False  # on a slow link pictures would wait in a queue, and all that is live behind them
        sent = connection.publish(topic, payload, qos=qos, retain=retain, delivered=delivered if qos else None)
        if sent is None:
            return False
        if picture:
            self._pictures[topic] = sent
        return True

    def stop(self) -> None:
        """See ``Transport.stop``."""
        self._stopping.set()
        if (connection := self._connection) is not None:
            connection.wake()
        if self._thread is not None and self._thread is not threading.current_thread():
            self._thread.join(timeout=3)

    # ------------------------------------------------------------ one connection after another

    def _run(self) -> None:
        back_off = BackOff()
        following: BrokerAccess | None = None
        while not self._stopping.is_set():
            back_off.attempt()
            version, access, following = self._version, following, None
            try:
                following = self._connect_once(access or self._access())
            except (OSError, ValueError) as error:
                _log.warning("no link: %s", error)
            except Exception:  # noqa: BLE001 (whatever it was: a robot that has lost its link must keep trying)
                _log.exception("no link")
            if following is not None:
                continue
            self._break_lasts()
            if self._version is not version:
                continue  # the broker is there, it only speaks an older MQTT
            if self._stopping.wait(back_off.wait_s()):
                break
        self._break_lasts()

    def _connect_once(self, access: BrokerAccess) -> BrokerAccess | None:
        """One connection, to its end; what the next one is to be made with at once, where that is why it has ended."""
        following: BrokerAccess | None = None
        renewal = _Renewal(self._access)
        self._session = self._next_session()
        self._pictures = {}
        self._gone.clear()
        connection = self._connection = Connection(self._new_client(access), self._receive)
        try:
            connection.open(access.host, access.port, keep_alive_s=KEEP_ALIVE_S)
            began_s = time.monotonic()
            while not self._gone.is_set() and not self._stopping.is_set():
                connection.turn(_LOOK_EVERY_S)
                if self._up and connection.silent_s > NOTICED_WITHIN_S:
                    raise OSError(f"{access.host}:{access.port} has been silent for {NOTICED_WITHIN_S:g} s")
                age_s = time.monotonic() - began_s
                if not self._up and age_s > _CONNECT_TIMEOUT_S:
                    self._fall_back()
                    raise OSError(f"{access.host}:{access.port} does not answer as an MQTT broker")
                share = age_s / access.lifetime_s
                if self._up and (share > _REFRESH_LATEST or (share > _REFRESH_AT and self._quiet())):
                    renewal.begin()
                if renewal.found is not None or share > _REFRESH_LAST_CALL:
                    following = renewal.found
                    break
        finally:
            was_up, self._up = self._up, False
            if following is not None:
                connection.settle(_UNNOTICED_S)
            if self._stopping.is_set() and was_up:
                with contextlib.suppress(ValueError, RuntimeError, OSError):
                    self._say_farewell(connection)
            confirmed = connection.close()
            self._connection = None
            if following is not None and confirmed:
                self._begin_break()
            elif was_up:
                self._link_changed(False)
        return following

    def _begin_break(self) -> None:
        with self._break_lock:
            self._break = threading.Timer(_UNNOTICED_S, self._break_lasts)
            self._break.daemon = True
            self._break.start()

    def _break_lasts(self) -> None:
        """The next connection is not up yet: the link is lost after all."""
        with self._break_lock:
            if self._break is not None:
                self._break.cancel()
                self._break = None
                self._link_changed(False)

    def _came_up(self) -> None:
        with self._break_lock:
            if self._break is not None:
                self._break.cancel()
                self._break = None
            self._link_changed(True)

    def _say_farewell(self, connection: Connection) -> None:
        farewell = connection.publish(self._presence_topic, self._presence(online=False), qos=1, retain=True)
        until_s = time.monotonic() + _FAREWELL_S
        while farewell is not None and not farewell.is_published() and time.monotonic() < until_s:
            connection.turn(_FAREWELL_S / 10)

    def _new_client(self, access: BrokerAccess) -> mqtt.Client:
        options: dict[str, Any] = {} if self._version is MQTTProtocolVersion.MQTTv5 else {"clean_session": True}
        client = mqtt.Client(
            CallbackAPIVersion.VERSION2,
            access.client_id,
            protocol=self._version,
            reconnect_on_failure=False,
            manual_ack=True,
            **options,
        )
        client.username_pw_set(access.username, access.password)
        if access.tls is not None:
            client.tls_set_context(access.tls)
        client.will_set(self._presence_topic, self._presence(online=False), qos=1, retain=True)
        client.max_queued_messages_set(_MOST_QUEUED)
        client.max_inflight_messages_set(100)
        client.connect_timeout = _CONNECT_TIMEOUT_S
        client.on_connect = self._on_connect
        client.on_disconnect = self._on_disconnect
        client.on_subscribe = self._on_subscribe
        client.user_data_set(access)
        return client

    # ------------------------------------------------------------ paho's callbacks, in a turn of the connection

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
                _log.warning("the broker refused the connection: %s", code)
            client.disconnect()
            return
        _, self._orders = client.subscribe([(pattern, 1) for pattern in access.subscribe])

    def _on_subscribe(
        self, client: mqtt.Client, _access: object, mid: int, codes: list[ReasonCode], _properties: Properties | None
    ) -> None:
        if mid != self._orders:
            if any(code.is_failure for code in codes):
                _log.warning("the broker does not let this agent hear all that agent.toml names of the room")
            return
        if any(code.is_failure for code in codes):
            _log.error("the broker refused a subscription; check the agent's rights")
            client.disconnect()
            return
        self._up = True
        client.publish(self._presence_topic, self._presence(online=True), qos=1, retain=True)
        for first in range(0, len(self._listen), _MOST_FILTERS):
            client.subscribe([(topic, 0) for topic in self._listen[first : first + _MOST_FILTERS]])
        if (connection := self._connection) is not None:
            connection.later(self._came_up)

    def _on_disconnect(
        self, _client: mqtt.Client, _access: object, _flags: object, _code: ReasonCode, _properties: Properties | None
    ) -> None:
        self._gone.set()
        if (connection := self._connection) is not None:
            connection.wake()

    def _fall_back(self) -> None:
        if self._version is MQTTProtocolVersion.MQTTv5:
            _log.info("the broker does not speak MQTT 5; using 3.1.1")
            self._version = MQTTProtocolVersion.MQTTv311

    def _presence(self, *, online: bool) -> bytes:
        return codec.encode(Presence(online=online, session=self._session, at_ms=wall_ms(), software=self._software))


class _Renewal:
    """Asks for the next credentials while the present connection goes on, again and again until it gets some."""

    def __init__(self, access: Callable[[], BrokerAccess]) -> None:
        self._access = access
        self._thread: threading.Thread | None = None
        self._next_s = float("-inf")
        self.found: BrokerAccess | None = None

    def begin(self) -> None:
        """Ask, unless that is being done, or was done in vain a moment ago."""
        asking = self._thread is not None and self._thread.is_alive()
        if self.found is None and not asking and time.monotonic() >= self._next_s:
            self._next_s = time.monotonic() + _ASK_AGAIN_S
            self._thread = threading.Thread(target=self._ask, name="mqtt-renewal", daemon=True)
            self._thread.start()

    def _ask(self) -> None:
        try:
            self.found = self._access()
        except (OSError, ValueError) as error:
            _log.warning("no new credentials yet: %s", error)
        except Exception:  # noqa: BLE001 (as above: the present ones still serve, and it is asked again)
            _log.exception("no new credentials yet")
