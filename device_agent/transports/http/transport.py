"""The HTTP transport: one connection asks for commands, one tells what there is to say.

The link is up when the cloud knows that the agent is there and has answered a poll. It is lost when a connection is
refused or cut and a fresh one is too, when a request gets no answer in time, or when polls are only answered with
trouble for ``LOST_AFTER_S``. As telling never pauses longer than a heartbeat, a network that swallows everything is
noticed within ``NOTICED_WITHIN_S`` while something moves.

Two threads: *poll* owns the link, hands on what comes, and alone says that the link has changed; *tell* empties the
tray.
"""

import contextlib
import logging
import threading
import time
from collections.abc import Callable, Sequence
from typing import TypeVar

from device_agent.ports.clock import wall_ms
from device_agent.ports.transport import LinkChanged, Receive
from device_agent.protocol import Ack, Presence, codec, topics
from device_agent.protocol.errors import ProtocolError
from device_agent.transports.backoff import BackOff
from device_agent.transports.http.client import ANSWER_WITHIN_S, CloudClient, CloudError, QueuedCommand
from device_agent.transports.http.send_queue import Message, SendQueue

LONG_POLL_S = 25.0
"""Below what proxies and hosts cut as idle."""
LOST_AFTER_S = 5.0
MOVING_HEARTBEAT_S = 1.0
RESTING_HEARTBEAT_S = 10.0
"""Without anything to tell the cloud is asked so often whether it is there; at rest a lost link does no harm."""
NOTICED_WITHIN_S = MOVING_HEARTBEAT_S + ANSWER_WITHIN_S
_LIMIT = 32
"""Commands in one answer, and ids that ``have`` may name: the most that the cloud takes."""
_AGAIN_S = 5.0
"""A command that nobody has answered for so long may be given again: the journal knows it."""
_BUSY_PAUSE_S = 0.2
_BREAK_EVERY_S = 0.02
_GOODBYE_S = 0.7
T = TypeVar("T")
_log = logging.getLogger(__name__)


