"""Confirmations of stored messages reach the senders of exactly these messages."""

import pytest

from device_agent.protocol import Stored, codec
from device_agent.protocol.acks import message_id
from device_agent.transports.mqtt import confirmations as module
from device_agent.transports.mqtt.confirmations import Confirmations

ACK, EVENT, LATE = (f"ts/v1/s/a/arm/{kind}" for kind in ("ack", "event", "late/joints"))
STORED = "ts/v1/s/a/arm/stored"


class Fixture:
    """Confirmations of a server, and the messages that were delivered."""

    def __init__(self) -> None:
        self.confirmations = Confirmations()
        self.confirmations.filter = "ts/v1/s/a/+/stored"
        self.delivered: list[str] = []

    def expect(self, topic: str, payload: bytes, name: str) -> bool:
        return self.confirmations.expect(topic, payload, lambda: self.delivered.append(name))

    def confirm(self, *messages: tuple[str, bytes], topic: str = STORED) -> bool:
        ids = tuple(message_id(*message) for message in messages)
        return self.confirmations.receive(topic, codec.encode(Stored(ids=ids)))


@pytest.fixture
def fixture() -> Fixture:
    return Fixture()


def test_each_confirmed_message_is_delivered_once(fixture: Fixture) -> None:
    for name, topic in (("ack", ACK), ("event", EVENT), ("late", LATE)):
        assert fixture.expect(topic, b"{}", name)
    assert fixture.confirm((LATE, b"{}"), (ACK, b"{}"), (ACK, b"{ }"))
    assert fixture.confirm((LATE, b"{}"))
    assert fixture.delivered == ["late", "ack"]


@pytest.mark.parametrize("kind", ["state", "desc", "tele/joints"])
def test_other_classes_are_not_confirmed(fixture: Fixture, kind: str) -> None:
    assert not fixture.expect(f"ts/v1/s/a/arm/{kind}", b"{}", kind)


def test_an_older_server_does_not_confirm(fixture: Fixture) -> None:
    fixture.confirmations.filter = ""
    assert not fixture.expect(ACK, b"{}", "ack")
    assert not fixture.confirm((ACK, b"{}"))


@pytest.mark.parametrize("topic", ["ts/v1/s/a/arm/cmd", "ts/v1/s/b/arm/stored", "ts/v1/s/a/arm/tele/stored"])
def test_other_messages_are_no_confirmations(fixture: Fixture, topic: str) -> None:
    fixture.expect(ACK, b"{}", "ack")
    assert not fixture.confirm((ACK, b"{}"), topic=topic)
    assert fixture.delivered == []


@pytest.mark.parametrize("payload", [b"", b"{", b"[]", b'{"ids":[]}', b'{"ids":["x"]}', b'{"ids":[1]}'])
def test_an_invalid_confirmation_is_ignored(fixture: Fixture, caplog: pytest.LogCaptureFixture, payload: bytes) -> None:
    fixture.expect(ACK, b"{}", "ack")
    assert fixture.confirmations.receive(STORED, payload)
    assert "invalid confirmation" in caplog.text
    assert fixture.confirm((ACK, b"{}"))
    assert fixture.delivered == ["ack"]


def test_the_number_of_waiting_messages_is_bounded(fixture: Fixture, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "MAX_UNCONFIRMED", 2)
    for number in range(3):
        fixture.expect(ACK, b"%d" % number, str(number))
    fixture.confirm(*((ACK, b"%d" % number) for number in range(3)))
    assert fixture.delivered == ["1", "2"]
