"""Previews of unsaved robot types: compiled, rendered, private to their author, and deleted after a time."""

from typing import Any

import pytest

from function_app.services.robot_types.preview import MAX_LOOKS
from function_app.services.robot_types.versions import GIVE_UP_MS, KEEP_LOOK_MS
from function_app.services.storage import records
from function_app.services.storage.retention import DAY_MS
from tests.harness.cloud.cloud import Cloud, Person, problem
from tests.integration.robot_types.lever import (
    FILES,
    LEVER,
    SCENE,
    add,
    advance,
    blobs,
    check_all,
    checking,
    manifest,
    rows,
    stop_after,
)

LOOKS = "/robot-type-previews"
_SLOW_MS = 600_000
"""No machine takes as long to compile the lever."""


def look(
    who: Person, text: str = "", *, wait_ms: int = 0, movements: dict[str, str] | None = None, **files: str
) -> Any:
    """Look at the lever; ``lever__xml`` replaces ``lever.xml``."""
    changed = {name.replace("__", "."): content for name, content in files.items()}
    body = {"manifest": text or manifest(), "files": {**FILES, **changed}, "wait_ms": wait_ms}
    return who.post(LOOKS, body | ({} if movements is None else {"movements": movements}))


def checked(cloud: Cloud, who: Person, text: str = "", **more: Any) -> dict[str, Any]:
    """A look with its verdict."""
    begun = look(who, text, **more)
    assert begun.status_code == 202, begun.text
    check_all(cloud)
    found: dict[str, Any] = who.get(f"{LOOKS}/{begun.json()['id']}").json()
    return found


def trials(cloud: Cloud, who: Person) -> list[str]:
    return [key for key in rows(cloud, records.MEMBERS, who.account) if key.startswith("type-look:")]


class TestLook:
    def test_one_is_seen_by_who_looks_and_is_no_robot_type_until_it_is_saved(self, cloud: Cloud, anna: Person) -> None:
        with checking(cloud):
            begun = look(anna, wait_ms=30_000)
            assert begun.status_code == 201, begun.text
            found = begun.json()
            assert (found["robot_type"]["type"], found["robot_type"]["upload"]["state"]) == ("lever", "ready")
            at = f"{LOOKS}/{found['id']}"
            twin = anna.get(f"{at}/twin").json()
            assert [body["name"] for body in twin["bodies"]] == ["base", "beam"]
            assert twin["bodies"][1]["joint"]["name"] == "shoulder"
            assert (twin["actuators"], twin["cameras"]) == (["shoulder"], [])
            assert all(item["built_in"] for item in anna.get("/robot-types").json()["items"])
            problem(anna.get(f"/robot-types/~{found['id']}"), 404, "robot-type-unknown")
            saved = anna.post(f"{at}/save", {"wait_ms": 30_000})
        assert (saved.status_code, saved.json()["state"], saved.json()["version"]) == (201, "ready", 1)
        problem(anna.get(at), 404, "robot-type-preview-unknown")
        assert anna.get("/robot-types/lever/files/robot.toml").text == manifest()
        shown = anna.get("/robot-types/lever/twin").json()
        assert shown["bodies"] == twin["bodies"]
        advance(cloud, 1)
        assert {name.split("/")[2] for name in blobs(cloud)} == {"lever"}
        assert trials(cloud, anna) == []

    def test_it_becomes_the_next_version_of_one_that_is_there(self, cloud: Cloud, anna: Person) -> None:
        add(anna, wait_ms=0)
        check_all(cloud)
        found = checked(cloud, anna, manifest(label='"Better"'))
        assert anna.get("/robot-types/lever").json()["label"] == "Lever"
        saved = anna.post(f"{LOOKS}/{found['id']}/save", {"wait_ms": 0})
        assert saved.status_code == 202
        check_all(cloud)
        shown = anna.get("/robot-types/lever").json()
        assert (shown["version"], shown["label"]) == (2, "Better")

    def test_built_in_ones_are_drawn_as_well(self, anna: Person) -> None:
        twin = anna.get("/robot-types/ur5/twin").json()
        assert next(body["joint"]["name"] for body in twin["bodies"] if body["joint"]) == "shoulder_pan"
        assert twin["cameras"] == ["picture"]
        problem(look(anna, manifest("ur5")), 409, "robot-type-built-in")


