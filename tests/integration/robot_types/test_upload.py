"""Robot types of an account: uploaded, compiled by a checker, used, downloaded, deleted."""

import asyncio
import base64
import contextlib
import copy
import ctypes
import io
import os
import subprocess
import sys
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from device_agent.protocol.manifests import robot_type as manifests
from device_agent.protocol.manifests.robot_type import RobotType
from function_app.adapters.model_compiler.compiler import MujocoCompiler
from function_app.entrypoints.hosts.worker import check_models
from function_app.entrypoints.http.robot_types.schemas import MAX_UPLOAD
from function_app.ports.model_compiler import CompilerMissingError, ModelReport
from function_app.ports.tables import Row
from function_app.services.robot_types.cleanup import CUT_OFF, NO_CHECKER
from function_app.services.robot_types.delete import AFTER_MS
from function_app.services.robot_types.model_validation import LEASE_MS, MAX_TRIES
from function_app.services.robot_types.package_reader import MAX_BYTES, MAX_FILES
from function_app.services.robot_types.rows import Place
from function_app.services.robot_types.versions import GIVE_UP_MS
from function_app.services.storage import records
from function_app.services.storage.retention import DAY_MS
from tests.fakes.clock import MovingClock
from tests.harness.cloud.cloud import Cloud, Person, problem, settings
from tests.harness.network.brokers import PATIENCE_S, wait_until
from tests.harness.paths import UR5

MANIFEST = """
type = "TYPE"
version = 1
label = "Lever"
kind = "arm"
description = "One joint."
model = "lever.xml"
scene = "scene.xml"
driver = "mujoco"
period_ms = 8
braking_rad_s2 = 20.0
frames = ["tip"]
capabilities = ["joints", "movements"]
home_rad = { shoulder = 0.1 }

[[streams]]
name = "joints"
rate_hz = 20.0

[[joints]]
name = "shoulder"
label = "Shoulder"
lower_rad = -1.0
upper_rad = 1.0
max_velocity_rad_s = 2.0
max_acceleration_rad_s2 = 8.0
max_jerk_rad_s3 = 80.0
max_effort_nm = 20.0
"""
LEVER = """<mujoco model="lever"><compiler angle="radian"/>
  <worldbody>
    <body name="base">
      <geom type="box" size="0.05 0.05 0.05"/>
      <body name="beam">
        <joint name="shoulder" range="-1 1" axis="0 1 0" damping="1"/>
        <geom type="capsule" size="0.02" fromto="0 0 0 0 0 0.3" mass="0.5"/>
        <site name="tip" pos="0 0 0.3"/>
      </body>
    </body>
  </worldbody>
  <actuator><position name="shoulder" joint="shoulder" kp="50" ctrlrange="-1 1" forcerange="-20 20"/></actuator>
</mujoco>
"""
SCENE = """<mujoco>
  <include file="lever.xml"/>
  <worldbody><geom type="plane" size="1 1 0.1" pos="0 0 -0.2"/></worldbody>
</mujoco>
"""
FILES = {"lever.xml": LEVER, "scene.xml": SCENE}
TETRAHEDRON = b"v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"


def manifest(robot_type: str = "lever", **changes: str) -> str:
    text = MANIFEST.replace("TYPE", robot_type)
    for old, new in changes.items():
        before = next(line for line in text.splitlines() if line.startswith(f"{old} = "))
        text = text.replace(before, f"{old} = {new}" if new else "", 1)
    return text


def add(who: Person, robot_type: str = "lever", *, wait_ms: int = 30_000, text: str = "", **files: str) -> Any:
    """Upload; ``lever__xml`` replaces ``lever.xml``."""
    changed = {name.replace("__", "."): content for name, content in files.items()}
    body = {"manifest": text or manifest(robot_type), "files": {**FILES, **changed}, "wait_ms": wait_ms}
    return who.post("/robot-types", body)


@pytest.fixture
def cloud(home: Path) -> Iterator[Cloud]:
    """The functions without a broker, and without a checker."""
    with Cloud(settings(home), clock=MovingClock()) as cloud:
        yield cloud


@pytest.fixture
def anna(cloud: Cloud) -> Person:
    return cloud.sign_in("anna")


