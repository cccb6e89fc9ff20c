"""Interlocks: presence, silence and changes."""

from typing import Any
from unittest import mock

import msgspec
import pytest

from device_agent.config.interlock_rule import InterlockRule
from device_agent.protocol import Measurements
from device_agent.protocol.events import EventKind
from device_agent.runtime.authority.event_recorder import EventRecord
from device_agent.runtime.authority.interlocks import Interlocks, engagement
from device_agent.runtime.readings import Reading, ReadingCache


def rule(**fields: Any) -> InterlockRule:
    return msgspec.convert({"device": "pir", "stream": "presence", "field": "present"} | fields, InterlockRule)


@pytest.mark.parametrize(
    ("fields", "acting", "free"),
    [
        ({"equals": True}, [True, 1.0], [False, 0.0, 2.0]),
        ({"equals": 3}, [3.0], [2.9, True]),
        ({"above": 0.5}, [0.51, True], [0.5, 0.0, False]),
        ({"below": 1}, [0.99, False], [1.0, True]),
    ],
)
def test_a_rule_acts_on_its_condition(fields: dict[str, Any], acting: list[float], free: list[float]) -> None:
    for value in acting:
        assert engagement(rule(**fields), Reading({"present": value}, 0.0)) == rule(**fields).condition
    for value in free:
        assert engagement(rule(**fields), Reading({"present": value}, 0.0)) is None


@pytest.mark.parametrize(
    "reading",
    [
        None,
        Reading({"present": False}, 2.01),
        Reading({"present": False}, float("nan")),
        Reading({}, 0.0),
        Reading({"absent": True}, 0.0),
        Reading({"present": float("nan")}, 0.0),
        Reading({"present": float("-inf")}, 0.0),
    ],
)
def test_a_rule_acts_when_in_doubt(reading: Reading | None) -> None:
    for condition in ({"equals": True}, {"above": 0.5}, {"below": -0.5}):
        assert engagement(rule(**condition), reading)


@pytest.mark.parametrize(
    ("fields", "text"),
    [
        ({}, "exactly one of above, below, equals"),
        ({"above": 1, "equals": True}, "exactly one of above, below, equals"),
        ({"above": float("nan")}, "finite"),
        ({"equals": float("inf")}, "finite"),
        ({"equals": True, "speed": 0}, "speed"),
        ({"equals": True, "speed": 1}, "speed"),
        ({"equals": True, "speed": float("nan")}, "speed"),
        ({"equals": True, "stale_s": float("nan")}, "stale_s"),
        ({"equals": True, "stale_s": 61}, "stale_s"),
        ({"equals": True, "action": "shout"}, "action"),
        ({"equals": True, "colour": "red"}, "colour"),
        ({"equals": True, "device": "a b"}, "device"),
    ],
)
def test_an_invalid_rule_is_rejected(fields: dict[str, Any], text: str) -> None:
    with pytest.raises(msgspec.ValidationError, match=text):
        rule(**fields)


def test_a_rule_is_named_by_its_condition() -> None:
    assert rule(equals=True).name == "pir/presence present = true"
    assert rule(above=0.5).name == "pir/presence present > 0.5"
    assert rule(below=2).name == "pir/presence present < 2"


class InterlocksFixture:
    """Interlocks, their measurements and their effects."""

    def __init__(self, *rules: InterlockRule) -> None:
        self.now_s = 10.0
        self.effects: list[tuple[Any, ...]] = []
        self.recorded: list[EventRecord] = []
        self.recorded_as: list[tuple[str, float]] = []
        self.sequence = 0
        named = [(each.device, each.stream) for each in rules]
        self.room = ReadingCache(space="lab", agent="own", own=["pir"], named=named, clock_s=lambda: self.now_s)
        self.interlocks = Interlocks(
            rules,
            self.room,
            restrict=lambda *what: self.effects.append(what),
            lift=lambda name: self.effects.append((name,)),
            record=self.record,
        )

    def record(self, event: EventRecord, key: str, now_s: float) -> None:
        self.recorded.append(event)
        self.recorded_as.append((key, now_s))

    def measure(self, **values: float | bool) -> None:
        self.sequence += 1
        message = Measurements(tick_ms=self.sequence, at_ms=1, sequence=self.sequence, values=values)
        self.room.record("pir", "presence", message)

    def step(self, wait_s: float = 0.0) -> list[tuple[Any, ...]]:
        """The effects of one period, after this time."""
        self.now_s += wait_s
        self.effects.clear()
        self.interlocks.update(self.now_s)
        return list(self.effects)


NAME = "pir/presence present = true"


def test_an_interlock_without_a_reading_holds() -> None:
    fixture = InterlocksFixture(rule(equals=True))
    assert fixture.step() == [(NAME, 0.0, "no measurement of pir/presence has arrived")]
    assert fixture.step(1.0) == [], "once"
    assert [happened.kind for happened in fixture.recorded] == [EventKind.INTERLOCK_ENGAGED]
    assert "room held the" in fixture.recorded[0].message


def test_presence_and_silence_slow_and_absence_clears() -> None:
    fixture = InterlocksFixture(rule(equals=True, action="slow", speed=0.25))
    fixture.measure(present=False)
    assert fixture.step() == [(NAME,)]
    assert fixture.recorded == [], "nothing changed"
    fixture.measure(present=True)
    assert fixture.step() == [(NAME, 0.25, "present = true")]
    fixture.measure(present=False)
    assert fixture.step() == [(NAME,)]
    assert fixture.step(2.0) == []
    assert fixture.step(0.01) == [(NAME, 0.25, "pir/presence is silent")]
    fixture.measure(present=False)
    assert fixture.step() == [(NAME,)]
    kinds = [happened.kind for happened in fixture.recorded]
    assert kinds == [EventKind.INTERLOCK_ENGAGED, EventKind.INTERLOCK_CLEARED] * 2
    assert fixture.recorded[0].data == {"interlock": NAME, "action": "slow", "reason": "present = true"}
    assert fixture.recorded[0].severity == "warning"
    assert "room slowed the" in fixture.recorded[0].message
    assert (fixture.recorded[1].severity, fixture.recorded[1].data) == ("info", {"interlock": NAME})
    assert all(event.message for event in fixture.recorded)
    keys = [f"{NAME} present = true", NAME, f"{NAME} pir/presence is silent", NAME]
    assert fixture.recorded_as == list(zip(keys, [10.0, 10.0, 12.01, 12.01], strict=True))


def test_rules_act_independently() -> None:
    fixture = InterlocksFixture(rule(field="distance_m", below=2, action="slow"), rule(field="distance_m", below=1))
    fixture.measure(distance_m=1.5)
    assert fixture.step() == [("pir/presence distance_m < 2", 0.2, "distance_m < 2"), ("pir/presence distance_m < 1",)]
    fixture.measure(distance_m=0.5)
    assert fixture.step() == [("pir/presence distance_m < 1", 0.0, "distance_m < 1")]


def test_a_failed_change_is_retried_in_the_next_period() -> None:
    fixture = InterlocksFixture(rule(equals=True))
    with mock.patch.object(fixture.interlocks, "_restrict", side_effect=RuntimeError), pytest.raises(RuntimeError):
        fixture.step()
    assert fixture.step() != []
