import pytest
from hypothesis import given
from hypothesis import strategies as st

from device_agent.protocol import topics
from device_agent.protocol.errors import ProtocolError

LEVELS = ["ts", "v1", "a", "b", "$SYS", ""]
TOPICS = st.lists(st.sampled_from(LEVELS), min_size=1, max_size=5)
FILTERS = st.builds(
    lambda levels, last: [*levels, last],
    st.lists(st.sampled_from([*LEVELS, "+"]), max_size=4),
    st.sampled_from([*LEVELS, "+", "#"]),
)


def mqtt_match(pattern: list[str], topic: list[str]) -> bool:
    """MQTT 3.1.1 §4.7, as an independent recursive implementation."""
    if topic and topic[0].startswith("$") and pattern and pattern[0] in {"+", "#"}:
        return False

    def walk(pattern: list[str], levels: list[str]) -> bool:
        if not pattern:
            return not levels
        if pattern[0] == "#":
            return True
        return bool(levels) and pattern[0] in {"+", levels[0]} and walk(pattern[1:], levels[1:])

    return walk(pattern, topic)


@given(FILTERS, FILTERS, TOPICS)
def test_filters_match_as_in_mqtt_and_a_covered_filter_matches_no_more_than_its_cover(
    cover: list[str], covered: list[str], topic: list[str]
) -> None:
    assert topics.matches("/".join(cover), "/".join(topic)) == mqtt_match(cover, topic)
    if topics.matches("/".join(cover), "/".join(covered)) and mqtt_match(covered, topic):
        assert mqtt_match(cover, topic)


@pytest.mark.parametrize(
    "topic",
    [
        *("", "ts/v1", "/ts/v1/s/a/conn", "ts/v2/s/a/conn", "ts/v1/s/a/d/nothing", "ts/v1/s/a/d/tele"),
        *("ts/v1/s/a/d/state/x", "ts/v1/s/a/d/ctl/5/6", "ts/v1/s/+/d/state", "ts/v1/s//d/state"),
        *("ts/v1/s/a/d é/state", "ts/v1/s/a/d\n/state"),
    ],
)
def test_invalid_topics_are_rejected(topic: str) -> None:
    with pytest.raises(ProtocolError):
        topics.parse(topic)


def test_topics_are_parsed() -> None:
    assert topics.parse(topics.conn("s", "a")) == ("s", "a", "", "conn", "")
    assert topics.parse(topics.device("s", "a", "d", topics.CTL, "5")) == ("s", "a", "d", "ctl", "5")
    assert topics.parse(topics.device("s", "a", "d", topics.STOP, "account")) == ("s", "a", "d", "stop", "account")
    assert topics.parse(topics.device("s", "a", "d", topics.DESC)) == ("s", "a", "d", "desc", "")
