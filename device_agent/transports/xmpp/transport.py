"""XMPP transport: one connection at a time, each with a new password; one thread with its event loop.

The cloud is a user with any number of resources, one per gateway process. The agent learns from presence which are
online, chooses one, and sends it the agent's presence. Once that is acknowledged the link is up. When the gateway or
the server goes offline, the link is lost, and the agent connects to the next gateway with a new session number.
"""

import asyncio
import contextlib
import logging
import random
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from xml.etree.ElementTree import Element

from device_agent.ports.threads import Recovery, SupervisedThread
from device_agent.ports.transport import LinkChanged, Receive
from device_agent.protocol.errors import ProtocolError
from device_agent.protocol.xmpp import stanzas
from device_agent.protocol.xmpp.stream import Login, Stream, StreamError
from device_agent.transports import presence
from device_agent.transports.backoff import BackOff

_CONFIRM_S = 5.0
_DISCONNECT_S = 0.5
_REFRESH_AT = 0.8
"""Share of the password's lifetime after which it is renewed at a quiet moment."""
_REFRESH_LATEST = 0.97
_POLL_S = 0.25
_MAX_UNSENT_BYTES = 128 * 1024
"""Above this size of the send buffer, only the newest measurement per topic is kept [bytes]."""
_UNSENT_POLL_S = 0.02
_RESPONSE_S, _CONNECT_RESPONSE_S = 5.0, 60.0
"""A connection, or an attempt to connect, without progress for this time hangs [s]."""
_MAX_QUEUED_BYTES = 4 * 1024 * 1024
"""Maximum size of queued messages; more are rejected [bytes]."""
SILENCE_TIMEOUT_S = stanzas.TIMEOUT_S + stanzas.PING_INTERVAL_S
_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class XmppAccess:
    """Credentials and peer of a connection.

    Attributes:
        login: The agent's JID and password.
        cloud: Bare JID of the cloud.
        lifetime_s: Validity of the password from now on [s].
    """

    login: Login
    cloud: str
    lifetime_s: float


