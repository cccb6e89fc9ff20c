"""Connection state, claiming, moving and unpairing of agents."""

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

links = st.builds(Link, online=st.booleans(), session=st.integers(min_value=0, max_value=3), seen_ms=st.integers(0, 9))


@given(st.lists(links))
def test_reordered_presence_never_returns_to_an_earlier_session(incoming: list[Link]) -> None:
    assert newer_link(Link(online=True, session=9, seen_ms=1), Link(online=True, session=1, seen_ms=0, pairing="q"))
    stored: Link | None = None
    for link in incoming:
        newer = newer_link(stored, link)
        if stored is not None and newer is not None:
            assert newer.session >= stored.session
            assert newer.session > stored.session or stored.online or not newer.online
        stored = newer or stored
    if incoming:
        newest = max(link.session for link in incoming)
        assert stored is not None
        assert stored.session == newest
        assert stored.online is all(link.online for link in incoming if link.session == newest)


@pytest.mark.parametrize(
    ("link", "silent_ms", "expected"),
    [
        (None, 0, False),
        (Link(online=True, session=1, seen_ms=0), SILENT_MS, True),
        (Link(online=True, session=1, seen_ms=0), SILENT_MS + 1, False),
        (Link(online=False, session=1, seen_ms=0), 0, False),
    ],
)
def test_a_silent_agent_counts_as_offline(link: Link | None, silent_ms: int, expected: bool) -> None:
    assert online(link, 1_000, 1_000 + silent_ms) is expected


def test_claiming_consumes_the_code_and_unpairing_removes_the_owner() -> None:
    agent = Agent("abcdefgh23", "lab", "key", "1", (), 5, claim_code="BCDFGHJK", claim_expires_ms=9)
    owned = claim(agent, account="a", space="s", pairing="p", now_ms=7)
    assert owned.claimed
    assert (owned.claim_code, owned.claim_expires_ms, owned.claimed_ms) == ("", 0, 7)
    free = unpair(owned)
    assert (free.claimed, free.space, free.pairing) == (False, None, "")
    assert (free.id, free.public_key, free.created_ms) == (agent.id, agent.public_key, 5)


def test_timestamps_as_text() -> None:
    assert rfc3339(1_769_860_800_007) == "2026-01-31T12:00:00.007Z"


def test_json_depth_is_limited_without_exceeding_the_stack() -> None:
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


def test_departures_contain_the_former_owner_and_are_bounded() -> None:
    (departure,) = unpair(CLAIMED).leaving
    assert (departure.why, departure.account, departure.space, departure.pairing) == ("unpaired", "anna", "home", "p")
    assert departure.devices == ("arm", "cam")
    moved = move(CLAIMED, "attic")
    assert (moved.space, moved.pairing, moved.account) == ("attic", "p", "anna")
    assert [(each.why, each.space) for each in moved.leaving] == [("moved", "home")]

    assert [(each.why, each.devices) for each in with_devices(CLAIMED, (CAM,)).leaving] == [("removed", ("arm",))]
    assert with_devices(CLAIMED, (CAM, ARM)).leaving == ()
    assert with_devices(Agent("a", "lab", "k", "1", (ARM, CAM), 0), (CAM,)).leaving == ()

    agent = CLAIMED
    for number in range(50):
        agent = move(agent, f"space{number}")
    assert len(agent.leaving) == 16
    assert agent.leaving[-1].space == "space48"
