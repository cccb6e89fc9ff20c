"""The wire contract over XMPP: one message of ours is one ``<message>`` with one element of ours in it.

```
<message to='cloud@…/…' id='7'><m xmlns='urn:telescope:v1' topic='ts/v1/…'>{"…": …}</m>
  <request xmlns='urn:xmpp:receipts'/></message>
```

Topic and payload are those of MQTT, byte for byte. What wants to be confirmed (QoS 1) asks for a receipt (XEP-0184),
which is sent once the message is stored; an error in its place says why it was refused. Agents speak with the cloud and
with nobody else.
"""

import base64
import binascii
import re
from collections.abc import Iterable
from typing import NamedTuple
from xml.etree.ElementTree import Element, SubElement, tostring

from device_agent.protocol import codec
from device_agent.protocol.errors import ProtocolError

NAMESPACE = "urn:telescope:v1"
RECEIPTS = "urn:xmpp:receipts"
PING_S = 2.5
"""Both ends say something at least this often."""
DEAD_S = 7.0
"""From whom nothing came for so long is gone."""
PRIORITY = -1
"""Of everybody's presence: a message to somebody's other, wrong place is never better than none."""
MAX_STANZA_BYTES = 192 * 1024
"""The longest payload in base64, and room for what is around it."""
MAX_TOPIC = 400
MAX_WHY = 400
MAX_LISTEN = 64

_ELEMENT = f"{{{NAMESPACE}}}m"
_UNFIT = re.compile("[^\\t\\n -\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")
"""What XML cannot carry, or (a carriage return) changes on the way."""
_ID = re.compile(r"\A[A-Za-z0-9_.-]{1,64}\Z")


class Told(NamedTuple):
    """One message, as it came. ``id`` is empty where no receipt is wanted."""

    topic: str
    payload: bytes
    id: str = ""


class Refused(NamedTuple):
    """A message that came back. ``final``: whoever is there does not take it, now or later; else nobody was there."""

    id: str
    why: str
    final: bool


def message(
    to: str, topic: str, payload: bytes, *, receipt: str = "", body: str = "", listen: Iterable[str] = ()
) -> str:
    """One message as the text of its stanza.

    Args:
        to: The JID of whom it is for.
        topic: Of ``protocol.topics``.
        payload: Any bytes; those that XML cannot carry travel as base64.
        receipt: An id, where a receipt is wanted.
        body: What an ordinary client shows.
        listen: With an agent's greeting: topics of the space's other agents that it wants to hear.
    """
    stanza = Element("message", {"to": to})
    if receipt:
        stanza.set("id", receipt)
        SubElement(stanza, "request", {"xmlns": RECEIPTS})
    if body:
        SubElement(stanza, "body").text = "".join(letter for letter in body if not _UNFIT.match(letter))
    for wanted in listen:
        SubElement(stanza, "listen", {"xmlns": NAMESPACE, "topic": wanted})
    element = SubElement(stanza, "m", {"xmlns": NAMESPACE, "topic": topic})
    element.text = _plain(payload)
    if element.text is None:
        element.set("as", "base64")
        element.text = base64.b64encode(payload).decode()
    return tostring(stanza, encoding="unicode")


def receipt(to: str, message_id: str) -> str:
    """The confirmation of a message."""
    stanza = Element("message", {"to": to})
    SubElement(stanza, "received", {"xmlns": RECEIPTS, "id": message_id})
    return tostring(stanza, encoding="unicode")


def refusal(to: str, message_id: str, why: str) -> str:
    """The answer to a message that is not taken, and would not be at another time."""
    stanza = Element("message", {"to": to, "type": "error", "id": message_id})
    error = SubElement(stanza, "error", {"type": "modify"})
    SubElement(error, "not-acceptable", {"xmlns": "urn:ietf:params:xml:ns:xmpp-stanzas"})
    text = SubElement(error, "text", {"xmlns": "urn:ietf:params:xml:ns:xmpp-stanzas"})
    text.text = "".join(letter for letter in why[:MAX_WHY] if not _UNFIT.match(letter))
    return tostring(stanza, encoding="unicode")


