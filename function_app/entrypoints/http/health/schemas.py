"""Responses of faults, device health and the health check."""

from typing import Literal

from function_app.entrypoints.http.framework.schemas import Moment, Response


class FaultOut(Response, frozen=True, kw_only=True):
    """Something that is or was wrong.

    ``kind``: ``reported`` by the device; ``silent``: nothing is heard of it; or what a detector found: ``level``, it is
    beyond a limit; ``trend``, on its way to one; ``change``, settled elsewhere; ``outlier``, far from its past.
    ``count``: first, second … of its code. ``worsened``: how often it got worse, each time to be acknowledged again.
    """

    id: str
    code: str
    state: Literal["raised", "acknowledged", "cleared"]
    source: Literal["device", "detector", "cloud"]
    kind: str
    severity: Literal["info", "warning", "error"]
    message: str
    stream: str
    field: str
    value: float | None
    baseline: float | None
    limit: float | None
    raised_at: Moment
    acknowledged_at: Moment | None
    acknowledged_by: str
    cleared_at: Moment | None
    count: int
    worsened: int


class FaultList(Response, frozen=True, kw_only=True):
    """Open ones worst first; then the history, newest first."""

    items: tuple[FaultOut, ...]
    cursor: str | None


Health = Literal["ok", "unknown", "warning", "fault"]


class DiagnosticFieldOut(Response, frozen=True, kw_only=True):
    """One watched field, by means over ten seconds.

    ``baseline`` is what is usual; values are usually from ``usual_low`` to ``usual_high``, null until that is known.
    ``slope_per_s`` is the trend of the last ten minutes; ``limit_in_s`` the time until it meets a limit, null: it
    does not. ``findings``: what is wrong now, of ``level``, ``trend``, ``change``, ``outlier``. ``advice``: what to do
    then, by the robot type or the room; empty for unlisted fields.
    """

    stream: str
    field: str
    label: str
    unit: str
    advice: str
    value: float
    baseline: float
    usual_low: float | None
    usual_high: float | None
    warning_low: float | None
    warning_high: float | None
    low: float | None
    high: float | None
    slope_per_s: float | None
    limit_in_s: float | None
    findings: tuple[str, ...]
    updated_at: Moment


class FaultCounts(Response, frozen=True, kw_only=True):
    """Open faults by severity."""

    error: int
    warning: int
    info: int


class DeviceDiagnostics(Response, frozen=True, kw_only=True):
    """How a device is, and all that is watched of it. ``unknown``: nothing is heard of it."""

    device: str
    label: str
    health: Health
    online: bool
    last_seen_at: Moment | None
    counts: FaultCounts
    faults: tuple[FaultOut, ...]
    fields: tuple[DiagnosticFieldOut, ...]


class DeviceHealthOut(Response, frozen=True, kw_only=True):
    """How a device is, in short. ``worst`` is its worst open fault."""

    device: str
    label: str
    space: str
    health: Health
    online: bool
    last_seen_at: Moment | None
    counts: FaultCounts
    worst: FaultOut | None


class DeviceHealthCounts(Response, frozen=True, kw_only=True):
    """Devices of this page by health."""

    fault: int
    warning: int
    unknown: int
    ok: int


class DeviceHealthList(Response, frozen=True, kw_only=True):
    """Devices, worst first. A page holds those of up to ``limit`` agents, by default all."""

    counts: DeviceHealthCounts
    items: tuple[DeviceHealthOut, ...]
    cursor: str | None


class HealthOut(Response, frozen=True, kw_only=True):
    """``ok``, or a sentence, for each thing the functions need."""

    status: Literal["ok", "degraded"]
    version: str
    tables: str
    broker: str
