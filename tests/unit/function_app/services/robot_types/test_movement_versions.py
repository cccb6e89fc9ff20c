"""Versions of movements: listed, retained and signed."""

import base64
import hashlib

import pytest
from cryptography.exceptions import InvalidSignature

from device_agent.protocol.security import signing
from function_app.ports.tables import Row
from function_app.services.robot_types.movements import KEEP_SCRIPT_MS
from function_app.services.storage import records
from tests.harness.cloud.cloud import Cloud, Person, problem
from tests.harness.cloud.memory import Memory
from tests.unit.function_app.services.robot_types.movements import MINE, SOURCE, UR5, WAVE, scripts


class TestVersions:
    def test_every_version_is_listed_and_readable(self, anna: Person) -> None:
        sources = [f"robot.home()  # {number}" for number in range(5)]
        for source in sources:
            anna.put(WAVE, {"source": source})
        pages = anna.each_page(f"{WAVE}/versions", limit=2)
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

    def test_a_built_in_movement_has_one_version(self, anna: Person) -> None:
        (only,) = anna.get(f"{WAVE}/versions").json()["items"]
        assert (only["built_in"], only["version"]) == (True, 1)
        assert anna.get(WAVE, params={"version": 1}).status_code == 200
        problem(anna.get(WAVE, params={"version": 2}), 404, "movement-version-unknown")
        problem(anna.get(f"{MINE}/versions"), 404, "movement-unknown")

    def test_deleted_versions_disappear_and_their_scripts_some_days_later(
        self, memory: Memory, alone: Cloud, anna: Person
    ) -> None:
        for number in range(3):
            anna.put(MINE, {"source": f"# {number}"})
        anna.delete(MINE)
        problem(anna.get(f"{MINE}/versions"), 404, "movement-unknown")
        anna.put(MINE, {"source": "# 1"})
        assert [item["version"] for item in anna.get(f"{MINE}/versions").json()["items"]] == [4]
        problem(anna.get(MINE, params={"version": 2}), 404, "movement-version-unknown")
        assert len(scripts(memory)) == 4, "commands of running actions may be resent"
        alone.clock.advance((KEEP_SCRIPT_MS + 1_000) / 1000)
        alone.run(alone.functions.retention.delete_due(alone.clock.now_ms()))
        assert scripts(memory) == ["# 1"]
        again = alone.sign_in("anna")
        assert again.get(MINE).json()["source"] == "# 1"
        page = alone.run(alone.functions.tables.query(records.MOVEMENTS, f"{anna.account}/ur5"))
        assert len(page.rows) == 2, "the row of the name and of its version"
        again.delete(MINE)
        alone.clock.advance((KEEP_SCRIPT_MS + 1_000) / 1000)
        alone.run(alone.functions.retention.delete_due(alone.clock.now_ms()))
        assert scripts(memory) == []
        page = alone.run(alone.functions.tables.query(records.MOVEMENTS, f"{anna.account}/ur5"))
        assert [row.key for row in page.rows] == ["mine"], (
            "the name row remains, so that version numbers are not reused"
        )

    def test_concurrent_saves_get_one_version_each_and_leave_no_orphan_script(
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

    def test_lists_of_built_in_and_own_movements_are_paged_by_name(self, anna: Person) -> None:
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
            pages = anna.each_page(f"{UR5}/movements", limit=limit)
            assert [item["name"] for page in pages for item in page] == names
            assert all(len(page) <= limit for page in pages)
        problem(anna.get(f"{UR5}/movements", params={"cursor": "~"}), 422, "cursor-invalid")


class TestSignatures:
    @pytest.mark.parametrize("own", [True, False])
    def test_signatures_verify_with_the_keys_of_agents(self, alone: Cloud, anna: Person, own: bool) -> None:
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
    def test_a_row_modified_in_the_store_is_not_run(self, alone: Cloud, anna: Person, change: str) -> None:
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
