"""Is a measurement as it should be? Online detectors of small, fixed state, fed with means of ten seconds.

Four questions, each with its own answer: *level* (beyond a limit now), *trend* (on its way to a limit), *change*
(settled elsewhere: Page and Hinkley's), *outlier* (far from its own past). What is far is measured by the noise it has
shown and, where there are limits, by the room that is left to them: a joint that warms by ten kelvin at work is well, a
joint that cannot stop warming is not. Without noise there is no measure, and nothing is unusual.
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

WINDOW_MS = 10_000
MINUTE_MS = 60_000
GAP_MS = 5 * MINUTE_MS
"""After such a silence trends begin anew;"""
ABSENCE_MS = 30 * MINUTE_MS
"""after such a one everything does: the robot may have been off, and be cold."""
LARGEST = 1e15
"""Larger values are taken as this, so that sums and squares stay finite."""

LEVEL = "level"
TREND = "trend"
CHANGE = "change"
OUTLIER = "outlier"
KINDS = (LEVEL, TREND, CHANGE, OUTLIER)


@dataclass(frozen=True, slots=True)
class Limits:
    """What is known beforehand of one field; ``None`` where nothing is.

    Attributes:
        low: Below this something breaks; ``high``: above.
        warning_low: Below this somebody should look; ``warning_high``: above.
        change: A lasting shift that is worth a word; without it half of the room to the limits.
        horizon_s: How long before a limit a trend towards it is worth a word [s].
        kinds: The questions to ask.
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
        """The limit below that counts for trends and room."""
        return self.warning_low if self.low is None else self.low

    @property
    def highest(self) -> float | None:
        """The limit above."""
        return self.warning_high if self.high is None else self.high

    def room(self, value: float) -> float | None:
        """How far the nearest limit is from ``value``; ``None`` without limits, 0 beyond them."""
        rooms = []
        if self.highest is not None:
            rooms.append(self.highest - value)
        if self.lowest is not None:
            rooms.append(value - self.lowest)
        return max(0.0, min(rooms)) if rooms else None


SPAN = 10
"""Minutes that a trend is read from; as many before them say whether it lasts."""
SURE = 4.0
"""A slope, or the difference of two, of so many standard errors is one."""
SLOWING = 0.9
"""A slope that is less than this share of the one before is on its way to rest, not to the limit."""
PROVEN = 0.75
"""A slope that was this share of today's one ten minutes before is no beginning any more."""
SOON = 1 / 4
"""Of a trend that has only begun, this share of the horizon counts: it may be a warming that comes to rest."""


@dataclass(frozen=True, slots=True)
class Trend:
    """Where a field is going.

    Attributes:
        per_s: Its slope [unit/s].
        limit_in_s: Time until it meets a limit [s]; ``None``: it does not.
        proven: It has lasted for longer than the span it is read from.
    """

    per_s: float
    limit_in_s: float | None = None
    proven: bool = False


def trend(minutes: Sequence[float], limits: Limits) -> Trend | None:
    """The trend of the newest minutes' means; ``None`` for too few.

    What warms at work comes to rest like e^(-t/τ); what has lost its cooling does not. So a slope that decreases is
    followed to where it ends, and any other is taken to last.
    """
    if len(minutes) < SPAN:
        return None
    now = theil_sen(minutes[-SPAN:], MINUTE_MS / 1000)
    limit = limits.highest if now.per_s > 0 else limits.lowest
    if abs(now.per_s) <= SURE * now.error_per_s or now.per_s == 0 or limit is None:
        return Trend(now.per_s)
    left = limit - now.end
    if left * now.per_s <= 0:
        return Trend(now.per_s, 0.0, proven=True)
    if len(minutes) < 2 * SPAN:
        return Trend(now.per_s, left / now.per_s)
    before = theil_sen(minutes[-2 * SPAN : -SPAN], MINUTE_MS / 1000)
    share = now.per_s / before.per_s if before.per_s else math.inf
    slower = abs(before.per_s) - abs(now.per_s) > SURE / 2 * math.hypot(now.error_per_s, before.error_per_s)
    if 0 < share < SLOWING and slower:
        decay_s = SPAN * MINUTE_MS / 1000 / -math.log(share)
        # The slope is that of the middle of its span.
        rest = now.per_s * math.exp(-SPAN * MINUTE_MS / 2000 / decay_s) * decay_s
        return Trend(now.per_s, -decay_s * math.log1p(-left / rest) if left / rest < 1 else None, proven=True)
    return Trend(now.per_s, left / now.per_s, proven=0 < share < 1 / PROVEN)


