"""Built-in movements of a robot type, and movements of an account, which may shadow them."""

import hashlib
from pathlib import Path
from typing import Any

import pytest

from device_agent.protocol import SHIPPED, AckStatus, RunMovement
from device_agent.runtime.actions.script_policy import ScriptPolicy
from device_agent.runtime.errors import Refused
from device_agent.runtime.storage.journal import Journal
from function_app.services.robot_types.parameter_schema import MAX_PARAMETERS_BYTES
from function_app.services.robot_types.script_metadata import MAX_SOURCE
from tests.fakes.agent import Robot
from tests.harness.cloud.cloud import Cloud, Person, problem
from tests.harness.cloud.memory import Memory
from tests.unit.function_app.services.robot_types.movements import MINE, SOURCE, UR5, WAVE


def test_robot_types_list_their_joints(anna: Person) -> None:
    (shown,) = [item for item in anna.get("/robot-types").json()["items"] if item["type"] == "ur5"]
    assert shown == anna.get(UR5).json()
    assert len(shown["joints"]) == 6
    assert shown["joints"][0]["max_velocity_rad_s"] > 0
    for name in ("nothing", "..", "UR5"):
        assert anna.get(f"/robot-types/{name}").status_code == 404
        assert anna.get(f"/robot-types/{name}/movements").status_code == 404


def test_built_in_movements_are_listed_by_name_with_description(anna: Person) -> None:
    items = anna.get(f"{UR5}/movements").json()["items"]
    names = [item["name"] for item in items]
    assert names == sorted(names)
    assert {"wave", "home"} <= set(names)
    assert all(item["built_in"] and item["description"] and "\n" not in item["description"] for item in items)
    one = anna.get(WAVE).json()
    assert hashlib.sha256(one["source"].encode()).hexdigest() == one["sha256"]


def test_an_own_movement_is_created_changed_and_deleted(anna: Person) -> None:
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
    assert (again.status_code, again.json()["version"]) == (201, 3), "version numbers are not reused"


def test_an_own_movement_shadows_the_built_in_one_for_its_account_only(alone: Cloud, anna: Person) -> None:
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


def test_saving_over_a_newer_version_is_refused(anna: Person) -> None:
    assert anna.put(MINE, {"source": SOURCE, "based_on": 0}).status_code == 201
    refused = problem(anna.put(MINE, {"source": SOURCE + "#", "based_on": 0}), 409, "movement-changed")
    assert refused["version"] == 1
    assert anna.put(MINE, {"source": SOURCE + "#", "based_on": 1}).json()["version"] == 2
    assert problem(anna.put(MINE, {"source": "1", "based_on": 1}), 409, "movement-changed")["version"] == 2
    assert anna.get(MINE).json()["source"] == SOURCE + "#"
    assert anna.delete(MINE).status_code == 204
    assert problem(anna.put(MINE, {"source": "1", "based_on": 2}), 409, "movement-changed")["version"] == 0
    built_in = anna.get(WAVE).json()["version"]
    problem(anna.put(WAVE, {"source": SOURCE, "based_on": 0}), 409, "movement-changed")
    assert anna.put(WAVE, {"source": SOURCE, "based_on": built_in}).status_code == 201


def test_a_check_does_not_save_and_lists_available_names(anna: Person) -> None:
    checked = anna.post(f"{UR5}/scripting/check", {"source": '"""Wave."""\nrobot.home(\n'}).json()
    mark = checked["diagnostics"][0]
    assert (checked["savable"], mark["line"], mark["severity"]) == (False, 2, "error")
    valid = '"""Wave."""\nPARAMETERS = {"speed": {"type": "number", "default": 1}}\nrobot.posture("x")\n'
    checked = anna.post(f"{UR5}/scripting/check", {"source": valid}).json()
    assert (checked["savable"], checked["description"]) == (True, "Wave.")
    assert checked["parameters_schema"]["properties"]["speed"]["default"] == 1
    reference = anna.get(f"{UR5}/scripting").json()
    assert "elbow" in reference["names"]["joints"]
    assert "robot" in [each["name"] for each in reference["api"]["values"]]
    problem(anna.get("/robot-types/nothing/scripting"), 404, "robot-type-unknown")
    problem(anna.post("/robot-types/nothing/scripting/check", {"source": ""}), 404, "robot-type-unknown")


