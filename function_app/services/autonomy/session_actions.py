"""Results of ended actions, which stay with their session after the action was deleted."""

from typing import Any, Final

from function_app.domain.actions.action import Action, Status, is_lost
from function_app.services.telemetry.session_log import SessionLog

_BY_A_PERSON: Final = frozenset({"lease_lost", "lease_ended", "stopped"})
"""Reasons of a failure for which a person intervened: control was taken, or Stop was pressed."""


class SessionActions:
    """Records the results of actions that have a lease of their own."""

    def __init__(self, *, session_log: SessionLog) -> None:
        self._session_log = session_log

    async def record(self, action: Action) -> None:
        """Record an ended action. Idempotent. Raises ``busy``."""
        # The device may still report how a lost action ended: its outcome is not recorded.
        result = result_of(action) | ({"outcome": ""} if is_lost(action) else {})
        await self._session_log.add_action(action.device, action.pairing, action.epoch, action.id, **result)


def result_of(action: Action) -> dict[str, Any]:
    """Arguments of ``Session.with_action`` for an action that runs or has ended."""
    kind, code = str(action.request["kind"]), (action.reason or {}).get("code", "")
    cancelled = action.status is Status.CANCELLED and bool(action.cancel_id)
    return {
        "task": str(action.request["name"]) if kind in {"run_movement", "run_trial"} else kind,
        "outcome": action.status.value,
        "intervened": cancelled or (action.status is Status.FAILED and code in _BY_A_PERSON),
        # An unknown outcome has freed the lease.
        "ended_ms": action.ended_ms if action.status.terminal or action.status is Status.UNKNOWN else 0,
    }
