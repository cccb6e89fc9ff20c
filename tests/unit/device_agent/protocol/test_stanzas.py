"""Messages of the wire contract as XMPP stanzas: nothing changes on the way, and nothing hostile gets through."""

from xml.etree.ElementTree import XML, tostring

import pytest
from hypothesis import given
from hypothesis import strategies as st

from device_agent.protocol import codec
from device_agent.protocol.errors import ProtocolError
from device_agent.protocol.xmpp import stanzas
from device_agent.protocol.xmpp.stanzas import Delivery

TOPIC = "ts/v1/lab/abc/arm/ack"
PAYLOADS = st.binary(max_size=300) | st.text(max_size=300).map(str.encode)


def across(stanza: str) -> stanzas.Delivery | None:
    """As a server passes it on: read, and written anew."""
    return stanzas.parse(XML(tostring(XML(stanza.encode()))))


@given(PAYLOADS)
def test_a_payload_arrives_byte_for_byte(payload: bytes) -> None:
    assert across(stanzas.message("a@b/c", TOPIC, payload, receipt="7")) == Delivery(TOPIC, payload, "7")


@given(PAYLOADS, st.text(max_size=50))
def test_no_carriage_return_and_nothing_that_xml_forbids_is_ever_written(payload: bytes, body: str) -> None:
    text = stanzas.message("a@b/c", TOPIC, payload, body=body) + stanzas.rejection("a@b/c", "7", body)
    assert not stanzas._UNFIT.search(text)


@pytest.mark.parametrize("fill", [b"&", b'"', b"x", b"\xff", "🤖".encode()])
def test_the_longest_message_fits_into_the_longest_stanza(fill: bytes) -> None:
    payload = (fill * codec.MAX_BYTES)[: codec.MAX_BYTES]
    text = stanzas.message("a" * 64 + "@" + "b" * 253 + "/c", "t" * stanzas.MAX_TOPIC, payload, receipt="7")
    assert len(text.encode()) <= stanzas.MAX_STANZA_BYTES
    told = across(text)
    assert told is not None
    assert told.payload == payload


@pytest.mark.parametrize(
    "inside",
    [
        "<m xmlns='urn:telescope:v1'>{}</m>",
        "<m xmlns='urn:telescope:v1' topic=''>{}</m>",
        f"<m xmlns='urn:telescope:v1' topic='{'t' * 401}'>{{}}</m>",
        "<m xmlns='urn:telescope:v1' topic='t'>{}<x/></m>",
        "<m xmlns='urn:telescope:v1' topic='t'/><m xmlns='urn:telescope:v1' topic='t'/>",
        "<m xmlns='urn:telescope:v1' topic='t' as='base64'>?</m>",
        "<m xmlns='urn:telescope:v1' topic='t' as='base64'>ä</m>",
        "<m xmlns='urn:telescope:v1' topic='t' as='zip'>aaaa</m>",
        f"<m xmlns='urn:telescope:v1' topic='t'>{'x' * (codec.MAX_BYTES + 1)}</m>",
    ],
)
def test_what_is_not_as_we_write_it_is_refused(inside: str) -> None:
    with pytest.raises(ProtocolError):
        stanzas.parse(XML(f"<message>{inside}</message>"))


def test_an_id_that_could_be_an_attack_is_refused() -> None:
    inside = "<m xmlns='urn:telescope:v1' topic='t'/><request xmlns='urn:xmpp:receipts'/>"
    with pytest.raises(ProtocolError, match="id"):
        stanzas.parse(XML(f'<message id="\'/&gt;">{inside}</message>'))


def test_an_ordinary_message_and_one_that_came_back_are_none_of_ours() -> None:
    assert stanzas.parse(XML("<message><body>hello</body></message>")) is None
    assert stanzas.parse(XML("<message type='error'><m xmlns='urn:telescope:v1' topic='t'/></message>")) is None


def test_a_receipt_and_a_refusal_name_their_message() -> None:
    assert stanzas.receipt_id(XML(stanzas.receipt("a@b/c", "7"))) == "7"
    assert stanzas.parse_rejection(XML(stanzas.rejection("a@b/c", "8", "not a topic"))) == ("8", "not a topic", True)
    bounced = "<message type='error' id='9'><error type='cancel'><service-unavailable/></error></message>"
    assert stanzas.parse_rejection(XML(bounced)) == ("9", "no recipient is available", False)
    assert stanzas.parse_rejection(XML(stanzas.receipt("a@b/c", "7"))) is None
    assert stanzas.receipt_id(XML(stanzas.rejection("a@b/c", "8", ""))) is None


@pytest.mark.parametrize("jid", ["x@other/r", "lab", "@lab", "x@lab.org/r", "lab/x@lab", ""])
def test_foreign_addresses_are_ignored(jid: str) -> None:
    assert stanzas.user_at(jid, "lab") is None


def test_an_address_of_this_server_is_taken_apart() -> None:
    assert stanzas.user_at("abc@lab/x@y/z", "lab") == ("abc", "x@y/z")


def test_a_greeting_says_what_it_wants_to_hear_and_no_more_than_is_heard_to() -> None:
    wanted = [f"ts/v1/lab/a/b/tele/{number}" for number in range(stanzas.MAX_LISTEN + 1)]
    stanza = XML(stanzas.message("a@b/c", TOPIC, b"{}", receipt="1", listen=["x" * 401, *wanted]))
    assert stanzas.requested_topics(stanza) == tuple(wanted[: stanzas.MAX_LISTEN])
    assert stanzas.parse(stanza) == Delivery(TOPIC, b"{}", "1")
