"""Movements: those that come with a robot type, and an account's own, which may shadow them."""

import base64
import hashlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any, ClassVar

import pytest
from cryptography.exceptions import InvalidSignature

from device_agent.protocol import SHIPPED, AckStatus, RunMovement
from device_agent.protocol.security import signing
from device_agent.runtime.actions.script_policy import ScriptPolicy
from device_agent.runtime.errors import Refused
from device_agent.runtime.storage.journal import Journal
from function_app.ports.tables import Row
from function_app.services.robot_types.movements import KEPT_MS
from function_app.services.robot_types.parameter_schema import MAX_PARAMETERS_BYTES
from function_app.services.robot_types.script_metadata import MAX_SOURCE
from function_app.services.storage import records
from tests.fakes.agent import Robot
from tests.fixtures.cloud import OpenCloud
from tests.harness.cloud.cloud import Cloud, Person, problem
from tests.harness.cloud.memory import Memory

UR5 = "/robot-types/ur5"
MINE = f"{UR5}/movements/mine"
WAVE = f"{UR5}/movements/wave"
SOURCE = '"""Wave twice.\n\nMore."""\nrobot.home()\n'


@pytest.fixture
def alone(open_cloud: OpenCloud) -> Cloud:
    return open_cloud()


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


def test_a_version_is_not_saved_over_one_that_its_author_has_not_seen(anna: Person) -> None:
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


def test_a_script_is_checked_without_being_saved_and_an_editor_learns_what_there_is(anna: Person) -> None:
    checked = anna.post(f"{UR5}/scripting/check", {"source": '"""Wave."""\nrobot.home(\n'}).json()
    assert (checked["savable"], checked["diagnostics"][0]["line"], checked["diagnostics"][0]["severity"]) == (
        False,
        2,
        "error",
    )
    good = '"""Wave."""\nPARAMETERS = {"speed": {"type": "number", "default": 1}}\nrobot.posture("x")\n'
    checked = anna.post(f"{UR5}/scripting/check", {"source": good}).json()
    assert (checked["savable"], checked["description"]) == (True, "Wave.")
    assert checked["parameters_schema"]["properties"]["speed"]["default"] == 1
    told = anna.get(f"{UR5}/scripting").json()
    assert "elbow" in told["names"]["joints"]
    assert "robot" in [each["name"] for each in told["api"]["values"]]
    problem(anna.get("/robot-types/nothing/scripting"), 404, "robot-type-unknown")
    problem(anna.post("/robot-types/nothing/scripting/check", {"source": ""}), 404, "robot-type-unknown")


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


def test_a_script_that_is_taken_can_be_sent_with_all_the_parameters_it_may_have(alone: Cloud, anna: Person) -> None:
    sources = {
        "letters": "# ".ljust(MAX_SOURCE),
        "umlauts": "# ".ljust(48_000, "ü"),
        "lines": "\n" * 48_000,
        "quotes": '#"' * 24_000,
    }
    text = "x" * (MAX_PARAMETERS_BYTES - len('{"text":""}'))
    starting = []
    for name, source in sources.items():
        saved = anna.put(f"{UR5}/movements/{name}", {"source": source})
        assert saved.status_code == 201, saved.text
        assert anna.get(f"{UR5}/movements/{name}").json()["source"] == source
        device = alone.robot().pair(anna)
        asked = {"kind": "run_movement", "name": name, "parameters": {"text": text}}
        starting.append(anna.begin("POST", f"/devices/{device}/actions", json={"request": asked}))
    assert [started().status_code for started in starting] == [202] * len(sources)


@pytest.mark.parametrize("letter", ["🤖", "ü", "\x01", '"'])
def test_a_script_that_a_message_cannot_carry_is_refused(anna: Person, letter: str) -> None:
    refused = problem(anna.put(MINE, {"source": "#".ljust(MAX_SOURCE, letter)}), 422, "movement-invalid")
    assert "bytes" in refused["detail"]


@pytest.mark.parametrize("name", ["a b", "x" * 65, "ä", "a.py", "%2e%2e", "a%2Fb", "-;"])
def test_a_name_is_an_id(anna: Person, name: str) -> None:
    assert anna.put(f"{UR5}/movements/{name}", {"source": "1"}).status_code in {404, 422}
    assert anna.get(f"{UR5}/movements/{name}").status_code == 404


def test_a_script_that_was_changed_in_the_store_is_not_run(alone: Cloud, memory: Memory) -> None:
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


