"""The highest common version of the wire contract, and the advice without one."""

import msgspec
import pytest

from device_agent.protocol import KINDS, VersionRange, common_version, incompatibility


@pytest.mark.parametrize(
    ("agent", "server", "version", "advice"),
    [
        ((1, 1), (1, 1), 1, ""),
        ((1, 3), (2, 5), 3, ""),
        ((4, 9), (2, 5), 5, ""),
        ((1, 2), (3, 4), None, "The agent supports protocol version 1 to 2, the server 3 to 4. Update the agent."),
        ((7, 7), (1, 1), None, "The agent supports protocol version 7, the server 1. Update the server."),
    ],
)
def test_the_highest_common_version_is_used(
    agent: tuple[int, int], server: tuple[int, int], version: int | None, advice: str
) -> None:
    ranges = [VersionRange(min=lowest, max=highest) for lowest, highest in (agent, server)]
    assert common_version(*ranges) == common_version(*reversed(ranges)) == version
    assert incompatibility(agent=ranges[0], server=ranges[1]) == advice


@pytest.mark.parametrize("invalid", [{"min": 2, "max": 1}, {"min": 0}, {"max": 1001}])
def test_an_invalid_range_is_rejected(invalid: dict[str, int]) -> None:
    with pytest.raises(msgspec.ValidationError):
        msgspec.convert(invalid, VersionRange)


def test_every_kind_of_request_is_reported() -> None:
    assert {"move_joints", "grant_lease", "stop_device", "set_control"} <= set(KINDS)
