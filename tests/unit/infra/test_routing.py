import pytest

from infra.embedded_broker.routing import Kept, Retained, Subscriptions, valid_filter, valid_topic


def test_hearers_are_those_whose_filters_cover_the_topic_once_with_their_highest_qos() -> None:
    table: Subscriptions[str] = Subscriptions()
    table.add("a", "ts/v1/+", 0)
    table.add("a", "ts/v1/x", 1)
    table.add("b", "ts/#", 0)
    table.add("c", "ts/v1/y", 1)
    assert dict(table.hearers("ts/v1/x")) == {"a": 1, "b": 0}


def test_hearers_follow_every_change() -> None:
    table: Subscriptions[str] = Subscriptions()
    assert table.hearers("t") == ()
    table.add("a", "t", 0)
    assert table.hearers("t") == (("a", 0),)
    table.add("a", "t", 1)
    assert table.hearers("t") == (("a", 1),)
    table.remove("a", "t")
    table.remove("a", "t")
    assert table.hearers("t") == ()


def test_a_wildcard_does_not_cover_the_brokers_own_topics() -> None:
    table: Subscriptions[str] = Subscriptions()
    table.add("a", "#", 0)
    assert table.hearers("$SYS/x") == ()


@pytest.mark.parametrize("pattern", ["", "a#", "#/a", "a/#/b", "a+", "+a/b", "a/b+/c", "a\0", "ü" * 300])
def test_what_is_no_filter_is_refused(pattern: str) -> None:
    assert not valid_filter(pattern, 512)


@pytest.mark.parametrize("topic", ["", "a/+", "#", "a\0b", "$SYS/x", "$", "ü" * 300])
def test_what_is_no_topic_is_refused(topic: str) -> None:
    assert not valid_topic(topic, 512)


def kept(payload: bytes, owner: str = "a") -> Kept:
    return Kept(payload, 1, owner)


def test_the_newest_message_of_a_topic_is_kept_until_an_empty_one_comes() -> None:
    store = Retained(per_client=10, total_bytes=100)
    store.keep("t", kept(b"1"))
    store.keep("t", kept(b"2"))
    assert list(store.matching("t")) == [("t", kept(b"2"))]
    store.keep("t", kept(b""))
    assert list(store.matching("#")) == []
    assert store.keep("never kept", kept(b""))


def test_one_client_cannot_keep_more_topics_than_its_share() -> None:
    store = Retained(per_client=2, total_bytes=100)
    assert all(store.keep(topic, kept(b"x")) for topic in "ab")
    assert not store.keep("c", kept(b"x"))
    assert store.keep("b", kept(b"again"))
    assert store.keep("c", kept(b"x", "other"))
    store.keep("a", kept(b""))
    assert store.keep("d", kept(b"x"))


def test_all_together_cannot_keep_more_than_the_bytes_there_are() -> None:
    store = Retained(per_client=10, total_bytes=10)
    assert store.keep("a", kept(bytes(10)))
    assert not store.keep("b", kept(b"x"))
    assert not store.keep("a", kept(bytes(11)))
    assert store.keep("a", kept(bytes(9)))
    assert store.keep("b", kept(b"x"))
    store.keep("a", kept(b""))
    assert store.keep("c", kept(bytes(9)))
