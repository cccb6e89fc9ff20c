"""Compilation of uploaded models: concurrent checkers, limits and separate processes."""

import asyncio
import os
import subprocess
import sys
from pathlib import Path
from typing import cast

import pytest

from device_agent.protocol.manifests import robot_type as manifests
from device_agent.protocol.manifests.robot_type import RobotType
from function_app.adapters.model_compiler.compiler import MujocoCompiler
from function_app.entrypoints.hosts.worker import check_models
from function_app.ports.model_compiler import CompilerMissingError, ModelReport
from function_app.services.robot_types.cleanup import INTERRUPTED, NO_VALIDATOR
from function_app.services.robot_types.model_validation import LEASE_MS, MAX_TRIES
from function_app.services.robot_types.versions import GIVE_UP_MS
from function_app.services.storage import records
from function_app.services.storage.retention import DAY_MS
from tests.harness.cloud.cloud import Cloud, Person, problem
from tests.harness.network.brokers import PATIENCE_S, wait_until
from tests.integration.robot_types.lever import (
    FILES,
    LEVER,
    add,
    advance,
    blobs,
    check_all,
    checking,
    killed_checker,
    manifest,
    rows,
    stop_after,
)


class AcceptingCompiler:
    """A compiler without errors."""

    async def check(self, *_: object) -> ModelReport:
        return ModelReport()


