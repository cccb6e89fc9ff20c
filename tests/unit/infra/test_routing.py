import pytest

from infra.embedded_broker.routing import RetainedMessage, RetainedMessages, Subscriptions, valid_filter, valid_topic


def test_subscribers_are_returned_once_with_their_highest_qos() -> None:
    table: Subscriptions[str] = Subscriptions()
    for client, pattern, qos in (("a", "ts/v1/+", 0), ("a", "ts/v1/x", 1), ("b", "ts/#", 0), ("c", "ts/v1/y", 1)):
        table.add(client, pattern, qos)
    assert dict(table.subscribers("ts/v1/x")) == {"a": 1, "b": 0}
    table.remove("a", "ts/v1/x")
    table.remove("a", "ts/v1/x")
    assert dict(table.subscribers("ts/v1/x")) == {"a": 0, "b": 0}
    table.add("a", "#", 0)
    assert table.subscribers("$SYS/x") == ()


@pytest.mark.parametrize("pattern", ["", "a#", "#/a", "a/#/b", "a+", "+a/b", "a/b+/c", "a\0", "ü" * 300])
def test_invalid_filters_are_rejected(pattern: str) -> None:
    assert not valid_filter(pattern, 512)


@pytest.mark.parametrize("topic", ["", "a/+", "#", "a\0b", "$SYS/x", "$", "ü" * 300])
def test_invalid_topics_are_rejected(topic: str) -> None:
    assert not valid_topic(topic, 512)


def message(payload: bytes, owner: str = "a") -> RetainedMessage:
    return RetainedMessage(payload, 1, owner)


def test_the_newest_retained_message_remains_until_an_empty_one() -> None:
    retained = RetainedMessages(per_client=10, total_bytes=100)
    retained.store("t", message(b"1"))
    retained.store("t", message(b"2"))
    assert list(retained.matching("t")) == [("t", message(b"2"))]
    retained.store("t", message(b""))
    assert list(retained.matching("#")) == []
    assert retained.store("unknown", message(b""))


def test_retained_topics_are_limited_per_client() -> None:
    retained = RetainedMessages(per_client=2, total_bytes=100)
    assert all(retained.store(topic, message(b"x")) for topic in "ab")
    assert not retained.store("c", message(b"x"))
    assert retained.store("b", message(b"again"))
    assert retained.store("c", message(b"x", "other"))
    retained.store("a", message(b""))
    assert retained.store("d", message(b"x"))


def test_retained_bytes_are_limited_in_total() -> None:
    retained = RetainedMessages(per_client=10, total_bytes=10)
    assert retained.store("a", message(bytes(10)))
    assert not retained.store("b", message(b"x"))
    assert not retained.store("a", message(bytes(11)))
    assert retained.store("a", message(bytes(9)))
    assert retained.store("b", message(b"x"))
    retained.store("a", message(b""))
    assert retained.store("c", message(bytes(9)))
