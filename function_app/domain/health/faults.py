"""A fault's life: ``raised → acknowledged → cleared``. It may get worse; it clears with or without acknowledgement.

Open faults of one device have one code each: what is reported again is the same fault, and what comes back after it was
cleared is the next one, with a count that is one higher.
"""

from dataclasses import dataclass, replace
from enum import StrEnum


class Severity(StrEnum):
    """How bad it is, mildest first: to know, to look at, to act on."""

    INFO = "info"
    WARNING = "warning"
    ERROR = "error"

    @property
    def rank(self) -> int:
        """Higher is worse."""
        return list(Severity).index(self)


class Source(StrEnum):
    """Who noticed: the device itself, the detectors, or the cloud, which no longer hears of the device."""

    DEVICE = "device"
    DETECTOR = "detector"
    CLOUD = "cloud"


@dataclass(frozen=True, slots=True)
class Report:
    """Something that is wrong now.

    Attributes:
        code: What, for programs: one open fault for each.
        kind: Which question found it: ``level``, ``trend``, ``change``, ``outlier``; ``reported``; ``silent``.
        message: What is wrong and what to do, for people.
        value: What was measured; ``baseline``: what is usual; ``limit``: what it must not pass.
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


@dataclass(frozen=True, slots=True)
class Fault:
    """One fault of one device, from its first report to its end.

    Attributes:
        id: Counts down with time: of all faults the newest sorts first.
        count: The first, second … fault of this code.
        worse: How often it got worse.
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
    )


def reported(fault: Fault, report: Report) -> Fault:
    """The open fault after one more report: the same object unless that is worse.

    What got worse wants to be acknowledged again.
    """
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
    """The fault, seen by somebody; the same object when somebody else was first."""
    if fault.acknowledged_ms is not None:
        return fault
    return replace(fault, acknowledged_ms=now_ms, acknowledged_by=by)


def cleared(fault: Fault, *, now_ms: int) -> Fault:
    """The fault at its end."""
    return replace(fault, cleared_ms=now_ms)
