"""The life cycle of a fault: ``raised → acknowledged → cleared``. It may clear without acknowledgement.

A device has at most one open fault per code: a repeated report refers to the same fault. A fault that occurs again
after clearing is a new fault with a higher count.
"""

from dataclasses import dataclass, replace
from enum import StrEnum


class Severity(StrEnum):
    """Severity of a fault, mildest first."""

    INFO = "info"
    WARNING = "warning"
    ERROR = "error"

    @property
    def rank(self) -> int:
        """Higher is worse."""
        return list(Severity).index(self)


class Source(StrEnum):
    """Who detected the fault: the device, a detector, or the cloud because the device is silent."""

    DEVICE = "device"
    DETECTOR = "detector"
    CLOUD = "cloud"


@dataclass(frozen=True, slots=True)
class Report:
    """A report of an active fault.

    Attributes:
        code: Code for programs; a device has at most one open fault for each code.
        kind: Detector: ``level``, ``trend``, ``change``, ``outlier``; or ``reported``, ``silent``.
        message: Description of the fault, and an instruction.
        value: Measured value; ``baseline``: usual value; ``limit``: allowed limit.
        occurrences: How often the condition has occurred since the device raised the fault.
    """

    code: str
    source: Source
    kind: str
    severity: Severity
    message: str
    stream: str = ""
    field: str = ""
    value: float | None = None
    baseline: float | None = None
    limit: float | None = None
    occurrences: int = 1


@dataclass(frozen=True, slots=True)
class Fault:
    """One fault of a device, from its first report until it is cleared.

    Attributes:
        id: Decreases with time, so that the newest fault sorts first.
        count: Number of this fault among the faults with the same code.
        worse: How often the severity increased.
        occurrences: How often its condition has come and gone while the fault was open.
        last_seen_ms: When its condition last occurred.
    """

    id: str
    code: str
    source: Source
    kind: str
    severity: Severity
    message: str
    raised_ms: int
    count: int = 1
    worse: int = 0
    stream: str = ""
    field: str = ""
    value: float | None = None
    baseline: float | None = None
    limit: float | None = None
    acknowledged_ms: int | None = None
    acknowledged_by: str = ""
    cleared_ms: int | None = None
    occurrences: int = 1
    last_seen_ms: int | None = None


def raised(report: Report, *, fault: str, now_ms: int, count: int) -> Fault:
    """A new fault."""
    return Fault(
        id=fault,
        code=report.code,
        source=report.source,
        kind=report.kind,
        severity=report.severity,
        message=report.message,
        raised_ms=now_ms,
        count=count,
        stream=report.stream,
        field=report.field,
        value=report.value,
        baseline=report.baseline,
        limit=report.limit,
        occurrences=report.occurrences,
        last_seen_ms=now_ms,
    )


def reported(fault: Fault, report: Report, *, now_ms: int) -> Fault:
    """The fault after another report: the same object, or with more occurrences or a higher severity.

    A higher severity removes the acknowledgement.
    """
    if report.occurrences > fault.occurrences:
        fault = replace(fault, occurrences=report.occurrences, last_seen_ms=now_ms)
    if report.severity.rank <= fault.severity.rank:
        return fault
    return replace(
        fault,
        kind=report.kind,
        severity=report.severity,
        message=report.message,
        value=report.value,
        baseline=report.baseline,
        limit=report.limit,
        worse=fault.worse + 1,
        acknowledged_ms=None,
        acknowledged_by="",
    )


def acknowledged(fault: Fault, *, by: str, now_ms: int) -> Fault:
    """The fault, acknowledged; the same object if already acknowledged."""
    if fault.acknowledged_ms is not None:
        return fault
    return replace(fault, acknowledged_ms=now_ms, acknowledged_by=by)


def cleared(fault: Fault, *, now_ms: int) -> Fault:
    """The cleared fault."""
    return replace(fault, cleared_ms=now_ms)
