"""The wire contract over XMPP: each message is one ``<message>`` with one element.

```
<message to='cloud@…/…' id='7'><m xmlns='urn:telescope:v1' topic='ts/v1/…'>{"…": …}</m>
  <request xmlns='urn:xmpp:receipts'/></message>
```

Topic and payload equal those of MQTT, byte for byte. A message with QoS 1 requests a receipt (XEP-0184), which is sent
once the message is stored; an error instead of the receipt contains the reason. Agents exchange messages with the cloud
only.
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
PING_INTERVAL_S = 2.5
"""Maximum interval between stanzas of either end [s]."""
TIMEOUT_S = 7.0
"""A peer without traffic for this long counts as disconnected [s]."""
PRIORITY = -1
"""Priority of all presences: a negative value keeps the server from rerouting messages to another resource."""
MAX_STANZA_BYTES = 192 * 1024
"""The largest payload in base64, and its envelope [bytes]."""
MAX_TOPIC = 400
MAX_REASON = 400
MAX_LISTEN = 64

_ELEMENT = f"{{{NAMESPACE}}}m"
UNFIT = re.compile("[^\\t\\n -\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")
"""Characters that XML cannot represent, or normalizes (carriage return)."""
_ID = re.compile(r"\A[A-Za-z0-9_.-]{1,64}\Z")


class Delivery(NamedTuple):
    """One received message. ``id`` is empty if no receipt is requested."""

    topic: str
    payload: bytes
    id: str = ""


class Rejection(NamedTuple):
    """A returned message. ``final``: the recipient rejects it permanently; otherwise no recipient was available."""

    id: str
    reason: str
    final: bool


def message(
    to: str, topic: str, payload: bytes, *, receipt: str = "", body: str = "", listen: Iterable[str] = ()
) -> str:
    """One message as stanza text.

    Args:
        to: JID of the recipient.
        topic: Topic of ``protocol.topics``.
        payload: Any bytes; bytes that XML cannot represent are encoded as base64.
        receipt: Message id if a receipt is requested.
        body: Text that an ordinary XMPP client shows.
        listen: Topics of other agents of the space that the agent subscribes to; sent with its presence.
    """
    stanza = Element("message", {"to": to})
    if receipt:
        stanza.set("id", receipt)
        SubElement(stanza, "request", {"xmlns": RECEIPTS})
    if body:
        SubElement(stanza, "body").text = UNFIT.sub("", body)
    for pattern in listen:
        SubElement(stanza, "listen", {"xmlns": NAMESPACE, "topic": pattern})
    element = SubElement(stanza, "m", {"xmlns": NAMESPACE, "topic": topic})
    element.text = _plain(payload)
    if element.text is None:
        element.set("as", "base64")
        element.text = base64.b64encode(payload).decode()
    return tostring(stanza, encoding="unicode")


def receipt(to: str, message_id: str) -> str:
    """The receipt of a message."""
    stanza = Element("message", {"to": to})
    SubElement(stanza, "received", {"xmlns": RECEIPTS, "id": message_id})
    return tostring(stanza, encoding="unicode")


def rejection(to: str, message_id: str, reason: str) -> str:
    """The final rejection of a message."""
    stanza = Element("message", {"to": to, "type": "error", "id": message_id})
    error = SubElement(stanza, "error", {"type": "modify"})
    SubElement(error, "not-acceptable", {"xmlns": "urn:ietf:params:xml:ns:xmpp-stanzas"})
    text = SubElement(error, "text", {"xmlns": "urn:ietf:params:xml:ns:xmpp-stanzas"})
    text.text = UNFIT.sub("", reason[:MAX_REASON])
    return tostring(stanza, encoding="unicode")


def presence(*, to: str = "", available: bool = True) -> str:
    """Presence, to all contacts or to one JID."""
    stanza = Element("presence", ({"to": to} if to else {}) | ({} if available else {"type": "unavailable"}))
    if available:
        SubElement(stanza, "priority").text = str(PRIORITY)
    return tostring(stanza, encoding="unicode")


def revoke_user(domain: str, user: str) -> str:
    """Revokes all rights of a user at the server (``infra/prosody``)."""
    stanza = Element("message", {"to": domain})
    SubElement(stanza, "forget", {"xmlns": NAMESPACE, "user": user})
    return tostring(stanza, encoding="unicode")


def ping(domain: str) -> str:
    """A ping to the server (XEP-0199)."""
    stanza = Element("iq", {"to": domain, "type": "get", "id": "ping"})
    SubElement(stanza, "ping", {"xmlns": "urn:xmpp:ping"})
    return tostring(stanza, encoding="unicode")


def parse(stanza: Element) -> Delivery | None:
    """The message in a ``<message>`` stanza, or ``None`` if it contains none.

    Raises:
        ProtocolError: The stanza violates the format of ``message``.
    """
    elements = stanza.findall(_ELEMENT)
    if not elements or stanza.get("type") == "error":
        return None
    (element, *others) = elements
    topic, text = element.get("topic", ""), element.text or ""
    if others or len(element) or not 1 <= len(topic) <= MAX_TOPIC:
        raise ProtocolError(
            f"a message must contain exactly one element <m xmlns='{NAMESPACE}' topic='…'> with text only"
        )
    match element.get("as", "text"):
        case "text":
            payload = text.encode()
        case "base64":
            try:
                payload = base64.b64decode(text, validate=True)
            except (ValueError, binascii.Error) as error:
                raise ProtocolError("the payload is not base64") from error
        case other:
            raise ProtocolError(f"the encoding must be text or base64, not '{other[:20]}'")
    if len(payload) > codec.MAX_BYTES:
        raise ProtocolError(f"the payload has {len(payload)} bytes; the limit is {codec.MAX_BYTES}")
    wants_receipt = stanza.find(f"{{{RECEIPTS}}}request") is not None
    message_id = stanza.get("id", "") if wants_receipt else ""
    if message_id and not is_message_id(message_id):
        raise ProtocolError("a message id has 1 to 64 letters, digits, _, . and -")
    return Delivery(topic, payload, message_id)


def is_message_id(text: str) -> bool:
    """Whether a text is valid as id of a message that gets a receipt or an answer."""
    return _ID.match(text) is not None


def requested_topics(stanza: Element) -> tuple[str, ...]:
    """Topics that the sender subscribes to; more than ``MAX_LISTEN`` are ignored."""
    requested = (element.get("topic", "") for element in stanza.findall(f"{{{NAMESPACE}}}listen"))
    return tuple(topic for topic in requested if len(topic) <= MAX_TOPIC)[:MAX_LISTEN]


def receipt_id(stanza: Element) -> str | None:
    """Id of the message that this receipt confirms, or ``None``."""
    element = stanza.find(f"{{{RECEIPTS}}}received")
    return None if element is None or stanza.get("type") == "error" else element.get("id", "")


def parse_rejection(stanza: Element) -> Rejection | None:
    """The rejection in an error stanza, or ``None`` if the stanza is not an error."""
    if stanza.get("type") != "error":
        return None
    tags = [element.tag for element in stanza.iter()]
    reason = next((text.text for text in stanza.iter() if text.tag.endswith("}text") and text.text), None)
    final = any(tag.endswith("}not-acceptable") for tag in tags)
    return Rejection(stanza.get("id", ""), (reason or "no recipient is available")[:MAX_REASON], final)


def user_at(jid: str, domain: str) -> tuple[str, str] | None:
    """User and resource of a JID of this domain; ``None`` for other domains."""
    bare, _, resource = jid.partition("/")
    user, _, host = bare.partition("@")
    return (user, resource) if user and host == domain else None


def _plain(payload: bytes) -> str | None:
    """The payload as text, or ``None`` if XML would change it or base64 would be shorter."""
    try:
        text = payload.decode()
    except UnicodeDecodeError:
        return None
    escapes = 4 * (text.count("&") + text.count("<") + text.count(">")) + 5 * text.count('"')
    if UNFIT.search(text) or (escapes > len(payload) // 3 and len(payload) > MAX_STANZA_BYTES // 8):
        return None
    return text
