"""The XMPP transport: one connection at a time, each made afresh with a new password; a thread with its event loop.

The cloud is a user with any number of places (resources): programs that speak for it. The agent sees by their presence
which are there, chooses one, and greets it with its own presence message. Once that is confirmed the link is up. When
that program or the server goes, the link is lost, and the next one that is there is greeted with a new session number.
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

from device_agent.ports.clock import wall_ms
from device_agent.ports.transport import LinkChanged, Receive
from device_agent.protocol import Presence, codec
from device_agent.protocol.errors import ProtocolError
from device_agent.protocol.xmpp import stanzas
from device_agent.protocol.xmpp.stream import Login, Stream, StreamError

_CONFIRM_S = 5.0
_GOODBYE_S = 0.5
_FIRST_BACK_OFF_S = 0.2
_LONGEST_BACK_OFF_S = 15.0
_REFRESH_AT = 0.8
"""Passwords are renewed after this share of their life, at a quiet moment; at the last moment in any case."""
_REFRESH_LATEST = 0.97
_LOOK_S = 0.25
_MOST_UNSENT_BYTES = 128 * 1024
"""More than this not yet taken by the kernel, and of each measurement only the newest is kept to be sent."""
_UNSENT_LOOK_S = 0.02
_MOST_QUEUED_BYTES = 4 * 1024 * 1024
"""More than this, and nothing is taken any more."""
NOTICED_WITHIN_S = stanzas.TIMEOUT_S + stanzas.PING_INTERVAL_S
_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class XmppAccess:
    """Where and as whom to connect, and with whom to speak.

    Attributes:
        login: The agent's own JID and password.
        cloud: The bare JID of the cloud.
        lifetime_s: Of the password, from now [s].
    """

    login: Login
    cloud: str
    lifetime_s: float


class XmppTransport:
    """``ports.transport.Transport`` over XMPP.

    Args:
        access: Asks the cloud for a password; raises ``OSError`` or ``ValueError`` when it has none now.
        presence_topic: Where presence goes.
        next_session: The next session number, rising across restarts.
        software: Name and version, for presence.
        listen: Topics of the space's other agents to hear as well.
        quiet: Whether a short break of the link would disturb nothing.
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
        self._thread: threading.Thread | None = None
        self._link: _Link | None = None

    def start(self, receive: Receive, link_changed: LinkChanged) -> None:
        """See ``Transport.start``."""
        self._receive = receive
        self._link_changed = link_changed
        self._thread = threading.Thread(target=self._run, name="xmpp", daemon=True)
        self._thread.start()

    def publish(
        self,
        topic: str,
        payload: bytes,
        *,
        qos: int,
        retain: bool = False,  # noqa: ARG002 (who speaks for the cloud knows what is kept)
        delivered: Callable[[], None] | None = None,
    ) -> bool:
        """See ``Transport.publish``. What is not JSON, as pictures, has no way here and is dropped."""
        if not payload.startswith(b"{"):
            return False
        link = self._link
        return link is not None and link.publish(topic, payload, qos=qos, delivered=delivered)

    def stop(self) -> None:
        """See ``Transport.stop``."""
        self._stopping.set()
        link = self._link
        if link is not None:
            link.wake()
        if self._thread is not None and self._thread is not threading.current_thread():
            self._thread.join(timeout=3)

    # ------------------------------------------------------------ one connection after another

    def _run(self) -> None:
        back_off_s = _FIRST_BACK_OFF_S
        while not self._stopping.is_set():
            began_s = time.monotonic()
            try:
                access = self._access()
                asyncio.run(self._connect_once(access))
            except (OSError, ValueError) as error:
                _log.warning("no link: %s", error)
            except Exception:  # noqa: BLE001 (whatever it was: a robot that has lost its link must keep trying)
                _log.exception("no link")
            if time.monotonic() - began_s > _LONGEST_BACK_OFF_S:
                back_off_s = _FIRST_BACK_OFF_S
            # Full jitter: agents that lost one server together do not come back together.
            if self._stopping.wait(random.uniform(_FIRST_BACK_OFF_S / 2, back_off_s)):  # noqa: S311 (not a secret)
                return
            back_off_s = min(2 * back_off_s, _LONGEST_BACK_OFF_S)

    async def _connect_once(self, access: XmppAccess) -> None:
        link = self._link = _Link(access, self._receive)
        staying: asyncio.Task[None] | None = None
        try:
            await link.stream.open()
            staying = asyncio.create_task(link.stream.stay())
            began_s = time.monotonic()
            while not self._stopping.is_set() and not self._to_renew(time.monotonic() - began_s, access.lifetime_s):
                if staying.done():
                    staying.result()
                if link.peer is None and await self._greet(link):
                    self._link_changed(True)
                await link.something(_LOOK_S)
                if link.left:
                    link.left = False
                    self._link_changed(False)
        finally:
            was_up, link.up = link.up, False
            if was_up and (self._stopping.is_set() or staying is None or not staying.done()):
                with contextlib.suppress(StreamError):
                    await link.tell(self._presence_topic, self._presence(link, online=False), _GOODBYE_S)
            self._link = None
            if staying is not None:
                staying.cancel()
                await asyncio.gather(staying, return_exceptions=True)
            await link.stream.close()
            if was_up or link.left:
                self._link_changed(False)

    def _to_renew(self, age_s: float, lifetime_s: float) -> bool:
        share = age_s / lifetime_s
        return share > _REFRESH_LATEST or (share > _REFRESH_AT and self._quiet())

    async def _greet(self, link: "_Link") -> bool:
        """Choose one of those that speak for the cloud, and say to it that we are there; whether it has heard.

        Raises:
            StreamError: It says no, or nothing.
        """
        if not link.present:
            return False
        link.peer = random.choice(sorted(link.present))  # noqa: S311 (spreads agents, hides nothing)
        link.session = self._next_session()
        await link.tell(self._presence_topic, self._presence(link, online=True), _CONFIRM_S, listen=self._listen)
        link.up = link.peer is not None
        link.left = False
        return link.up

    def _presence(self, link: "_Link", *, online: bool) -> bytes:
        return codec.encode(Presence(online=online, session=link.session, at_ms=wall_ms(), software=self._software))


