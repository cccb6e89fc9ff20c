"""Robot types of an account: uploaded, used, downloaded and deleted."""

import base64
import io
import zipfile
from pathlib import Path

import pytest

from device_agent.protocol.manifests import robot_type as manifests
from function_app.services.robot_types.delete import AFTER_MS
from function_app.services.robot_types.versions import GIVE_UP_MS
from function_app.services.storage import records
from function_app.services.storage.retention import DAY_MS
from tests.fakes.agent import Robot
from tests.harness.cloud.cloud import Cloud, Person, problem
from tests.harness.paths import UR5
from tests.integration.robot_types.lever import FILES, LEVER, TETRAHEDRON, add, advance, blobs, manifest, rows


def claimed(robot: Robot, owner: Person) -> str:
    """Claim a lever for the owner; returns its id."""
    lever = [{"name": "arm", "kind": "arm", "robot_type": "lever", "label": "Arm"}]
    code = robot.enroll(devices=lever).json()["claim_code"]
    return str(owner.post("/agents/claim", {"code": code}).json()["devices"][0]["id"])


@pytest.mark.usefixtures("checker")
class TestUse:
    def test_a_type_contains_the_limits_for_keyframes(self, anna: Person) -> None:
        nao = anna.get("/robot-types/nao").json()
        assert set(nao["home_rad"]) == {joint["name"] for joint in nao["joints"]}
        assert {"take_posture", "run_behaviour", "drive"} <= set(nao["actions"])
        assert all(len(nao[key]) > 0 for key in ("mimic_joints", "position_dependent_limits", "postures", "behaviours"))
        problem(add(anna, "ur5"), 409, "robot-type-built-in")
        problem(anna.delete("/robot-types/ur5"), 409, "robot-type-built-in")
        ur5 = anna.get("/robot-types/ur5").json()
        assert (ur5["actions"], ur5["mimic_joints"], ur5["postures"]) == (["move_joints", "move_pose"], [], [])

    def test_an_uploaded_type_is_listed_and_used_like_a_built_in_one(self, cloud: Cloud, anna: Person) -> None:
        added = add(anna)
        assert added.status_code == 201, added.text
        assert added.headers["location"] == "/api/v1/robot-types/lever"
        shown = anna.get("/robot-types/lever").json()
        assert shown == added.json()
        assert (shown["state"], shown["version"], shown["built_in"], shown["label"]) == ("ready", 1, False, "Lever")
        assert shown["upload"]["errors"] == []
        assert [joint["name"] for joint in shown["joints"]] == ["shoulder"]
        assert shown["streams"] == [{"name": "joints", "rate_hz": 20.0}]
        assert (shown["home_rad"].keys(), shown["actions"]) == ({"shoulder"}, ["move_joints"])
        assert shown["files"] == {name: len(text) for name, text in {**FILES, "robot.toml": manifest()}.items()}
        source = 'PARAMETERS = {"speed": {"type": "number", "default": 0.5}}\nrobot.home()\n'
        assert anna.put("/robot-types/lever/movements/up", {"source": source}).status_code == 201
        device = claimed(cloud.robot(), anna)
        started = anna.start(device, request={"kind": "run_movement", "name": "up"})
        assert started.status_code == 202, started.text
        assert started.json()["request"]["parameters"] == {"speed": 0.5}

    def test_every_built_in_type_can_be_uploaded(self, anna: Person) -> None:
        for folder in sorted(path.parent for path in UR5.parent.glob("*/robot.toml")):
            files = {
                path.relative_to(folder).as_posix(): path.read_text()
                if path.suffix == ".xml"
                else base64.b64encode(path.read_bytes()).decode()
                for path in folder.rglob("*")
                if path.suffix in {".xml", ".stl", ".obj", ".png"}
            }
            text = (folder / "robot.toml").read_text().replace(f'type = "{folder.name}"', f'type = "my-{folder.name}"')
            added = anna.post("/robot-types", {"manifest": text, "files": files, "wait_ms": 30_000})
            assert added.status_code == 201, added.text

    def test_a_download_equals_the_upload(self, tmp_path: Path, anna: Person) -> None:
        mesh = base64.b64encode(TETRAHEDRON).decode()
        model = LEVER.replace(
            "<worldbody>", '<asset><mesh name="tip" file="meshes/tip.obj"/></asset><worldbody>'
        ).replace('<site name="tip"', '<geom type="mesh" mesh="tip" mass="0.1"/><site name="tip"')
        body = {"manifest": manifest(), "files": {**FILES, "lever.xml": model, "meshes/tip.obj": mesh}}
        assert anna.post("/robot-types", {**body, "wait_ms": 30_000}).status_code == 201
        assert anna.get("/robot-types/lever/files/robot.toml").text == manifest()
        assert anna.get("/robot-types/lever/files/lever.xml").text == model
        found = anna.get("/robot-types/lever/files/meshes/tip.obj")
        assert found.content == TETRAHEDRON
        assert found.headers["content-disposition"] == 'attachment; filename="tip.obj"'
        archive = anna.get("/robot-types/lever/archive")
        assert archive.headers["content-type"] == "application/zip"
        with zipfile.ZipFile(io.BytesIO(archive.content)) as held:
            held.extractall(tmp_path)
        assert manifests.load(tmp_path / "lever").label == "Lever"
        assert (tmp_path / "lever" / "meshes" / "tip.obj").read_bytes() == TETRAHEDRON
        for name in ("other.xml", "%2e%2e/1/lever.xml", "x" * 500, "a%00b"):
            problem(anna.get(f"/robot-types/lever/files/{name}"), 404, "file-unknown")

    def test_another_upload_is_the_next_version(self, cloud: Cloud, anna: Person) -> None:
        add(anna)
        again = add(anna, text=manifest(label='"Better"'))
        assert (again.status_code, again.json()["version"], again.json()["label"]) == (200, 2, "Better")
        assert anna.get("/robot-types/lever/files/robot.toml").text == manifest(label='"Better"')
        jump = add(anna, text=manifest(version="7"))
        assert jump.json()["version"] == 7
        assert add(anna, text=manifest(version="7")).json()["version"] == 8
        advance(cloud, GIVE_UP_MS)
        assert len(rows(cloud, records.ROBOT_TYPES, f"{anna.account}/lever")) == 5, (
            "an old version must remain for a day, for running downloads"
        )
        advance(cloud, DAY_MS + GIVE_UP_MS)
        assert rows(cloud, records.ROBOT_TYPES, f"{anna.account}/lever") == ["type", "version:00000008"]
        assert len(blobs(cloud)) == 4
        assert anna.cloud.sign_in("anna").get("/robot-types/lever").json()["version"] == 8

    def test_a_rejected_version_does_not_replace_the_previous_one(self, cloud: Cloud, anna: Person) -> None:
        add(anna)
        refused = problem(add(anna, lever__xml=LEVER.replace('"shoulder"', '"hip"')), 422, "robot-type-rejected")
        assert refused["version"] == 2
        assert "no joint 'shoulder'; the model has: hip" in refused["errors"][0]
        shown = anna.get("/robot-types/lever").json()
        assert (shown["state"], shown["version"], shown["upload"]["state"]) == ("ready", 1, "rejected")
        assert shown["upload"]["errors"] == refused["errors"]
        assert add(anna).json()["version"] == 3
        advance(cloud, GIVE_UP_MS)
        assert rows(cloud, records.ROBOT_TYPES, f"{anna.account}/lever") == [
            "type",
            "version:00000001",
            "version:00000003",
        ]

    def test_another_account_may_use_the_same_name(self, cloud: Cloud, anna: Person) -> None:
        add(anna)
        bert = cloud.sign_in("bert")
        assert all(item["type"] != "lever" for item in bert.get("/robot-types").json()["items"])
        for path in ("/archive", "/files/robot.toml", "/movements/up/versions"):
            problem(bert.get(f"/robot-types/lever{path}"), 404, "robot-type-unknown")
        other = add(bert, text=manifest(label='"Bert"'))
        assert (other.status_code, other.json()["version"]) == (201, 1)
        assert anna.get("/robot-types/lever").json()["label"] == "Lever"
        assert bert.delete("/robot-types/lever").status_code == 204
        advance(cloud, GIVE_UP_MS)
        assert anna.get("/robot-types/lever/archive").status_code == 200
        assert {name.split("/")[1] for name in blobs(cloud)} == {anna.account}

    def test_lists_page_by_id(self, anna: Person) -> None:
        for name in ("aaa", "mmm", "zzz"):
            assert add(anna, name).status_code == 201
        whole = [item["type"] for item in anna.get("/robot-types").json()["items"]]
        assert whole == sorted(whole)
        assert {"aaa", "mmm", "ur5", "zzz"} <= set(whole)
        for limit in (1, 2, 3):
            pages = anna.each_page("/robot-types", limit=limit)
            assert max(map(len, pages)) <= limit
            assert [item["type"] for page in pages for item in page] == whole
        problem(anna.get("/robot-types", params={"cursor": "*"}), 422, "cursor-invalid")


