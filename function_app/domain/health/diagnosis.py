"""Converts detector results to fault reports, and faults to a health status."""

import math
from collections.abc import Iterable
from dataclasses import dataclass, field
from enum import StrEnum

from function_app.domain.health.detectors import CHANGE, LEVEL, NEAR, OUTLIER, TREND, DetectorState, Limits, scale
from function_app.domain.health.faults import Fault, Report, Severity, Source
from function_app.domain.health.forecast import Interval

_FIVE_DIGITS = 10_000.0
_LONG_S = 120.0


class Health(StrEnum):
    """Health of a device; unknown if it is offline."""

    OK = "ok"
    UNKNOWN = "unknown"
    WARNING = "warning"
    FAULT = "fault"

    @property
    def rank(self) -> int:
        """Higher is worse."""
        return list(Health).index(self)


@dataclass(frozen=True, slots=True)
class Rule:
    """Diagnosis settings of one field.

    Attributes:
        label: Display name.
        unit: Display unit.
        advice: Instruction for the operator.
        listed: Whether the robot type lists the field. Findings on other fields are informational.
    """

    label: str
    unit: str = ""
    advice: str = ""
    limits: Limits = field(default_factory=lambda: Limits(kinds=(CHANGE, OUTLIER)))
    listed: bool = False


def health(faults: Iterable[Fault], *, online: bool) -> Health:
    """The health that follows from the open faults and the connection."""
    worst = max((fault.severity.rank for fault in faults), default=0)
    if worst >= Severity.ERROR.rank:
        return Health.FAULT
    if worst >= Severity.WARNING.rank:
        return Health.WARNING
    return Health.OK if online else Health.UNKNOWN


def usual_range(watch: DetectorState, limits: Limits) -> tuple[float, float] | None:
    """The usual range of values; ``None`` if unknown."""
    spread = scale(watch, limits)
    if spread <= 0:
        return None
    return watch.baseline.mean - NEAR * spread, watch.baseline.mean + NEAR * spread


def diagnose(rule: Rule, stream: str, name: str, watch: DetectorState) -> Report | None:
    """The most severe fault of a field."""
    result = watch.findings
    if not result:
        return None
    kind = (
        LEVEL
        if watch.breach.on
        else next(candidate for candidate in (TREND, LEVEL, CHANGE, OUTLIER) if candidate in result)
    )
    severity = Severity.ERROR if watch.breach.on else Severity.WARNING if rule.listed else Severity.INFO
    limit = _limit(kind, rule.limits, watch)
    return Report(
        code=f"{stream}.{name}",
        source=Source.DETECTOR,
        kind=kind,
        severity=severity,
        message=f"{_describe(kind, rule, name, watch, limit)} {rule.advice or 'Check the device.'}",
        stream=stream,
        field=name,
        value=watch.value,
        baseline=watch.settled_at if kind == CHANGE else watch.baseline.mean,
        limit=limit,
    )


def _limit(kind: str, limits: Limits, watch: DetectorState) -> float | None:
    """The exceeded limit, or the limit that a trend approaches."""
    if kind == TREND:
        return limits.highest if (watch.slope_per_s or 0) > 0 else limits.lowest
    if kind != LEVEL:
        return None
    high, low = (limits.high, limits.low) if watch.breach.on else (limits.warning_high, limits.warning_low)
    if high is None or low is None:
        return low if high is None else high
    return high if abs(watch.value - high) < abs(watch.value - low) else low


def _describe(kind: str, rule: Rule, name: str, watch: DetectorState, limit: float | None) -> str:
    part = name.partition(".")[2]
    what = f"{rule.label} ({part.replace('_', ' ')})" if part else rule.label
    value = _show(watch.value, rule.unit)
    if kind == LEVEL:
        bound = "its limit of" if watch.breach.on else "the warning limit of"
        return f"{what} is {value}, beyond {bound} {_show(limit or 0.0, rule.unit)}."
    if kind == TREND:
        slope = watch.slope_per_s or 0.0
        verb = "rises" if slope > 0 else "falls"
        per_minute = _show(abs(slope) * 60, rule.unit)
        bound = _show(limit or 0.0, rule.unit)
        when = "" if watch.forecast is None else f" It reaches {bound} {_when(watch.forecast)}."
        return f"{what} is {value} and {verb} by {per_minute} per minute towards {bound}.{when}"
    if kind == CHANGE:
        return f"{what} has changed to {value} from {_show(watch.settled_at or 0.0, rule.unit)}."
    return f"{what} is {value}, far from the usual {_show(watch.baseline.mean, rule.unit)}."


def _when(forecast: Interval) -> str:
    """The interval, in minutes if it starts after two minutes."""
    if forecast.latest_s <= 0:
        return "now"
    unit, name = (60, "min") if forecast.earliest_s >= _LONG_S else (1, "s")
    return f"in {math.floor(forecast.earliest_s / unit)} to {math.ceil(forecast.latest_s / unit)} {name}"


def _show(value: float, unit: str) -> str:
    """The value with four digits, without scientific notation."""
    return f"{value:.0f} {unit}".strip() if abs(value) >= _FIVE_DIGITS else f"{value:.4g} {unit}".strip()
