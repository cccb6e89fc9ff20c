"""Load governors at a level, in virtual time."""

from device_agent.runtime.load import LoadGovernor

PERIOD_S = 0.01


def advance(load: LoadGovernor, start_s: float, seconds: float, *, late_s: float = 0.0) -> float:
    """Report control periods for some virtual time; returns the end [s]."""
    periods = round(seconds / PERIOD_S)
    for number in range(1, periods + 1):
        load.record_period(start_s + number * PERIOD_S, late_s=late_s, period_s=PERIOD_S)
    return start_s + periods * PERIOD_S


def raise_level(load: LoadGovernor, level: int) -> None:
    """Report late periods until the level is reached."""
    now_s = 1000.0
    while load.level < level:
        now_s = advance(load, now_s, 0.1, late_s=PERIOD_S)
