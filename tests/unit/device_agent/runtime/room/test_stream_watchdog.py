"""Stream watchdog: silent and stuck sources."""

from device_agent.protocol.manifests.room import Watch
from device_agent.runtime.room.stream_watchdog import StreamWatchdog


class Bedside:
    """A watchdog of one stream that is read once a second on a manual clock."""

    def __init__(self, *watches: Watch, rate_hz: float = 1.0) -> None:
        self.now_s, self.rate_hz = 100.0, rate_hz
        self.watchdog = StreamWatchdog(watches, lambda _: self.rate_hz, lambda: self.now_s)
        self.watchdog.reset()

    def pass_s(self, seconds: int, *contents: object) -> list[str]:
        """Seconds go by, in which it gives these in turn, or nothing; the codes of what is wrong then."""
        for second in range(seconds):
            self.now_s += 1.0
            if contents:
                self.watchdog.record("air", contents[second % len(contents)])
        return [fault.code for fault in self.watchdog.faults()]


def test_a_source_with_readings_has_no_fault() -> None:
    assert Bedside(Watch(source="air", silent_s=5.0, stuck_s=20.0)).pass_s(100, {"x": 1.0}, {"x": 1.1}) == []


def test_a_source_without_readings_is_silent_until_the_next_one() -> None:
    bed = Bedside(Watch(source="air", silent_s=5.0))
    assert bed.pass_s(5) == []
    assert bed.pass_s(1) == ["silent.air"]
    assert bed.pass_s(1, {"x": 1.0}) == []


def test_there_is_no_fault_before_the_first_reset() -> None:
    watchdog = StreamWatchdog((Watch(source="air", silent_s=5.0),), lambda _: 1.0, lambda: 100.0)
    watchdog.record("air", {"x": 1.0})
    assert watchdog.faults() == ()


def test_a_reset_restarts_the_timeout() -> None:
    bed = Bedside(Watch(source="air", silent_s=5.0))
    assert bed.pass_s(60) == ["silent.air"]
    bed.watchdog.reset()
    assert bed.pass_s(5) == []


def test_a_low_rate_extends_the_timeout() -> None:
    bed = Bedside(Watch(source="air", silent_s=5.0), rate_hz=0.1)
    assert bed.pass_s(30) == []
    assert bed.pass_s(1) == ["silent.air"]


def test_equal_readings_are_a_stuck_fault_until_one_differs() -> None:
    bed = Bedside(Watch(source="air", stuck_s=20.0))
    assert bed.pass_s(21, {"x": 1.0}) == []
    assert bed.pass_s(1, {"x": 1.0}) == ["stuck.air"]
    assert bed.pass_s(1, {"x": 1.01}) == []


def test_few_equal_readings_are_no_fault() -> None:
    bed = Bedside(Watch(source="air", stuck_s=2.0))
    assert bed.pass_s(9, b"picture") == []
    assert bed.pass_s(1, b"picture") == ["stuck.air"]


def test_a_source_without_limits_has_no_faults() -> None:
    bed = Bedside(Watch(source="air"))
    assert bed.pass_s(1000) == []
    assert bed.pass_s(1000, {"open": False}) == []
    assert Bedside().pass_s(1000) == []


def test_a_continuing_fault_keeps_its_time_and_gives_advice() -> None:
    bed = Bedside(Watch(source="air", silent_s=5.0, stuck_s=20.0))
    bed.pass_s(10)
    (first,) = bed.watchdog.faults()
    bed.pass_s(100)
    assert bed.watchdog.faults() == (first,)
    assert "'air' has sent nothing for 5 s. Check that the device has power" in first.message
