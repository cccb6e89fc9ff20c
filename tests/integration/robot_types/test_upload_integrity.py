"""Stored robot types are used only if unchanged since their check."""

import copy
from collections.abc import Callable
from typing import Any

import pytest

from function_app.ports.tables import Row
from function_app.services.robot_types.rows import Place
from function_app.services.storage import records
from tests.harness.cloud.cloud import Cloud, Person, problem
from tests.integration.robot_types.lever import add, check_all


class TestSeal:
    """With write access to the stores an attacker cannot change a checked robot type unnoticed."""

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

    def test_a_changed_field_or_another_seal_is_detected(self, cloud: Cloud, anna: Person, lever: Place) -> None:
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
        content = cloud.run(cloud.functions.blobs.get(f"{lever.prefix(1)}lever.xml")) or b""
        cloud.run(cloud.functions.blobs.put(f"{lever.prefix(1)}lever.xml", content.replace(b"box", b"bax")))
        problem(anna.get("/robot-types/lever/files/lever.xml"), 409, "robot-type-damaged")

        bert = cloud.sign_in("bert")
        add(bert, wait_ms=0)
        add(anna, wait_ms=0)
        check_all(cloud)
        self.change(cloud, Place(bert.account, "lever"), "type", lambda data: data.update(seal=good["seal"]))
        problem(bert.get("/robot-types/lever/files/robot.toml"), 409, "robot-type-damaged")
        # An older version in place of the newest.
        old = {"manifest": good["manifest"], "seal": good["seal"]}
        self.change(cloud, lever, "type", lambda data: data.update(old))
        problem(anna.get("/robot-types/lever/files/robot.toml"), 409, "robot-type-damaged")