class XmppTransport:
    """``ports.transport.Transport`` over XMPP.

    Args:
        access: Requests a password; raises ``OSError`` or ``ValueError`` if none is available now.
        presence_topic: Topic of presence.
        next_session: Next session number; it rises across restarts.
        software: Name and version, for presence.
        listen: Topics of other agents of the space to subscribe to.
        quiet: Whether a short interruption is harmless now.
    """

    def __init__(
        self,
        *,
        access: Callable[[], XmppAccess],
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
        self._stopping = threading.Event()
        self._thread = SupervisedThread(
            self._run,
            name="xmpp",
            part="XMPP connection",
            stopping=self._stopping,
            recovery=Recovery.RESTART_OR_EXIT,
            within_s=_RESPONSE_S,
        )
        self._link: _Link | None = None

    def start(self, receive: Receive, link_changed: LinkChanged) -> None:
        """Implements ``Transport.start``."""
        self._receive = receive
        self._link_changed = link_changed
        self._thread.start()

    def publish(
        self,
        topic: str,
        payload: bytes,
        *,
        qos: int,
        retain: bool = False,  # noqa: ARG002 (the gateway retains by class)
        delivered: Callable[[], None] | None = None,
    ) -> bool:
        """Implements ``Transport.publish``. Payloads that are not JSON, such as camera frames, are dropped."""
        if not payload.startswith(b"{"):
            return False
        link = self._link
        return link is not None and link.publish(topic, payload, qos=qos, delivered=delivered)

    def stop(self) -> None:
        """Implements ``Transport.stop``."""
        self._stopping.set()
        link = self._link
        if link is not None:
            link.wake()
        if not self._thread.is_current():
            self._thread.join(timeout=3)

    # ------------------------------------------------------------ connections

    def _run(self) -> None:
        back_off = BackOff()
        while not self._stopping.is_set():
            back_off.attempt()
            self._thread.beat(_CONNECT_RESPONSE_S)
            try:
                access = self._access()
                asyncio.run(self._connect_once(access))
            except (OSError, ValueError) as error:
                _log.warning("no link: %s", error)
            except Exception:  # noqa: BLE001 (the transport must keep reconnecting after any error)
                _log.exception("no link")
            wait_s = back_off.wait_s()
            self._thread.beat(wait_s + _RESPONSE_S)
            if self._stopping.wait(wait_s):
                return

    async def _connect_once(self, access: XmppAccess) -> None:
        link = self._link = _Link(access, self._receive)
        staying: asyncio.Task[None] | None = None
        try:
            await link.stream.open()
            staying = asyncio.create_task(link.stream.stay())
            started_s = time.monotonic()
            while not self._stopping.is_set() and not self._renewal_due(
                time.monotonic() - started_s, access.lifetime_s
            ):
                self._thread.beat(_CONNECT_RESPONSE_S if link.peer is None else _RESPONSE_S)
                if staying.done():
                    staying.result()
                if link.peer is None and await self._announce(link):
                    self._link_changed(True)
                await link.wait_for_change(_POLL_S)
                if link.left:
                    link.left = False
                    self._link_changed(False)
        finally:
            was_up, link.up = link.up, False
            if was_up and (self._stopping.is_set() or staying is None or not staying.done()):
                with contextlib.suppress(StreamError):
                    await link.send(self._presence_topic, self._presence(link, online=False), _DISCONNECT_S)
            self._link = None
            if staying is not None:
                staying.cancel()
                await asyncio.gather(staying, return_exceptions=True)
            await link.stream.close()
            if was_up or link.left:
                self._link_changed(False)

    def _renewal_due(self, age_s: float, lifetime_s: float) -> bool:
        share = age_s / lifetime_s
        return share > _REFRESH_LATEST or (share > _REFRESH_AT and self._quiet())

    async def _announce(self, link: "_Link") -> bool:
        """Choose a gateway and send presence to it. Returns whether the link is up.

        Raises:
            StreamError: The gateway rejects the agent or does not respond.
        """
        if not link.present:
            return False
        link.peer = random.choice(sorted(link.present))  # noqa: S311 (load distribution)
        link.session = self._next_session()
        await link.send(self._presence_topic, self._presence(link, online=True), _CONFIRM_S, listen=self._listen)
        link.up = link.peer is not None
        link.left = False
        return link.up

    def _presence(self, link: "_Link", *, online: bool) -> bytes:
        return presence.encode(online=online, session=link.session, software=self._software)


class _Link:
    """One connection. All methods but ``publish`` and ``wake`` run in its event loop.

    Attributes:
        present: JIDs of the gateways that are online.
        peer: The chosen gateway.
        up: Whether it has acknowledged the agent's presence.
        left: Whether the gateway has gone offline.
        session: Session number.
    """

    def __init__(self, access: XmppAccess, receive: Receive) -> None:
        self.stream = Stream(access.login, message=self._on_message, presence=self._on_presence)
        self.present: set[str] = set()
        self.peer: str | None = None
        self.up = False
        self.left = False
        self.session = 0
        self._access = access
        self._receive = receive
        self._loop = asyncio.get_running_loop()
        self._changed = asyncio.Event()
        self._lock = threading.Lock()
        self._queued_bytes = 0
        self._number = 0
        self._newest: dict[str, str] = {}
        self._delivered: dict[str, Callable[[], None]] = {}
        self._responses: dict[str, asyncio.Future[str]] = {}

    # ------------------------------------------------------------ outgoing

    def publish(self, topic: str, payload: bytes, *, qos: int, delivered: Callable[[], None] | None) -> bool:
        """Send a message, from any thread."""
        peer = self.peer
        if not self.up or peer is None:
            return False
        with self._lock:
            if self._queued_bytes + len(payload) > _MAX_QUEUED_BYTES:
                return False
            self._queued_bytes += len(payload)
            self._number += 1
            number = str(self._number) if qos else ""
        stanza = stanzas.message(peer, topic, payload, receipt=number)
        try:
            if qos:
                self._loop.call_soon_threadsafe(self._write, stanza, len(payload), number, delivered)
            else:
                self._loop.call_soon_threadsafe(self._write_newest, topic, stanza, len(payload))
        except RuntimeError:  # the loop has ended
            return False
        return True

    async def send(self, topic: str, payload: bytes, within_s: float, *, listen: tuple[str, ...] = ()) -> None:
        """Send a message and wait for its receipt.

        Raises:
            StreamError: The message was rejected, or not acknowledged in time.
        """
        if self.peer is None:
            return
        with self._lock:
            self._number += 1
            number = str(self._number)
        response = self._responses[number] = self._loop.create_future()
        self.stream.send(stanzas.message(self.peer, topic, payload, receipt=number, listen=listen))
        try:
            async with asyncio.timeout(within_s):
                reason = await response
        except TimeoutError as error:
            raise StreamError("the cloud's XMPP gateway does not respond") from error
        finally:
            del self._responses[number]
        if reason:
            raise StreamError(f"the cloud's XMPP gateway rejects this agent: {reason}")

    def wake(self) -> None:
        """Wake the event loop, from any thread."""
        with contextlib.suppress(RuntimeError):
            self._loop.call_soon_threadsafe(self._changed.set)

    async def wait_for_change(self, within_s: float) -> None:
        """Wait for a change, at most ``within_s`` [s]."""
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(within_s):
                await self._changed.wait()
        self._changed.clear()

    def _write(self, stanza: str, size: int, number: str, delivered: Callable[[], None] | None) -> None:
        with self._lock:
            self._queued_bytes -= size
        if number and delivered is not None:
            self._delivered[number] = delivered
        self.stream.send(stanza)

    def _write_newest(self, topic: str, stanza: str, size: int) -> None:
        with self._lock:
            self._queued_bytes -= size
        if not self._newest and self.stream.unsent_bytes <= _MAX_UNSENT_BYTES:
            self.stream.send(stanza)
            return
        if not self._newest:
            self._loop.call_later(_UNSENT_POLL_S, self._send_newest)
        self._newest[topic] = stanza

    def _send_newest(self) -> None:
        if self.stream.unsent_bytes > _MAX_UNSENT_BYTES:
            self._loop.call_later(_UNSENT_POLL_S, self._send_newest)
            return
        newest, self._newest = self._newest, {}
        for stanza in newest.values():
            self.stream.send(stanza)

    # ------------------------------------------------------------ incoming

    def _on_message(self, stanza: Element) -> None:
        sender = stanza.get("from", "")
        if (rejection := stanzas.parse_rejection(stanza)) is not None:
            self._on_rejection(rejection)
            return
        if sender.partition("/")[0] != self._access.cloud:
            _log.warning("a message from %s was dropped: agents accept messages of the cloud only", sender[:200])
            return
        if (number := stanzas.receipt_id(stanza)) is not None:
            self._settle(number)
            return
        try:
            delivery = stanzas.parse(stanza)
        except ProtocolError as error:
            _log.warning("a message was dropped: %s", error)
            return
        if delivery is not None:
            self._receive(delivery.topic, delivery.payload)

    def _settle(self, number: str, reason: str = "") -> None:
        """Complete a message that was acknowledged or rejected permanently, so that it is not sent again."""
        response = self._responses.get(number)
        if response is not None and not response.done():
            response.set_result(reason)
        delivered = self._delivered.pop(number, None)
        if delivered is not None:
            delivered()

    def _on_rejection(self, rejection: stanzas.Rejection) -> None:
        if rejection.id not in self._responses:
            _log.warning("a message was returned: %s", rejection.reason)
        if not rejection.final:
            self._delivered.pop(rejection.id, None)
        self._settle(rejection.id, rejection.reason)

    def _on_presence(self, stanza: Element) -> None:
        sender = stanza.get("from", "")
        if sender.partition("/")[0] != self._access.cloud or "/" not in sender:
            return
        if stanza.get("type") is None:
            self.present.add(sender)
        elif stanza.get("type") == "unavailable":
            self.present.discard(sender)
            if sender == self.peer:
                self.peer = None
                self.left, self.up = self.up or self.left, False
                self._delivered.clear()
                for number in list(self._responses):
                    self._settle(number, "the gateway went offline")
        self._changed.set()
