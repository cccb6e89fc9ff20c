"""Converts actions to API responses."""

from function_app.domain.actions.action import Action
from function_app.domain.common.timestamps import rfc3339
from function_app.entrypoints.http.actions.schemas import ActionOut, ReasonOut
from function_app.entrypoints.http.framework.schemas import response_from


def action_out(action: Action, position: int | None = None) -> ActionOut:
    """The response for an action with its position in the queue."""
    return response_from(
        action,
        ActionOut,
        status=action.status.value,
        queue_position=position,
        created_at=rfc3339(action.created_ms),
        deadline_at=rfc3339(action.deadline_ms),
        times={f"{status}_ms": at_ms for status, at_ms in action.times.items()},
        reason=None if action.reason is None else ReasonOut(**action.reason),
    )
