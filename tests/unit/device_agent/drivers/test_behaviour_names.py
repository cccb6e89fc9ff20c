"""Names of a robot's behaviours as ids: valid, reversible and without collisions."""

import re

import pytest
from hypothesis import given
from hypothesis import strategies as st

from device_agent.drivers.behaviour_names import decode, encode
from device_agent.protocol.topics import ID_PATTERN

NAMES = st.text(st.characters(exclude_categories=["Cs"]), min_size=1, max_size=80)


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("wave", "naoqi-wave"),
        ("animations/Stand/Hey_1", "naoqi-animations--Stand--Hey_1"),
        ("User/a-b.c d", "naoqi-User--a-2db-_c-20d"),
        ("žiť", "naoqi--c5-bei-c5-a5"),
    ],
)
def test_ids_are_readable(name: str, expected: str) -> None:
    assert encode("naoqi", name) == expected
    assert decode(expected) == ("naoqi", name)


@given(NAMES, NAMES)
def test_every_name_has_a_valid_id_of_its_own(one: str, other: str) -> None:
    first, second = encode("naoqi", one), encode("naoqi", other)
    assert re.fullmatch(ID_PATTERN, first)
    assert (first == second) == (one == other)
    assert encode("script", one) != first
    assert decode(first) in {("naoqi", one), ("naoqi", None)}
    assert decode(first)[1] is not None or len(first) == 64


def test_long_names_with_an_equal_start_differ() -> None:
    one, other = encode("naoqi", "a" * 100 + "1"), encode("naoqi", "a" * 100 + "2")
    assert len(one) == len(other) == 64
    assert one != other
    assert decode(one) == ("naoqi", None)


@pytest.mark.parametrize("invalid", ["naoqi", "naoqi--", "naoqi-a-2", "naoqi-a-ff", "naoqi-a-61", "naoqi-a.b", ""])
def test_ids_that_no_name_has_are_not_decoded(invalid: str) -> None:
    kind, name = decode(invalid)
    assert kind == invalid.partition("-")[0]
    assert name is None or encode(kind, name) == invalid
