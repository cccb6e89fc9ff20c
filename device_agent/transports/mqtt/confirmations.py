"""Messages that wait until the cloud confirms their storage."""

import logging
import threading
from collections.abc import Callable

from device_agent.protocol import Stored, codec, topics
from device_agent.protocol.acks import message_id
from device_agent.protocol.errors import ProtocolError

MAX_UNCONFIRMED = 5000
"""Messages that wait. A confirmation of an older one is ignored, so the message is sent again."""
_log = logging.getLogger(__name__)


class Confirmations:
    """Calls the sender of each message that the cloud confirms. Any thread adds messages; one thread receives.

    Attributes:
        filter: Topics of the confirmations; empty: the server does not confirm.
    """

    def __init__(self) -> None:
        self.filter = ""
        self._lock = threading.Lock()
        self._waiting: dict[str, Callable[[], None]] = {}

    def expect(self, topic: str, payload: bytes, delivered: Callable[[], None]) -> bool:
        """Call ``delivered`` at the confirmation of a message; returns False if the cloud does not confirm it."""
        if not self.filter or topics.parse(topic).kind not in topics.CONFIRMED:
            return False
        number = message_id(topic, payload)
        with self._lock:
            while len(self._waiting) >= MAX_UNCONFIRMED:
                del self._waiting[next(iter(self._waiting))]
            self._waiting[number] = delivered
        return True

    def receive(self, topic: str, payload: bytes) -> bool:
        """Process a received message; returns False if it is not a confirmation."""
        if not topics.matches(self.filter, topic):
            return False
        try:
            stored = codec.decode(payload, Stored)
        except ProtocolError as error:
            _log.warning("an invalid confirmation on %s: %s", topic, str(error)[:300])
            return True
        with self._lock:
            confirmed = [self._waiting.pop(number) for number in stored.ids if number in self._waiting]
        for delivered in confirmed:
            delivered()
        return True
