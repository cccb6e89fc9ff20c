"""Topics: ``ts/v1/{space}/{agent}/{device}/{class}[/{name}]``, and ``ts/v1/{space}/{agent}/conn`` for presence.

Seven levels at most and no leading slash, so that every broker of DESIGN §4 takes them.
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

CLASSES = frozenset({DESC, STATE, TELE, LATE, CAM, EVENT, CMD, ACK, CTL, STOP})
MEASURED = frozenset({TELE, LATE})
"""What carries measurements: as they are made, and what could not be sent then. Only the first is live."""
_NAME_REQUIRED = frozenset({TELE, LATE, CAM, CTL})
_NAME_ALLOWED = _NAME_REQUIRED | {DESC}
ANY = "+"

JOINTS = "joints"
"""Name under ``tele`` of the stream of all joints (``JointTelemetry``); all others carry ``Measurements``."""
TWIN = "twin"
"""Name under ``desc`` of the retained drawing of the device (``Twin``)."""


class Topic(NamedTuple):
    """One parsed topic. ``device`` is empty for an agent's presence, ``name`` where the class has none."""

    space: str
    agent: str
    device: str
    kind: str
    name: str = ""


def is_id(text: str) -> bool:
    """Whether ``text`` may stand as an id in a topic, a URL and a table key."""
    return _ID.match(text) is not None


def conn(space: str, agent: str) -> str:
    """The retained presence topic of an agent."""
    return f"{ROOT}/{space}/{agent}/{CONN}"


def device(space: str, agent: str, name: str, kind: str, stream: str = "") -> str:
    """A topic of one device.

    Args:
        space: Id of the space, or ``+`` in a filter.
        agent: Id of the agent, or ``+`` in a filter.
        name: The device's name at its agent, or ``+`` in a filter.
        kind: One of ``CLASSES``.
        stream: The last level, for classes that have one: a stream, a camera, the epoch of a lease.
    """
    base = f"{ROOT}/{space}/{agent}/{name}/{kind}"
    return f"{base}/{stream}" if stream else base


@lru_cache(maxsize=1024)
def parse(topic: str) -> Topic:
    """Read a topic that arrived. The same few arrive again and again.

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
    raise ProtocolError(f"'{topic[:200]}' is not a topic of {ROOT}")


def matches(pattern: str, topic: str) -> bool:
    """Whether an MQTT filter covers a topic or another filter: never lets a filter reach further than ``pattern``.

    ``+`` in ``topic`` is covered only by ``+`` or ``#`` in ``pattern``; ``#`` only by ``#``. As MQTT says (4.7.2), a
    wildcard at the first level does not cover topics that start with ``$``.
    """
    wanted, given = pattern.split("/"), topic.split("/")
    if given[0].startswith("$") and wanted[0] in (ANY, "#"):
        return False
    for index, level in enumerate(wanted):
        if level == "#":
            return True
        if index >= len(given):
            return False
        if given[index] == "#" or (level != ANY and level != given[index]):
            return False
    return len(wanted) == len(given)