@contextlib.contextmanager
def checking(cloud: Cloud, count: int = 1) -> Iterator[None]:
    """Some checkers at work."""

    async def start() -> list[asyncio.Task[None]]:
        return [asyncio.create_task(check_models(cloud.functions, drain=False)) for _ in range(count)]

    async def stop(tasks: list[asyncio.Task[None]]) -> None:
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)

    tasks = cloud.run(start())
    try:
        yield
    finally:
        cloud.run(stop(tasks))


@pytest.fixture
def checker(cloud: Cloud) -> Iterator[None]:
    with checking(cloud):
        yield


def blobs(cloud: Cloud, prefix: str = "robot-types/") -> tuple[str, ...]:
    return cloud.run(cloud.functions.blobs.list(prefix))


def rows(cloud: Cloud, table: str, partition: str) -> list[str]:
    return [row.key for row in cloud.run(cloud.functions.tables.query(table, partition, limit=1000)).rows]


def check_all(cloud: Cloud) -> None:
    """What a checker does, by hand."""
    while cloud.run(cloud.functions.model_checks.run()):
        pass


def advance(cloud: Cloud, ms: int) -> None:
    cloud.clock.advance(ms / 1000)
    cloud.run(cloud.functions.scheduler._robot_types.run_due_jobs())


@pytest.mark.usefixtures("checker")
class TestLife:
    def test_it_says_what_keyframes_are_checked_by(self, anna: Person) -> None:
        nao = anna.get("/robot-types/nao").json()
        assert set(nao["home_rad"]) == {joint["name"] for joint in nao["joints"]}
        assert {"take_posture", "run_behaviour", "drive"} <= set(nao["actions"])
        assert all(len(nao[key]) > 0 for key in ("mimic_joints", "position_dependent_limits", "postures", "behaviours"))
        ur5 = anna.get("/robot-types/ur5").json()
        assert (ur5["actions"], ur5["mimic_joints"], ur5["postures"]) == (["move_joints"], [], [])

    def test_one_is_added_seen_and_used_like_a_built_in_one(self, cloud: Cloud, anna: Person) -> None:
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
        robot = cloud.robot()
        spec = [{"name": "arm", "kind": "arm", "robot_type": "lever", "label": "Arm"}]
        code = robot.enroll(devices=spec).json()["claim_code"]
        device = anna.post("/agents/claim", {"code": code}).json()["devices"][0]["id"]
        started = anna.start(device, request={"kind": "run_movement", "name": "up"})
        assert started.status_code == 202, started.text
        assert started.json()["request"]["parameters"] == {"speed": 0.5}

    def test_every_built_in_one_could_have_been_uploaded(self, anna: Person) -> None:
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

    def test_it_is_downloaded_as_it_was_uploaded(self, tmp_path: Path, anna: Person) -> None:
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

    def test_uploading_again_makes_the_next_version(self, cloud: Cloud, anna: Person) -> None:
        add(anna)
        again = add(anna, text=manifest(label='"Better"'))
        assert (again.status_code, again.json()["version"], again.json()["label"]) == (200, 2, "Better")
        assert anna.get("/robot-types/lever/files/robot.toml").text == manifest(label='"Better"')
        jump = add(anna, text=manifest(version="7"))
        assert jump.json()["version"] == 7
        assert add(anna, text=manifest(version="7")).json()["version"] == 8
        advance(cloud, GIVE_UP_MS)
        assert len(rows(cloud, records.ROBOT_TYPES, f"{anna.account}/lever")) == 5, "a day for who has begun a download"
        advance(cloud, DAY_MS + GIVE_UP_MS)
        assert rows(cloud, records.ROBOT_TYPES, f"{anna.account}/lever") == ["type", "version:00000008"]
        assert len(blobs(cloud)) == 4
        assert anna.cloud.sign_in("anna").get("/robot-types/lever").json()["version"] == 8

    def test_a_refused_version_leaves_the_one_before_in_use(self, cloud: Cloud, anna: Person) -> None:
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

    def test_another_account_sees_nothing_of_it_and_may_have_its_own(self, cloud: Cloud, anna: Person) -> None:
        add(anna)
        bert = cloud.sign_in("bert")
        assert all(item["type"] != "lever" for item in bert.get("/robot-types").json()["items"])
        for path in ("", "/movements", "/archive", "/files/robot.toml", "/movements/up", "/movements/up/versions"):
            problem(bert.get(f"/robot-types/lever{path}"), 404, "robot-type-unknown")
        problem(bert.put("/robot-types/lever/movements/up", {"source": "1"}), 404, "robot-type-unknown")
        problem(bert.delete("/robot-types/lever"), 404, "robot-type-unknown")
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
            found, cursor = [], None
            while True:
                query = {"limit": limit, **({"cursor": cursor} if cursor else {})}
                page = anna.get("/robot-types", params=query).json()
                assert len(page["items"]) <= limit
                found += [item["type"] for item in page["items"]]
                cursor = page["cursor"]
                if cursor is None:
                    break
            assert found == whole
        problem(anna.get("/robot-types", params={"cursor": "*"}), 422, "cursor-invalid")

    def test_a_built_in_id_is_taken(self, anna: Person) -> None:
        problem(add(anna, "ur5"), 409, "robot-type-built-in")
        problem(anna.delete("/robot-types/ur5"), 409, "robot-type-built-in")