@pytest.mark.parametrize(
    ("source", "line"),
    [("x = (", 1), ("a = 1\nb = = 2\n", 2), ("  x", 1), ("print 'x'", 1), ("x\x00", None), ("\n\nif x:\n", 3)],
)
def test_syntax_errors_are_refused_with_the_line(anna: Person, source: str, line: int | None) -> None:
    refused = problem(anna.put(MINE, {"source": source}), 422, "movement-invalid")
    assert refused.get("line") == line
    problem(anna.get(MINE), 404, "movement-unknown")


@pytest.mark.parametrize(
    "source",
    [
        "(" * 30_000, "-" * 30_000 + "1", "1+" * 30_000 + "1", "a." * 30_000 + "b", "[" * 150 + "]" * 150,
        "x" * 64_001, "",
    ],
    ids=["parentheses", "minus", "plus", "dots", "lists", "long", "empty"],
)  # fmt: skip
def test_extreme_scripts_are_refused_or_stored(anna: Person, source: str) -> None:
    assert anna.put(MINE, {"source": source}).status_code in {201, 422}
    assert anna.get(f"{UR5}/movements").status_code == 200


def test_an_accepted_script_fits_into_a_command_with_parameters(alone: Cloud, anna: Person) -> None:
    text = "x" * (MAX_PARAMETERS_BYTES - len('{"text":""}'))
    for source in ("# ".ljust(MAX_SOURCE), "# ".ljust(48_000, "ü"), "\n" * 48_000, '#"' * 24_000):
        assert anna.put(MINE, {"source": source}).status_code in {200, 201}
        assert anna.get(MINE).json()["source"] == source
        request = {"kind": "run_movement", "name": "mine", "parameters": {"text": text}}
        assert anna.start(alone.robot().pair(anna), request=request).status_code == 202


@pytest.mark.parametrize("letter", ["🤖", "ü", "\x01", '"'])
def test_a_script_larger_than_a_message_is_refused(anna: Person, letter: str) -> None:
    refused = problem(anna.put(MINE, {"source": "#".ljust(MAX_SOURCE, letter)}), 422, "movement-invalid")
    assert "bytes" in refused["detail"]


@pytest.mark.parametrize("name", ["a b", "x" * 65, "ä", "a.py", "%2e%2e", "a%2Fb", "-;"])
def test_invalid_names_are_refused(anna: Person, name: str) -> None:
    assert anna.put(f"{UR5}/movements/{name}", {"source": "1"}).status_code in {404, 422}
    assert anna.get(f"{UR5}/movements/{name}").status_code == 404


def test_a_script_modified_in_the_store_is_not_run(alone: Cloud, memory: Memory) -> None:
    anna = alone.sign_in("anna")
    anna.put(MINE, {"source": SOURCE})
    (stored,) = [name for name, content in memory.blobs.contents.items() if content.decode() == SOURCE]
    memory.blobs.contents[stored] = b"evil()"
    problem(anna.get(MINE), 409, "movement-damaged")
    robot = alone.robot()
    device = robot.pair(anna)
    problem(anna.start(device, request={"kind": "run_movement", "name": "mine"}), 409, "movement-damaged")
    del memory.blobs.contents[stored]
    problem(anna.get(MINE), 409, "movement-damaged")


def test_version_numbers_increase_over_built_in_and_own_movements(anna: Person, robot: Robot, tmp_path: Path) -> None:
    robot.reports = lambda _: (AckStatus.DONE,)
    request = {"kind": "run_movement", "name": "wave"}

    def run() -> None:
        anna.start(robot.device, request=request, wait_ms=10_000, wait_for="done")

    run()
    built_in = anna.get(WAVE).json()["source"]
    own = [f"robot.home()  # {number}\n" for number in range(3)]
    for source in own[:2]:
        anna.put(WAVE, {"source": source})
        run()
    anna.delete(WAVE)
    run()
    anna.put(WAVE, {"source": own[2]})
    run()
    orders: list[Any] = [command.request for command in robot.received(RunMovement)]
    assert [order.source for order in orders] == [built_in, *own[:2], built_in, own[2]]
    journal = Journal(tmp_path / "journal.db")
    journal.open(now_ms=0)
    policy = ScriptPolicy(device="arm", robot_type="ur5", owner=anna.account, keys=robot._keys, journal=journal)
    for order in orders:
        policy.verify(order)
        policy.record_version(order)
        assert not policy.is_untrusted(order)
        assert order.timeout_ms == 300_000
    with pytest.raises(Refused, match="older than version"):
        policy.verify(orders[1])
    journal.close()
    assert [order.author for order in orders] == [SHIPPED, anna.account, anna.account, SHIPPED, anna.account]