class TestFindings:
    def test_all_that_is_wrong_is_said_at_once(self, cloud: Cloud, anna: Person) -> None:
        """A missing mesh, a limit wider than the joint's, torn XML and a script that is none."""
        mesh = '<asset><mesh name="hand" file="hand.stl"/></asset><worldbody>'
        model = LEVER.replace("<worldbody>", mesh).replace(
            '<site name="tip"', '<geom type="mesh" mesh="hand" mass="0.1"/><site name="tip"'
        )
        wide = manifest().replace("upper_rad = 1.0", "upper_rad = 2.0")
        torn = SCENE.replace("</worldbody>", "</worldbdy>")
        found = checked(cloud, anna, wide, lever__xml=model, scene__xml=torn, movements={"up": "robot.home(\n"})
        errors = found["robot_type"]["upload"]["errors"]
        assert found["robot_type"]["upload"]["state"] == "rejected"
        assert len(errors) == 5, errors
        text = "\n".join(errors)
        for words in (
            "movements/up.py: Line 1:",
            "lever.xml: the range of joint 'shoulder'",
            "lever.xml: the control range of actuator 'shoulder'",
            "lever.xml: 'hand.stl' is not among the files (line 2)",
            "scene.xml: mismatched tag: line 3",
        ):
            assert words in text, words
        problem(anna.post(f"{LOOKS}/{found['id']}/save"), 422, "robot-type-rejected")
        problem(anna.get(f"{LOOKS}/{found['id']}/twin"), 422, "robot-type-rejected")

    def test_what_can_be_said_without_compiling_is_said_at_once_too(self, anna: Person) -> None:
        outside = LEVER.replace("<worldbody>", '<include file="/etc/passwd"/><worldbody>', 1)
        asked = look(
            anna, manifest(model='"no.xml"'), lever__xml=outside, movements={"a b": "1", "up": "PARAMETERS = 3"}
        )
        refused = problem(asked, 422, "manifest-invalid")
        text = "\n".join(refused["errors"])
        for words in ("robot.toml: model is 'no.xml'", "lever.xml: <include", "movements/a b.py", "up.py: Line 1"):
            assert words in text, words
        assert trials(anna.cloud, anna) == []

    def test_warnings_refuse_nothing(self, cloud: Cloud, anna: Person) -> None:
        idle = '<position name="idle" joint="shoulder" kp="1"/></actuator>'
        found = checked(cloud, anna, lever__xml=LEVER.replace("</actuator>", idle))
        upload = found["robot_type"]["upload"]
        assert upload["state"] == "ready"
        assert upload["warnings"] == [
            "lever.xml: actuator 'idle' is not in robot.toml, so it cannot be moved.",
            "scene.xml: there is no camera.",
        ]


class TestEnd:
    def test_it_goes_by_itself(self, cloud: Cloud, anna: Person) -> None:
        found = checked(cloud, anna)
        advance(cloud, KEEP_LOOK_MS - _SLOW_MS)
        assert anna.get(f"{LOOKS}/{found['id']}").status_code == 200
        cloud.clock.advance(_SLOW_MS / 1000)
        anna = cloud.sign_in("anna")
        problem(anna.get(f"{LOOKS}/{found['id']}"), 404, "robot-type-preview-unknown")
        problem(anna.delete(f"{LOOKS}/{found['id']}"), 404, "robot-type-preview-unknown")
        assert blobs(cloud), "only the timer deletes"
        advance(cloud, 1)
        assert blobs(cloud) == ()
        assert trials(cloud, anna) == []
        assert rows(cloud, records.ROBOT_TYPES, f"{anna.account}/~{found['id']}") == []
        advance(cloud, DAY_MS)
        assert rows(cloud, records.MODEL_CHECKS, "looks") == []
        anna = cloud.sign_in("anna")
        other = checked(cloud, anna)["id"]
        assert anna.delete(f"{LOOKS}/{other}").status_code == 204
        advance(cloud, 1)
        assert blobs(cloud) == ()

    def test_one_too_many_ends_the_oldest(self, cloud: Cloud, anna: Person) -> None:
        made = []
        for _ in range(MAX_LOOKS + 2):
            made.append(look(anna).json()["id"])
            advance(cloud, 10)
        alive = [name for name in made if anna.get(f"{LOOKS}/{name}").status_code == 200]
        assert alive == made[2:]
        assert len(trials(cloud, anna)) == MAX_LOOKS

    @pytest.mark.parametrize("saving", [False, True])
    def test_one_that_is_cut_off_at_any_write_leaves_nothing(
        self, cloud: Cloud, anna: Person, monkeypatch: pytest.MonkeyPatch, *, saving: bool
    ) -> None:
        """Or, where it was being saved, what was saved: then it is a robot type, or can be saved again."""
        cut = 0
        for after in range(1, 60):
            found = checked(cloud, anna)["id"] if saving else ""
            with monkeypatch.context() as patch:
                stop_after(cloud, patch, after)
                done = anna.post(f"{LOOKS}/{found}/save", {"wait_ms": 0}) if saving else look(anna)
            if done.status_code == 202:
                break
            cut += 1
            assert done.status_code == 500
            advance(cloud, GIVE_UP_MS)
            check_all(cloud)
        assert cut > 5
        for _ in range(3):
            check_all(cloud)
            advance(cloud, KEEP_LOOK_MS)
        anna = cloud.sign_in("anna")
        assert trials(cloud, anna) == []
        left = {name.split("/")[2] for name in blobs(cloud)}
        assert left == ({"lever"} if saving else set())
        assert rows(cloud, records.MODEL_CHECKS, "checks") == []
        if saving:
            assert anna.get("/robot-types/lever").json()["state"] == "ready"

    def test_a_drawing_that_a_deletion_overtook_is_not_left(self, cloud: Cloud, anna: Person) -> None:
        """The checker compiles while the timer deletes: what it writes then goes with its note."""
        found = look(anna).json()["id"]
        compiler = cloud.functions.model_checks._compiler

        class Slow:
            async def check(self, *asked: Any) -> Any:
                where = (await cloud.functions.tables.query(records.ROBOT_TYPES, f"{anna.account}/~{found}")).rows
                for row in where:
                    await cloud.functions.tables.delete(records.ROBOT_TYPES, row)
                for name in await cloud.functions.blobs.list("robot-types/"):
                    await cloud.functions.blobs.delete(name)
                return await compiler.check(*asked)

        cloud.functions.model_checks._compiler = Slow()  # type: ignore[assignment]
        check_all(cloud)
        assert blobs(cloud) == ()
