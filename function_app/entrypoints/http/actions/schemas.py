"""Requests and responses of actions on one device or many, and of Stop."""

from typing import Annotated, Any, Literal

import msgspec
from msgspec import Meta

from device_agent.protocol import Id, Text
from function_app.entrypoints.http.framework.schemas import Epoch, Moment, Problem, Request, Response
from function_app.services.actions.requests import ActionOptions, ActionRequest
from function_app.services.actions.stop import StopOutcome

MAX_DEVICES = 100


class ReasonOut(Response, frozen=True, kw_only=True):
    """Why an action ended, or why a command was rejected."""

    code: str
    message: str


class ActionOut(Response, frozen=True, kw_only=True):
    """An action. ``times``: ``<status>_ms`` → milliseconds since 1970. ``queue_position``: 1 is next.

    ``epoch`` is 0 while a queued action has no lease. Status ``unknown``: the device has not reported the outcome in
    time and may have executed the action. The device is free, and the action ends when the device reports.
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
        "unknown",
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


class BatchActionRequest(ActionOptions, frozen=True, kw_only=True):
    """A request to start one action on many devices. ``epochs``: device → epoch of the caller's lease on the device."""

    devices: Annotated[tuple[Id, ...], Meta(min_length=1, max_length=MAX_DEVICES)]
    epochs: Annotated[dict[Id, Epoch], Meta(max_length=MAX_DEVICES)] = msgspec.field(default_factory=dict)

    def for_device(self, device: str) -> ActionRequest:
        """The request for one of the devices."""
        return ActionRequest(
            request=self.request,
            policy=self.policy,
            queue_ms=self.queue_ms,
            ttl_ms=self.ttl_ms,
            timeout_ms=self.timeout_ms,
            wait_ms=self.wait_ms,
            wait_for=self.wait_for,
            epoch=self.epochs.get(device),
        )


class BatchActionItem(Response, frozen=True, kw_only=True):
    """The result for one device: the action, or the problem. ``status`` is the same as for a single device."""

    device: str
    status: int
    action: ActionOut | None
    problem: Problem | None


class BatchActionOut(Response, frozen=True, kw_only=True):
    """One item for each device, in the order of the request."""

    items: tuple[BatchActionItem, ...]


class StopRequest(Request, frozen=True, kw_only=True):
    """The reason for the Stop; optional."""

    reason: Text = ""


class ResetConfirmation(Response, frozen=True, kw_only=True):
    """Whether the device has confirmed the reset within one second, and why it rejected it.

    ``reason``: null if the device has confirmed the reset, or has not responded.
    """

    confirmed: bool
    reason: ReasonOut | None


class StopItem(Response, frozen=True, kw_only=True):
    """The result for one device.

    Attributes:
        status: 200: confirmed; 202: sent or offline; 503: nothing could be sent.
        outcome: ``confirmed``: the control loop has applied it. ``sent``: no confirmation within one second.
            ``unreachable``: the agent is offline, or the broker cannot be reached.
        confirmed: Whether ``outcome`` is ``confirmed``.
        message: What the outcome means, and what to do.
        problem: Why nothing could be sent.
    """

    device: str
    status: int
    outcome: StopOutcome
    confirmed: bool
    message: str
    problem: Problem | None


class StopOut(Response, frozen=True, kw_only=True):
    """One item for each device that the caller may operate."""

    items: tuple[StopItem, ...]
