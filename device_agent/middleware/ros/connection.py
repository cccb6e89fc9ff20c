"""A connection to ROS: topics and actions, as messages of the rosbridge protocol, version 2.

A ``Channel`` transports the messages: ``rosbridge.py`` over a WebSocket to a rosbridge server, ``rospy_channel.py``
over a socket to a bridge process.
"""

import logging
import threading
from collections.abc import Callable, Mapping, Sequence
from types import MappingProxyType
from typing import Any, NamedTuple, Protocol

import msgspec

from device_agent.middleware.ros.messages import Message
from device_agent.ports.driver import UnreachableError
from device_agent.ports.threads import SupervisedThread

_END_S = 2.0
_log = logging.getLogger(__name__)


class Channel(Protocol):
    """Transports whole messages, and is lost for good at the first error.

    Attributes:
        where: The other end, for operators.
    """

    where: str

    def send(self, message: bytes) -> None:
        """Send a message. Any thread may call it. It never blocks.

        Raises:
            OSError: The channel is lost, or the other end does not receive.
        """

    def receive(self) -> Sequence[bytes]:
        """Messages that arrived; waits for them at most 0.1 s. Only one thread calls it.

        Raises:
            OSError: The channel is lost.
        """

    def disconnect(self) -> None:
        """End the channel. ``send`` and ``receive`` then fail, also calls that other threads have started."""

    def close(self) -> None:
        """Free all resources, when no other thread uses the channel any more."""


class Publication(NamedTuple):
    """A message for a topic."""

    topic: str
    message: Message

    @property
    def request(self) -> Message:
        """The message of the protocol."""
        return {"op": "publish", "topic": self.topic, "msg": self.message}


class ActionGoal(NamedTuple):
    """A goal for an action server of ROS 2. In ROS 1 a goal is a message for a topic."""

    action: str
    type: str
    id: str
    message: Message

    @property
    def request(self) -> Message:
        """The message of the protocol. Feedback is not requested, because measurements have a topic."""
        names = {"id": self.id, "action": self.action, "action_type": self.type}
        return {"op": "send_action_goal", **names, "args": self.message, "feedback": False}


class ActionCancel(NamedTuple):
    """The end of a goal in ROS 2."""

    action: str
    id: str

    @property
    def request(self) -> Message:
        """The message of the protocol."""
        return {"op": "cancel_action_goal", "id": self.id, "action": self.action}


Command = Publication | ActionGoal | ActionCancel


class ActionResult(msgspec.Struct, frozen=True):
    """The end of a goal in ROS 2. ``result`` is false if the server is missing or has rejected the goal.

    Attributes:
        action: Name of the action.
        id: Id of the goal.
        status: ``action_msgs/GoalStatus``.
        values: The result message; a text if ``result`` is false.
    """

    action: str
    id: str
    result: bool
    status: int = 0
    values: Any = None


class Subscription(NamedTuple):
    """A topic to receive.

    Attributes:
        topic: Name of the topic.
        type: Its type.
        message: Python type of the messages.
        accept: Called with each valid message and its arrival [s]. It raises ``ValueError`` for one to be rejected.
        throttle_ms: Shortest time between two messages [ms].
    """

    topic: str
    type: str
    message: Any
    accept: Callable[[Any, float], None]
    throttle_ms: int = 0


class _Received(msgspec.Struct, frozen=True):
    op: str
    topic: str = ""
    action: str = ""
    level: str = ""
    msg: msgspec.Raw = msgspec.Raw(b"null")


class Connection:
    """One connection; a lost one is replaced by a new object, so that no value outlives it.

    Args:
        channel: The connected channel.
        subscriptions: Topics to receive.
        advertised: Topics to publish, with their types.
        results: Action → called with each result and its arrival [s]; only in ROS 2.
        device: Id of the device at its agent.
        clock: The monotonic clock [s].

    Attributes:
        problem: The newest error of the other end, or why a message was rejected; empty if there was none.

    Raises:
        UnreachableError: The channel is lost.
    """

    def __init__(
        self,
        channel: Channel,
        *,
        subscriptions: Sequence[Subscription],
        advertised: Mapping[str, str],
        device: str,
        clock: Callable[[], float],
        results: Mapping[str, Callable[[ActionResult, float], None]] = MappingProxyType({}),
    ) -> None:
        self._results = results
        self._result_decoder = msgspec.json.Decoder(ActionResult)
        self._channel = channel
        self._clock = clock
        self._closed = threading.Event()
        self._decoder = msgspec.json.Decoder(_Received)
        self._subscriptions = [(each, msgspec.json.Decoder(each.message)) for each in subscriptions]
        self.problem = ""
        self._thread = SupervisedThread(
            self._receive, name=f"{device}-receiver", part="receiver of the driver", device=device
        )
        self._thread.start()
        try:
            for topic, kind in advertised.items():
                self._send({"op": "advertise", "topic": topic, "type": kind})
            for each in subscriptions:
                self._send(
                    {"op": "subscribe", "topic": each.topic, "type": each.type, "throttle_rate": each.throttle_ms}
                )
        except UnreachableError:
            self.close()
            raise

    @property
    def where(self) -> str:
        """The other end, for operators."""
        return self._channel.where

    @property
    def lost(self) -> bool:
        """Whether the connection has ended."""
        return self._closed.is_set()

    def publish(self, command: Command) -> None:
        """Publish a message, or send or cancel a goal. Never blocks; any thread may call it.

        Raises:
            UnreachableError: The connection has ended.
        """
        self._send(command.request)

    def close(self) -> None:
        """End the connection and its thread. May be called repeatedly."""
        self._closed.set()
        self._channel.disconnect()
        self._thread.join(_END_S)
        self._channel.close()

    def _send(self, message: Message) -> None:
        if self._closed.is_set():
            raise UnreachableError(f"the connection to {self.where} is lost")
        try:
            self._channel.send(msgspec.json.encode(message))
        except OSError as error:
            self._closed.set()
            self._channel.disconnect()
            raise UnreachableError(f"the connection to {self.where} is lost: {error}") from error

    def _receive(self) -> None:
        while not self._closed.is_set():
            try:
                messages = self._channel.receive()
            except OSError as error:
                self.problem = self.problem or str(error)
                break
            for message in messages:
                self._accept(message)
        self._closed.set()

    def _accept(self, data: bytes) -> None:
        """Process a message. An invalid one is discarded, and the reason is kept for operators."""
        at_s, topic = self._clock(), "a message"
        try:
            received = self._decoder.decode(data)
            if received.op == "status":
                self._report_status(received)
            if received.op == "action_result" and received.action in self._results:
                topic = received.action
                self._results[topic](self._result_decoder.decode(data), at_s)
            if received.op != "publish":
                return
            topic = received.topic
            for subscription, decoder in self._subscriptions:
                if subscription.topic == topic:
                    subscription.accept(decoder.decode(received.msg), at_s)
        except (ValueError, msgspec.MsgspecError) as error:
            self.problem = f"{topic} was rejected: {error}"
            _log.debug("%s: %s", self.where, self.problem)

    def _report_status(self, received: _Received) -> None:
        text = msgspec.json.decode(received.msg, type=str)[:500]
        if received.level in {"error", "warning"}:
            self.problem = f"ROS reports: {text}"
            _log.warning("%s: %s", self.where, text)
