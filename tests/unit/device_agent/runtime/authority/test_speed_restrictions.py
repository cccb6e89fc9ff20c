"""Speed restrictions: valid shares, and which one applies."""

import math

import pytest

from device_agent.runtime.authority.speed_restrictions import Restriction, Restrictions


@pytest.mark.parametrize(
    ("speed", "applied"),
    [(0.0, 0.0), (0.5, 0.5), (1.0, 1.0), (1.01, 0.0), (-0.01, 0.0), (math.inf, 0.0), (math.nan, 0.0)],
)
def test_an_invalid_share_of_the_speed_means_hold(speed: float, applied: float) -> None:
    restrictions = Restrictions()
    restrictions.set("door", speed, "open")
    assert restrictions.all == (Restriction("door", applied, "open"),)
    assert restrictions.speed == applied


def test_the_strictest_restriction_applies() -> None:
    restrictions = Restrictions()
    assert (restrictions.strictest, restrictions.speed) == (None, 1.0)
    for source, speed in (("b", 0.5), ("c", 0.2), ("a", 0.5)):
        restrictions.set(source, speed, "open")
    assert [each.source for each in restrictions.all] == ["c", "a", "b"]
    assert restrictions.strictest == Restriction("c", 0.2, "open")
    restrictions.clear("c")
    restrictions.clear("unknown")
    assert restrictions.strictest == Restriction("a", 0.5, "open")
    assert restrictions.speed == 0.5


def test_the_text_is_bounded() -> None:
    assert Restriction("door", 0.5, "open").text == "interlock: open"
    assert len(Restriction("door", 0.5, "x" * 300).text) == 200
