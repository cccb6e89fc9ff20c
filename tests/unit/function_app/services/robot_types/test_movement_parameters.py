"""Parameters of movements: schemas, defaults and refusals."""

from typing import Any, ClassVar

import pytest

from device_agent.protocol import RunMovement
from tests.fakes.agent import Robot
from tests.harness.cloud.cloud import Person, problem
from tests.unit.function_app.services.robot_types.movements import MINE


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

    def test_the_callers_schema_precedes_the_scripts(self, anna: Person) -> None:
        literal = 'PARAMETERS = {"who": {"type": "string"}, "times": {"type": "integer", "default": 1}}'
        literal_schema = anna.put(MINE, {"source": literal}).json()["parameters_schema"]
        assert (sorted(literal_schema["properties"]), literal_schema["required"]) == (["times", "who"], ["who"])
        schema = anna.put(MINE, {"source": literal, "parameters_schema": self.SCHEMA}).json()["parameters_schema"]
        assert schema["properties"]["who"]["enum"] == ["anna", "bert"]
        assert anna.get(MINE).json()["parameters_schema"] == schema
        assert anna.put(MINE, {"source": "1"}).json()["parameters_schema"] is None
        assert anna.get(MINE, params={"version": 2}).json()["parameters_schema"] == schema

    def test_invalid_schemas_are_refused(self, anna: Person) -> None:
        for unknown in ({"type": "object", "properties": {"a": {"$ref": "#"}}}, {"type": "array", "items": {}}):
            problem(anna.put(MINE, {"source": "1", "parameters_schema": unknown}), 422, "invalid")
        schema = {"type": "object", "properties": {"a": {"type": "integer", "default": "x"}}}
        refused = problem(anna.put(MINE, {"source": "1", "parameters_schema": schema}), 422, "schema-invalid")
        assert "$.a" in refused["detail"]
        problem(anna.put(MINE, {"source": 'PARAMETERS = {"a": 1}'}), 422, "schema-invalid")
        problem(anna.put(MINE, {"source": "PARAMETERS = f()"}), 422, "movement-invalid")

    def test_an_action_stores_the_defaults(self, anna: Person, robot: Robot) -> None:
        anna.put(MINE, {"source": "1", "parameters_schema": self.SCHEMA})
        request = {"kind": "run_movement", "name": "mine", "parameters": {"who": "bert"}}
        started = anna.start(robot.device, request=request, wait_ms=10_000, idempotency_key="x").json()
        (command,) = robot.received(RunMovement)
        assert isinstance(command.request, RunMovement)
        assert command.request.parameters == {"who": "bert", "times": 3}
        assert started["request"]["parameters"] == {"who": "bert", "times": 3}
        assert (
            anna.start(robot.device, request=request, wait_ms=10_000, idempotency_key="x").json()["id"] == started["id"]
        )

    @pytest.mark.parametrize(
        ("parameters", "place"),
        [
            ({}, "$"), ({"who": "carl"}, "$.who"), ({"who": "anna", "more": 1}, "$"),
            ({"who": "anna", "times": 0}, "$.times"), ({"who": "anna", "times": True}, "$.times"),
        ],
    )  # fmt: skip
    def test_invalid_parameters_are_refused_with_their_place_and_take_no_slot(
        self, anna: Person, parameters: dict[str, Any], place: str
    ) -> None:
        device = anna.cloud.robot().pair(anna)
        anna.put(MINE, {"source": "1", "parameters_schema": self.SCHEMA})
        request = {"kind": "run_movement", "name": "mine", "parameters": parameters}
        refused = problem(anna.start(device, request=request), 422, "parameters-invalid")
        assert refused["place"] == place
        assert anna.get(f"/devices/{device}/actions").json()["items"] == []