@pytest.mark.usefixtures("checker")
class TestDeletion:
    def test_what_is_in_use_stays_and_says_who_uses_it(self, cloud: Cloud, anna: Person) -> None:
        add(anna)
        anna.put("/robot-types/lever/movements/up", {"source": "1"})
        robot = cloud.robot()
        spec = [{"name": "arm", "kind": "arm", "robot_type": "lever", "label": "Arm"}]
        code = robot.enroll(devices=spec).json()["claim_code"]
        device = anna.post("/agents/claim", {"code": code}).json()["devices"][0]["id"]
        refused = problem(anna.delete("/robot-types/lever"), 409, "robot-type-in-use")
        assert (refused["devices"], refused["movements"]) == ([device], ["up"])
        anna.delete(f"/agents/{robot.id}")
        refused = problem(anna.delete("/robot-types/lever"), 409, "robot-type-in-use")
        assert (refused["devices"], refused["movements"]) == ([], ["up"])
        anna.delete("/robot-types/lever/movements/up")
        assert anna.delete("/robot-types/lever").status_code == 204
        problem(anna.get("/robot-types/lever"), 404, "robot-type-unknown")
        problem(anna.delete("/robot-types/lever"), 404, "robot-type-unknown")

    def test_its_files_go_and_its_versions_are_never_used_twice(self, cloud: Cloud, anna: Person) -> None:
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


