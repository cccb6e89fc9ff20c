"""HTTP transport: one connection polls for commands, another one sends messages.

The link is up once the cloud has accepted the agent's presence and answered a poll. It is lost when a connection fails
twice in a row, when a request times out, or when polls only return temporary errors for ``LOST_AFTER_S``. The sender
sends heartbeats, so a network that drops all packets is detected within ``SILENCE_TIMEOUT_S`` during motion.

The *poll* thread owns the link, forwards commands and alone reports changes of the link. The *send* thread empties the
queue.
"""

import contextlib
import logging
import threading
import time
from collections.abc import Callable, Sequence
from typing import TypeVar

from device_agent.ports.threads import Recovery, SupervisedThread
from device_agent.ports.transport import LinkChanged, Receive
from device_agent.protocol import Ack, codec, topics
from device_agent.protocol.errors import ProtocolError
from device_agent.transports import presence
from device_agent.transports.backoff import BackOff
from device_agent.transports.http.client import RESPONSE_TIMEOUT_S, CloudClient, CloudError, QueuedCommand
from device_agent.transports.http.send_queue import Message, SendQueue

LONG_POLL_S = 25.0
"""Maximum duration of a long poll [s]; below idle timeouts of proxies and hosts."""
LOST_AFTER_S = 5.0
MOVING_HEARTBEAT_S = 1.0
RESTING_HEARTBEAT_S = 10.0
"""Heartbeat interval without other messages [s]; at rest a lost link is harmless."""
SILENCE_TIMEOUT_S = MOVING_HEARTBEAT_S + RESPONSE_TIMEOUT_S
_LIMIT = 32
"""Maximum number of commands per response, and of ids in ``have``."""
_REDELIVERY_S = 5.0
"""A command without acknowledgement for this time may be sent again [s]; the journal deduplicates it."""
_BUSY_PAUSE_S = 0.2
_ABORT_INTERVAL_S = 0.02
_DISCONNECT_S = 0.7
_RESPONSE_S = 120.0
"""A thread without progress for this time hangs [s]: a poll, its retry and a check of the pairing."""
T = TypeVar("T")
_log = logging.getLogger(__name__)


