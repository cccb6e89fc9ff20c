"""``actions``: one action, many devices."""

from typing import Annotated, Literal

import msgspec
from msgspec import Meta

from device_agent.protocol import Id
from function_app.entrypoints.http.actions.schemas import ActionOut
from function_app.entrypoints.http.framework.schemas import Epoch, Problem, Request, Response, WaitMs
from function_app.services.actions.start import Asked


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