class _Link:
    """One connection. Everything but ``publish`` and ``wake`` runs in its event loop.

    Attributes:
        present: JIDs of those that speak for the cloud now.
        peer: The one that we have chosen.
        up: Whether it has heard our greeting.
        left: Whether it has gone since.
        session: Number of the greeting.
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
        self._answers: dict[str, asyncio.Future[str]] = {}

    # ------------------------------------------------------------ out

    def publish(self, topic: str, payload: bytes, *, qos: int, delivered: Callable[[], None] | None) -> bool:
        """From any thread: have a message written."""
        peer = self.peer
        if not self.up or peer is None:
            return False
        with self._lock:
            if self._queued_bytes + len(payload) > _MOST_QUEUED_BYTES:
                return False
            self._queued_bytes += len(payload)
            self._number += 1
            number = str(self._number) if qos else ""
        stanza = stanzas.message(peer, topic, payload, receipt=number)
        try:
            if qos:
                self._loop.call_soon_threadsafe(self._write, stanza, len(payload), number, delivered)
            else:
                self._loop.call_soon_threadsafe(self._measure, topic, stanza, len(payload))
        except RuntimeError:  # the loop has ended meanwhile
            return False
        return True

    async def tell(self, topic: str, payload: bytes, within_s: float, *, listen: tuple[str, ...] = ()) -> None:
        """Send a message of our own, and wait until it is confirmed.

        Raises:
            StreamError: It was refused, or not confirmed in time.
        """
        if self.peer is None:
            return
        with self._lock:
            self._number += 1
            number = str(self._number)
        answer = self._answers[number] = self._loop.create_future()
        self.stream.send(stanzas.message(self.peer, topic, payload, receipt=number, listen=listen))
        try:
            async with asyncio.timeout(within_s):
                why = await answer
        except TimeoutError as error:
            raise StreamError("whoever speaks for the cloud over XMPP does not answer") from error
        finally:
            del self._answers[number]
        if why:
            raise StreamError(f"whoever speaks for the cloud over XMPP refuses this agent: {why}")

    def wake(self) -> None:
        """From any thread: look again at once."""
        with contextlib.suppress(RuntimeError):
            self._loop.call_soon_threadsafe(self._changed.set)

    async def something(self, within_s: float) -> None:
        """Wait until something has changed, but no longer than this."""
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

    def _measure(self, topic: str, stanza: str, size: int) -> None:
        with self._lock:
            self._queued_bytes -= size
        if not self._newest and self.stream.unsent_bytes <= _MOST_UNSENT_BYTES:
            self.stream.send(stanza)
            return
        if not self._newest:
            self._loop.call_later(_UNSENT_LOOK_S, self._send_newest)
        self._newest[topic] = stanza

    def _send_newest(self) -> None:
        if self.stream.unsent_bytes > _MOST_UNSENT_BYTES:
            self._loop.call_later(_UNSENT_LOOK_S, self._send_newest)
            return
        newest, self._newest = self._newest, {}
        for stanza in newest.values():
            self.stream.send(stanza)

    # ------------------------------------------------------------ in

    def _on_message(self, stanza: Element) -> None:
        sender = stanza.get("from", "")
        if (refused := stanzas.parse_rejection(stanza)) is not None:
            self._came_back(refused)
            return
        if sender.partition("/")[0] != self._access.cloud:
            _log.warning("a message of %s was dropped: only the cloud may speak to an agent", sender[:200])
            return
        if (number := stanzas.receipt_id(stanza)) is not None:
            self._settle(number)
            return
        try:
            told = stanzas.parse(stanza)
        except ProtocolError as error:
            _log.warning("a message was dropped: %s", error)
            return
        if told is not None:
            self._receive(told.topic, told.payload)

    def _settle(self, number: str, why: str = "") -> None:
        """A message was confirmed, or will never be taken: to tell it again would change nothing."""
        answer = self._answers.get(number)
        if answer is not None and not answer.done():
            answer.set_result(why)
        delivered = self._delivered.pop(number, None)
        if delivered is not None:
            delivered()

    def _came_back(self, refused: stanzas.Rejection) -> None:
        if refused.id not in self._answers:
            _log.warning("a message came back: %s", refused.reason)
        if not refused.final:
            self._delivered.pop(refused.id, None)
        self._settle(refused.id, refused.reason)

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
                for number in list(self._answers):
                    self._settle(number, "it has gone")
        self._changed.set()
