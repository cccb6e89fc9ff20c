"""A connection to the MQTT broker of a house, which is made again after each loss."""

import contextlib
import logging
import os
import secrets
import selectors
import ssl
import threading
from collections.abc import Callable, Collection
from pathlib import Path
from typing import Annotated, Any

import paho.mqtt.client as mqtt
from msgspec import Meta, Struct
from paho.mqtt.enums import CallbackAPIVersion, MQTTProtocolVersion
from paho.mqtt.properties import Properties
from paho.mqtt.reasoncodes import ReasonCode

from device_agent.ports.sensor import SensorError
from device_agent.ports.threads import Recovery, SupervisedThread
from device_agent.protocol.security.private_folder import UMASK

_MAX_PACKET = 4 << 20
"""Largest accepted packet [bytes]: Zigbee2MQTT describes all its devices in one message."""
_KEEP_ALIVE_S = 10
_CONNECT_S = 3.0
_POLL_S = 0.25
_RETRY_S = 1.0
_RESPONSE_S = 30.0
_END_S = 5.0
_log = logging.getLogger(__name__)


class BrokerOptions(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Option ``broker``: the MQTT broker of the house.

    Attributes:
        host: Host name or address.
        port: TCP port; ``None``: 8883 with TLS, otherwise 1883.
        tls: Whether the broker uses TLS.
        ca: File of the certificate authority (PEM); empty: the authorities of the operating system.
        user: User name; empty: none.
        password_file: File with the password in its first line. Only the agent's user may read it.
    """

    host: Annotated[str, Meta(min_length=1, max_length=255)]
    port: Annotated[int, Meta(ge=1, le=65_535)] | None = None
    tls: bool = False
    ca: str = ""
    user: str = ""
    password_file: str = ""

    def __post_init__(self) -> None:
        if self.password_file and not self.user:
            raise ValueError("`password_file` needs `user`")
        if self.ca and not self.tls:
            raise ValueError("`ca` needs `tls = true`")

    @property
    def address(self) -> tuple[str, int]:
        """Host and port."""
        return self.host, self.port or (8883 if self.tls else 1883)


class _BoundedClient(mqtt.Client):
    """A client that ends the connection before it would receive a packet above ``_MAX_PACKET``.

    Attributes:
        rejected: Size of the packet that ended the connection [bytes].
    """

    rejected = 0

    def _sock_recv(self, bufsize: int) -> bytes:
        if bufsize > _MAX_PACKET:
            self.rejected = bufsize
            raise ConnectionError(f"a packet has {bufsize} bytes")
        return super()._sock_recv(bufsize)


class HomeBroker:
    """Connection of one device. ``publish`` may be called by any thread, except with a lock of ``receive``.

    Args:
        options: The broker.
        folder: Folder to which the files of the options are relative.
        device: Name of the device.
        filters: Topic filters to subscribe to.
        receive: Called with topic, payload and whether the message is retained, by the connection's thread.
        changed: Called by the same thread when ``problem`` has changed.

    Attributes:
        problem: Why there is no connection; empty while all filters are subscribed.
    """

    def __init__(
        self,
        options: BrokerOptions,
        folder: Path,
        *,
        device: str,
        filters: Collection[str],
        receive: Callable[[str, bytes, bool], None],
        changed: Callable[[], None],
    ) -> None:
        self._options = options
        self._folder = folder
        self._filters = tuple(filters)
        self._receive = receive
        self._changed = changed
        self._where = "{}:{}".format(*options.address)
        self._client_id = f"telescope-{device[:32]}-{secrets.token_hex(4)}"
        self._client: mqtt.Client | None = None
        self._lock = threading.RLock()
        self._stopping = threading.Event()
        self.problem = f"no connection to the broker {self._where} yet"
        self._thread = SupervisedThread(
            self._run,
            name=f"{device}-broker",
            part="connection to the broker of the house",
            device=device,
            stopping=self._stopping,
            recovery=Recovery.RESTART,
            within_s=_RESPONSE_S,
        )

    def start(self) -> None:
        """Start to connect."""
        self._thread.start()

    def publish(self, topic: str, payload: str) -> None:
        """Send a message with QoS 1.

        Raises:
            SensorError: There is no connection.
        """
        with self._lock:
            sent = None if self._client is None or self.problem else self._client.publish(topic, payload, qos=1)
        if sent is None or sent.rc != mqtt.MQTT_ERR_SUCCESS:
            raise SensorError(self.problem or f"the connection to the broker {self._where} is lost")

    def close(self) -> None:
        """Disconnect and end the thread. May be called repeatedly."""
        self._stopping.set()
        if not self._thread.is_current():
            self._thread.join(_END_S)

    # ------------------------------------------------------------ the connection's thread

    def _run(self) -> None:
        while not self._stopping.is_set():
            self._thread.beat()
            try:
                problem = self._session()
            except SensorError as error:
                problem = str(error)
            except (OSError, ValueError, mqtt.WebsocketConnectionError) as error:
                problem = f"the broker {self._where} cannot be reached: {_reason(error)}; check `broker` in the options"
            if not self._stopping.is_set():
                self._set_problem(problem)
                self._stopping.wait(_RETRY_S)

    def _session(self) -> str:
        """One connection, from its start to its end; returns why it ended."""
        client = self._new_client()
        try:
            client.connect(*self._options.address, keepalive=_KEEP_ALIVE_S)
            with self._lock:
                self._client = client
            with selectors.DefaultSelector() as selector:
                opened: Any = client.socket()
                if opened is None:
                    return f"the broker {self._where} has closed the connection"
                selector.register(opened, selectors.EVENT_READ)
                while not self._stopping.is_set() and client.socket() is opened:
                    self._thread.beat()
                    self._turn(client, selector, opened)
        finally:
            with self._lock:
                self._client = None
                client.disconnect()
                self._free(client)
        if client.rejected:
            return f"the broker {self._where} has sent a message of {client.rejected} bytes; the limit is {_MAX_PACKET}"
        return self.problem or f"the connection to the broker {self._where} is lost"

    def _turn(self, client: mqtt.Client, selector: selectors.BaseSelector, opened: Any) -> None:
        writes = selectors.EVENT_WRITE if client.want_write() else 0
        selector.modify(opened, selectors.EVENT_READ | writes)
        # TLS may have decrypted several messages; the socket does not signal those.
        decrypted = isinstance(opened, ssl.SSLSocket) and opened.pending() > 0
        ready = selector.select(0 if decrypted else _POLL_S)
        with self._lock:
            if decrypted or any(events & selectors.EVENT_READ for _, events in ready):
                client.loop_read()
            if client._in_messages:  # noqa: SLF001 (the library stores them until the broker releases them)
                raise SensorError(
                    f"the broker {self._where} sends with QoS 2, which was not requested; check the broker"
                )
            if client.want_write():
                client.loop_write()
            client.loop_misc()

    def _free(self, client: mqtt.Client) -> None:
        if (remaining := client.socket()) is not None:
            with contextlib.suppress(OSError):
                remaining.close()
        client._reset_sockets()  # noqa: SLF001 (closes the socket pair that the library opens for a thread of its own)

    def _new_client(self) -> _BoundedClient:
        client = _BoundedClient(
            CallbackAPIVersion.VERSION2,
            self._client_id,
            clean_session=True,
            protocol=MQTTProtocolVersion.MQTTv311,
            reconnect_on_failure=False,
        )
        client.connect_timeout = _CONNECT_S
        client.on_connect = self._on_connect
        client.on_subscribe = self._on_subscribe
        client.on_message = self._on_message
        if self._options.user:
            client.username_pw_set(self._options.user, self._password())
        if self._options.tls:
            client.tls_set_context(self._tls())
        return client

    def _password(self) -> str | None:
        if not self._options.password_file:
            return None
        path = self._folder / self._options.password_file
        try:
            if os.name != "nt" and path.stat().st_mode & UMASK:
                raise SensorError(f"other users can read {path}, which contains a password; run `chmod 600 {path}`")
            return path.read_text(encoding="utf-8").partition("\n")[0].strip()
        except OSError as error:
            raise SensorError(f"{path}: {error.strerror}; store the password of the broker there") from error
        except UnicodeDecodeError:
            raise SensorError(f"{path} is not a text in UTF-8; store the password of the broker there") from None

    def _tls(self) -> ssl.SSLContext:
        path = self._folder / self._options.ca if self._options.ca else None
        try:
            context = ssl.create_default_context(cafile=None if path is None else str(path))
        except OSError as error:
            raise SensorError(f"the certificate authority {path} cannot be read; it must be a PEM file") from error
        context.minimum_version = ssl.TLSVersion.TLSv1_2
        return context

    def _set_problem(self, problem: str) -> None:
        if problem and problem != self.problem:
            _log.warning("%s", problem)
        self.problem = problem
        self._changed()

    # ------------------------------------------------------------ callbacks

    def _on_connect(
        self, client: mqtt.Client, _userdata: object, _flags: object, reason: ReasonCode, _properties: Properties | None
    ) -> None:
        if reason.is_failure:
            self._set_problem(f"the broker {self._where} rejects the connection: {reason}; check `user` and password")
        else:
            client.subscribe([(topic, 1) for topic in self._filters])

    def _on_subscribe(
        self,
        client: mqtt.Client,
        _userdata: object,
        _mid: int,
        reasons: list[ReasonCode],
        _properties: Properties | None,
    ) -> None:
        for topic, reason in zip(self._filters, reasons, strict=False):
            if reason.is_failure:
                self._set_problem(f"the broker {self._where} does not allow '{topic}'; check the rights of the user")
                client.disconnect()
                return
        self._set_problem("")

    def _on_message(self, _client: mqtt.Client, _userdata: object, message: mqtt.MQTTMessage) -> None:
        self._receive(message.topic, bytes(message.payload), message.retain)


def _reason(error: Exception) -> str:
    """Why the broker cannot be reached, in the words of the operating system."""
    if isinstance(error, ssl.SSLCertVerificationError):
        return f"its certificate is not trusted ({error.verify_message})"
    if isinstance(error, ssl.SSLError):
        return "it does not use TLS as configured"
    if isinstance(error, TimeoutError):
        return "no response"
    return getattr(error, "strerror", None) or "the connection failed"
