"""Valid parameter schemas, and the parameters that they accept."""

import json
from collections.abc import Callable
from typing import Any

import jsonschema
import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from function_app.domain.common.problems import Problem
from function_app.services.robot_types import parameter_schema
from function_app.services.robot_types.parameter_schema import MAX_PARAMETERS_BYTES, MAX_SCHEMA_BYTES
from function_app.services.robot_types.script_metadata import read_script

NUMBERS = st.floats(-10, 10)
VALUES = st.recursive(
    st.one_of(
        st.builds(
            lambda low, high: {"type": "number", "minimum": min(low, high), "maximum": max(low, high)}, NUMBERS, NUMBERS
        ),
        st.builds(lambda low: {"type": "integer", "minimum": low}, st.integers(-10, 10)),
        st.builds(
            lambda words: {"type": "string", "enum": words}, st.lists(st.text(max_size=3), min_size=1, max_size=3)
        ),
        st.just({"type": "boolean", "default": True}),
    ),
    lambda inner: st.one_of(
        st.builds(lambda items: {"type": "array", "items": items, "maxItems": 3}, inner),
        st.builds(
            lambda properties: {"type": "object", "properties": properties},
            st.dictionaries(st.text(min_size=1, max_size=3), inner, max_size=3),
        ),
    ),
    max_leaves=6,
)
SCHEMAS = st.dictionaries(st.text(min_size=1, max_size=3), VALUES, max_size=4)
JSON = st.recursive(
    st.one_of(st.none(), st.booleans(), st.integers(-20, 20), NUMBERS, st.text(max_size=3)),
    lambda inner: st.one_of(st.lists(inner, max_size=3), st.dictionaries(st.text(max_size=3), inner, max_size=3)),
    max_leaves=8,
)


def outcome(call: Callable[[], Any]) -> tuple[Any, Problem | None]:
    """The result, or the problem."""
    try:
        return call(), None
    except Problem as problem:
        return None, problem


@given(SCHEMAS, st.dictionaries(st.text(min_size=1, max_size=3), JSON, max_size=4))
def test_accepted_parameters_are_valid_for_other_validators(
    properties: dict[str, Any], parameters: dict[str, Any]
) -> None:
    schema = parameter_schema.plain(parameter_schema.of_properties(properties))
    jsonschema.Draft202012Validator.check_schema(schema)
    filled, refused = outcome(lambda: parameter_schema.fit(schema, parameters))
    if refused is not None:
        assert (refused.code, refused.status) == ("parameters-invalid", 422)
        assert refused.extras["place"].startswith("$")
    else:
        jsonschema.validate(filled, schema)
        assert filled.keys() >= parameters.keys()
        assert parameter_schema.fit(schema, filled) == filled, "filling in twice changes nothing"


@given(JSON)
def test_any_json_is_a_schema_or_is_refused(given_: Any) -> None:
    _, refused = outcome(lambda: parameter_schema.schema_of(given_))
    assert refused is None or (refused.code, refused.status) == ("schema-invalid", 422)


@pytest.mark.parametrize(
    ("schema", "words"),
    [
        ({"type": "integer", "pattern": "a"}, "pattern"),
        ({"$ref": "#/properties/a"}, "type"),
        ({"type": "string", "format": "regex"}, "format"),
        ({"type": "string", "pattern": "(a+)+$"}, "pattern"),
        ({"type": "array", "uniqueItems": True, "items": {"type": "string"}}, "uniqueItems"),
        ({"type": "array"}, "items"),
        ({"anyOf": [{"type": "string"}]}, "type"),
        ({"type": "null"}, "null"),
        ({"type": "integer", "minimum": 2, "maximum": 1}, "minimum is above maximum"),
        ({"type": "array", "items": {"type": "string"}, "minItems": 2, "maxItems": 1}, "minItems"),
        ({"type": "integer", "minimum": 2, "default": 1}, "default"),
        ({"type": "string", "enum": []}, "enum"),
        ({"type": "string", "enum": ["a"], "default": "b"}, "default"),
        ({"type": "object", "properties": {}, "required": ["b"]}, "required"),
        ({"type": "object", "properties": {"b": {"type": "integer", "default": "x"}}}, "$.a.b"),
        ({"type": "string", "title": "x" * 201}, "200"),
        ({"type": "string", "default": "x" * MAX_SCHEMA_BYTES}, str(MAX_SCHEMA_BYTES)),
        (1, "object"),
    ],
)
def test_invalid_schemas_are_rejected_with_the_reason(schema: Any, words: str) -> None:
    with pytest.raises(Problem) as refused:
        parameter_schema.of_properties({"a": schema})
    assert refused.value.code == "schema-invalid"
    assert words in refused.value.detail
    assert "a" in refused.value.detail


