"""Parameter schemas of movements: a subset of JSON Schema, and validation of parameters.

The structs are the metaschema. References and patterns are excluded on purpose: they allow schemas whose validation
does not end.
"""

from collections.abc import Mapping
from copy import deepcopy
from typing import Annotated, Any

import msgspec
from msgspec import UNSET, Meta, Struct, UnsetType

from function_app.domain.common.json_depth import MAX_LEVELS, too_deep
from function_app.domain.common.problems import Problem, invalid

MAX_SCHEMA_BYTES = 8_192
MAX_PARAMETERS_BYTES = 16_384
"""Maximum size of the parameters of an action with defaults, as JSON [bytes]."""
SCHEMA_LEVELS = 24
_SHOWN = 300

_Name = Annotated[str, Meta(min_length=1, max_length=64)]
_Words = Annotated[str, Meta(max_length=200)]
_Count = Annotated[int, Meta(ge=0, le=10_000)]
_Whole = Annotated[int, Meta(ge=-(2**53), le=2**53)]


class _Value(
    Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, omit_defaults=True, rename="camel", tag_field="type"
):
    """Common fields of all values. ``unit`` is for display."""

    title: _Words | UnsetType = UNSET
    description: _Words | UnsetType = UNSET
    unit: Annotated[str, Meta(max_length=20)] | UnsetType = UNSET
    default: Any = UNSET


class NumberSchema(_Value, frozen=True, kw_only=True, tag="number"):
    """A number."""

    minimum: float | UnsetType = UNSET
    maximum: float | UnsetType = UNSET
    exclusive_minimum: float | UnsetType = UNSET
    exclusive_maximum: float | UnsetType = UNSET


class IntegerSchema(_Value, frozen=True, kw_only=True, tag="integer"):
    """An integer."""

    minimum: _Whole | UnsetType = UNSET
    maximum: _Whole | UnsetType = UNSET


class StringSchema(_Value, frozen=True, kw_only=True, tag="string"):
    """Text, or one of several words."""

    enum: Annotated[tuple[_Words, ...], Meta(min_length=1, max_length=64)] | UnsetType = UNSET
    min_length: _Count | UnsetType = UNSET
    max_length: _Count | UnsetType = UNSET


class BooleanSchema(_Value, frozen=True, kw_only=True, tag="boolean"):
    """A Boolean."""


class ArraySchema(_Value, frozen=True, kw_only=True, tag="array"):
    """A list of values of one type."""

    items: "ValueSchema"
    min_items: _Count | UnsetType = UNSET
    max_items: _Count | UnsetType = UNSET


class ObjectSchema(_Value, frozen=True, kw_only=True, tag="object"):
    """Values by name. Unlisted names are rejected unless ``additionalProperties`` is true."""

    properties: Annotated[dict[_Name, "ValueSchema"], Meta(max_length=64)] = {}
    required: Annotated[tuple[_Name, ...], Meta(max_length=64)] = ()
    additional_properties: bool = False


ValueSchema = NumberSchema | IntegerSchema | StringSchema | BooleanSchema | ArraySchema | ObjectSchema


def schema_of(data: Any) -> ObjectSchema:
    """A schema from JSON.

    Raises:
        Problem: ``schema-invalid``, with the place and the allowed values.
    """
    if too_deep(data, SCHEMA_LEVELS):
        raise _bad_schema(f"It is nested more than {SCHEMA_LEVELS} levels deep.")
    try:
        schema = msgspec.convert(data, ObjectSchema, strict=True)
    except msgspec.ValidationError as error:
        raise _bad_schema(f"{_invalid_parameter(data) or error}.") from error
    check_schema(schema)
    return schema


def of_properties(properties: Mapping[str, Any]) -> ObjectSchema:
    """The schema from ``PARAMETERS`` of a script: name → schema; a value without default is required.

    Raises:
        Problem: ``schema-invalid``.
    """
    required = [name for name, value in properties.items() if not (isinstance(value, dict) and "default" in value)]
    return schema_of({"type": "object", "properties": dict(properties), "required": required})


def plain(schema: ObjectSchema) -> dict[str, Any]:
    """The schema as JSON, compatible with other JSON Schema validators."""
    result: dict[str, Any] = msgspec.json.decode(msgspec.json.encode(schema))
    _close(result)
    return result


def check_schema(schema: ObjectSchema) -> None:
    """Check what the structs cannot express: contradictions, defaults and size.

    Raises:
        Problem: ``schema-invalid``.
    """
    result = plain(schema)
    size = len(msgspec.json.encode(result))
    if size > MAX_SCHEMA_BYTES or too_deep(result, SCHEMA_LEVELS):
        raise _bad_schema(f"It has at most {MAX_SCHEMA_BYTES} bytes and {SCHEMA_LEVELS} levels, not {size} bytes.")
    _check(result, "$")


