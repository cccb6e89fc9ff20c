"""Ids contain their parts, sort by time and are parsed strictly."""

import hashlib
import re

import pytest
from hypothesis import given
from hypothesis import strategies as st

from device_agent.protocol.topics import is_id
from function_app.domain.common import ids

AGENT = "abcdefgh23"
times = st.integers(min_value=0, max_value=4_102_444_800_000)  # until 2100


def test_agent_ids_use_fifty_bits_of_the_key() -> None:
    agents = {ids.agent_id(hashlib.sha256(str(n).encode()).hexdigest()[:16]) for n in range(2_000)}
    assert len(agents) == 2_000
    assert all(re.fullmatch("[a-z2-7]{10}", agent) for agent in agents)
    assert ids.agent_id("0" * 16) != ids.agent_id(f"{1 << 14:016x}")
    assert ids.agent_id("f" * 16) == "7" * 10


@given(st.from_regex(ids.DEVICE_NAME), times, times)
def test_action_ids_contain_the_device_and_sort_newest_first(name: str, one: int, two: int) -> None:
    device = ids.device_id(AGENT, name)
    action = ids.command_id(device, one)
    assert is_id(action)
    assert ids.split_device(device) == (AGENT, name)
    assert ids.split_command(action) == (device, action[-20:])
    if one != two:
        earlier, later = sorted((one, two))
        assert ids.new_suffix(later) < ids.new_suffix(earlier)


def test_ids_do_not_repeat() -> None:
    assert len({ids.new_suffix(0) for _ in range(5_000)}) == 5_000
    assert len({ids.new_id() for _ in range(5_000)}) == 5_000
    assert all(re.fullmatch("[a-z2-7]{16}", ids.new_id()) for _ in range(100))


@pytest.mark.parametrize("agent", ["", AGENT[:-1], f"{AGENT}x", "äbcdefgh23", "abcdefgh2٣", AGENT])
@pytest.mark.parametrize("name", ["", "a/b", "a b", "ärm", "x" * 33, "arm\n", "\x00"])
def test_invalid_device_ids_are_rejected(agent: str, name: str) -> None:
    for text in (f"{agent}-{name}", agent, "-arm", "short-arm"):
        assert ids.split_device(text) is None
        assert ids.split_command(f"{text}-{'0' * 20}") is None


def test_invalid_action_ids_are_rejected() -> None:
    for suffix in ("", "0" * 19, "0" * 21, "0" * 19 + "/", "0" * 19 + " "):
        assert ids.split_command(f"{AGENT}-arm-{suffix}") is None


@given(st.text())
def test_any_text_is_parsed_or_rejected(text: str) -> None:
    for split in (ids.split_device, ids.split_command):
        parts = split(text)
        assert parts is None or "-".join(parts) == text
    code = ids.parse_claim_code(text)
    assert code is None or set(code) <= set(ids.CLAIM_ALPHABET)


def test_claim_codes_are_accepted_in_any_notation() -> None:
    for _ in range(100):
        code = ids.new_claim_code()
        displayed = ids.format_claim_code(code)
        assert re.fullmatch("[BCDFGHJKLMNPQRSTVWXZ]{4}-[BCDFGHJKLMNPQRSTVWXZ]{4}", displayed)
        for typed in (displayed, code, displayed.lower(), f" {displayed[:4]} - {displayed[5:]} "):
            assert ids.parse_claim_code(typed) == code
    for invalid in ("", "BCDF-GHJ", "BCDF-GHJKL", "ABCD-EFGH", "BCDF-GHJ1", "BCDF_GHJK", "\uff22CDF-GHJK"):
        assert ids.parse_claim_code(invalid) is None
