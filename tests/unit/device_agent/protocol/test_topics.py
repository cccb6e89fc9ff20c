import pytest
from hypothesis import given
from hypothesis import strategies as st

from device_agent.protocol import topics
from device_agent.protocol.errors import ProtocolError

LEVEL = st.sampled_from(["ts", "v1", "a", "b", "$SYS", ""])
FILTER_LEVEL = st.sampled_from(["ts", "v1", "a", "b", "+", "#", "$SYS", ""])


def mqtt_match(pattern: list[str], topic: list[str]) -> bool:
    """MQTT 3.1.1 §4.7, as an independent recursive implementation."""
    if topic and topic[0].startswith("$") and pattern and pattern[0] in {"+", "#"}:
        return False

    def walk(wanted: list[str], given: list[str]) -> bool:
        if not wanted:
            return not given
        if wanted[0] == "#":
            return True
        return bool(given) and wanted[0] in {"+", given[0]} and walk(wanted[1:], given[1:])

    return walk(pattern, topic)


@given(st.lists(FILTER_LEVEL, min_size=1, max_size=5), st.lists(LEVEL, min_size=1, max_size=5))
def test_filters_match_as_in_mqtt(pattern: list[str], topic: list[str]) -> None:
    if "#" in pattern[:-1]:
        return
    assert topics.matches("/".join(pattern), "/".join(topic)) == mqtt_match(pattern, topic)


@given(
    st.lists(FILTER_LEVEL, min_size=1, max_size=4),
    st.lists(FILTER_LEVEL, min_size=1, max_size=4),
    st.lists(LEVEL, min_size=1, max_size=5),
)
def test_a_covered_filter_matches_no_more_than_its_cover(
    granted: list[str], asked: list[str], topic: list[str]
) -> None:
    if "#" in granted[:-1] or "#" in asked[:-1]:
        return
    if topics.matches("/".join(granted), "/".join(asked)) and mqtt_match(asked, topic):
        assert mqtt_match(granted, topic)


@pytest.mark.parametrize(
    "topic",
    [
        "",
        "ts/v1",
        "ts/v2/s/a/conn",
        "ts/v1/s/a/d/nothing",
        "ts/v1/s/a/d/tele",
        "ts/v1/s/a/d/state/x",
        "ts/v1/s/a/d/ctl/5/6",
        "ts/v1/s/+/d/state",
        "ts/v1/s//d/state",
        "ts/v1/s/a/d é/state",
        "ts/v1/s/a/d\n/state",
        "/ts/v1/s/a/conn",
    ],
)
def test_invalid_topics_are_rejected(topic: str) -> None:
    with pytest.raises(ProtocolError):
        topics.parse(topic)


def test_topics_are_parsed() -> None:
    assert topics.parse(topics.conn("s", "a")) == ("s", "a", "", "conn", "")
    assert topics.parse(topics.device("s", "a", "d", topics.CTL, "5")) == ("s", "a", "d", "ctl", "5")
    assert topics.parse(topics.device("s", "a", "d", topics.DESC)) == ("s", "a", "d", "desc", "")