def presence(*, to: str = "", available: bool = True) -> str:
    """Presence, to all who know us or to one."""
    stanza = Element("presence", ({"to": to} if to else {}) | ({} if available else {"type": "unavailable"}))
    if available:
        SubElement(stanza, "priority").text = str(PRIORITY)
    return tostring(stanza, encoding="unicode")


def forget(domain: str, user: str) -> str:
    """The cloud's word to the server that a user has no rights any more (``infra/prosody``)."""
    stanza = Element("message", {"to": domain})
    SubElement(stanza, "forget", {"xmlns": NAMESPACE, "user": user})
    return tostring(stanza, encoding="unicode")


def ping(domain: str) -> str:
    """A question to the server that it answers at once (XEP-0199)."""
    stanza = Element("iq", {"to": domain, "type": "get", "id": "ping"})
    SubElement(stanza, "ping", {"xmlns": "urn:xmpp:ping"})
    return tostring(stanza, encoding="unicode")


def read(stanza: Element) -> Told | None:
    """Our message in a ``<message>`` that arrived; ``None`` where there is none.

    Raises:
        ProtocolError: It is not as ``message`` makes it.
    """
    found = stanza.findall(_ELEMENT)
    if not found or stanza.get("type") == "error":
        return None
    (element, *others) = found
    topic, text = element.get("topic", ""), element.text or ""
    if others or len(element) or not 1 <= len(topic) <= MAX_TOPIC:
        raise ProtocolError(f"a message holds one element <m xmlns='{NAMESPACE}' topic='…'> with text alone in it")
    match element.get("as", "text"):
        case "text":
            payload = text.encode()
        case "base64":
            try:
                payload = base64.b64decode(text, validate=True)
            except (ValueError, binascii.Error) as error:
                raise ProtocolError("the payload is not base64") from error
        case other:
            raise ProtocolError(f"a payload is text or base64, not '{other[:20]}'")
    if len(payload) > codec.MAX_BYTES:
        raise ProtocolError(f"message of {len(payload)} bytes, {codec.MAX_BYTES} is the most")
    wanted = stanza.find(f"{{{RECEIPTS}}}request") is not None
    message_id = stanza.get("id", "") if wanted else ""
    if message_id and not _ID.match(message_id):
        raise ProtocolError("the id of a message that wants a receipt is letters, digits, _, . and -, 64 at most")
    return Told(topic, payload, message_id)


def listened(stanza: Element) -> tuple[str, ...]:
    """What somebody who greets wants to hear; what is more than ``MAX_LISTEN`` is left out."""
    wanted = (element.get("topic", "") for element in stanza.findall(f"{{{NAMESPACE}}}listen"))
    return tuple(topic for topic in wanted if len(topic) <= MAX_TOPIC)[:MAX_LISTEN]


def received(stanza: Element) -> str | None:
    """The id of the message that this one confirms."""
    found = stanza.find(f"{{{RECEIPTS}}}received")
    return None if found is None or stanza.get("type") == "error" else found.get("id", "")


def refused(stanza: Element) -> Refused | None:
    """What an error says about a message of ours; ``None`` where this is no error."""
    if stanza.get("type") != "error":
        return None
    tags = [element.tag for element in stanza.iter()]
    why = next((text.text for text in stanza.iter() if text.tag.endswith("}text") and text.text), None)
    final = any(tag.endswith("}not-acceptable") for tag in tags)
    return Refused(stanza.get("id", ""), (why or "nobody takes it there")[:MAX_WHY], final)


def user_at(jid: str, domain: str) -> tuple[str, str] | None:
    """User and resource of a JID of this domain; ``None`` for any other."""
    bare, _, resource = jid.partition("/")
    user, at, found = bare.partition("@")
    return (user, resource) if at and user and found == domain else None


def _plain(payload: bytes) -> str | None:
    """The payload as text, where XML carries it unchanged and no longer than base64 would be."""
    try:
        text = payload.decode()
    except UnicodeDecodeError:
        return None
    escapes = 4 * (text.count("&") + text.count("<") + text.count(">")) + 5 * text.count('"')
    if _UNFIT.search(text) or (escapes > len(payload) // 3 and len(payload) > MAX_STANZA_BYTES // 8):
        return None
    return text
