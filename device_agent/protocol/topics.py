"""Topics: ``ts/v1/{space}/{agent}/{device}/{class}[/{name}]``, and ``ts/v1/{space}/{agent}/conn`` for presence.

At most seven levels and no leading slash, so that every supported broker accepts them.
"""

import re
from functools import lru_cache
from typing import NamedTuple

from device_agent.protocol.errors import ProtocolError

ROOT = "ts/v1"
ID_PATTERN = r"[A-Za-z0-9_-]{1,64}"
_ID = re.compile(rf"\A{ID_PATTERN}\Z")

CONN = "conn"
DESC = "desc"
STATE = "state"
TELE = "tele"
LATE = "late"
CAM = "cam"
EVENT = "event"
CMD = "cmd"
ACK = "ack"
CTL = "ctl"
STOP = "stop"
STORED = "stored"

CLASSES = frozenset({DESC, STATE, TELE, LATE, CAM, EVENT, CMD, ACK, CTL, STOP, STORED})
CONFIRMED = frozenset({ACK, EVENT, LATE})
"""Classes whose messages the cloud confirms under ``STORED``. An agent repeats them until then."""
MEASURED = frozenset({TELE, LATE})
"""Classes that carry measurements: live, and delayed by a disconnection."""
_NAME_REQUIRED = frozenset({TELE, LATE, CAM, CTL})
_NAME_ALLOWED = _NAME_REQUIRED | {DESC, STOP}
RETAINED = frozenset({CONN, DESC, STATE})
"""Classes that brokers retain. A retained message of any other class is rejected."""
_CLASS_LEVEL = 5
ANY = "+"

JOINTS = "joints"
"""Name of the joint stream under ``tele`` (``JointTelemetry``); all other streams carry ``Measurements``."""
TWIN = "twin"
"""Name of the retained device model under ``desc`` (``Twin``)."""


class Topic(NamedTuple):
    """One parsed topic. ``device`` is empty for an agent's presence; ``name`` is empty if the class has none."""

    space: str
    agent: str
    device: str
    kind: str
    name: str = ""


def is_id(text: str) -> bool:
    """Whether ``text`` is a valid id in topics, URLs and table keys."""
    return _ID.match(text) is not None


def conn(space: str, agent: str) -> str:
    """The retained presence topic of an agent."""
    return f"{ROOT}/{space}/{agent}/{CONN}"


def device(space: str, agent: str, name: str, kind: str, stream: str = "") -> str:
    """A topic of one device.

    Args:
        space: Id of the space, or ``+`` in a filter.
        agent: Id of the agent, or ``+`` in a filter.
        name: Name of the device at its agent, or ``+`` in a filter.
        kind: One of ``CLASSES``.
        stream: Last level, for classes that have one: a stream, a camera, the epoch of a lease, or the account that
            stops the device.
    """
    base = f"{ROOT}/{space}/{agent}/{name}/{kind}"
    return f"{base}/{stream}" if stream else base


@lru_cache(maxsize=1024)
def parse(topic: str) -> Topic:
    """Parse a received topic. Cached, because the same topics repeat.

    Raises:
        ProtocolError: The text is not a topic of this contract.
    """
    levels = topic.split("/")
    if topic.startswith(f"{ROOT}/") and all(is_id(level) for level in levels):
        match levels[2:]:
            case [space, agent, "conn"]:
                return Topic(space, agent, "", CONN)
            case [space, agent, name, kind] if kind in CLASSES - _NAME_REQUIRED:
                return Topic(space, agent, name, kind)
            case [space, agent, name, kind, stream] if kind in _NAME_ALLOWED:
                return Topic(space, agent, name, kind, stream)
    raise ProtocolError(f"{topic[:200]!r} is not a topic of {ROOT}")


def may_retain(pattern: str) -> bool:
    """Whether a retained message is allowed on a topic, or on the topics of a filter; topics outside ``ROOT`` too."""
    levels = pattern.split("/")
    kind = levels[_CLASS_LEVEL] if len(levels) > _CLASS_LEVEL else levels[-1]
    return not pattern.startswith(f"{ROOT}/") or kind in RETAINED


def matches(pattern: str, topic: str) -> bool:
    """Whether an MQTT filter covers a topic, or the whole of another filter.

    Only ``+`` or ``#`` in ``pattern`` covers ``+`` in ``topic``; only ``#`` covers ``#``. A wildcard at the first level
    does not cover topics that start with ``$`` (MQTT 4.7.2).
    """
    filter_levels, levels = pattern.split("/"), topic.split("/")
    if levels[0].startswith("$") and filter_levels[0] in (ANY, "#"):
        return False
    for index, level in enumerate(filter_levels):
        if level == "#":
            return True
        if index >= len(levels):
            return False
        if levels[index] == "#" or (level != ANY and level != levels[index]):
            return False
    return len(filter_levels) == len(levels)