@pytest.mark.usefixtures("checker")
class TestDeletion:
    def test_a_type_in_use_cannot_be_deleted_and_its_users_are_named(self, cloud: Cloud, anna: Person) -> None:
        add(anna)
        anna.put("/robot-types/lever/movements/up", {"source": "1"})
        robot = cloud.robot()
        device = claimed(robot, anna)
        refused = problem(anna.delete("/robot-types/lever"), 409, "robot-type-in-use")
        assert (refused["devices"], refused["movements"]) == ([device], ["up"])
        anna.delete(f"/agents/{robot.id}")
        refused = problem(anna.delete("/robot-types/lever"), 409, "robot-type-in-use")
        assert (refused["devices"], refused["movements"]) == ([], ["up"])
        anna.delete("/robot-types/lever/movements/up")
        assert anna.delete("/robot-types/lever").status_code == 204
        problem(anna.get("/robot-types/lever"), 404, "robot-type-unknown")
        problem(anna.delete("/robot-types/lever"), 404, "robot-type-unknown")

    def test_files_are_deleted_and_version_numbers_are_never_reused(self, cloud: Cloud, anna: Person) -> None:
        add(anna)
        assert anna.delete("/robot-types/lever").status_code == 204
        again = add(anna)
        assert (again.status_code, again.json()["version"]) == (201, 2)
        advance(cloud, AFTER_MS)
        assert {name.split("/")[3] for name in blobs(cloud)} == {"2"}
        assert anna.get("/robot-types/lever/archive").status_code == 200
        assert anna.delete("/robot-types/lever").status_code == 204
        advance(cloud, AFTER_MS)
        assert blobs(cloud) == ()
        assert rows(cloud, records.ROBOT_TYPES, f"{anna.account}/lever") == ["type"]
        assert not [key for key in rows(cloud, records.MEMBERS, anna.account) if key.startswith("type:")]