def fit(schema: Mapping[str, Any] | None, parameters: Mapping[str, Any]) -> dict[str, Any]:
    """The parameters with defaults. Without a schema all parameters are accepted.

    Args:
        schema: Result of ``plain``.
        parameters: Parameters of the operator.

    Raises:
        Problem: ``parameters-invalid``, with the place and the allowed values.
    """
    check(parameters)
    if schema is None:
        return dict(parameters)
    filled: dict[str, Any] = _filled(schema, parameters)
    _check_size(filled)
    error = _first_error(schema, filled)
    if error is not None:
        place, message = error
        raise _bad_parameters(f"{place}: {message}", place=place)
    return filled


def _invalid_parameter(data: Any) -> str:
    """The first invalid parameter by name, which the error of the whole schema does not contain."""
    properties = data.get("properties") if isinstance(data, dict) else None
    for name, value in properties.items() if isinstance(properties, dict) else ():
        try:
            msgspec.convert(value, ValueSchema, strict=True)
        except msgspec.ValidationError as error:
            return f"'{str(name)[:64]}': {error}"
    return ""


def _check_size(parameters: Mapping[str, Any]) -> None:
    size = len(msgspec.json.encode(parameters))
    if size > MAX_PARAMETERS_BYTES:
        raise _bad_parameters(f"Parameters with their defaults have at most {MAX_PARAMETERS_BYTES} bytes, not {size}.")


def check(parameters: Mapping[str, Any]) -> None:
    """Reject parameters that no script accepts.

    Raises:
        Problem: ``parameters-invalid``: nested too deeply or too large.
    """
    if too_deep(parameters):
        raise _bad_parameters(f"The parameters are nested more than {MAX_LEVELS} levels deep.")
    _check_size(parameters)


def _filled(schema: Mapping[str, Any], value: Any) -> Any:
    """A copy with the defaults of all present objects."""
    if schema["type"] == "object" and isinstance(value, dict):
        existing = schema["properties"]
        result = {name: _filled(existing[name], part) if name in existing else part for name, part in value.items()}
        for name, each in existing.items():
            if name not in value and "default" in each:
                result[name] = _filled(each, deepcopy(each["default"]))
        return result
    if schema["type"] == "array" and isinstance(value, list):
        return [_filled(schema["items"], part) for part in value]
    return value


def _close(schema: dict[str, Any]) -> None:
    """Make defaults explicit where other validators assume different ones."""
    if schema["type"] == "object":
        schema.setdefault("properties", {})
        schema.setdefault("additionalProperties", False)
        for value in schema["properties"].values():
            _close(value)
    elif schema["type"] == "array":
        _close(schema["items"])


def _check(schema: dict[str, Any], place: str) -> None:
    for low, high in (("minimum", "maximum"), ("minLength", "maxLength"), ("minItems", "maxItems")):
        if schema.get(low, 0) > schema.get(high, schema.get(low, 0)):
            raise _bad_schema(f"{place}: {low} is above {high}.")
    for name in schema.get("required", ()):
        if name not in schema["properties"]:
            raise _bad_schema(f"{place}: '{name}' is required and not among the properties.")
    if "default" in schema:
        error = _first_error(schema, schema["default"])
        if error is not None:
            raise _bad_schema(f"{place}: the default is not valid: {error[1]}")
    for name, value in schema.get("properties", {}).items():
        _check(value, f"{place}.{name}")
    if "items" in schema:
        _check(schema["items"], f"{place}[]")


def _first_error(schema: Mapping[str, Any], value: Any) -> tuple[str, str] | None:
    """Place and message of the most relevant error."""
    from jsonschema import Draft202012Validator  # noqa: PLC0415 (80 ms, which a cold start need not wait for)
    from jsonschema.exceptions import best_match  # noqa: PLC0415

    error = best_match(Draft202012Validator(schema).iter_errors(value))
    if error is None:
        return None
    text = error.message if len(error.message) <= _SHOWN else error.message[:_SHOWN] + " …"
    return error.json_path, text.rstrip(".") + "."


def _bad_schema(detail: str) -> Problem:
    return invalid(f"The parameter schema is not valid. {detail}", code="schema-invalid")


def _bad_parameters(detail: str, **extras: Any) -> Problem:
    return invalid(detail, code="parameters-invalid", **extras)
