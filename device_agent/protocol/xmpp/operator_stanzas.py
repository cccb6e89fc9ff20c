"""Stanzas of operators over XMPP. An operator exchanges ``<message>`` stanzas with the cloud only.

```
<message to='cloud@…/…' id='1'><sign-in xmlns='urn:telescope:v1' token='…'/></message>
<message to='cloud@…/…' id='2'><call xmlns='urn:telescope:v1' method='GET' path='/api/v1/devices'/></message>
<message to='cloud@…/…' id='3'><listen xmlns='urn:telescope:v1'><topic>ts/v1/…</topic></listen></message>
<message from='cloud@…/…' id='2'><answer xmlns='urn:telescope:v1' status='200'>{"…": …}</answer></message>
```

Each of them gets one answer with its id. A call is a request of the HTTP API; body and answer are JSON. Messages of
the topics that an operator listens to, and setpoints, have the format of ``stanzas.message``.
"""

import json
from collections.abc import Iterable
from typing import NamedTuple
from xml.etree.ElementTree import Element, SubElement, tostring

from device_agent.protocol.errors import ProtocolError
from device_agent.protocol.xmpp.stanzas import MAX_LISTEN, MAX_TOPIC, NAMESPACE, UNFIT, is_message_id

METHODS = frozenset({"GET", "POST", "PUT", "DELETE"})
MAX_PATH = 2000
MAX_ANSWER_BYTES = 128 * 1024
"""Longest answer of a call [bytes]; with its XML escapes it fits into a stanza."""


class SignIn(NamedTuple):
    """Starts the session of an operator, or renews its access token."""

    id: str
    token: str


class Call(NamedTuple):
    """One request of the HTTP API; ``path`` contains the query."""

    id: str
    method: str
    path: str
    body: bytes


class Listen(NamedTuple):
    """All topics that the operator wants to receive; it replaces the earlier ones."""

    id: str
    topics: tuple[str, ...]


class Answer(NamedTuple):
    """The answer to a request: status code of HTTP, and JSON or nothing."""

    id: str
    status: int
    body: bytes


def sign_in(to: str, request_id: str, token: str) -> str:
    """A sign-in with an access token or API key of the HTTP API."""
    return _stanza(to, request_id, "sign-in", {"token": token})


def call(to: str, request_id: str, method: str, path: str, body: str = "") -> str:
    """A call of the HTTP API with a JSON body."""
    return _stanza(to, request_id, "call", {"method": method, "path": path}, body)


def listen(to: str, request_id: str, topics: Iterable[str]) -> str:
    """A request for all messages of these topics."""
    stanza = Element("message", {"to": to, "id": request_id})
    element = SubElement(stanza, "listen", {"xmlns": NAMESPACE})
    for topic in topics:
        SubElement(element, "topic").text = topic
    return tostring(stanza, encoding="unicode")


def answer(to: str, request_id: str, status: int, body: str = "") -> str:
    """The answer to a request."""
    return _stanza(to, request_id, "answer", {"status": str(status)}, UNFIT.sub("", body))


def problem(to: str, request_id: str, status: int, detail: str) -> str:
    """An answer that rejects a request."""
    return answer(to, request_id, status, json.dumps({"status": status, "detail": detail}, ensure_ascii=False))


def parse_request(stanza: Element) -> SignIn | Call | Listen | None:
    """The operator's request in a ``<message>`` stanza, or ``None`` if it contains none.

    Raises:
        ProtocolError: The stanza violates the format.
    """
    found = [each for each in stanza if each.tag in _PARSERS]
    if not found or stanza.get("type") == "error":
        return None
    request_id = stanza.get("id", "")
    if len(found) > 1 or not is_message_id(request_id):
        raise ProtocolError("a request needs one element, and an id of 1 to 64 letters, digits, _, . and -")
    return _PARSERS[found[0].tag](request_id, found[0])


def parse_answer(stanza: Element) -> Answer | None:
    """The answer in a ``<message>`` stanza, or ``None`` if it contains none."""
    element = stanza.find(f"{{{NAMESPACE}}}answer")
    if element is None:
        return None
    return Answer(stanza.get("id", ""), int(element.get("status", "0")), (element.text or "").encode())


def _stanza(to: str, request_id: str, name: str, attributes: dict[str, str], text: str = "") -> str:
    stanza = Element("message", {"to": to, "id": request_id})
    SubElement(stanza, name, {"xmlns": NAMESPACE, **attributes}).text = text or None
    return tostring(stanza, encoding="unicode")


def _sign_in(request_id: str, element: Element) -> SignIn:
    return SignIn(request_id, element.get("token", ""))


def _call(request_id: str, element: Element) -> Call:
    method, path = element.get("method", ""), element.get("path", "")
    if method not in METHODS or not 1 <= len(path) <= MAX_PATH or not path.startswith("/"):
        raise ProtocolError(f"a call needs a method ({', '.join(sorted(METHODS))}) and a path of the HTTP API")
    return Call(request_id, method, path, (element.text or "").encode())


def _listen(request_id: str, element: Element) -> Listen:
    topics = tuple((each.text or "").strip() for each in element.findall(f"{{{NAMESPACE}}}topic"))
    if len(topics) > MAX_LISTEN or not all(1 <= len(topic) <= MAX_TOPIC for topic in topics):
        raise ProtocolError(f"an operator listens to at most {MAX_LISTEN} topics of 1 to {MAX_TOPIC} characters")
    return Listen(request_id, topics)


_PARSERS = {
    f"{{{NAMESPACE}}}{name}": parser for name, parser in (("sign-in", _sign_in), ("call", _call), ("listen", _listen))
}