class HttpTransport:
    """``ports.transport.Transport`` over HTTP.

    Args:
        open_api: The cloud's API, one for each thread.
        check: Raises ``CloudError`` when this agent is no longer what it was built as, ``OSError`` without an answer.
        presence_topic: Where presence goes; its other topics begin alike.
        next_session: The next session number, rising across restarts.
        software: Name and version, for presence.
        quiet: Whether a short break would disturb nothing.
        wait_s: How long the cloud may hold a poll back [s]; 0: plain polls.
        pause_s: From the begin of one plain poll to the next [s].
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
        self._tell_api = open_api()
        self._check = check
        self._presence_topic = presence_topic
        self._agent = topics.parse(presence_topic).agent
        self._own = presence_topic.removesuffix(topics.CONN)
        self._next_session = next_session
        self._software = software
        self._quiet = quiet
        self._wait_s = wait_s
        self._pause_s = pause_s
        self._tray = SendQueue()
        self._have: dict[str, float] = {}
        self._have_lock = threading.Lock()
        self._session = 0
        self._said_online = False
        self._up = False
        self._interrupt = threading.Event()
        self._stopping = threading.Event()
        self._threads: list[threading.Thread] = []

    def start(self, receive: Receive, link_changed: LinkChanged) -> None:
        """See ``Transport.start``."""
        self._receive = receive
        self._link_changed = link_changed
        self._threads = [
            threading.Thread(target=self._run, name="http-poll", daemon=True),
            threading.Thread(target=self._tell, name="http-tell", daemon=True),
        ]
        for thread in self._threads:
            thread.start()

    def publish(
        self,
        topic: str,
        payload: bytes,
        *,
        qos: int,
        retain: bool = False,  # noqa: ARG002 (the cloud knows which classes are retained)
        delivered: Callable[[], None] | None = None,
    ) -> bool:
        """See ``Transport.publish``. What is not JSON, as pictures, has no way here and is dropped."""
        if not self._up or not payload.startswith(b"{"):
            return False
        return self._tray.put(Message(topic, payload, kept=qos > 0, delivered=delivered))

    def stop(self) -> None:
        """See ``Transport.stop``."""
        self._stopping.set()
        self._interrupt.set()
        self._tray.close()
        others = [thread for thread in self._threads if thread is not threading.current_thread()]
        goodbye_s = time.monotonic() + _GOODBYE_S
        while any(thread.is_alive() for thread in others) and time.monotonic() < goodbye_s + _GOODBYE_S:
            # Again and again: a call may just be about to begin.
            self._poll_api.break_off()
            if time.monotonic() > goodbye_s:
                self._tell_api.break_off()
            for thread in others:
                thread.join(_BREAK_EVERY_S)

    # ------------------------------------------------------------ the poll thread

    def _run(self) -> None:
        back_off = BackOff()
        while not self._stopping.is_set():
            back_off.attempt()
            try:
                self._connect()
                self._poll()
            except (OSError, ValueError) as error:
                if not self._interrupt.is_set():
                    _log.warning("no link: %s", error)
            except Exception:  # noqa: BLE001 (whatever it was: a robot that has lost its link must keep trying)
                _log.exception("no link")
            finally:
                self._disconnect()
            if self._stopping.wait(back_off.wait_s()):
                return

    def _connect(self) -> None:
        """Say that the agent is there, and see that commands would come.

        Raises:
            CloudError: The cloud does not want it.
            OSError: Not reached.
        """
        self._interrupt.clear()
        if self._stopping.is_set():
            return
        self._check(self._poll_api)
        self._session = self._next_session()
        self._said_online = True
        (refused,) = self._poll_api.tell(self._agent, [(self._presence_topic, self._presence(online=True))])
        if refused is not None:
            raise CloudError(f"the cloud refuses this agent's presence: {refused}")
        with self._have_lock:
            self._have.clear()
        letters = self._ask(wait_s=0.0)
        if self._stopping.is_set():
            return
        self._up = True
        self._link_changed(True)
        self._hand_on(letters)

    def _disconnect(self) -> None:
        was_up, self._up = self._up, False
        if not self._stopping.is_set():
            self._said_online = False
            self._tray.clear()
        if was_up:
            self._link_changed(False)

    def _poll(self) -> None:
        """Ask until the link is lost.

        Raises:
            CloudError, OSError: Why it is.
        """
        answered_s = time.monotonic()
        while not self._interrupt.wait(self._pause(answered_s)):
            began_s = time.monotonic()
            try:
                letters = self._twice(lambda: self._ask(wait_s=self._wait_s))
            except CloudError as error:
                self._be_patient(error, began_s - answered_s)
                continue
            answered_s = time.monotonic() if self._wait_s else began_s
            self._hand_on(letters)

    def _pause(self, last_s: float) -> float:
        """Until the next poll [s]."""
        return max(0.0, last_s + self._pause_s - time.monotonic())

    def _ask(self, *, wait_s: float) -> list[QueuedCommand]:
        long_ago_s = time.monotonic() - _AGAIN_S
        with self._have_lock:
            for command in [command for command, came_s in self._have.items() if came_s < long_ago_s]:
                del self._have[command]
            have = list(self._have)[:_LIMIT]
        return self._poll_api.commands(self._agent, wait_s=wait_s, limit=_LIMIT, have=have)

    def _hand_on(self, letters: Sequence[QueuedCommand]) -> None:
        for letter in letters:
            if self._interrupt.is_set():
                return
            if not letter.topic.startswith(self._own):
                self._check(self._poll_api)
                _log.warning("the cloud gives this agent a command for '%s'", letter.topic[:200])
                continue
            with self._have_lock:
                known = letter.command in self._have
                self._have.setdefault(letter.command, time.monotonic())
            if not known:
                self._receive(letter.topic, letter.payload)
        if letters and len(self._have) > _LIMIT:
            # More than can be named: what is given again until the first are answered must not keep two machines busy.
            self._interrupt.wait(_BUSY_PAUSE_S)

    def _be_patient(self, error: CloudError, since_s: float) -> None:
        """Wait a little when the cloud may do better soon.

        Raises:
            CloudError: It will not, or has not for too long.
        """
        if not error.passing:
            self._check(self._poll_api)
            raise error
        if since_s > LOST_AFTER_S:
            raise error
        self._interrupt.wait(_BUSY_PAUSE_S)

    def _twice(self, call: Callable[[], T]) -> T:
        """Call again when the connection was closed: a server may do so with one that has waited.

        Raises:
            OSError: A fresh one does not work either, or there was no answer in time.
        """
        try:
            return call()
        except TimeoutError:
            raise
        except OSError:
            if self._interrupt.is_set():
                raise
            return call()

    # ------------------------------------------------------------ the tell thread

    def _tell(self) -> None:
        while not self._stopping.is_set():
            batch = self._tray.take(RESTING_HEARTBEAT_S if self._quiet() else MOVING_HEARTBEAT_S)
            if self._stopping.is_set():
                self._tray.put_back(batch)
            elif self._interrupt.is_set() or not self._up:
                # The link is lost: what was for it is nobody's. The poll thread may not have seen it yet.
                if self._up:
                    self._poll_api.break_off()
                self._stopping.wait(_BREAK_EVERY_S)
            else:
                self._try_to_tell(batch)
        self._say_goodbye()

    def _try_to_tell(self, batch: Sequence[Message]) -> None:
        session = self._session
        try:
            self._twice(lambda: self._tell_batch(batch))
        except (OSError, ValueError) as error:
            if session != self._session:
                return
            self._tray.put_back(batch)
            if isinstance(error, CloudError) and error.passing:
                self._interrupt.wait(_BUSY_PAUSE_S)
            elif not self._interrupt.is_set():
                _log.warning("link given up: %s", error)
                self._interrupt.set()
                self._poll_api.break_off()
        except Exception:  # noqa: BLE001 (whatever it was: there are other messages)
            _log.exception("telling")

    def _tell_batch(self, batch: Sequence[Message]) -> None:
        """Tell all, or, when there is nothing to tell, ask whether all is well.

        Raises:
            CloudError: The cloud takes nothing now, or nothing of this agent any more.
            OSError: Not reached.
        """
        if not batch:
            self._check(self._tell_api, within_s=ANSWER_WITHIN_S)
            return
        try:
            results = self._tell_api.tell(self._agent, [(message.topic, message.payload) for message in batch])
        except CloudError as error:
            if error.passing:
                raise
            self._check(self._tell_api)
            if len(batch) == 1:
                _log.warning("the cloud refuses a message on %s: %s", batch[0].topic, error)
                return
            # One of them is wrong: the others shall not suffer for it.
            self._tell_batch(batch[: len(batch) // 2])
            self._tell_batch(batch[len(batch) // 2 :])
            return
        self._take_results(batch, results)
        if any(results):
            self._check(self._tell_api)

    def _take_results(self, batch: Sequence[Message], results: Sequence[str | None]) -> None:
        for message, refused in zip(batch, results, strict=True):
            if refused is not None:
                _log.warning("the cloud refuses a message on %s: %s", message.topic, refused[:300])
                continue
            if message.is_ack:
                self._forget(message.payload)
            if message.delivered is not None:
                message.delivered()

    def _forget(self, payload: bytes) -> None:
        """The cloud knows that this command has come, and will not give it again."""
        with contextlib.suppress(ProtocolError), self._have_lock:
            self._have.pop(codec.decode(payload, Ack).id, None)

    def _say_goodbye(self) -> None:
        self._threads[0].join(_GOODBYE_S / 2)  # its presence must not come after ours
        if not self._said_online:
            return
        batch = self._tray.take(0.0)
        last = Message(self._presence_topic, self._presence(online=False), kept=True)
        told = [(message.topic, message.payload) for message in (*batch, last)]
        with contextlib.suppress(OSError, ValueError):
            self._take_results((*batch, last), self._tell_api.tell(self._agent, told, within_s=_GOODBYE_S))

    def _presence(self, *, online: bool) -> bytes:
        return codec.encode(Presence(online=online, session=self._session, at_ms=wall_ms(), software=self._software))