class HttpTransport:
    """``ports.transport.Transport`` over HTTP.

    Args:
        open_api: Creates a client of the cloud's API, one per thread.
        check: Raises ``CloudError`` if the agent's pairing is no longer valid, ``OSError`` without a response.
        presence_topic: Topic of presence; the agent's other topics have the same prefix.
        next_session: Next session number; it rises across restarts.
        software: Name and version, for presence.
        quiet: Whether a short interruption is harmless now.
        wait_s: Maximum duration of a long poll [s]; 0: plain polls.
        pause_s: Interval of plain polls [s].
    """

    def __init__(
        self,
        *,
        open_api: Callable[[], CloudClient],
        check: Callable[..., None],
        presence_topic: str,
        next_session: Callable[[], int],
        software: str,
        quiet: Callable[[], bool] = lambda: True,
        wait_s: float = LONG_POLL_S,
        pause_s: float = 0.0,
    ) -> None:
        self._poll_api = open_api()
        self._send_api = open_api()
        self._check = check
        self._presence_topic = presence_topic
        self._agent = topics.parse(presence_topic).agent
        self._own = presence_topic.removesuffix(topics.CONN)
        self._next_session = next_session
        self._software = software
        self._quiet = quiet
        self._wait_s = wait_s
        self._pause_s = pause_s
        self._queue = SendQueue()
        self._have: dict[str, float] = {}
        self._have_lock = threading.Lock()
        self._session = 0
        self._announced_online = False
        self._up = False
        self._interrupt = threading.Event()
        self._stopping = threading.Event()
        self._threads = [
            SupervisedThread(
                target,
                name=name,
                part=part,
                stopping=self._stopping,
                recovery=Recovery.RESTART_OR_EXIT,
                within_s=_RESPONSE_S,
            )
            for target, name, part in ((self._run, "http-poll", "HTTP poll"), (self._send, "http-send", "HTTP sender"))
        ]
        self._poll_thread, self._send_thread = self._threads

    def start(self, receive: Receive, link_changed: LinkChanged) -> None:
        """Implements ``Transport.start``."""
        self._receive = receive
        self._link_changed = link_changed
        for thread in self._threads:
            thread.start()

    def publish(
        self,
        topic: str,
        payload: bytes,
        *,
        qos: int,
        retain: bool = False,  # noqa: ARG002 (the cloud retains by class)
        delivered: Callable[[], None] | None = None,
    ) -> bool:
        """Implements ``Transport.publish``. Payloads that are not JSON, such as camera frames, are dropped."""
        if not self._up or not payload.startswith(b"{"):
            return False
        return self._queue.put(Message(topic, payload, reliable=qos > 0, delivered=delivered))

    def stop(self) -> None:
        """Implements ``Transport.stop``."""
        self._stopping.set()
        self._interrupt.set()
        self._queue.close()
        others = [thread for thread in self._threads if not thread.is_current()]
        deadline_s = time.monotonic() + _DISCONNECT_S
        while any(thread.is_alive() for thread in others) and time.monotonic() < deadline_s + _DISCONNECT_S:
            # Repeatedly: a call may be about to start.
            self._poll_api.abort()
            if time.monotonic() > deadline_s:
                self._send_api.abort()
            for thread in others:
                thread.join(_ABORT_INTERVAL_S)

    # ------------------------------------------------------------ poll thread

    def _run(self) -> None:
        back_off = BackOff()
        while not self._stopping.is_set():
            back_off.attempt()
            self._poll_thread.beat()
            try:
                self._connect()
                self._poll()
            except (OSError, ValueError) as error:
                if not self._interrupt.is_set():
                    _log.warning("no link: %s", error)
            except Exception:  # noqa: BLE001 (the transport must keep reconnecting after any error)
                _log.exception("no link")
            finally:
                self._disconnect()
            if self._stopping.wait(back_off.wait_s()):
                return

    def _connect(self) -> None:
        """Publish presence, and check that commands can be received.

        Raises:
            CloudError: The cloud rejects the agent.
            OSError: The cloud cannot be reached.
        """
        self._interrupt.clear()
        if self._stopping.is_set():
            return
        self._check(self._poll_api)
        self._session = self._next_session()
        self._announced_online = True
        (rejection,) = self._poll_api.send(self._agent, [(self._presence_topic, self._presence(online=True))])
        if rejection is not None:
            raise CloudError(f"the cloud rejects this agent's presence: {rejection}")
        with self._have_lock:
            self._have.clear()
        commands = self._request_commands(wait_s=0.0)
        if self._stopping.is_set():
            return
        self._up = True
        self._link_changed(True)
        self._forward(commands)

    def _disconnect(self) -> None:
        was_up, self._up = self._up, False
        if not self._stopping.is_set():
            self._announced_online = False
            self._queue.clear()
        if was_up:
            self._link_changed(False)

    def _poll(self) -> None:
        """Poll until the link is lost.

        Raises:
            CloudError, OSError: Why the link is lost.
        """
        answered_s = time.monotonic()
        while not self._interrupt.wait(self._pause(answered_s)):
            self._poll_thread.beat()
            started_s = time.monotonic()
            try:
                commands = self._with_retry(lambda: self._request_commands(wait_s=self._wait_s))
            except CloudError as error:
                self._wait_or_raise(error, started_s - answered_s)
                continue
            answered_s = time.monotonic() if self._wait_s else started_s
            self._forward(commands)

    def _pause(self, last_s: float) -> float:
        """Time until the next poll [s]."""
        return max(0.0, last_s + self._pause_s - time.monotonic())

    def _request_commands(self, *, wait_s: float) -> list[QueuedCommand]:
        expired_s = time.monotonic() - _REDELIVERY_S
        with self._have_lock:
            for command in [command for command, came_s in self._have.items() if came_s < expired_s]:
                del self._have[command]
            have = list(self._have)[:_LIMIT]
        return self._poll_api.commands(self._agent, wait_s=wait_s, limit=_LIMIT, have=have)

    def _forward(self, commands: Sequence[QueuedCommand]) -> None:
        for command in commands:
            if self._interrupt.is_set():
                return
            if not command.topic.startswith(self._own):
                self._check(self._poll_api)
                _log.warning("the cloud sent this agent a command for '%s'", command.topic[:200])
                continue
            with self._have_lock:
                duplicate = command.command in self._have
                self._have.setdefault(command.command, time.monotonic())
            if not duplicate:
                self._receive(command.topic, command.payload)
        if commands and len(self._have) > _LIMIT:
            # `have` cannot list more: limit the load of redeliveries until the first are acknowledged.
            self._interrupt.wait(_BUSY_PAUSE_S)

    def _wait_or_raise(self, error: CloudError, since_s: float) -> None:
        """Wait briefly after a temporary error.

        Raises:
            CloudError: The error is permanent, or has lasted for too long.
        """
        if not error.passing:
            self._check(self._poll_api)
            raise error
        if since_s > LOST_AFTER_S:
            raise error
        self._interrupt.wait(_BUSY_PAUSE_S)

    def _with_retry(self, call: Callable[[], T]) -> T:
        """Retry once on a closed connection: servers may close idle ones.

        Raises:
            OSError: The retry failed too, or the request timed out.
        """
        try:
            return call()
        except TimeoutError:
            raise
        except OSError:
            if self._interrupt.is_set():
                raise
            return call()

    # ------------------------------------------------------------ send thread

    def _send(self) -> None:
        while not self._stopping.is_set():
            self._send_thread.beat()
            batch = self._queue.take(RESTING_HEARTBEAT_S if self._quiet() else MOVING_HEARTBEAT_S)
            if self._stopping.is_set():
                self._queue.put_back(batch)
            elif self._interrupt.is_set() or not self._up:
                # The link is lost: drop the batch. The poll thread may not have detected it yet.
                if self._up:
                    self._poll_api.abort()
                self._stopping.wait(_ABORT_INTERVAL_S)
            else:
                self._try_send(batch)
        self._publish_offline()

    def _try_send(self, batch: Sequence[Message]) -> None:
        session = self._session
        try:
            self._with_retry(lambda: self._send_batch(batch))
        except (OSError, ValueError) as error:
            if session != self._session:
                return
            self._queue.put_back(batch)
            if isinstance(error, CloudError) and error.passing:
                self._interrupt.wait(_BUSY_PAUSE_S)
            elif not self._interrupt.is_set():
                _log.warning("link lost: %s", error)
                self._interrupt.set()
                self._poll_api.abort()
        except Exception:  # noqa: BLE001 (other messages must still be sent)
            _log.exception("sending messages")

    def _send_batch(self, batch: Sequence[Message]) -> None:
        """Send a batch, or a heartbeat if it is empty.

        Raises:
            CloudError: The cloud rejects all messages at present, or all of this agent.
            OSError: The cloud cannot be reached.
        """
        if not batch:
            self._check(self._send_api, within_s=RESPONSE_TIMEOUT_S)
            return
        try:
            results = self._send_api.send(self._agent, [(message.topic, message.payload) for message in batch])
        except CloudError as error:
            if error.passing:
                raise
            self._check(self._send_api)
            if len(batch) == 1:
                self._process_results(batch, [str(error)])
                return
            # One of the messages is invalid: send the others.
            self._send_batch(batch[: len(batch) // 2])
            self._send_batch(batch[len(batch) // 2 :])
            return
        self._process_results(batch, results)
        if any(results):
            self._check(self._send_api)

    def _process_results(self, batch: Sequence[Message], results: Sequence[str | None]) -> None:
        for message, rejection in zip(batch, results, strict=True):
            if rejection is not None:  # permanent, so the message is not sent again
                _log.warning("the cloud rejects a message on %s: %s", message.topic, rejection[:300])
            elif message.is_ack:
                self._remove_received(message.payload)
            if message.delivered is not None:
                message.delivered()

    def _remove_received(self, payload: bytes) -> None:
        """Remove a command from ``have``: the cloud has received its acknowledgement."""
        with contextlib.suppress(ProtocolError), self._have_lock:
            self._have.pop(codec.decode(payload, Ack).id, None)

    def _publish_offline(self) -> None:
        self._poll_thread.join(_DISCONNECT_S / 2)  # its presence must not follow the offline presence
        if not self._announced_online:
            return
        batch = self._queue.take(0.0)
        last = Message(self._presence_topic, self._presence(online=False), reliable=True)
        payloads = [(message.topic, message.payload) for message in (*batch, last)]
        with contextlib.suppress(OSError, ValueError):
            self._process_results((*batch, last), self._send_api.send(self._agent, payloads, within_s=_DISCONNECT_S))

    def _presence(self, *, online: bool) -> bytes:
        return presence.encode(online=online, session=self._session, software=self._software)