class TestChecker:
    def test_without_a_checker_the_upload_waits_and_is_rejected_after_the_time_limit(
        self, cloud: Cloud, anna: Person
    ) -> None:
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
        assert (shown["state"], shown["upload"]["errors"]) == ("rejected", [NO_VALIDATOR])
        check_all(cloud)
        assert anna.get("/robot-types/lever").json()["state"] == "rejected", "a result must not change"
        assert add(anna, wait_ms=0).json()["version"] == 2
        check_all(cloud)
        assert anna.get("/robot-types/lever").json()["state"] == "ready"
        assert rows(cloud, records.MODEL_CHECKS, "checks") == []

    def test_another_checker_continues_after_a_kill(self, cloud: Cloud, anna: Person) -> None:
        add(anna, wait_ms=0)
        with killed_checker(cloud):
            check_all(cloud)
        assert rows(cloud, records.MODEL_CHECKS, "checks"), "the pending check must remain"
        check_all(cloud)
        assert anna.get("/robot-types/lever").json()["state"] == "checking", "another checker may still process it"
        advance(cloud, LEASE_MS)
        check_all(cloud)
        assert anna.get("/robot-types/lever").json()["state"] == "ready"

    def test_a_model_that_kills_every_checker_is_rejected(self, cloud: Cloud, anna: Person) -> None:
        add(anna, wait_ms=0)
        for _ in range(MAX_TRIES):
            with killed_checker(cloud):
                check_all(cloud)
            cloud.clock.advance(LEASE_MS / 1000)
        check_all(cloud)
        shown = anna.get("/robot-types/lever").json()
        assert shown["state"] == "rejected"
        assert "interrupted" in shown["upload"]["errors"][0]

    def test_concurrent_checkers_compile_each_upload_once(
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
            for name in (*names, names[0])
        ]
        with checking(cloud, 4):
            assert sorted(answer().status_code for answer in waiting) == [201] * 12 + [409]
        assert sorted(compiled) == sorted(names), "one of two concurrent uploads must be rejected"

    def test_uploads_wait_while_the_checker_is_busy(self, cloud: Cloud, anna: Person) -> None:
        add(anna, "first", wait_ms=0)
        add(anna, "second", wait_ms=0)
        cloud.clock.advance((GIVE_UP_MS - 1_000) / 1000)
        with killed_checker(cloud):
            cloud.run(cloud.functions.model_checks.run())
        advance(cloud, 1_000)
        assert anna.get("/robot-types/second").json()["state"] == "checking"
        check_all(cloud)
        assert anna.get("/robot-types/second").json()["state"] == "ready"

    def test_a_checker_without_mujoco_fails_and_releases_the_check(
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

    def test_accounts_take_turns_however_many_uploads_one_has(self, cloud: Cloud, anna: Person) -> None:
        for number in range(4):
            add(anna, f"lever-{number}", wait_ms=0)
        ben = cloud.sign_in("ben")
        add(ben, wait_ms=0)
        cloud.functions.model_checks._compiler = cast("MujocoCompiler", AcceptingCompiler())
        for _ in range(2):
            assert cloud.run(cloud.functions.model_checks.run())
        assert ben.get("/robot-types/lever").json()["state"] == "ready"
        check_all(cloud)
        assert {anna.get(f"/robot-types/lever-{number}").json()["state"] for number in range(4)} == {"ready"}

    def test_a_checker_that_cannot_be_confined_is_reported_to_the_operator_and_the_author(
        self, cloud: Cloud, anna: Person, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
    ) -> None:
        add(anna, wait_ms=0)
        child = tmp_path / "child.py"
        child.write_text('import sys\nprint(\'{"missing": {"landlock": "too old"}}\')\nsys.exit(4)\n')
        with monkeypatch.context() as patch:
            patch.setattr("function_app.adapters.model_compiler.compiler._CHILD", child)
            with pytest.raises(CompilerMissingError, match="cannot confine"):
                cloud.run(check_models(cloud.functions, drain=True))
        health = anna.get("/health").json()
        assert health["status"] == "degraded"
        assert "no landlock (too old)" in health["models"]
        advance(cloud, GIVE_UP_MS)
        shown = anna.get("/robot-types/lever").json()
        assert shown["state"] == "rejected"
        assert "no landlock (too old)" in shown["upload"]["errors"][0]
        cloud.run(cloud.functions.model_checks.require())
        assert anna.get("/health").json()["models"] == "ok"

    def test_an_upload_killed_at_any_write_ends_and_leaves_no_data(
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
                assert state.json()["upload"]["errors"][0] in {INTERRUPTED, NO_VALIDATOR}
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


class TestProcesses:
    """The checker as a separate program with the same store."""

    def start(self, cloud: Cloud, *arguments: str) -> subprocess.Popen[bytes]:
        environment = {**os.environ, "TELESCOPE_HOME": str(cloud.functions.settings.home)}
        return subprocess.Popen([sys.executable, "-m", "function_app", "check-models", *arguments], env=environment)

    def test_the_checker_processes_all_pending_checks_and_exits(self, cloud: Cloud, anna: Person) -> None:
        add(anna, "first", wait_ms=0)
        add(anna, "second", wait_ms=0)
        assert self.start(cloud, "--drain").wait(PATIENCE_S) == 0
        assert [anna.get(f"/robot-types/{name}").json()["state"] for name in ("first", "second")] == ["ready", "ready"]

    def test_the_next_checker_repeats_the_check_of_a_killed_one(self, cloud: Cloud, anna: Person) -> None:
        endless = LEVER.replace("<site", '<replicate count="1000000"><body/></replicate><site')
        add(anna, wait_ms=0, lever__xml=endless)
        running = self.start(cloud)
        try:
            wait_until(lambda: taken(cloud), "a checker to start the check")
        finally:
            running.kill()
            running.wait()
        cloud.clock.advance(LEASE_MS / 1000)
        cloud.functions.model_checks._compiler = MujocoCompiler(cpu_s=1)
        check_all(cloud)
        shown = anna.get("/robot-types/lever").json()
        assert (shown["state"], len(shown["upload"]["errors"])) == ("rejected", 1)


def taken(cloud: Cloud) -> bool:
    """Whether a checker has started a check."""
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
    def test_a_model_that_exceeds_resource_limits_is_rejected(
        self, cloud: Cloud, anna: Person, xml: str, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr(cloud.functions.model_checks, "_compiler", MujocoCompiler(cpu_s=2, wall_s=20))
        with checking(cloud):
            refused = problem(add(anna, lever__xml=xml), 422, "robot-type-rejected")
        assert refused["errors"]

    def test_a_child_process_without_an_end_is_killed(
        self, cloud: Cloud, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
    ) -> None:
        child = tmp_path / "child.py"
        child.write_text("import time\ntime.sleep(1000)\n")
        monkeypatch.setattr("function_app.adapters.model_compiler.compiler._CHILD", child)
        compiler = MujocoCompiler(wall_s=1)
        found = cloud.run(compiler.check(manifests.parse(manifest()), {"lever.xml": b""}))
        assert "Simplify" in found.errors[0]

    def test_the_child_process_reads_only_the_upload(self, cloud: Cloud, tmp_path: Path) -> None:
        """Without the check of references, Landlock denies access."""
        outside = tmp_path / "outside.xml"
        outside.write_text(LEVER)
        xml = f'<mujoco><include file="{outside}"/></mujoco>'.encode()
        compiler = MujocoCompiler()
        found = cloud.run(compiler.check(manifests.parse(manifest()), {"lever.xml": xml, "scene.xml": xml}))
        assert found.errors