class TestChecker:
    def test_without_one_the_upload_waits_and_is_refused_in_the_end(self, cloud: Cloud, anna: Person) -> None:
        added = add(anna, wait_ms=0)
        assert (added.status_code, added.json()["state"]) == (202, "checking")
        problem(anna.get("/robot-types/lever/archive"), 409, "robot-type-not-ready")
        problem(anna.get("/robot-types/lever/movements"), 409, "robot-type-not-ready")
        problem(anna.put("/robot-types/lever/movements/up", {"source": "1"}), 409, "robot-type-not-ready")
        problem(add(anna, wait_ms=0), 409, "robot-type-checking")
        advance(cloud, GIVE_UP_MS - 1_000)
        assert anna.get("/robot-types/lever").json()["state"] == "checking"
        advance(cloud, 1_000)
        shown = anna.get("/robot-types/lever").json()
        assert (shown["state"], shown["upload"]["errors"]) == ("rejected", [NO_CHECKER])
        check_all(cloud)
        assert anna.get("/robot-types/lever").json()["state"] == "rejected", "a verdict stays"
        assert add(anna, wait_ms=0).json()["version"] == 2
        check_all(cloud)
        assert anna.get("/robot-types/lever").json()["state"] == "ready"
        assert rows(cloud, records.MODEL_CHECKS, "checks") == []

    def test_one_that_is_killed_is_followed_by_another(self, cloud: Cloud, anna: Person) -> None:
        add(anna, wait_ms=0)
        with dies_in(cloud):
            check_all(cloud)
        assert rows(cloud, records.MODEL_CHECKS, "checks"), "the note outlives it"
        check_all(cloud)
        assert anna.get("/robot-types/lever").json()["state"] == "checking", "somebody may still be at it"
        advance(cloud, LEASE_MS)
        check_all(cloud)
        assert anna.get("/robot-types/lever").json()["state"] == "ready"

    def test_a_model_that_kills_every_one_is_refused(self, cloud: Cloud, anna: Person) -> None:
        add(anna, wait_ms=0)
        for _ in range(MAX_TRIES):
            with dies_in(cloud):
                check_all(cloud)
            cloud.clock.advance(LEASE_MS / 1000)
        check_all(cloud)
        shown = anna.get("/robot-types/lever").json()
        assert shown["state"] == "rejected"
        assert "cut off" in shown["upload"]["errors"][0]

    def test_many_give_each_upload_one_verdict(
        self, cloud: Cloud, anna: Person, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        compiled: list[str] = []

        async def counting(__: object, robot_type: RobotType, *_: object) -> ModelReport:
            compiled.append(robot_type.type)
            await asyncio.sleep(0.01)
            return ModelReport()

        monkeypatch.setattr(MujocoCompiler, "check", counting)
        names = [f"lever-{number}" for number in range(12)]
        waiting = [
            anna.begin("POST", "/robot-types", json={"manifest": manifest(name), "files": FILES, "wait_ms": 30_000})
            for name in names
        ]
        with checking(cloud, 4):
            assert [answer().status_code for answer in waiting] == [201] * 12
        assert sorted(compiled) == sorted(names)

    def test_while_one_is_busy_the_others_wait_for_their_turn(self, cloud: Cloud, anna: Person) -> None:
        add(anna, "first", wait_ms=0)
        add(anna, "second", wait_ms=0)
        cloud.clock.advance((GIVE_UP_MS - 1_000) / 1000)
        with dies_in(cloud):
            cloud.run(cloud.functions.model_checks.run())
        advance(cloud, 1_000)
        assert anna.get("/robot-types/second").json()["state"] == "checking"
        check_all(cloud)
        assert anna.get("/robot-types/second").json()["state"] == "ready"

    def test_one_without_mujoco_says_so_and_gives_the_note_back(
        self, cloud: Cloud, anna: Person, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        add(anna, wait_ms=0)
        with monkeypatch.context() as patch:
            patch.setattr("importlib.util.find_spec", lambda _: None)
            with pytest.raises(CompilerMissingError, match="MuJoCo is not installed"):
                cloud.run(check_models(cloud.functions, drain=True))
            with pytest.raises(CompilerMissingError):
                check_all(cloud)
        check_all(cloud)
        assert anna.get("/robot-types/lever").json()["state"] == "ready"

    def test_of_two_uploads_at_once_each_gets_a_version_or_is_told_to_wait(self, cloud: Cloud, anna: Person) -> None:
        body = {"manifest": manifest(), "files": FILES, "wait_ms": 0}
        waiting = [anna.begin("POST", "/robot-types", json=body) for _ in range(6)]
        answers = [answer() for answer in waiting]
        assert [answer.status_code for answer in answers].count(202) == 1
        for answer in answers:
            if answer.status_code != 202:
                problem(answer, 409, "robot-type-checking")
        check_all(cloud)
        assert anna.get("/robot-types/lever").json()["version"] == 1

    def test_an_upload_that_is_cut_off_at_any_write_is_ended_and_leaves_nothing(
        self, cloud: Cloud, anna: Person, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        cut = 0
        for after in range(1, 40):
            with monkeypatch.context() as patch:
                stop_after(cloud, patch, after)
                done = add(anna, wait_ms=0)
            if done.status_code == 202:
                break
            cut += 1
            assert done.status_code == 500
            advance(cloud, GIVE_UP_MS)
            state = anna.get("/robot-types/lever")
            if state.status_code == 200:
                assert state.json()["upload"]["errors"][0] in {CUT_OFF, NO_CHECKER}
            else:
                problem(state, 404, "robot-type-unknown")
            anna = cloud.sign_in("anna")
        assert cut > 5
        check_all(cloud)
        assert anna.get("/robot-types/lever").json()["state"] == "ready"
        advance(cloud, DAY_MS)
        advance(cloud, DAY_MS)
        assert len({name.split("/")[3] for name in blobs(cloud)}) == 1
        assert rows(cloud, records.MODEL_CHECKS, "checks") == []
        assert rows(cloud, records.MODEL_CHECKS, "looks") == []


@contextlib.contextmanager
def dies_in(cloud: Cloud) -> Iterator[None]:
    """A checker that is killed while it compiles: nothing it would have written then is written."""

    class KilledError(Exception):
        pass

    async def killed(*_: object) -> tuple[str, ...]:
        raise KilledError

    checks = cloud.functions.model_checks
    known = checks._compiler
    dying = MujocoCompiler()
    dying.check = killed  # type: ignore[assignment, method-assign]
    checks._compiler = dying
    try:
        with contextlib.suppress(KilledError):
            yield
    finally:
        checks._compiler = known


def stop_after(cloud: Cloud, patch: pytest.MonkeyPatch, writes: int) -> None:
    """Let the functions end with the write of this number."""
    left = writes

    def counted(call: Callable[..., Any]) -> Callable[..., Any]:
        async def made(*arguments: Any, **options: Any) -> Any:
            nonlocal left
            left -= 1
            if left < 0:
                raise RuntimeError("killed")
            return await call(*arguments, **options)

        return made

    for target, names in ((cloud.functions.tables, ("create", "replace", "batch")), (cloud.functions.blobs, ("put",))):
        for name in names:
            patch.setattr(target, name, counted(getattr(target, name)))


@pytest.fixture(scope="module")
def bert(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Person]:
    """Somebody whose uploads are checked, for tests that leave nothing behind but versions."""
    with Cloud(settings(tmp_path_factory.mktemp("home")), clock=MovingClock()) as cloud, checking(cloud):
        yield cloud.sign_in("bert")


class TestHostileUploads:
    @pytest.mark.parametrize(
        ("xml", "words"),
        [
            ("<mujoco><worldbody><body></worldbody></mujoco>", ["lever.xml", "XML_ERROR_MISMATCHED_ELEMENT", "Line"]),
            (LEVER.replace('type="box"', 'type="boxx"'), ["lever.xml", "invalid keyword: 'boxx'", "line 4"]),
            (LEVER.replace("<site", "<sight"), ["lever.xml", "unrecognized element", "'sight'", "line 8"]),
            (
                LEVER.replace("<worldbody>", '<asset><mesh name="m" file="nothing.stl"/></asset><worldbody>'),
                ["lever.xml", "nothing.stl"],
            ),
            (LEVER.replace("<worldbody>", '<include file="more.xml"/><worldbody>'), ["lever.xml", "more.xml"]),
            (LEVER.replace("<worldbody>", '<include file="lever.xml"/><worldbody>'), ["lever.xml", "already included"]),
            (LEVER.replace('range="-1 1"', 'range="-0.5 0.5"'), ["range of joint 'shoulder' is -0.5000 to 0.5000"]),
            (LEVER.replace('ctrlrange="-1 1"', 'ctrlrange="0 1"'), ["control range of actuator 'shoulder'"]),
            (LEVER.replace("<position", "<motor").replace(' kp="50"', ""), ["'shoulder' is not a position servo"]),
            (
                LEVER.replace('<position name="shoulder"', '<position name="hip"'),
                ["no actuator 'shoulder'", "has: hip"],
            ),
            (LEVER.replace('<site name="tip"', '<site name="top"'), ["no site or body 'tip'", "top"]),
            (
                LEVER.replace(' range="-1 1" axis="0 1 0"', ' type="ball"')
                .replace("<actuator>", "<!--")
                .replace("</actuator>", "-->"),
                ["neither a hinge nor a slide"],
            ),
            (
                LEVER.replace('mass="0.5"', 'mass="1e-9"')
                .replace('kp="50"', 'kp="1e9"')
                .replace(' forcerange="-20 20"', ""),
                ["unstable at home"],
            ),
            ("", ["lever.xml", "empty"]),
            ("<mujoco/>", ["no joint 'shoulder'"]),
            ("<robot name='x'/>", ["lever.xml"]),
            ("\x00\x01", ["lever.xml"]),
        ],
    )
    def test_what_mujoco_refuses_is_refused_in_its_words(self, bert: Person, xml: str, words: list[str]) -> None:
        refused = problem(add(bert, lever__xml=xml), 422, "robot-type-rejected")
        text = " ".join(refused["errors"])
        for word in words:
            assert word in text
        assert "/tmp" not in text

    def test_wheels_that_its_model_does_not_have_are_refused(self, bert: Person) -> None:
        wheels = '[simulation.wheels]\nleft = "shoulder"\nright = "wheel"\nradius_m = 0.05\ntrack_m = 0.3\n'
        refused = problem(add(bert, text=manifest() + wheels), 422, "robot-type-rejected")
        assert refused["errors"] == [
            "lever.xml: actuator 'shoulder' is not a velocity servo on a hinge, with a control range.",
            "lever.xml: no actuator 'wheel'; the model has: shoulder.",
        ]

    @pytest.mark.parametrize(
        "inside",
        [
            '<include file="/etc/passwd"/>',
            '<include file="../1/lever.xml"/>',
            '<include file="a/../../x.xml"/>',
            '<include file="..\\\\x.xml"/>',
            '<include file="&#47;etc/passwd"/>',
            '<asset><mesh name="m" file="/etc/hosts.stl"/></asset>',
            '<asset><texture name="t" type="skybox" fileup="/x.png"/></asset>',
            '<asset><hfield name="h" file="C:x.png" size="1 1 1 1"/></asset>',
            '<compiler meshdir="/usr"/>',
            '<compiler texturedir=".."/>',
            '<compiler assetdir="~"/>',
        ],
    )
    def test_a_reference_out_of_the_folder_is_refused_unread(self, bert: Person, inside: str) -> None:
        before = blobs(bert.cloud)
        refused = problem(
            add(bert, lever__xml=LEVER.replace("<worldbody>", inside + "<worldbody>", 1)), 422, "robot-type-invalid"
        )
        assert "lever.xml" in refused["detail"]
        assert blobs(bert.cloud) == before

    def test_entities_are_refused(self, bert: Person) -> None:
        doctype = '<!DOCTYPE m [<!ENTITY a "aaaaaaaaaa"><!ENTITY b "&a;&a;&a;&a;&a;&a;&a;&a;&a;">]>'
        problem(add(bert, lever__xml=doctype + LEVER), 422, "robot-type-invalid")

    def test_what_only_mujoco_can_read_is_never_good(self, bert: Person) -> None:
        """Its parser takes more than ours: what ours cannot read it cannot have looked at."""
        lenient = LEVER.replace('model="lever"', 'model="&nothing;"')
        refused = problem(add(bert, lever__xml=lenient), 422, "robot-type-rejected")
        assert "undefined entity" in refused["errors"][0]

    @pytest.mark.parametrize(
        "name",
        [
            "../x.xml",
            "/x.xml",
            "a/../x.xml",
            "a//x.xml",
            "./x.xml",
            ".x.xml",
            "a\\x.xml",
            "C:x.xml",
            "x.XML",
            "x.xml/",
            "x.py",
            "robot.toml",
            "x.so",
            "x",
            "",
            "x\x00.xml",
            "ä.xml",
            "a/b/c/d/e.xml",
            "x" * 130 + ".xml",
            "lever.xml/x.xml",
            "PK\x03\x04.xml",
        ],
    )
    def test_a_file_that_is_called_what_a_file_may_not_be_called_is_refused(self, bert: Person, name: str) -> None:
        body = {"manifest": manifest(), "files": {**FILES, name: "<mujoco/>"}}
        problem(bert.post("/robot-types", body), 422, "robot-type-invalid")

    @pytest.mark.parametrize(
        ("change", "words"),
        [
            ({"type": '"a b"'}, "type"),
            ({"type": '"../x"'}, "type"),
            ({"type": f'"{"x" * 65}"'}, "type"),
            ({"version": "0"}, "version"),
            ({"version": "10000000"}, "version"),
            ({"version": '"x"'}, "version"),
            ({"model": '"other.xml"'}, "lever.xml, scene.xml"),
            ({"scene": '"../scene.xml"'}, "scene"),
            ({"model": '"robot.toml"'}, "model"),
            ({"period_ms": "0"}, "period_ms"),
            ({"braking_rad_s2": "nan"}, "braking_rad_s2"),
            ({"lower_rad": "-inf"}, "lower_rad"),
            ({"max_velocity_rad_s": "0"}, "max_velocity_rad_s"),
            ({"home_rad": "{ shoulder = 2 }"}, "home_rad"),
            ({"home_rad": "{ shoulder = nan }"}, "home_rad"),
            ({"home_rad": "{}"}, "home_rad"),
            ({"label": ""}, "label"),
            ({"label": "="}, "line"),
            ({"driver": '"mujoco"\nsurprise = 1'}, "surprise"),
        ],
    )
    def test_a_manifest_says_which_field_is_wrong(self, bert: Person, change: dict[str, str], words: str) -> None:
        refused = problem(add(bert, text=manifest(**change)), 422, "manifest-invalid")
        assert words in refused["detail"]

    def test_sizes_are_limited(self, bert: Person) -> None:
        many = {f"f{number}.xml": "<mujoco/>" for number in range(MAX_FILES - 1)}
        problem(bert.post("/robot-types", {"manifest": manifest(), "files": {**FILES, **many}}), 422, "invalid")
        big = base64.b64encode(bytes(MAX_BYTES)).decode()
        problem(
            bert.post("/robot-types", {"manifest": manifest(), "files": {**FILES, "m.stl": big}}),
            422,
            "robot-type-invalid",
        )
        problem(bert.ask("POST", "/robot-types", content=b" " * (MAX_UPLOAD + 1)), 413, "too-large")
        problem(
            bert.post("/robot-types", {"manifest": manifest(), "files": {**FILES, "m.stl": "%"}}),
            422,
            "robot-type-invalid",
        )

    def test_a_large_mesh_arrives(self, bert: Person) -> None:
        body = {"manifest": manifest(), "files": {**FILES, "m.png": base64.b64encode(bytes(5_900_000)).decode()}}
        added = bert.post("/robot-types", {**body, "wait_ms": 30_000})
        assert added.status_code in {200, 201}, added.text
        assert added.json()["files"]["m.png"] == 5_900_000


class TestProcesses:
    """The checker as people run it: a program of its own over the same store."""

    def start(self, cloud: Cloud, *arguments: str) -> subprocess.Popen[bytes]:
        environment = {**os.environ, "TELESCOPE_HOME": str(cloud.functions.settings.home)}
        return subprocess.Popen([sys.executable, "-m", "function_app", "check-models", *arguments], env=environment)

    def test_it_checks_what_is_there_and_ends(self, cloud: Cloud, anna: Person) -> None:
        add(anna, "first", wait_ms=0)
        add(anna, "second", wait_ms=0)
        assert self.start(cloud, "--drain").wait(PATIENCE_S) == 0
        assert [anna.get(f"/robot-types/{name}").json()["state"] for name in ("first", "second")] == ["ready", "ready"]

    def test_what_a_killed_one_had_taken_is_checked_by_the_next(self, cloud: Cloud, anna: Person) -> None:
        endless = LEVER.replace("<site", '<replicate count="1000000"><body/></replicate><site')
        add(anna, wait_ms=0, lever__xml=endless)
        running = self.start(cloud)
        try:
            wait_until(lambda: taken(cloud), "the note to be taken")
        finally:
            running.kill()
            running.wait()
        cloud.clock.advance(LEASE_MS / 1000)
        cloud.functions.model_checks._compiler = MujocoCompiler(cpu_s=1)
        check_all(cloud)
        shown = anna.get("/robot-types/lever").json()
        assert (shown["state"], len(shown["upload"]["errors"])) == ("rejected", 1)


def taken(cloud: Cloud) -> bool:
    """Whether a checker holds a note."""
    page = cloud.run(cloud.functions.tables.query(records.MODEL_CHECKS, "checks"))
    return any(note.data["until_ms"] for note in page.rows)


class TestLimits:
    @pytest.mark.parametrize(
        "xml",
        [
            LEVER.replace("<site", '<replicate count="1000000"><body/></replicate><site'),
            LEVER.replace(
                "</mujoco>", '<asset><hfield name="h" nrow="30000" ncol="30000" size="1 1 1 1"/></asset></mujoco>'
            ),
            LEVER.replace("<worldbody>", '<size memory="100G"/><worldbody>'),
        ],
        ids=["bodies", "heights", "memory"],
    )
    def test_a_model_that_would_eat_the_machine_is_refused(
        self, cloud: Cloud, anna: Person, xml: str, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr(cloud.functions.model_checks, "_compiler", MujocoCompiler(cpu_s=2, wall_s=20))
        with checking(cloud):
            refused = problem(add(anna, lever__xml=xml), 422, "robot-type-rejected")
        assert refused["errors"]

    def test_a_child_that_waits_for_ever_is_ended(
        self, cloud: Cloud, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
    ) -> None:
        child = tmp_path / "child.py"
        child.write_text("import time\ntime.sleep(1000)\n")
        monkeypatch.setattr("function_app.adapters.model_compiler.compiler._CHILD", child)
        compiler = MujocoCompiler(wall_s=1)
        found = cloud.run(compiler.check(manifests.parse(manifest()), {"lever.xml": b""}))
        assert "Simplify" in found.errors[0]

    def test_the_child_reads_nothing_but_the_upload(self, cloud: Cloud, tmp_path: Path) -> None:
        """Past the look at references: what the kernel itself refuses, where it can."""
        outside = tmp_path / "outside.xml"
        outside.write_text(LEVER)
        xml = f'<mujoco><include file="{outside}"/></mujoco>'.encode()
        compiler = MujocoCompiler()
        found = cloud.run(compiler.check(manifests.parse(manifest()), {"lever.xml": xml, "scene.xml": xml}))
        # Where the kernel has no Landlock, the look at references has to do alone.
        assert bool(found.errors) == (ctypes.CDLL(None).syscall(444, None, 0, 1) > 0)


class TestSeal:
    """Somebody can write to the stores: what was checked is used, or nothing."""

    @pytest.fixture
    def lever(self, cloud: Cloud, anna: Person) -> Place:
        assert add(anna, wait_ms=0).status_code < 300
        check_all(cloud)
        assert anna.get("/robot-types/lever/files/robot.toml").status_code == 200
        return Place(anna.account, "lever")

    def change(self, cloud: Cloud, place: Place, key: str, edit: Callable[[dict[str, Any]], object]) -> None:
        row = cloud.run(cloud.functions.tables.get(records.ROBOT_TYPES, place.partition, key))
        assert row is not None
        data = copy.deepcopy(dict(row.data))
        edit(data)
        cloud.run(cloud.functions.tables.replace(records.ROBOT_TYPES, Row(row.partition, row.key, data, row.etag)))

    def test_no_byte_of_a_manifest_or_a_model_may_differ(self, cloud: Cloud, anna: Person, lever: Place) -> None:
        for name in ("robot.toml", "lever.xml"):
            blob = lever.prefix(1) + name
            good = cloud.run(cloud.functions.blobs.get(blob))
            assert good is not None
            for index in range(0, len(good), 23):
                bad = good[:index] + bytes([good[index] ^ 1]) + good[index + 1 :]
                cloud.run(cloud.functions.blobs.put(blob, bad))
                problem(anna.get(f"/robot-types/lever/files/{name}"), 409, "robot-type-damaged")
            cloud.run(cloud.functions.blobs.put(blob, good))
            assert anna.get(f"/robot-types/lever/files/{name}").content == good

    def test_no_field_of_it_may_differ_and_no_other_seal_fits(self, cloud: Cloud, anna: Person, lever: Place) -> None:
        first = cloud.run(cloud.functions.tables.get(records.ROBOT_TYPES, lever.partition, "type"))
        assert first is not None
        good = copy.deepcopy(dict(first.data))
        edits: tuple[Callable[[dict[str, Any]], object], ...] = (
            lambda data: data["manifest"].update(label="Another"),
            lambda data: data["manifest"]["joints"][0].update(max_velocity_rad_s=99.0),
            lambda data: data["manifest"].update(type="ur5"),
            lambda data: data["seal"].update(signature=data["seal"]["signature"][::-1]),
            lambda data: data["seal"].update(key="0" * 16),
            lambda data: data["seal"]["hashes"].update({"lever.xml": "0" * 64}),
            lambda data: data.pop("seal"),
        )
        for edit in edits:
            self.change(cloud, lever, "type", edit)
            problem(anna.get("/robot-types/lever/files/robot.toml"), 409, "robot-type-damaged")
            self.change(cloud, lever, "type", lambda data: data.update(copy.deepcopy(good)))
        assert anna.get("/robot-types/lever/files/robot.toml").status_code == 200

        bert = cloud.sign_in("bert")
        add(bert, wait_ms=0)
        add(anna, wait_ms=0)
        check_all(cloud)
        self.change(cloud, Place(bert.account, "lever"), "type", lambda data: data.update(seal=good["seal"]))
        problem(bert.get("/robot-types/lever/files/robot.toml"), 409, "robot-type-damaged")
        # An older version passed off as the newest.
        old = {"manifest": good["manifest"], "seal": good["seal"]}
        self.change(cloud, lever, "type", lambda data: data.update(old))
        problem(anna.get("/robot-types/lever/files/robot.toml"), 409, "robot-type-damaged")