def test_no_version_that_may_run_is_older_for_the_device_than_one_that_ran(
    pair: tuple[Person, Robot], tmp_path: Path
) -> None:
    anna, robot = pair
    robot.reports = lambda _: (AckStatus.DONE,)
    asked = {"kind": "run_movement", "name": "wave"}

    def run() -> None:
        anna.start(robot.device, request=asked, wait_ms=10_000, wait_for="done")

    run()
    for source in ("robot.home()\n", "robot.home()  # again\n"):
        anna.put(WAVE, {"source": source})
        run()
    anna.delete(WAVE)
    run()
    anna.put(WAVE, {"source": "robot.home()  # made anew\n"})
    run()
    orders = [command.request for command in robot.heard(RunMovement)]
    journal = Journal(tmp_path / "journal.db")
    journal.open(now_ms=0)
    trust = ScriptPolicy(device="arm", robot_type="ur5", owner=anna.account, keys=robot._keys, journal=journal)
    for order in orders:
        assert isinstance(order, RunMovement)
        trust.verify(order)
        trust.record_version(order)
        assert not trust.is_untrusted(order)
        assert order.timeout_ms == 300_000
    with pytest.raises(Refused, match="older than version"):
        trust.verify(orders[1])  # type: ignore[arg-type]
    journal.close()
    assert [each.author for each in orders if isinstance(each, RunMovement)] == [
        SHIPPED, anna.account, anna.account, SHIPPED, anna.account,
    ]  # fmt: skip


class TestVersions:
    def test_every_version_is_listed_and_can_be_had(self, anna: Person) -> None:
        sources = [f"robot.home()  # {number}" for number in range(5)]
        for source in sources:
            anna.put(WAVE, {"source": source})
        pages = list(paged(anna, f"{WAVE}/versions", limit=2))
        found = [item for page in pages for item in page]
        assert max(map(len, pages)) <= 3
        assert [item["version"] for item in found] == [6, 5, 4, 3, 2, 1]
        assert [item["built_in"] for item in found] == [False] * 5 + [True]
        for item, source in zip(found[:5], reversed(sources), strict=True):
            one = anna.get(WAVE, params={"version": item["version"]}).json()
            assert (one["source"], one["sha256"]) == (source, item["sha256"])
        built_in = anna.get(WAVE, params={"version": 1}).json()
        assert built_in["built_in"]
        assert hashlib.sha256(built_in["source"].encode()).hexdigest() == built_in["sha256"]
        for version in (7, 2**31):
            problem(anna.get(WAVE, params={"version": version}), 404, "movement-version-unknown")
        for wrong in ("0", "-1", "x", "1.5"):
            problem(anna.get(WAVE, params={"version": wrong}), 422, "invalid")

    def test_versions_of_a_built_in_one_are_that_one(self, anna: Person) -> None:
        (only,) = anna.get(f"{WAVE}/versions").json()["items"]
        assert (only["built_in"], only["version"]) == (True, 1)
        assert anna.get(WAVE, params={"version": 1}).status_code == 200
        problem(anna.get(WAVE, params={"version": 2}), 404, "movement-version-unknown")
        problem(anna.get(f"{MINE}/versions"), 404, "movement-unknown")

    def test_nobody_else_sees_them(self, alone: Cloud, anna: Person) -> None:
        anna.put(MINE, {"source": SOURCE})
        anna.put(WAVE, {"source": SOURCE})
        bert = alone.sign_in("bert")
        problem(bert.get(f"{MINE}/versions"), 404, "movement-unknown")
        problem(bert.get(MINE, params={"version": 1}), 404, "movement-unknown")
        problem(bert.get(WAVE, params={"version": 2}), 404, "movement-version-unknown")
        assert len(bert.get(f"{WAVE}/versions").json()["items"]) == 1

    def test_versions_of_before_a_deletion_are_gone_and_their_scripts_after_some_days(
        self, memory: Memory, alone: Cloud, anna: Person
    ) -> None:
        for number in range(3):
            anna.put(MINE, {"source": f"# {number}"})
        anna.delete(MINE)
        problem(anna.get(f"{MINE}/versions"), 404, "movement-unknown")
        anna.put(MINE, {"source": "# 1"})
        assert [item["version"] for item in anna.get(f"{MINE}/versions").json()["items"]] == [4]
        problem(anna.get(MINE, params={"version": 2}), 404, "movement-version-unknown")
        assert len(scripts(memory)) == 4, "an action that was started with one may still be sent again"
        alone.clock.advance((KEPT_MS + 1_000) / 1000)
        alone.run(alone.functions.retention.delete_due(alone.clock.now_ms()))
        assert scripts(memory) == ["# 1"]
        again = alone.sign_in("anna")
        assert again.get(MINE).json()["source"] == "# 1"
        page = alone.run(alone.functions.tables.query(records.MOVEMENTS, f"{anna.account}/ur5"))
        assert len(page.rows) == 2, "a name and a version"

    def test_of_a_deleted_one_its_name_is_all_that_stays(self, memory: Memory, alone: Cloud, anna: Person) -> None:
        for number in range(3):
            anna.put(MINE, {"source": f"# {number}"})
        anna.delete(MINE)
        alone.clock.advance((KEPT_MS + 1_000) / 1000)
        alone.run(alone.functions.retention.delete_due(alone.clock.now_ms()))
        assert scripts(memory) == []
        page = alone.run(alone.functions.tables.query(records.MOVEMENTS, f"{anna.account}/ur5"))
        assert [row.key for row in page.rows] == ["mine"]

    def test_many_who_save_at_once_get_a_version_each_and_leave_no_other_script(
        self, memory: Memory, anna: Person
    ) -> None:
        waiting = [anna.begin("PUT", MINE, json={"source": f"# {number}"}) for number in range(8)]
        saved = [answer().json()["version"] for answer in waiting]
        assert sorted(saved) == list(range(1, 9))
        found = anna.get(f"{MINE}/versions").json()["items"]
        assert [item["version"] for item in found] == list(range(8, 0, -1))
        assert sorted(scripts(memory)) == sorted(
            anna.get(MINE, params={"version": version}).json()["source"] for version in range(1, 9)
        )

    def test_lists_page_by_name_over_built_in_ones_and_ones_own(self, anna: Person) -> None:
        for name in ("aaa", "home", "zzz", "wave-2", "gone"):
            anna.put(f"{UR5}/movements/{name}", {"source": SOURCE})
        anna.delete(f"{UR5}/movements/gone")
        whole = anna.get(f"{UR5}/movements").json()
        names = [item["name"] for item in whole["items"]]
        assert whole["cursor"] is None
        assert names == sorted(names)
        assert {"aaa", "zzz", "wave", "wave-2"} <= set(names)
        assert "gone" not in names
        for limit in (1, 2, 3, 100):
            pages = list(paged(anna, f"{UR5}/movements", limit=limit))
            assert [item["name"] for page in pages for item in page] == names
            assert all(len(page) <= limit for page in pages)
        problem(anna.get(f"{UR5}/movements", params={"cursor": "~"}), 422, "cursor-invalid")


