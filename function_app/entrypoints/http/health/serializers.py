"""Converts faults to API responses."""

from function_app.domain.common.timestamps import rfc3339
from function_app.domain.health.faults import Fault
from function_app.entrypoints.http.framework.schemas import response_from
from function_app.entrypoints.http.health.schemas import FaultOut


def fault_out(fault: Fault) -> FaultOut:
    """The response for a fault with its state."""
    return response_from(
        fault,
        FaultOut,
        state="cleared" if fault.cleared_ms else "acknowledged" if fault.acknowledged_ms else "raised",
        source=fault.source.value,
        severity=fault.severity.value,
        raised_at=rfc3339(fault.raised_ms),
        acknowledged_at=None if fault.acknowledged_ms is None else rfc3339(fault.acknowledged_ms),
        cleared_at=None if fault.cleared_ms is None else rfc3339(fault.cleared_ms),
        worsened=fault.worse,
        last_seen_at=None if fault.last_seen_ms is None else rfc3339(fault.last_seen_ms),
    )
