"""What the detectors find, as faults with words; and the health that follows from faults."""

from collections.abc import Iterable
from dataclasses import dataclass, field
from enum import StrEnum

from function_app.domain.health.detectors import CHANGE, LEVEL, NEAR, OUTLIER, TREND, DetectorState, Limits, scale
from function_app.domain.health.faults import Fault, Report, Severity, Source

_FIVE_DIGITS = 10_000.0


class Health(StrEnum):
    """How a device is: unknown when nothing is heard of it."""

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
    """How one field is to be judged.

    Attributes:
        label: What is measured, for people.
        unit: Of its values, for people.
        advice: What to do when something is wrong with it.
        listed: It is named by the robot type. Of any other field nobody has said what it should be: what is found there
            is worth knowing, and no warning.
    """

    label: str
    unit: str = ""
    advice: str = ""
    limits: Limits = field(default_factory=lambda: Limits(kinds=(CHANGE, OUTLIER)))
    listed: bool = False


def health(faults: Iterable[Fault], *, online: bool) -> Health:
    """The worst of the open faults; without any it is well if it is there."""
    worst = max((fault.severity.rank for fault in faults), default=0)
    if worst >= Severity.ERROR.rank:
        return Health.FAULT
    if worst >= Severity.WARNING.rank:
        return Health.WARNING
    return Health.OK if online else Health.UNKNOWN


def usual_range(watch: DetectorState, limits: Limits) -> tuple[float, float] | None:
    """Where values usually are; ``None`` as long as that is not known."""
    spread = scale(watch, limits)
    if spread <= 0:
        return None
    return watch.baseline.mean - NEAR * spread, watch.baseline.mean + NEAR * spread


def diagnose(rule: Rule, stream: str, name: str, watch: DetectorState) -> Report | None:
    """The one fault of a field: what is worst of all that is found."""
    result = watch.findings
    if not result:
        return None
    kind = (
        LEVEL
        if watch.breach.on
        else next(previous for previous in (TREND, LEVEL, CHANGE, OUTLIER) if previous in result)
    )
    severity = Severity.ERROR if watch.breach.on else Severity.WARNING if rule.listed else Severity.INFO
    limit = _limit(kind, rule.limits, watch)
    return Report(
        code=f"{stream}.{name}",
        source=Source.DETECTOR,
        kind=kind,
        severity=severity,
        message=f"{_words(kind, rule, name, watch, limit)} {rule.advice or 'Look at the device.'}",
        stream=stream,
        field=name,
        value=watch.value,
        baseline=watch.settled_at if kind == CHANGE else watch.baseline.mean,
        limit=limit,
    )


def _limit(kind: str, limits: Limits, watch: DetectorState) -> float | None:
    """The limit that a level is beyond or a trend leads to."""
    if kind == TREND:
        return limits.highest if (watch.slope_per_s or 0) > 0 else limits.lowest
    if kind != LEVEL:
        return None
    high, low = (limits.high, limits.low) if watch.breach.on else (limits.warning_high, limits.warning_low)
    if high is None or low is None:
        return low if high is None else high
    return high if abs(watch.value - high) < abs(watch.value - low) else low


def _words(kind: str, rule: Rule, name: str, watch: DetectorState, limit: float | None) -> str:
    part = name.partition(".")[2]
    what = f"{rule.label} ({part.replace('_', ' ')})" if part else rule.label
    value = _show(watch.value, rule.unit)
    if kind == LEVEL:
        bound = "its limit of" if watch.breach.on else "the warning at"
        return f"{what} is {value}, beyond {bound} {_show(limit or 0.0, rule.unit)}."
    if kind == TREND:
        slope = watch.slope_per_s or 0.0
        way = "rises" if slope > 0 else "falls"
        left = "now" if not watch.limit_in_s else f"in about {max(1, round(watch.limit_in_s / 60))} min"
        pace = _show(abs(slope) * 60, rule.unit)
        return f"{what} is {value} and {way} by {pace} a minute: {left} it reaches {_show(limit or 0.0, rule.unit)}."
    if kind == CHANGE:
        return f"{what} has settled at {value}; it was {_show(watch.settled_at or 0.0, rule.unit)} before."
    return f"{what} is {value}, far from the usual {_show(watch.baseline.mean, rule.unit)}."


def _show(value: float, unit: str) -> str:
    """Four digits; what has more is not written in powers of ten, which people would have to count."""
    return f"{value:.0f} {unit}".strip() if abs(value) >= _FIVE_DIGITS else f"{value:.4g} {unit}".strip()
