"""Requests and responses of actions on one device or many, and of Stop."""

from typing import Annotated, Any, Literal

import msgspec
from msgspec import Meta

from device_agent.protocol import Id, Text
from function_app.entrypoints.http.framework.schemas import Epoch, Moment, Problem, Request, Response, WaitMs
from function_app.services.actions.start import Asked


class ActionRequest(Request, frozen=True, kw_only=True):
    """What to run. Without ``epoch`` the action brings a lease for its own time.

    While the device is busy, ``policy`` ``reject`` refuses it; with ``queue`` it waits for its turn, at most
    ``queue_ms``. ``ttl_ms`` and ``timeout_ms`` count from its turn. It starts if ``epoch`` is the caller's lease then,
    or, without ``epoch``, if nobody else has control. After a Stop or a failed action nothing that waits starts by
    itself.
    """

    request: Asked
    epoch: Epoch | None = None
    policy: Literal["reject", "queue"] = "reject"
    queue_ms: Annotated[int, Meta(ge=1_000, le=86_400_000)] = 300_000
    ttl_ms: Annotated[int, Meta(ge=1, le=86_400_000)] = 10_000
    timeout_ms: Annotated[int, Meta(ge=1_000, le=86_400_000)] = 300_000
    wait_ms: WaitMs = 0
    wait_for: Literal["started", "done"] = "started"


class ReasonOut(Response, frozen=True, kw_only=True):
    """Why an action ended as it did."""

    code: str
    message: str


class ActionOut(Response, frozen=True, kw_only=True):
    """An action. ``times``: ``<status>_ms`` → milliseconds since 1970. ``queue_position``: 1 is the next one.

    ``epoch`` is 0 while it waits for a lease of its own.
    """

    id: str
    device: str
    request: dict[str, Any]
    status: Literal[
        "queued",
        "created",
        "published",
        "received",
        "accepted",
        "started",
        "done",
        "failed",
        "expired",
        "cancelled",
    ]
    queue_position: int | None
    epoch: int
    caller: str
    created_at: Moment
    deadline_at: Moment
    times: dict[str, int]
    reason: ReasonOut | None
    progress: float | None
    output: str
    result: dict[str, Any]


class ActionList(Response, frozen=True, kw_only=True):
    """Actions, newest first."""

    items: tuple[ActionOut, ...]
    cursor: str | None


class BatchActionRequest(Request, frozen=True, kw_only=True):
    """One action on many devices. As for one device; ``epochs``: device → the epoch of the caller's lease on it."""

    devices: Annotated[tuple[Id, ...], Meta(min_length=1, max_length=100)]
    request: Asked
    epochs: Annotated[dict[Id, Epoch], Meta(max_length=100)] = msgspec.field(default_factory=dict)
    policy: Literal["reject", "queue"] = "reject"
    queue_ms: Annotated[int, Meta(ge=1_000, le=86_400_000)] = 300_000
    ttl_ms: Annotated[int, Meta(ge=1, le=86_400_000)] = 10_000
    timeout_ms: Annotated[int, Meta(ge=1_000, le=86_400_000)] = 300_000
    wait_ms: WaitMs = 0
    wait_for: Literal["started", "done"] = "started"


class BatchActionItem(Response, frozen=True, kw_only=True):
    """What became of it on one device: the action, or why there is none; ``status`` as for one device."""

    device: str
    status: int
    action: ActionOut | None
    problem: Problem | None


class BatchActionOut(Response, frozen=True, kw_only=True):
    """One item for each device, in the order asked."""

    items: tuple[BatchActionItem, ...]


class StopRequest(Request, frozen=True, kw_only=True):
    """Why."""

    reason: Text = ""


class StopConfirmation(Response, frozen=True, kw_only=True):
    """Whether the device has confirmed within a second."""

    confirmed: bool


class StopItem(Response, frozen=True, kw_only=True):
    """What became of it on one device; ``status`` and ``problem`` as for one device."""

    device: str
    status: int
    confirmed: bool
    problem: Problem | None


class StopOut(Response, frozen=True, kw_only=True):
    """One item for each device that the caller may operate."""

    items: tuple[StopItem, ...]
