"""Responses of faults, device health and the health check."""

from typing import Literal

from function_app.domain.health.server_health import Status
from function_app.entrypoints.http.framework.schemas import Moment, Response


class FaultOut(Response, frozen=True, kw_only=True):
    """A fault of a device, open or cleared.

    ``kind``: ``reported`` by the device, ``silent`` (no messages from it), or the detector: ``level`` (beyond a limit),
    ``trend`` (moving towards a limit), ``change`` (lasting shift), ``outlier`` (far from the baseline). ``count``:
    number of this fault among those with the same code. ``worsened``: how often its severity increased, which each
    time removes the acknowledgement. ``occurrences``: how often its condition has come and gone while it was open;
    ``last_seen_at``: the newest occurrence.
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
    occurrences: int
    last_seen_at: Moment | None


class FaultList(Response, frozen=True, kw_only=True):
    """Open faults, worst first; then cleared faults, newest first."""

    items: tuple[FaultOut, ...]
    cursor: str | None


Health = Literal["ok", "unknown", "warning", "fault"]


class DiagnosticFieldOut(Response, frozen=True, kw_only=True):
    """One monitored field, as mean of ten seconds.

    ``baseline`` is the usual value; ``usual_low`` and ``usual_high`` are the usual range, null until it is known.
    ``slope_per_s`` is the trend of the last ten minutes. The field reaches a limit between ``limit_earliest_s`` and
    ``limit_latest_s`` after ``updated_at`` with a probability of 90 %; null: uncertain, or no limit is approached.
    ``updated_at`` is the end of the newest mean.
    ``findings``: triggered detectors (``level``, ``trend``, ``change``, ``outlier``). ``advice``:
    instruction of the robot type or room; empty for unlisted fields.
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
    limit_earliest_s: float | None
    limit_latest_s: float | None
    findings: tuple[str, ...]
    updated_at: Moment


class FaultCounts(Response, frozen=True, kw_only=True):
    """Open faults by severity."""

    error: int
    warning: int
    info: int


class DeviceDiagnostics(Response, frozen=True, kw_only=True):
    """Health of a device, with its faults and monitored fields. ``unknown``: the device is offline."""

    device: str
    label: str
    health: Health
    online: bool
    last_seen_at: Moment | None
    counts: FaultCounts
    faults: tuple[FaultOut, ...]
    fields: tuple[DiagnosticFieldOut, ...]


class DeviceHealthOut(Response, frozen=True, kw_only=True):
    """Summary of a device's health. ``worst``: its most severe open fault."""

    device: str
    label: str
    space: str
    health: Health
    online: bool
    last_seen_at: Moment | None
    counts: FaultCounts
    worst: FaultOut | None


class DeviceHealthCounts(Response, frozen=True, kw_only=True):
    """Number of devices on this page by health."""

    fault: int
    warning: int
    unknown: int
    ok: int


class DeviceHealthList(Response, frozen=True, kw_only=True):
    """Devices, worst first. A page has the devices of up to ``limit`` agents."""

    counts: DeviceHealthCounts
    items: tuple[DeviceHealthOut, ...]
    cursor: str | None


class PartOut(Response, frozen=True, kw_only=True):
    """One part of the server. ``message``: the cause and the remedy, or a figure. ``since``: start of the status."""

    name: str
    status: Status
    message: str
    since: Moment


class LiveOut(Response, frozen=True, kw_only=True):
    """The process answers."""

    status: Literal["ok"]


class ReadyOut(Response, frozen=True, kw_only=True):
    """The worst status of a part. ``parts``: for administrators and the metrics token."""

    status: Literal["ok", "degraded"]
    parts: tuple[PartOut, ...] | None


class HealthOut(Response, frozen=True, kw_only=True):
    """Health of the server.

    Attributes:
        tables, broker, models: ``ok``, or the error; without sign-in, ``failed``.
        parts: For administrators and the metrics token.
    """

    status: Literal["ok", "degraded"]
    version: str
    tables: str
    broker: str
    models: str
    parts: tuple[PartOut, ...] | None


class WorkerOut(Response, frozen=True, kw_only=True):
    """A process that stores messages and runs timers. ``seen_at``: its newest heartbeat."""

    name: str
    host: str
    version: str
    started_at: Moment
    seen_at: Moment


class BrokerOut(Response, frozen=True, kw_only=True):
    """The broker of the installation, and its address for agents."""

    kind: str
    address: str


class LoggedOut(Response, frozen=True, kw_only=True):
    """A recent line of a log. ``program``: ``server``, or the name of a worker."""

    program: str
    at: Moment
    level: str
    message: str


class AdministrationOut(Response, frozen=True, kw_only=True):
    """The state of the installation. Sizes are null for a cloud store."""

    status: Status
    version: str
    parts: tuple[PartOut, ...]
    workers: tuple[WorkerOut, ...]
    broker: BrokerOut
    agents_online: int
    devices_online: int
    tables_bytes: int | None
    blobs_bytes: int | None
    free_bytes: int | None
    errors: tuple[LoggedOut, ...]
