"""Base classes and common types of the schemas."""

from typing import Annotated, Any, ClassVar, TypeVar

from msgspec import Meta, Struct

from function_app.domain.common.text import require_label

Moment = Annotated[
    str, Meta(description="RFC 3339 time in UTC with milliseconds", examples=["2026-01-31T12:00:00.000Z"])
]
Epoch = Annotated[int, Meta(ge=1, le=2**53)]
DeviceName = Annotated[str, Meta(pattern="^[A-Za-z0-9_-]{1,32}$")]
Name = Annotated[str, Meta(min_length=1, max_length=200)]
LeaseMs = Annotated[int, Meta(ge=1_000, le=600_000)]
WaitMs = Annotated[int, Meta(ge=0, le=30_000)]


class Request(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Base class of request bodies. Unknown fields are rejected."""


class EmptyRequest(Request, frozen=True, kw_only=True):
    """A body without fields."""


class AgentRequest(Request, frozen=True, kw_only=True, forbid_unknown_fields=False):
    """Base class of request bodies of agents. Unknown fields are ignored: the agent may be newer."""


class LabelledRequest(Request, frozen=True, kw_only=True):
    """Base class of request bodies with text for other users, named in ``labels``. See ``domain/common/text.py``."""

    labels: ClassVar[tuple[str, ...]] = ()

    def __post_init__(self) -> None:
        for field in self.labels:
            text = getattr(self, field)
            if text is not None:
                require_label(text, field)


class Response(Struct, frozen=True, kw_only=True):
    """Base class of response bodies."""


class Problem(Response, frozen=True, kw_only=True):
    """Problem details (RFC 9457). ``type`` ends with a stable code, which determines further members."""

    type: str
    title: str
    status: int
    detail: str


class AccountRef(Response, frozen=True, kw_only=True):
    """Id and name of an account."""

    id: str
    name: str


R = TypeVar("R", bound=Response)


def response_from(source: object, kind: type[R], /, **more: Any) -> R:
    """A response with the attributes of ``source`` that have the same names, and the fields in ``more``."""
    fields = kind.__struct_fields__
    return kind(
        **{name: getattr(source, name) for name in fields if name not in more and hasattr(source, name)}, **more
    )
