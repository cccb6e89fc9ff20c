"""Account names that look alike are rejected."""

from typing import Any

import httpx
import pytest

from function_app.services.identity.account_names import name_error, skeleton
from tests.fakes.agent import Robot
from tests.harness.cloud.cloud import API, Cloud, Person, problem

PASSWORD = "correct horse battery"  # pragma: allowlist secret


@pytest.mark.parametrize(
    ("first", "second"),
    [
        ("demo", "d\u0435mo"),  # Cyrillic e
        ("demo", "derno"),
        ("Paul", "PauI"),
        ("scope", "\u0455\u0441\u043e\u0440\u0435"),  # all Cyrillic
        ("bob", "b0b"),
        ("\u0430nna", "anna"),
        ("aa", "\u0251a"),
    ],
)
def test_names_that_look_alike_have_one_skeleton(first: str, second: str) -> None:
    assert skeleton(first) == skeleton(second)


def test_names_that_look_different_have_different_skeletons() -> None:
    names = ("anna", "ana", "bob", "rob", "J\u00fcrgen", "Jurgen", "\u0430\u043d\u043d\u0430 \u0431", "dora d", "dora")
    assert len({skeleton(name) for name in names}) == len(names)


@pytest.mark.parametrize(
    "name",
    [
        "d\u0435mo",
        "de\u200bmo",
        "demo\u202e",
        "de\u00admo",
        "<b>demo</b>",
        "demo (owner)",
        "de\tmo",
        "a\u2028b",
        "demo\ue000",
    ],
)
def test_misleading_characters_are_rejected(name: str) -> None:
    assert name_error(name).endswith((".", "+"))


@pytest.mark.parametrize(
    "name",
    [
        "demo",
        "J\u00fcrgen  Wei\u00df",
        "O'Neil-2",
        "a.b@c.org",
        "\u0410\u043d\u043d\u0430",
        "\u5c71\u7530 \u3055\u304f\u3089 Yamada",
        "\uae40 \u6c11 Kim",
    ],
)
def test_ordinary_names_are_accepted(name: str) -> None:
    assert name_error(name) == ""


def test_an_account_cannot_imitate_an_existing_one(cloud: Cloud, pair: tuple[Person, Robot]) -> None:
    owner, robot = pair
    for name in ("demo", "emil"):
        cloud.sign_in(name)
    invitation = owner.post(f"/devices/{robot.device}/invitations", {"role": "viewer"}).json()["secret"]

    def join(name: str) -> httpx.Response:
        body = {"invitation": invitation, "name": name, "password": PASSWORD}
        return cloud.request("POST", f"{API}/auth/accounts", json=body)

    problem(join("d\u0435mo"), 422, "name-invalid")
    problem(join("de\u200bmo"), 422, "name-invalid")
    for imitation in ("derno", "dem0", "emi1"):
        problem(join(imitation), 409, "name-taken")
    with pytest.raises(Exception, match="looks like"):
        cloud.sign_in("derno")
    assert join("dario").status_code == 201


@pytest.mark.parametrize("character", ["\u200b", "\u202e", "\x1b", "\u2066", "\ue000"])
def test_labels_with_invisible_characters_are_rejected(pair: tuple[Person, Robot], character: str) -> None:
    owner, robot = pair
    text = f"left{character}right"
    requests: list[tuple[str, str, dict[str, Any]]] = [
        ("POST", "/spaces", {"name": text}),
        ("POST", "/api-keys", {"name": text, "role": "viewer"}),
        ("PUT", f"/devices/{robot.device}/label", {"label": text}),
        ("PUT", "/robot-types/ur5/movements/wave", {"source": "def run(robot):\n    pass\n", "description": text}),
        ("POST", f"/devices/{robot.device}/lease", {"take_over": True, "reason": text}),
    ]
    for method, path, body in requests:
        detail = problem(owner.request(method, path, json=body), 422, "invalid")["detail"]
        assert "character" in detail or "pattern" in detail or "match" in detail, (path, detail)
    assert owner.post(f"/devices/{robot.device}/stop", {"reason": text}).status_code in {200, 202}, (
        "Stop is never refused"
    )
