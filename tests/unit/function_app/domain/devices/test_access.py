"""Permissions by ownership, shares and API keys, in all combinations."""

import itertools

import pytest

from function_app.domain.common.problems import Problem
from function_app.domain.common.timestamps import NEVER_MS
from function_app.domain.devices import access
from function_app.domain.devices.access import OWNER_PERMISSIONS, Permissions, Share
from function_app.domain.devices.devices import Agent, DeviceSpec
from function_app.domain.identity.accounts import Identity, Role

NOW_MS = 1_000
SPEC = DeviceSpec("arm", "arm", "ur5", "Arm")
AGENT = Agent("aaaaaaaaaa", "lab", "", "", (SPEC,), 0, account="anna", space="home", pairing="p1")
DEVICE, SPACE = "device:aaaaaaaaaa-arm", "space:home"
BERT = Identity("bert", "bert", "s")
RANK = {None: 0, Role.VIEWER: 1, Role.OPERATOR: 2, Role.OWNER: 3}


def share(on: str, role: Role, **more: object) -> Share:
    fields: dict[str, object] = {"account": "bert", "owner": "anna", "by": "anna", "created_ms": 0}
    fields |= {"pairing": "p1"} if on == DEVICE else {}
    return Share(on=on, role=role, **{**fields, **more})  # type: ignore[arg-type]


def role(*shares: Share, caller: Identity = BERT, agent: Agent = AGENT, now_ms: int = NOW_MS) -> Role | None:
    result = access.permissions(caller, agent, "arm", shares, now_ms)
    return None if result is None else result.role


def test_only_the_owner_has_access_without_a_share() -> None:
    assert access.permissions(Identity("anna", "anna", "s"), AGENT, "arm", (), NOW_MS) == OWNER_PERMISSIONS
    assert role() is None


@pytest.mark.parametrize(
    ("of_device", "of_space"), list(itertools.product((None, Role.VIEWER, Role.OPERATOR), repeat=2))
)
def test_the_highest_share_counts(of_device: Role | None, of_space: Role | None) -> None:
    shares = [share(on, each) for on, each in ((DEVICE, of_device), (SPACE, of_space)) if each is not None]
    result = access.permissions(BERT, AGENT, "arm", shares, NOW_MS)
    assert RANK[result.role if result else None] == max(RANK[of_device], RANK[of_space])
    assert (result.space if result else None) == of_space


@pytest.mark.parametrize(
    "ignored",
    [
        share(DEVICE, Role.OPERATOR, expires_ms=NOW_MS),
        share(DEVICE, Role.OPERATOR, pairing="p0"),
        share(DEVICE, Role.OPERATOR, pairing=""),
        share(DEVICE, Role.OPERATOR, owner="clara"),
        share(DEVICE, Role.OPERATOR, account="clara"),
        share("device:aaaaaaaaaa-leg", Role.OPERATOR),
        share(SPACE, Role.OPERATOR, owner="clara"),
        share("space:attic", Role.OPERATOR),
        share("space:attic", Role.OPERATOR, pairing="p1"),
    ],
)
def test_expired_and_foreign_shares_are_ignored(ignored: Share) -> None:
    assert role(ignored) is None


def test_a_share_is_valid_until_its_expiry() -> None:
    expiring = share(DEVICE, Role.OPERATOR, expires_ms=NOW_MS)
    assert role(expiring, now_ms=NOW_MS - 1) is Role.OPERATOR
    assert role(expiring, share(SPACE, Role.VIEWER)) is Role.VIEWER
    shares = [share(DEVICE, Role.OPERATOR, expires_ms=5_000), share(SPACE, Role.VIEWER, expires_ms=9_000)]
    assert access.permissions(BERT, AGENT, "arm", shares, NOW_MS) == Permissions(Role.OPERATOR, 5_000, Role.VIEWER)
    equal = [share(DEVICE, Role.VIEWER, expires_ms=5_000), share(SPACE, Role.VIEWER)]
    assert access.permissions(BERT, AGENT, "arm", equal, NOW_MS) == Permissions(Role.VIEWER, NEVER_MS, Role.VIEWER)


@pytest.mark.parametrize(
    ("most", "only", "expected"),
    [
        (Role.OWNER, (), Role.OPERATOR),
        (Role.OPERATOR, (), Role.OPERATOR),
        (Role.VIEWER, (), Role.VIEWER),
        (Role.OWNER, ("aaaaaaaaaa-arm",), Role.OPERATOR),
        (Role.OWNER, ("space:home",), Role.OPERATOR),
        (Role.VIEWER, ("space:home",), Role.VIEWER),
        (Role.OWNER, ("aaaaaaaaaa-leg", "space:attic"), None),
    ],
)
def test_a_key_limits_role_and_devices(most: Role, only: tuple[str, ...], expected: Role | None) -> None:
    caller = Identity("bert", "app", "k", key="k", most=most, only=only)
    assert role(share(SPACE, Role.OPERATOR), caller=caller) is expected


def test_a_key_for_one_device_has_no_role_in_its_space() -> None:
    caller = Identity("anna", "app", "k", key="k", only=("aaaaaaaaaa-arm",))
    assert access.permissions(caller, AGENT, "arm", (), NOW_MS) == Permissions(Role.OWNER, NEVER_MS, None)


def test_an_unclaimed_agent_has_no_roles() -> None:
    unclaimed = Agent("aaaaaaaaaa", "lab", "", "", (SPEC,), 0)
    assert role(share(DEVICE, Role.OPERATOR), share("space:", Role.OPERATOR), agent=unclaimed) is None


def test_ownership_cannot_be_shared() -> None:
    assert access.require_shareable(Role.VIEWER) is Role.VIEWER
    with pytest.raises(Problem, match="transfer"):
        access.require_shareable(Role.OWNER)
