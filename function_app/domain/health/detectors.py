"""Online detectors with small, fixed state for measurements averaged over 10 s.

There are four detectors: *level* (beyond a limit), *trend* (moving towards a limit), *change* (a lasting shift,
Page-Hinkley) and *outlier* (far from its baseline). Distances are measured relative to the observed noise and to the
distance from the limits. A joint may warm by ten kelvin while it works; a joint that does not stop warming is a fault.
Without noise there is no scale, and no detector triggers.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

from function_app.domain.health.estimators import (
    MEMORY,
    VARIED,
    WARM_UP,
    Baseline,
    PageHinkley,
    Streak,
    learn,
    page_hinkley,
    theil_sen,
)
from function_app.domain.health.forecast import SHORT, Interval, forecast

WINDOW_MS = 10_000
MINUTE_MS = 60_000
GAP_MS = 5 * MINUTE_MS
"""After a gap of this length trends restart."""
ABSENCE_MS = 30 * MINUTE_MS
"""After a gap of this length all detectors restart: the robot may have been off."""
LARGEST = 1e15
"""Larger values are clipped to this, so that sums and squares stay finite."""

LEVEL = "level"
TREND = "trend"
CHANGE = "change"
OUTLIER = "outlier"
KINDS = (LEVEL, TREND, CHANGE, OUTLIER)


@dataclass(frozen=True, slots=True)
class Limits:
    """Known limits of one field; ``None``: unknown.

    Attributes:
        low: Below it damage occurs; ``high``: above it.
        warning_low: Below it a warning is raised; ``warning_high``: above it.
        change: Lasting shift that is reported; default: half of the distance to the limits.
        horizon_s: A trend is reported if it reaches a limit within this time [s].
        kinds: Enabled detectors.
    """

    low: float | None = None
    high: float | None = None
    warning_low: float | None = None
    warning_high: float | None = None
    change: float | None = None
    horizon_s: float = 2_700.0
    kinds: tuple[str, ...] = KINDS

    @property
    def lowest(self) -> float | None:
        """The lower limit for trends and distances."""
        return self.warning_low if self.low is None else self.low

    @property
    def highest(self) -> float | None:
        """The upper limit for trends and distances."""
        return self.warning_high if self.high is None else self.high

    def room(self, value: float) -> float | None:
        """Distance of ``value`` to the nearest limit; ``None`` without limits, 0 beyond them."""
        rooms = []
        if self.highest is not None:
            rooms.append(self.highest - value)
        if self.lowest is not None:
            rooms.append(value - self.lowest)
        return max(0.0, min(rooms)) if rooms else None


SPAN = 10
"""Minutes in the window of a trend; the window before it shows whether the trend lasts."""
SIGNIFICANT = 4.0
"""A slope is significant beyond this number of standard errors."""
SLOWING = 0.9
"""A slope below this share of the previous slope is decaying."""
PROVEN = 0.75
"""A trend is proven if the previous slope was at least this share of the current one."""


@dataclass(frozen=True, slots=True)
class Trend:
    """The trend of a field.

    Attributes:
        per_s: Slope [unit/s].
        limit_in_s: Time until it reaches a limit [s]; ``None``: never.
        proven: The trend has lasted longer than its window.
    """

    per_s: float
    limit_in_s: float | None = None
    proven: bool = False


def trend(minutes: Sequence[float], limits: Limits) -> Trend | None:
    """The trend of the newest one-minute means; ``None`` for too few values.

    Warming at work decays like e^(-t/τ); warming after a loss of cooling does not. A decreasing slope is therefore
    extrapolated to its end value, any other slope linearly.
    """
    if len(minutes) < SPAN:
        return None
    now = theil_sen(minutes[-SPAN:], MINUTE_MS / 1000)
    limit = limits.highest if now.per_s > 0 else limits.lowest
    if abs(now.per_s) <= SIGNIFICANT * now.error_per_s or now.per_s == 0 or limit is None:
        return Trend(now.per_s)
    left = limit - now.end
    if left * now.per_s <= 0:
        return Trend(now.per_s, 0.0, proven=True)
    if len(minutes) < 2 * SPAN:
        return Trend(now.per_s, left / now.per_s)
    before = theil_sen(minutes[-2 * SPAN : -SPAN], MINUTE_MS / 1000)
    share = now.per_s / before.per_s if before.per_s else math.inf
    slower = abs(before.per_s) - abs(now.per_s) > SIGNIFICANT / 2 * math.hypot(now.error_per_s, before.error_per_s)
    if 0 < share < SLOWING and slower:
        decay_s = SPAN * MINUTE_MS / 1000 / -math.log(share)
        # The slope applies to the middle of its window.
        rest = now.per_s * math.exp(-SPAN * MINUTE_MS / 2000 / decay_s) * decay_s
        return Trend(now.per_s, -decay_s * math.log1p(-left / rest) if left / rest < 1 else None, proven=True)
    return Trend(now.per_s, left / now.per_s, proven=0 < share < 1 / PROVEN)


@dataclass(frozen=True, slots=True)
class DetectorState:
    """State of the detectors of one field between two windows.

    Attributes:
        seen_ms: Start of the newest window [ms since 1970].
        value: Mean of that window.
        recent: Number since 1970 and mean of the newest windows, for the forecast.
        minutes: Means of the newest whole minutes, without gaps.
        minute: Sum and count of the windows of the current minute.
        slope_per_s: Slope [unit/s].
        limit_in_s: Expected time until a limit is reached [s]; only for the detector.
        forecast: 90 % prediction interval of that time; ``None``: uncertain, or no limit is approached.
        level: Beyond a warning; ``breach``: beyond a limit.
        settled_at: Value before the current change.
    """

    seen_ms: int = 0
    value: float = 0.0
    baseline: Baseline = field(default_factory=Baseline)
    hinkley: PageHinkley = field(default_factory=PageHinkley)
    recent: tuple[tuple[int, float], ...] = ()
    minutes: tuple[float, ...] = ()
    minute: tuple[float, int] = (0.0, 0)
    slope_per_s: float | None = None
    limit_in_s: float | None = None
    forecast: Interval | None = None
    level: Streak = field(default_factory=Streak)
    breach: Streak = field(default_factory=Streak)
    trend: Streak = field(default_factory=Streak)
    outlier: Streak = field(default_factory=Streak)
    change: Streak = field(default_factory=Streak)
    settled_at: float | None = None

    @property
    def findings(self) -> tuple[str, ...]:
        """The triggered detectors."""
        return tuple(
            kind
            for kind, on in (
                (LEVEL, self.level.on or self.breach.on),
                (TREND, self.trend.on),
                (CHANGE, self.change.on),
                (OUTLIER, self.outlier.on),
            )
            if on
        )


ROOM_SHARE = 0.05
"""With limits, the standard deviation is at least this share of the distance to them."""
FAR = 8.0
"""An outlier is this number of standard deviations away."""
NEAR = 4.0
"""An outlier ends within this number of standard deviations."""
PATIENCE = 60
"""Windows for which a minimal shift must last: ten minutes. Larger shifts are reported earlier."""
SHIFT = 6.0
"""Without limits, a lasting shift has this number of standard deviations."""


def scale(previous: DetectorState, limits: Limits) -> float:
    """Assumed standard deviation of the field; 0: no noise observed yet."""
    if previous.baseline.varied < VARIED or previous.baseline.distance <= 0:
        return 0.0
    room = limits.room(previous.baseline.mean)
    # The rounding error of a large value is not noise.
    least = 1e-9 * abs(previous.baseline.mean)
    return max(previous.baseline.noise, least, ROOM_SHARE * room if room is not None else 0.0)


def update(previous: DetectorState, limits: Limits, at_ms: int, value: float) -> DetectorState:
    """The state after one more window with its start [ms since 1970] and mean; the same object for an old window."""
    if at_ms <= previous.seen_ms:
        return previous
    value = max(-LARGEST, min(LARGEST, value))
    previous = _after_gap(previous, at_ms)
    spread = scale(previous, limits)
    warm = previous.baseline.count >= WARM_UP and spread > 0
    after = replace(
        previous,
        seen_ms=at_ms,
        value=value,
        recent=_recent(previous, limits, at_ms, value),
        baseline=learn(previous.baseline, value, scale=spread, repeated=value == previous.value),
        level=_level(previous.level, limits.warning_low, limits.warning_high, limits, value),
        breach=_level(previous.breach, limits.low, limits.high, limits, value),
        outlier=_outlier(previous, value, spread) if warm and OUTLIER in limits.kinds else Streak(),
    )
    if LEVEL not in limits.kinds:
        after = replace(after, level=Streak(), breach=Streak())
    if CHANGE in limits.kinds:
        after = _changed(after, limits, value, spread if warm else 0.0)
    return _forecast(_minute(previous, after, limits, at_ms, value), limits)


def _after_gap(previous: DetectorState, at_ms: int) -> DetectorState:
    if not previous.seen_ms or at_ms - previous.seen_ms <= GAP_MS:
        return previous
    if at_ms - previous.seen_ms > ABSENCE_MS:
        return DetectorState(level=previous.level, breach=previous.breach)
    after = replace(previous, recent=(), minutes=(), minute=(0.0, 0), trend=Streak())
    return replace(after, slope_per_s=None, limit_in_s=None, forecast=None)


def _level(streak: Streak, low: float | None, high: float | None, limits: Limits, value: float) -> Streak:
    """Triggers after 20 s beyond the limit; ends after one minute inside, with 2 % hysteresis."""
    if low is None and high is None:
        return Streak()
    ends = [end for end in (limits.lowest, limits.highest) if end is not None]
    margin = (max(ends) - min(ends) if len(ends) > 1 else abs(ends[0])) / 50
    beyond = (high is not None and value > high) or (low is not None and value < low)
    inside = (high is None or value < high - margin) and (low is None or value > low + margin)
    return streak.step(bad=beyond, good=inside, after=2, until=6)


def _outlier(previous: DetectorState, value: float, spread: float) -> Streak:
    distance = abs(value - previous.baseline.mean) / spread
    return previous.outlier.step(bad=distance > FAR, good=distance < NEAR, after=3, until=6)


def _changed(after: DetectorState, limits: Limits, value: float, spread: float) -> DetectorState:
    """Detects a shift of about ten minutes. Ends when the value is back, or after one hour at the new value."""
    room = limits.room(after.hinkley.mean)
    shift = limits.change or (None if room is None else room / 2)
    shift = SHIFT * spread if shift is None else max(shift, SHIFT * after.baseline.noise)
    if spread <= 0 or shift <= 0:
        hinkley, _ = page_hinkley(after.hinkley, value, delta=math.inf, threshold=math.inf)
        return replace(after, hinkley=hinkley)
    hinkley, changed = page_hinkley(after.hinkley, value, delta=shift / 2, threshold=shift / 2 * PATIENCE)
    if changed:
        return replace(after, hinkley=PageHinkley(), change=Streak(on=True), settled_at=after.hinkley.mean)
    if not after.change.on or after.settled_at is None:
        return replace(after, hinkley=hinkley)
    back = abs(value - after.settled_at) < shift / 2
    change = after.change.step(bad=False, good=True, after=1, until=6 if back else MEMORY)
    return replace(after, hinkley=hinkley, change=change, settled_at=after.settled_at if change.on else None)


SOON_S = 600.0
"""A trend is reported at once if its forecast ends within this time [s]."""


def _recent(previous: DetectorState, limits: Limits, at_ms: int, value: float) -> tuple[tuple[int, float], ...]:
    """The newest windows for the forecast, with seven digits, so that the state stays small."""
    if TREND not in limits.kinds or limits.lowest is limits.highest is None:
        return ()
    window = at_ms // WINDOW_MS
    earlier = tuple(each for each in previous.recent if each[0] < window)
    return (*earlier, (window, float(f"{value:.7g}")))[-SHORT[-1] :]


def _forecast(after: DetectorState, limits: Limits) -> DetectorState:
    """Forecast the time to a limit, from the end of the newest window."""
    if len(after.recent) < SHORT[0]:
        return replace(after, forecast=None)
    now_ms = after.seen_ms + WINDOW_MS
    recent = [(((window + 0.5) * WINDOW_MS - now_ms) / 1000, value) for window, value in after.recent]
    newest_ms = after.seen_ms // MINUTE_MS * MINUTE_MS - MINUTE_MS / 2 - now_ms
    count = len(after.minutes)
    minutes = [((newest_ms - (count - 1 - place) * MINUTE_MS) / 1000, mean) for place, mean in enumerate(after.minutes)]
    result = forecast(recent, minutes, low=limits.lowest, high=limits.highest)
    soon = result is not None and result.latest_s <= SOON_S
    return replace(after, forecast=result, trend=Streak(on=True) if soon else after.trend)


def _minute(previous: DetectorState, after: DetectorState, limits: Limits, at_ms: int, value: float) -> DetectorState:
    """Close a completed minute and update its trend."""
    total, count = previous.minute
    if not count or at_ms // MINUTE_MS == previous.seen_ms // MINUTE_MS:
        return replace(after, minute=(total + value, count + 1))
    mean = total / count
    missing = at_ms // MINUTE_MS - previous.seen_ms // MINUTE_MS - 1
    filled = tuple(mean + (value - mean) * (step + 1) / (missing + 1) for step in range(missing))
    minutes = (*previous.minutes, mean, *filled)[-2 * SPAN :]
    after = replace(after, minutes=minutes, minute=(value, 1))
    if TREND not in limits.kinds:
        return after
    result = trend(minutes, limits)
    limit_in_s = None if result is None else result.limit_in_s
    # A new trend may be a warm-up: it is left to the forecast.
    near = result is not None and result.proven and limit_in_s is not None and limit_in_s <= limits.horizon_s
    far = limit_in_s is None or limit_in_s > 1.5 * limits.horizon_s
    streak = after.trend.step(bad=near, good=far, after=3, until=5)
    return replace(after, slope_per_s=None if result is None else result.per_s, limit_in_s=limit_in_s, trend=streak)
