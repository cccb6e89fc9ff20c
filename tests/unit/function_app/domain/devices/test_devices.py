"""What is believed of an agent's connection."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from function_app.domain.common.json_depth import MAX_LEVELS, too_deep
from function_app.domain.common.timestamps import rfc3339
from function_app.domain.devices.devices import (
    SILENT_MS,
    Agent,
    DeviceSpec,
    Link,
    claim,
    move,
    newer_link,
    online,
    unpair,
    with_devices,
)
from function_app.domain.identity.accounts import Role

links = st.builds(Link, online=st.booleans(), session=st.integers(min_value=0, max_value=3), seen_ms=st.integers(0, 9))


def test_an_old_will_does_not_mark_a_new_session_dead() -> None:
    known = Link(online=True, session=5, seen_ms=1)
    assert newer_link(known, Link(online=False, session=4, seen_ms=2)) is None


def test_the_will_of_this_session_does_and_nothing_late_revives_it() -> None:
    dead = newer_link(Link(online=True, session=5, seen_ms=1), Link(online=False, session=5, seen_ms=2))
    assert dead == Link(online=False, session=5, seen_ms=2)
    assert newer_link(dead, Link(online=True, session=5, seen_ms=3)) is None
    alive = Link(online=True, session=6, seen_ms=4)
    assert newer_link(dead, alive) == alive


@given(st.lists(links))
def test_any_order_of_presence_never_goes_back_to_an_earlier_session(news: list[Link]) -> None:
    known: Link | None = None
    for link in news:
        newer = newer_link(known, link)
        if known is not None and newer is not None:
            assert newer.session >= known.session
            assert newer.session > known.session or known.online or not newer.online
        known = newer or known
    if news:
        newest = max(link.session for link in news)
        assert known is not None
        assert known.session == newest
        assert known.online is all(link.online for link in news if link.session == newest)


@pytest.mark.parametrize(
    ("link", "silent_ms", "expected"),
    [
        (None, 0, False),
        (Link(online=True, session=1, seen_ms=0), SILENT_MS, True),
        (Link(online=True, session=1, seen_ms=0), SILENT_MS + 1, False),
        (Link(online=False, session=1, seen_ms=0), 0, False),
    ],
)
def test_silence_ends_the_belief_that_an_agent_is_there(link: Link | None, silent_ms: int, expected: bool) -> None:
    assert online(link, 1_000, 1_000 + silent_ms) is expected


def test_a_claim_uses_the_code_up_and_unpairing_leaves_nobodys_agent() -> None:
    agent = Agent("abcdefgh23", "lab", "key", "1", (), 5, claim_code="BCDFGHJK", claim_expires_ms=9)
    owned = claim(agent, account="a", space="s", pairing="p", now_ms=7)
    assert owned.claimed
    assert (owned.claim_code, owned.claim_expires_ms, owned.claimed_ms) == ("", 0, 7)
    free = unpair(owned)
    assert (free.claimed, free.space, free.pairing) == (False, None, "")
    assert (free.id, free.public_key, free.created_ms) == (agent.id, agent.public_key, 5)


def test_roles() -> None:
    assert [role.may_operate for role in (Role.OWNER, Role.OPERATOR, Role.VIEWER)] == [True, True, False]
    assert [role.may_own for role in (Role.OWNER, Role.OPERATOR, Role.VIEWER)] == [True, False, False]


def test_a_moment_as_text() -> None:
    assert rfc3339(0) == "1970-01-01T00:00:00.000Z"
    assert rfc3339(1_769_860_800_007) == "2026-01-31T12:00:00.007Z"


def test_nesting_is_bounded_and_the_check_itself_is_too() -> None:
    value: object = {}
    for _ in range(MAX_LEVELS - 2):
        value = {"a": [0, {}], "b": value}
    assert not too_deep(value)
    assert too_deep([value])
    for _ in range(5_000):
        value = [value]
    assert too_deep(value)


ARM, CAM = DeviceSpec("arm", "arm", "ur5", ""), DeviceSpec("cam", "camera", "c", "")
CLAIMED = claim(Agent("a", "lab", "k", "1", (ARM, CAM), 0), account="anna", space="home", pairing="p", now_ms=1)


def test_what_leaves_is_told_with_whose_it_was_and_where() -> None:
    (left,) = unpair(CLAIMED).leaving
    assert (left.why, left.account, left.space, left.pairing) == ("unpaired", "anna", "home", "p")
    assert left.devices == ("arm", "cam")
    moved = move(CLAIMED, "attic")
    assert (moved.space, moved.pairing, moved.account) == ("attic", "p", "anna")
    assert [(each.why, each.space) for each in moved.leaving] == [("moved", "home")]


def test_only_devices_that_are_no_longer_named_leave_and_only_from_an_owner() -> None:
    assert [(each.why, each.devices) for each in with_devices(CLAIMED, (CAM,)).leaving] == [("removed", ("arm",))]
    assert with_devices(CLAIMED, (CAM, ARM)).leaving == ()
    assert with_devices(Agent("a", "lab", "k", "1", (ARM, CAM), 0), (CAM,)).leaving == ()


def test_an_agent_that_is_moved_again_and_again_does_not_grow_without_end() -> None:
    agent = CLAIMED
    for number in range(50):
        agent = move(agent, f"space{number}")
    assert len(agent.leaving) == 16
    assert agent.leaving[-1].space == "space48"


def test_what_is_said_under_another_pairing_is_news_whatever_its_number() -> None:
    known = Link(online=True, session=5, seen_ms=1, pairing="p")
    news = Link(online=False, session=1, seen_ms=2, pairing="q")
    assert newer_link(known, news) == news