class TestSignatures:
    @pytest.mark.parametrize("own", [True, False])
    def test_one_verifies_with_the_keys_that_agents_know(self, alone: Cloud, anna: Person, own: bool) -> None:
        if own:
            anna.put(WAVE, {"source": SOURCE})
        robot = alone.robot()
        robot.pair(anna)
        keys = {key["id"]: key["public"] for key in robot.enrollment()["keys"]}
        shown = anna.get(WAVE).json()
        signature = shown["signature"]
        assert keys[signature["key"]] == signature["public"]
        text = "\n".join(["ur5", "wave", str(shown["version"]), shown["sha256"]])
        assert signature["signed"] == text
        raw = base64.urlsafe_b64decode(signature["signature"] + "==")
        key = signing.public_key(keys[signature["key"]])
        key.verify(raw, b"telescope/v1/movement\n" + text.encode())
        with pytest.raises(InvalidSignature):
            key.verify(raw, b"telescope/v1/command\n" + text.encode())

    @pytest.mark.parametrize("change", ["sha256", "version", "signature", "key"])
    def test_a_row_that_was_changed_in_the_store_is_not_run(self, alone: Cloud, anna: Person, change: str) -> None:
        anna.put(MINE, {"source": SOURCE})
        tables = alone.functions.tables
        row = alone.run(tables.get(records.MOVEMENTS, f"{anna.account}/ur5", "mine"))
        assert row is not None
        evil = "evil()"
        sha256 = hashlib.sha256(evil.encode()).hexdigest()
        values = {"sha256": sha256, "version": 2, "signature": "A" * 86, "key": "0" * 16}
        alone.run(
            tables.replace(
                records.MOVEMENTS, Row(row.partition, row.key, {**row.data, change: values[change]}, row.etag)
            )
        )
        version = 2 if change == "version" else 1
        for digest in (sha256, row.data["sha256"]):
            name = f"movements/{anna.account}/ur5/mine/{version}-{digest}.py"
            alone.run(alone.functions.blobs.put(name, evil.encode() if digest == sha256 else SOURCE.encode()))
        problem(anna.get(MINE), 409, "movement-damaged")
        device = alone.robot().pair(anna)
        problem(anna.start(device, request={"kind": "run_movement", "name": "mine"}), 409, "movement-damaged")