@dataclass(frozen=True, slots=True)
class DetectorState:
    """All that is kept of one field between two windows.

    Attributes:
        seen_ms: Start of the newest window [ms since 1970].
        value: Its mean.
        minutes: Means of the newest whole minutes.
        minute: Sum and count of the open minute's windows.
        slope_per_s: The trend [unit/s].
        limit_in_s: Time until it meets a limit [s].
        level: Beyond a warning; ``breach``: beyond a limit.
        settled_at: Where it was before the change that is open.
    """

    seen_ms: int = 0
    value: float = 0.0
    baseline: Baseline = field(default_factory=Baseline)
    hinkley: PageHinkley = field(default_factory=PageHinkley)
    minutes: tuple[float, ...] = ()
    minute: tuple[float, int] = (0.0, 0)
    slope_per_s: float | None = None
    limit_in_s: float | None = None
    level: Streak = field(default_factory=Streak)
    breach: Streak = field(default_factory=Streak)
    trend: Streak = field(default_factory=Streak)
    outlier: Streak = field(default_factory=Streak)
    change: Streak = field(default_factory=Streak)
    settled_at: float | None = None

    @property
    def findings(self) -> tuple[str, ...]:
        """What is wrong."""
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
"""Where there are limits, a standard deviation is at least this share of the room to them."""
FAR = 8.0
"""An outlier is so many standard deviations away;"""
NEAR = 4.0
"""and is none any more so near."""
PATIENCE = 60
"""Windows for which a shift must last that is worth a word: ten minutes. A larger one is told sooner."""
SHIFT = 6.0
"""Without limits a lasting shift is one of so many standard deviations."""


def scale(previous: DetectorState, limits: Limits) -> float:
    """What a standard deviation of this field is taken to be; 0: it has not shown any."""
    if previous.baseline.varied < VARIED or previous.baseline.distance <= 0:
        return 0.0
    room = limits.room(previous.baseline.mean)
    # Rounding of a large value is no noise.
    least = 1e-9 * abs(previous.baseline.mean)
    return max(previous.baseline.noise, least, ROOM_SHARE * room if room is not None else 0.0)


def update(previous: DetectorState, limits: Limits, at_ms: int, value: float) -> DetectorState:
    """The watch after one more window; the same object for a window that is not newer.

    Args:
        previous: The watch before.
        limits: What is known of the field.
        at_ms: Start of the window [ms since 1970].
        value: Mean of the window; finite.
    """
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
        baseline=learn(previous.baseline, value, scale=spread, repeated=value == previous.value),
        level=_level(previous.level, limits.warning_low, limits.warning_high, limits, value),
        breach=_level(previous.breach, limits.low, limits.high, limits, value),
        outlier=_outlier(previous, value, spread) if warm and OUTLIER in limits.kinds else Streak(),
    )
    if LEVEL not in limits.kinds:
        after = replace(after, level=Streak(), breach=Streak())
    if CHANGE in limits.kinds:
        after = _changed(after, limits, value, spread if warm else 0.0)
    return _minute(previous, after, limits, at_ms, value)


def _after_gap(previous: DetectorState, at_ms: int) -> DetectorState:
    if not previous.seen_ms or at_ms - previous.seen_ms <= GAP_MS:
        return previous
    if at_ms - previous.seen_ms > ABSENCE_MS:
        return DetectorState(level=previous.level, breach=previous.breach)
    return replace(previous, minutes=(), minute=(0.0, 0), slope_per_s=None, limit_in_s=None, trend=Streak())


def _level(streak: Streak, low: float | None, high: float | None, limits: Limits, value: float) -> Streak:
    """Beyond for 20 s; inside again, by a fiftieth of the limit or of the band, for a minute."""
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
    """A shift that lasts about ten minutes; over when the value is back, or has been the new normal for an hour."""
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


def _minute(previous: DetectorState, after: DetectorState, limits: Limits, at_ms: int, value: float) -> DetectorState:
    """Close the minute that is over, and look where its trend leads."""
    total, count = previous.minute
    if not count or at_ms // MINUTE_MS == previous.seen_ms // MINUTE_MS:
        return replace(after, minute=(total + value, count + 1))
    minutes = (*previous.minutes, total / count)[-2 * SPAN :]
    after = replace(after, minutes=minutes, minute=(value, 1))
    if TREND not in limits.kinds:
        return after
    result = trend(minutes, limits)
    limit_in_s = None if result is None else result.limit_in_s
    horizon_s = limits.horizon_s * (1.0 if result is None or result.proven else SOON)
    near = limit_in_s is not None and limit_in_s <= horizon_s
    far = limit_in_s is None or limit_in_s > 1.5 * limits.horizon_s
    streak = after.trend.step(bad=near, good=far, after=3, until=5)
    return replace(after, slope_per_s=None if result is None else result.per_s, limit_in_s=limit_in_s, trend=streak)
