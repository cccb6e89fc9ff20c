"""The messages between the Functions host and its worker, with the fields that the worker reads.

In production the host passes protobuf classes to the worker. These replacements check what protobuf would check: one
value in ``TypedData``, and text in text fields.
"""

from types import SimpleNamespace
from typing import Any

SUCCESS = "Success"
FAILED = "Failure"


class TypedData:
    """A value of one of several kinds."""

    _KINDS = frozenset({"http", "string", "bytes", "json"})

    def __init__(self, **value: Any) -> None:
        assert len(value) <= 1, value
        assert value.keys() <= self._KINDS, value
        for kind, content in value.items():
            assert kind == "http" or isinstance(content, bytes if kind == "bytes" else str), (kind, content)
            setattr(self, kind, content)
        self._kind = next(iter(value), None)

    def WhichOneof(self, _group: str) -> str | None:  # noqa: N802 (protobuf's name)
        return self._kind


class Parameter:
    """A value for one of a function's parameters."""

    def __init__(self, name: str, data: TypedData) -> None:
        self.name = name
        self.data = data

    def WhichOneof(self, _group: str) -> str:  # noqa: N802 (protobuf's name)
        return "data"


class Record:
    """A message with these fields."""

    def __init__(self, **fields: Any) -> None:
        self.__dict__.update(fields)


class RpcHttp(Record):
    """A response to an HTTP request."""

    def __init__(self, *, status_code: str, headers: dict[str, str], cookies: Any, body: Any, **more: Any) -> None:
        assert isinstance(status_code, str)
        assert all(isinstance(text, str) for item in headers.items() for text in item), headers
        super().__init__(status_code=status_code, headers=headers, cookies=cookies, body=body, **more)


class RpcHttpCookie(Record):
    SameSite = SimpleNamespace(Lax="lax", Strict="strict", ExplicitNone="none", **{"None": ""})


class BindingInfo(Record):
    """The binding of one parameter."""

    # The worker compares these numbers with those of ``azure.functions``.
    out = 1
    inout = 2
    undefined = None


class StatusResult(Record):
    """The result of a call."""

    Success = SUCCESS
    Failure = FAILED


def record(**fields: Any) -> Record:
    """A message that only the worker reads."""
    return Record(**fields)


PROTOS = SimpleNamespace(
    BindingInfo=BindingInfo,
    FunctionLoadResponse=Record,
    FunctionMetadataResponse=Record,
    InvocationResponse=Record,
    NullableBool=Record,
    NullableDouble=Record,
    NullableString=Record,
    NullableTimestamp=Record,
    ParameterBinding=Record,
    RpcException=Record,
    RpcFunctionMetadata=Record,
    RpcHttp=RpcHttp,
    RpcHttpCookie=RpcHttpCookie,
    RpcRetryOptions=Record,
    StatusResult=StatusResult,
    TypedData=TypedData,
    WorkerInitResponse=Record,
    WorkerMetadata=Record,
)