class TestParameters:
    SCHEMA: ClassVar = {
        "type": "object",
        "properties": {
            "times": {"type": "integer", "minimum": 1, "default": 3},
            "who": {"type": "string", "enum": ["anna", "bert"]},
        },
        "required": ["who"],
        "additionalProperties": False,
    }

    def test_built_in_ones_say_what_they_take(self, anna: Person) -> None:
        for item in anna.get(f"{UR5}/movements").json()["items"]:
            properties = item["parameters_schema"]["properties"]
            assert properties["speed"]["default"] > 0
            assert all(value["description"] for value in properties.values())

    def test_a_schema_is_the_callers_else_the_scripts_else_none(self, anna: Person) -> None:
        literal = 'PARAMETERS = {"who": {"type": "string"}, "times": {"type": "integer", "default": 1}}'
        read = anna.put(MINE, {"source": literal}).json()["parameters_schema"]
        assert (sorted(read["properties"]), read["required"]) == (["times", "who"], ["who"])
        said = anna.put(MINE, {"source": literal, "parameters_schema": self.SCHEMA}).json()["parameters_schema"]
        assert said["properties"]["who"]["enum"] == ["anna", "bert"]
        assert anna.get(MINE).json()["parameters_schema"] == said
        assert anna.put(MINE, {"source": "1"}).json()["parameters_schema"] is None
        assert anna.get(MINE, params={"version": 2}).json()["parameters_schema"] == said

    @pytest.mark.parametrize(
        "schema",
        [
            {"type": "object", "properties": {"a": {"$ref": "#"}}},
            {"type": "object", "properties": {"a": {"type": "string", "pattern": "(a+)+$"}}},
            {"type": "object", "patternProperties": {}},
            {"type": "array", "items": {"type": "string"}},
            {"type": "object", "properties": {"a": {"type": ["string", "null"]}}},
        ],
    )
    def test_what_a_schema_may_not_say_is_refused(self, anna: Person, schema: dict[str, Any]) -> None:
        problem(anna.put(MINE, {"source": "1", "parameters_schema": schema}), 422, "invalid")

    def test_a_schema_that_contradicts_itself_is_refused(self, anna: Person) -> None:
        schema = {"type": "object", "properties": {"a": {"type": "integer", "default": "x"}}}
        refused = problem(anna.put(MINE, {"source": "1", "parameters_schema": schema}), 422, "schema-invalid")
        assert "$.a" in refused["detail"]
        problem(anna.put(MINE, {"source": 'PARAMETERS = {"a": 1}'}), 422, "schema-invalid")
        problem(anna.put(MINE, {"source": "PARAMETERS = f()"}), 422, "movement-invalid")

    def test_an_action_gets_the_defaults_and_keeps_them(self, pair: tuple[Person, Robot]) -> None:
        anna, robot = pair
        anna.put(MINE, {"source": "1", "parameters_schema": self.SCHEMA})
        asked = {"kind": "run_movement", "name": "mine", "parameters": {"who": "bert"}}
        started = anna.start(robot.device, request=asked, wait_ms=10_000, once="x").json()
        (command,) = robot.heard(RunMovement)
        assert isinstance(command.request, RunMovement)
        assert command.request.parameters == {"who": "bert", "times": 3}
        assert started["request"]["parameters"] == {"who": "bert", "times": 3}
        assert anna.start(robot.device, request=asked, wait_ms=10_000, once="x").json()["id"] == started["id"]

    @pytest.mark.parametrize(
        ("given", "place"),
        [
            ({}, "$"),
            ({"who": "carl"}, "$.who"),
            ({"who": "anna", "times": 0}, "$.times"),
            ({"who": "anna", "times": True}, "$.times"),
            ({"who": "anna", "more": 1}, "$"),
        ],
    )
    def test_what_does_not_fit_is_refused_with_its_place_and_takes_no_slot(
        self, anna: Person, given: dict[str, Any], place: str
    ) -> None:
        device = anna.cloud.robot().pair(anna)
        anna.put(MINE, {"source": "1", "parameters_schema": self.SCHEMA})
        asked = {"kind": "run_movement", "name": "mine", "parameters": given}
        refused = problem(anna.start(device, request=asked), 422, "parameters-invalid")
        assert refused["place"] == place
        assert anna.get(f"/devices/{device}/actions").json()["items"] == []


def paged(person: Person, path: str, **query: Any) -> Iterator[list[dict[str, Any]]]:
    cursor = None
    while True:
        body = person.get(path, params={**query, **({"cursor": cursor} if cursor else {})}).json()
        yield body["items"]
        cursor = body["cursor"]
        if cursor is None:
            return


def scripts(memory: Memory) -> list[str]:
    """Every script in the blob store."""
    return sorted(content.decode() for content in memory.blobs.contents.values())