def test_a_deep_schema_is_refused() -> None:
    schema: dict[str, Any] = {"type": "string"}
    for _ in range(500):
        schema = {"type": "array", "items": schema}
    with pytest.raises(Problem, match="levels"):
        parameter_schema.schema_of({"type": "object", "properties": {"a": schema}})


def test_defaults_apply_inside_present_objects_and_lists() -> None:
    point = {
        "type": "object",
        "properties": {"x": {"type": "number", "default": 0}, "y": {"type": "number", "default": 1}},
    }
    schema = parameter_schema.plain(
        parameter_schema.of_properties(
            {"to": point, "path": {"type": "array", "items": point, "default": []}, "at": point}
        )
    )
    schema["required"] = ["to"]
    found = parameter_schema.fit(schema, {"to": {"x": 5}, "path": [{}]})
    assert found == {"to": {"x": 5, "y": 1}, "path": [{"x": 0, "y": 1}]}


def test_default_lists_are_copied() -> None:
    schema = parameter_schema.plain(
        parameter_schema.of_properties({"a": {"type": "array", "items": {"type": "integer"}, "default": []}})
    )
    parameter_schema.fit(schema, {})["a"].append(1)
    assert parameter_schema.fit(schema, {}) == {"a": []}


@pytest.mark.parametrize(("schema", "spare"), [(None, 0), ("default", 40)])
def test_the_size_of_parameters_includes_defaults(schema: str | None, spare: int) -> None:
    known = None
    if schema:
        properties = {
            "big": {"type": "string"},
            "more": {"type": "string", "default": "x" * (spare - len(',"more":""'))},
        }
        known = parameter_schema.plain(parameter_schema.of_properties(properties))
    fits = MAX_PARAMETERS_BYTES - len('{"big":""}') - spare
    assert len(msgspec.json.encode(parameter_schema.fit(known, {"big": "x" * fits}))) == MAX_PARAMETERS_BYTES
    with pytest.raises(Problem, match=str(MAX_PARAMETERS_BYTES)):
        parameter_schema.fit(known, {"big": "x" * (fits + 1)})


@pytest.mark.parametrize(
    "value",
    [
        "f()",
        "dict(a=1)",
        "{**x}",
        "[]",
        "None",
        "{'a': {1, 2}}",
        "{'a': 1j}",
        "{'a': b'x'}",
        "{'a': 1e999}",
        "{'a': ...}",
    ],
)
def test_computed_schemas_are_rejected(value: str) -> None:
    with pytest.raises(Problem) as refused:
        read_script(f"\nPARAMETERS = {value}\n")
    assert refused.value.code == "movement-invalid"
    assert refused.value.extras["line"] == 2


def test_a_literal_schema_is_read_anywhere_at_the_top_level() -> None:
    literal = {"a": {"type": "integer", "default": 1}}
    for form in ("PARAMETERS = {}", "PARAMETERS: dict = {}", "x = 1\nPARAMETERS = {}\nrobot.home()"):
        schema = read_script(form.replace("{}", json.dumps(literal))).schema
        assert schema is not None
        assert schema["properties"] == literal
    for none in ("def f():\n    PARAMETERS = 1", "PARAMETERS.x = 1", "parameters = 1", "PARAMETERS: dict"):
        assert read_script(none).schema is None
