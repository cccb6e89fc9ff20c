"""Who may do what, by ownership, by shares and by what a key allows: every combination."""

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


def role(*shares: Share, who: Identity = BERT, agent: Agent = AGENT, now_ms: int = NOW_MS) -> Role | None:
    found = access.permissions(who, agent, "arm", shares, now_ms)
    return None if found is None else found.role


def test_the_owner_needs_no_share_and_nobody_else_has_a_part_without_one() -> None:
    assert access.permissions(Identity("anna", "anna", "s"), AGENT, "arm", (), NOW_MS) == OWNER_PERMISSIONS
    assert role() is None


@pytest.mark.parametrize(
    ("of_device", "of_space"), list(itertools.product((None, Role.VIEWER, Role.OPERATOR), repeat=2))
)
def test_the_higher_of_both_shares_counts(of_device: Role | None, of_space: Role | None) -> None:
    shares = [share(on, each) for on, each in ((DEVICE, of_device), (SPACE, of_space)) if each is not None]
    found = access.permissions(BERT, AGENT, "arm", shares, NOW_MS)
    assert RANK[found.role if found else None] == max(RANK[of_device], RANK[of_space])
    assert (found.space if found else None) == of_space


@pytest.mark.parametrize(
    "dead",
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
def test_what_is_over_of_another_or_for_another_counts_for_nothing(dead: Share) -> None:
    assert role(dead) is None


def test_a_share_counts_until_the_very_moment_of_its_end() -> None:
    lasting = share(DEVICE, Role.OPERATOR, expires_ms=NOW_MS)
    assert role(lasting, now_ms=NOW_MS - 1) is Role.OPERATOR
    assert role(lasting, share(SPACE, Role.VIEWER)) is Role.VIEWER


def test_the_end_that_is_told_is_that_of_the_role_that_counts() -> None:
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
def test_a_key_caps_the_role_and_keeps_to_its_devices(most: Role, only: tuple[str, ...], expected: Role | None) -> None:
    who = Identity("bert", "app", "k", key="k", most=most, only=only)
    assert role(share(SPACE, Role.OPERATOR), who=who) is expected


def test_a_key_for_one_device_has_no_part_in_the_space_around_it() -> None:
    who = Identity("anna", "app", "k", key="k", only=("aaaaaaaaaa-arm",))
    assert access.permissions(who, AGENT, "arm", (), NOW_MS) == Permissions(Role.OWNER, NEVER_MS, None)


def test_an_agent_that_nobody_has_claimed_has_no_roles() -> None:
    nobodys = Agent("aaaaaaaaaa", "lab", "", "", (SPEC,), 0)
    assert role(share(DEVICE, Role.OPERATOR), share("space:", Role.OPERATOR), agent=nobodys) is None


def test_ownership_cannot_be_shared() -> None:
    assert access.require_shareable(Role.VIEWER) is Role.VIEWER
    with pytest.raises(Problem, match="transfer"):
        access.require_shareable(Role.OWNER)
