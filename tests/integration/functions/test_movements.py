"""Movements: those that come with a robot type, and an account's own, which may shadow them."""

import hashlib
from pathlib import Path
from typing import Any

import pytest

from device_agent.protocol.messages import AckStatus, RunMovement
from function_app.services.movements import MAX_SOURCE
from tests.support.cloud import Cloud, Person, Robot, problem, settings

UR5 = "/robot-types/ur5"
MINE = f"{UR5}/movements/mine"
WAVE = f"{UR5}/movements/wave"
SOURCE = '"""Wave twice.\n\nMore."""\nrobot.home()\n'


@pytest.fixture
def alone(home: Path) -> Any:
    with Cloud(settings(home)) as cloud:
        yield cloud


@pytest.fixture
def anna(alone: Cloud) -> Person:
    return alone.sign_in("anna")


def test_robot_types_say_their_joints(anna: Person) -> None:
    (shown,) = [item for item in anna.get("/robot-types").json()["items"] if item["type"] == "ur5"]
    assert shown == anna.get(UR5).json()
    assert len(shown["joints"]) == 6
    assert shown["joints"][0]["max_velocity_rad_s"] > 0
    for name in ("nothing", "..", "UR5"):
        assert anna.get(f"/robot-types/{name}").status_code == 404
        assert anna.get(f"/robot-types/{name}/movements").status_code == 404


def test_built_in_ones_are_listed_by_name_with_their_first_line(anna: Person) -> None:
    items = anna.get(f"{UR5}/movements").json()["items"]
    names = [item["name"] for item in items]
    assert names == sorted(names)
    assert {"wave", "home"} <= set(names)
    assert all(item["built_in"] and item["description"] and "\n" not in item["description"] for item in items)
    one = anna.get(WAVE).json()
    assert hashlib.sha256(one["source"].encode()).hexdigest() == one["sha256"]


def test_ones_own_is_made_changed_and_deleted(anna: Person) -> None:
    made = anna.put(MINE, {"source": SOURCE})
    assert (made.status_code, made.json()["version"], made.json()["description"]) == (201, 1, "Wave twice.")
    changed = anna.put(MINE, {"source": SOURCE + "#", "description": "Mine"})
    assert (changed.status_code, changed.json()["version"], changed.json()["description"]) == (200, 2, "Mine")
    shown = anna.get(MINE).json()
    assert (shown["source"], shown["built_in"]) == (SOURCE + "#", False)
    assert shown["sha256"] == hashlib.sha256((SOURCE + "#").encode()).hexdigest()
    assert anna.delete(MINE).status_code == 204
    problem(anna.get(MINE), 404, "movement-unknown")
    problem(anna.delete(MINE), 404, "movement-unknown")
    again = anna.put(MINE, {"source": SOURCE})
    assert (again.status_code, again.json()["version"]) == (201, 3), "a version is never used twice"


def test_ones_own_shadows_a_built_in_one_for_oneself_only(alone: Cloud, anna: Person) -> None:
    built_in = anna.get(WAVE).json()
    own = anna.put(WAVE, {"source": SOURCE})
    assert (own.status_code, own.json()["version"]) == (201, built_in["version"] + 1)
    assert anna.get(WAVE).json()["source"] == SOURCE
    (listed,) = [item for item in anna.get(f"{UR5}/movements").json()["items"] if item["name"] == "wave"]
    assert listed["built_in"] is False
    bert = alone.sign_in("bert")
    assert bert.get(WAVE).json() == built_in
    problem(bert.delete(WAVE), 409, "movement-built-in")
    problem(bert.get(MINE), 404, "movement-unknown")
    assert anna.delete(WAVE).status_code == 204
    assert anna.get(WAVE).json() == built_in
    problem(anna.delete(WAVE), 409, "movement-built-in")


@pytest.mark.parametrize(
    ("source", "line"),
    [("x = (", 1), ("a = 1\nb = = 2\n", 2), ("  x", 1), ("print 'x'", 1), ("x\x00", None), ("\n\nif x:\n", 3)],
)
def test_what_is_not_python_is_refused_with_the_line(anna: Person, source: str, line: int | None) -> None:
    refused = problem(anna.put(MINE, {"source": source}), 422, "movement-invalid")
    assert refused.get("line") == line
    problem(anna.get(MINE), 404, "movement-unknown")


@pytest.mark.parametrize(
    "source",
    [
        "(" * 30_000,
        "-" * 30_000 + "1",
        "1+" * 30_000 + "1",
        "a." * 30_000 + "b",
        "[" * 150 + "]" * 150,
        "x" * 64_001,
        "",
    ],
    ids=["parentheses", "minus", "plus", "dots", "lists", "long", "empty"],
)
def test_a_script_that_is_too_much_is_refused_or_kept_and_never_a_fault(anna: Person, source: str) -> None:
    assert anna.put(MINE, {"source": source}).status_code in {201, 422}
    assert anna.get(f"{UR5}/movements").status_code == 200


def test_a_script_may_have_64_000_characters_of_any_kind(anna: Person) -> None:
    source = "# ".ljust(MAX_SOURCE, "ü")
    assert anna.put(MINE, {"source": source}).status_code == 201
    assert anna.get(MINE).json()["source"] == source


@pytest.mark.parametrize("name", ["a b", "x" * 65, "ä", "a.py", "%2e%2e", "a%2Fb", "-;"])
def test_a_name_is_an_id(anna: Person, name: str) -> None:
    assert anna.put(f"{UR5}/movements/{name}", {"source": "1"}).status_code in {404, 422}
    assert anna.get(f"{UR5}/movements/{name}").status_code == 404


def test_a_script_that_was_changed_in_the_store_is_not_run(alone: Cloud, home: Path) -> None:
    anna = alone.sign_in("anna")
    anna.put(MINE, {"source": SOURCE})
    (stored,) = [path for path in (home / "blobs").rglob("*.blob") if path.read_text() == SOURCE]
    stored.write_text("evil()")
    problem(anna.get(MINE), 409, "movement-damaged")
    robot = alone.robot()
    device = robot.pair(anna)
    problem(anna.start(device, request={"kind": "run_movement", "name": "mine"}), 409, "movement-damaged")
    stored.unlink()
    problem(anna.get(MINE), 409, "movement-damaged")


def test_an_action_runs_the_newest_version_of_the_callers_own(pair: tuple[Person, Robot]) -> None:
    anna, robot = pair
    robot.reports = lambda _: (AckStatus.DONE,)
    asked = {"kind": "run_movement", "name": "wave"}
    sources = ["robot.home()\n", "robot.home()  # again\n"]
    for source in sources:
        anna.put(WAVE, {"source": source})
        anna.start(robot.device, request=asked, wait_ms=10_000, wait_for="done")
    anna.delete(WAVE)
    anna.start(robot.device, request=asked, wait_ms=10_000, wait_for="done")
    ran = [command.request for command in robot.heard(RunMovement)]
    assert [each.source for each in ran if isinstance(each, RunMovement)] == [*sources, anna.get(WAVE).json()["source"]]
