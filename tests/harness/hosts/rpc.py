"""The messages between the Functions host and its worker, as far as the worker looks at them.

In production they are protobuf's; the worker takes them from its host. These check what protobuf would: one
value in ``TypedData``, text in text fields.
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
        for kind, what in value.items():
            assert kind == "http" or isinstance(what, bytes if kind == "bytes" else str), (kind, what)
            setattr(self, kind, what)
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
    """An answer to an HTTP request."""

    def __init__(self, *, status_code: str, headers: dict[str, str], cookies: Any, body: Any, **more: Any) -> None:
        assert isinstance(status_code, str)
        assert all(isinstance(text, str) for item in headers.items() for text in item), headers
        super().__init__(status_code=status_code, headers=headers, cookies=cookies, body=body, **more)


class RpcHttpCookie(Record):
    """A cookie to be set."""

    SameSite = SimpleNamespace(Lax="lax", Strict="strict", ExplicitNone="none", **{"None": ""})


class BindingInfo(Record):
    """What one parameter is bound to."""

    # ``azure.functions`` has numbers of its own for these, which the worker compares.
    out = 1
    inout = 2
    undefined = None


class StatusResult(Record):
    """How it went."""

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
