"""Previews of unsaved robot types: compiled, rendered, private to their author, and deleted after a time."""

from typing import Any

import pytest

from function_app.services.robot_types.preview import MAX_PREVIEWS
from function_app.services.robot_types.versions import GIVE_UP_MS, KEEP_PREVIEW_MS
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

PREVIEWS = "/robot-type-previews"
_SLOW_MS = 600_000
"""More than the compilation of the lever takes on any machine."""


def preview(
    person: Person, text: str = "", *, wait_ms: int = 0, movements: dict[str, str] | None = None, **files: str
) -> Any:
    """Request a preview of the lever; ``lever__xml`` replaces ``lever.xml``."""
    changed = {name.replace("__", "."): content for name, content in files.items()}
    body = {"manifest": text or manifest(), "files": {**FILES, **changed}, "wait_ms": wait_ms}
    return person.post(PREVIEWS, body | ({} if movements is None else {"movements": movements}))


def checked(cloud: Cloud, person: Person, text: str = "", **more: Any) -> dict[str, Any]:
    """Request a preview and wait for its result."""
    response = preview(person, text, **more)
    assert response.status_code == 202, response.text
    check_all(cloud)
    found: dict[str, Any] = person.get(f"{PREVIEWS}/{response.json()['id']}").json()
    return found


def previews(cloud: Cloud, person: Person) -> list[str]:
    return [key for key in rows(cloud, records.MEMBERS, person.account) if key.startswith("type-look:")]


class TestPreview:
    def test_a_preview_is_private_and_becomes_a_robot_type_when_saved(self, cloud: Cloud, anna: Person) -> None:
        with checking(cloud):
            response = preview(anna, wait_ms=30_000)
            assert response.status_code == 201, response.text
            found = response.json()
            assert (found["robot_type"]["type"], found["robot_type"]["upload"]["state"]) == ("lever", "ready")
            at = f"{PREVIEWS}/{found['id']}"
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
        assert previews(cloud, anna) == []

    def test_a_saved_preview_is_the_next_version_of_an_existing_type(self, cloud: Cloud, anna: Person) -> None:
        add(anna, wait_ms=0)
        check_all(cloud)
        found = checked(cloud, anna, manifest(label='"Better"'))
        assert anna.get("/robot-types/lever").json()["label"] == "Lever"
        saved = anna.post(f"{PREVIEWS}/{found['id']}/save", {"wait_ms": 0})
        assert saved.status_code == 202
        check_all(cloud)
        shown = anna.get("/robot-types/lever").json()
        assert (shown["version"], shown["label"]) == (2, "Better")

    def test_built_in_types_have_a_twin(self, anna: Person) -> None:
        twin = anna.get("/robot-types/ur5/twin").json()
        assert next(body["joint"]["name"] for body in twin["bodies"] if body["joint"]) == "shoulder_pan"
        assert twin["cameras"] == ["picture"]
        problem(preview(anna, manifest("ur5")), 409, "robot-type-built-in")


class TestErrors:
    def test_all_errors_are_reported_together(self, cloud: Cloud, anna: Person) -> None:
        """A missing mesh, a limit wider than the joint's, invalid XML and an invalid script."""
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
        problem(anna.post(f"{PREVIEWS}/{found['id']}/save"), 422, "robot-type-rejected")
        problem(anna.get(f"{PREVIEWS}/{found['id']}/twin"), 422, "robot-type-rejected")

    def test_errors_found_without_compilation_are_reported_in_the_response(self, anna: Person) -> None:
        outside = LEVER.replace("<worldbody>", '<include file="/etc/passwd"/><worldbody>', 1)
        refused_response = preview(
            anna, manifest(model='"no.xml"'), lever__xml=outside, movements={"a b": "1", "up": "PARAMETERS = 3"}
        )
        refused = problem(refused_response, 422, "manifest-invalid")
        text = "\n".join(refused["errors"])
        for words in ("robot.toml: model is 'no.xml'", "lever.xml: <include", "movements/a b.py", "up.py: Line 1"):
            assert words in text, words
        assert previews(anna.cloud, anna) == []

    def test_warnings_do_not_reject(self, cloud: Cloud, anna: Person) -> None:
        idle = '<position name="idle" joint="shoulder" kp="1"/></actuator>'
        found = checked(cloud, anna, lever__xml=LEVER.replace("</actuator>", idle))
        upload = found["robot_type"]["upload"]
        assert upload["state"] == "ready"
        assert upload["warnings"] == [
            "lever.xml: actuator 'idle' is not in robot.toml, so it cannot be moved.",
            "scene.xml: there is no camera.",
        ]


