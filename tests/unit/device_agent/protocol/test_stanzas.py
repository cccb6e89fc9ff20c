"""Messages of the wire contract as XMPP stanzas: payloads stay unchanged, and hostile stanzas are rejected."""

from xml.etree.ElementTree import XML, tostring

import pytest
from hypothesis import given
from hypothesis import strategies as st

from device_agent.protocol import codec
from device_agent.protocol.errors import ProtocolError
from device_agent.protocol.xmpp import stanzas
from device_agent.protocol.xmpp.stanzas import Delivery

TOPIC = "ts/v1/lab/abc/arm/ack"
MESSAGE = "<m xmlns='urn:telescope:v1' topic='t'/>"


def forwarded(stanza: str) -> Delivery | None:
    """Parses the stanza after a server has read it and written it anew."""
    return stanzas.parse(XML(tostring(XML(stanza.encode()))))


@given(st.binary(max_size=300) | st.text(max_size=300).map(str.encode), st.text(max_size=50))
def test_any_payload_arrives_unchanged_in_valid_xml(payload: bytes, body: str) -> None:
    text = stanzas.message("a@b/c", TOPIC, payload, receipt="7", body=body)
    assert forwarded(text) == Delivery(TOPIC, payload, "7")
    assert not stanzas.UNFIT.search(text + stanzas.rejection("a@b/c", "7", body))


@pytest.mark.parametrize("fill", [b"&", b'"', b"x", b"\xff", "🤖".encode()])
def test_the_longest_message_fits_into_the_longest_stanza(fill: bytes) -> None:
    payload = (fill * codec.MAX_BYTES)[: codec.MAX_BYTES]
    text = stanzas.message("a" * 64 + "@" + "b" * 253 + "/c", "t" * stanzas.MAX_TOPIC, payload, receipt="7")
    assert len(text.encode()) <= stanzas.MAX_STANZA_BYTES
    delivery = forwarded(text)
    assert delivery is not None
    assert delivery.payload == payload


@pytest.mark.parametrize(
    "inside",
    [
        "<m xmlns='urn:telescope:v1'>{}</m>",
        "<m xmlns='urn:telescope:v1' topic=''>{}</m>",
        f"<m xmlns='urn:telescope:v1' topic='{'t' * 401}'>{{}}</m>",
        "<m xmlns='urn:telescope:v1' topic='t'>{}<x/></m>",
        MESSAGE + MESSAGE,
        "<m xmlns='urn:telescope:v1' topic='t' as='base64'>?</m>",
        "<m xmlns='urn:telescope:v1' topic='t' as='base64'>ä</m>",
        "<m xmlns='urn:telescope:v1' topic='t' as='zip'>aaaa</m>",
        f"<m xmlns='urn:telescope:v1' topic='t'>{'x' * (codec.MAX_BYTES + 1)}</m>",
    ],
)
def test_invalid_messages_are_rejected(inside: str) -> None:
    with pytest.raises(ProtocolError):
        stanzas.parse(XML(f"<message>{inside}</message>"))


def test_an_id_with_markup_is_rejected() -> None:
    with pytest.raises(ProtocolError, match="id"):
        stanzas.parse(XML(f"<message id=\"'/&gt;\">{MESSAGE}<request xmlns='urn:xmpp:receipts'/></message>"))


def test_chat_messages_and_bounced_messages_are_ignored() -> None:
    assert stanzas.parse(XML("<message><body>hello</body></message>")) is None
    assert stanzas.parse(XML(f"<message type='error'>{MESSAGE}</message>")) is None


def test_receipts_and_rejections_name_their_message() -> None:
    receipt, rejection = (XML(stanzas.receipt("a@b/c", "7")), XML(stanzas.rejection("a@b/c", "8", "not a topic")))
    assert (stanzas.receipt_id(receipt), stanzas.receipt_id(rejection)) == ("7", None)
    assert stanzas.parse_rejection(rejection) == ("8", "not a topic", True)
    assert stanzas.parse_rejection(receipt) is None
    bounced = "<message type='error' id='9'><error type='cancel'><service-unavailable/></error></message>"
    assert stanzas.parse_rejection(XML(bounced)) == ("9", "no recipient is available", False)


@pytest.mark.parametrize("jid", ["x@other/r", "lab", "@lab", "x@lab.org/r", "lab/x@lab", ""])
def test_users_are_recognized_by_their_server(jid: str) -> None:
    assert stanzas.user_at(jid, "lab") is None
    assert stanzas.user_at("abc@lab/x@y/z", "lab") == ("abc", "x@y/z")


def test_requested_topics_are_limited_in_number_and_length() -> None:
    topics = [f"ts/v1/lab/a/b/tele/{number}" for number in range(stanzas.MAX_LISTEN + 1)]
    stanza = XML(stanzas.message("a@b/c", TOPIC, b"{}", receipt="1", listen=["x" * 401, *topics]))
    assert stanzas.requested_topics(stanza) == tuple(topics[: stanzas.MAX_LISTEN])
    assert stanzas.parse(stanza) == Delivery(TOPIC, b"{}", "1")
