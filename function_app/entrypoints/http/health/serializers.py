"""Faults as the API shows them."""

from function_app.domain.common.timestamps import rfc3339
from function_app.domain.health.faults import Fault
from function_app.entrypoints.http.health.schemas import FaultOut


def fault_out(fault: Fault) -> FaultOut:
    """A fault with its state."""
    return FaultOut(
        id=fault.id,
        code=fault.code,
        state="cleared" if fault.cleared_ms else "acknowledged" if fault.acknowledged_ms else "raised",
        source=fault.source.value,
        kind=fault.kind,
        severity=fault.severity.value,
        message=fault.message,
        stream=fault.stream,
        field=fault.field,
        value=fault.value,
        baseline=fault.baseline,
        limit=fault.limit,
        raised_at=rfc3339(fault.raised_ms),
        acknowledged_at=None if fault.acknowledged_ms is None else rfc3339(fault.acknowledged_ms),
        acknowledged_by=fault.acknowledged_by,
        cleared_at=None if fault.cleared_ms is None else rfc3339(fault.cleared_ms),
        count=fault.count,
        worsened=fault.worse,
    )