class TestExpiry:
    def test_a_preview_expires_and_the_timer_deletes_it(self, cloud: Cloud, anna: Person) -> None:
        found = checked(cloud, anna)
        advance(cloud, KEEP_PREVIEW_MS - _SLOW_MS)
        assert anna.get(f"{PREVIEWS}/{found['id']}").status_code == 200
        cloud.clock.advance(_SLOW_MS / 1000)
        anna = cloud.sign_in("anna")
        problem(anna.get(f"{PREVIEWS}/{found['id']}"), 404, "robot-type-preview-unknown")
        problem(anna.delete(f"{PREVIEWS}/{found['id']}"), 404, "robot-type-preview-unknown")
        assert blobs(cloud), "only the timer may delete files"
        advance(cloud, 1)
        assert blobs(cloud) == ()
        assert previews(cloud, anna) == []
        assert rows(cloud, records.ROBOT_TYPES, f"{anna.account}/~{found['id']}") == []
        advance(cloud, DAY_MS)
        assert rows(cloud, records.MODEL_CHECKS, "looks") == []
        anna = cloud.sign_in("anna")
        other = checked(cloud, anna)["id"]
        assert anna.delete(f"{PREVIEWS}/{other}").status_code == 204
        advance(cloud, 1)
        assert blobs(cloud) == ()

    def test_a_preview_above_the_limit_replaces_the_oldest(self, cloud: Cloud, anna: Person) -> None:
        created = []
        for _ in range(MAX_PREVIEWS + 2):
            created.append(preview(anna).json()["id"])
            advance(cloud, 10)
        existing = [name for name in created if anna.get(f"{PREVIEWS}/{name}").status_code == 200]
        assert existing == created[2:]
        assert len(previews(cloud, anna)) == MAX_PREVIEWS

    @pytest.mark.parametrize("saving", [False, True])
    def test_a_preview_killed_at_any_write_leaves_no_data(
        self, cloud: Cloud, anna: Person, monkeypatch: pytest.MonkeyPatch, *, saving: bool
    ) -> None:
        """If it was being saved, the robot type exists or can be saved again."""
        cut = 0
        for after in range(1, 60):
            found = checked(cloud, anna)["id"] if saving else ""
            with monkeypatch.context() as patch:
                stop_after(cloud, patch, after)
                done = anna.post(f"{PREVIEWS}/{found}/save", {"wait_ms": 0}) if saving else preview(anna)
            if done.status_code == 202:
                break
            cut += 1
            assert done.status_code == 500
            advance(cloud, GIVE_UP_MS)
            check_all(cloud)
        assert cut > 5
        for _ in range(3):
            check_all(cloud)
            advance(cloud, KEEP_PREVIEW_MS)
        anna = cloud.sign_in("anna")
        assert previews(cloud, anna) == []
        remaining = {name.split("/")[2] for name in blobs(cloud)}
        assert remaining == ({"lever"} if saving else set())
        assert rows(cloud, records.MODEL_CHECKS, "checks") == []
        if saving:
            assert anna.get("/robot-types/lever").json()["state"] == "ready"

    def test_a_picture_is_deleted_if_the_preview_is_deleted_meanwhile(self, cloud: Cloud, anna: Person) -> None:
        """The timer deletes the preview while the checker compiles; files written afterwards are deleted too."""
        found = preview(anna).json()["id"]
        compiler = cloud.functions.model_checks._compiler

        class Slow:
            async def check(self, *arguments: Any) -> Any:
                stored = (await cloud.functions.tables.query(records.ROBOT_TYPES, f"{anna.account}/~{found}")).rows
                for row in stored:
                    await cloud.functions.tables.delete(records.ROBOT_TYPES, row)
                for name in await cloud.functions.blobs.list("robot-types/"):
                    await cloud.functions.blobs.delete(name)
                return await compiler.check(*arguments)

        cloud.functions.model_checks._compiler = Slow()  # type: ignore[assignment]
        check_all(cloud)
        assert blobs(cloud) == ()
