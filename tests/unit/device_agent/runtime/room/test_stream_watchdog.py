"""Stream watchdog: silent and stuck sources."""

from device_agent.protocol.manifests.room import Watch
from device_agent.runtime.room.stream_watchdog import StreamWatchdog


class WatchdogFixture:
    """A watchdog of one stream that is read once a second on a manual clock."""

    def __init__(self, *watches: Watch, rate_hz: float = 1.0) -> None:
        self.now_s = 100.0
        self.watchdog = StreamWatchdog(watches, lambda _: rate_hz, lambda: self.now_s)
        self.watchdog.reset()

    def faults_after(self, seconds: int, *contents: object) -> list[str]:
        """Codes of the faults after these seconds with readings of these contents in turn, or with none."""
        for second in range(seconds):
            self.now_s += 1.0
            if contents:
                self.watchdog.record("air", contents[second % len(contents)])
        return [fault.code for fault in self.watchdog.faults()]


def test_sources_with_changing_readings_or_without_limits_have_no_fault() -> None:
    watched = WatchdogFixture(Watch(source="air", silent_s=5.0, stuck_s=20.0))
    assert watched.faults_after(100, {"x": 1.0}, {"x": 1.1}) == []
    unlimited = WatchdogFixture(Watch(source="air"))
    assert unlimited.faults_after(1000) == []
    assert unlimited.faults_after(1000, {"open": False}) == []
    assert WatchdogFixture().faults_after(1000) == []


def test_a_source_without_readings_is_silent_until_the_next_one_or_a_reset() -> None:
    fixture = WatchdogFixture(Watch(source="air", silent_s=5.0))
    assert fixture.faults_after(5) == []
    assert fixture.faults_after(1) == ["silent.air"]
    assert fixture.faults_after(1, {"x": 1.0}) == []
    assert fixture.faults_after(60) == ["silent.air"]
    fixture.watchdog.reset()
    assert fixture.faults_after(5) == []


def test_there_is_no_fault_before_the_first_reset() -> None:
    watchdog = StreamWatchdog((Watch(source="air", silent_s=5.0),), lambda _: 1.0, lambda: 100.0)
    watchdog.record("air", {"x": 1.0})
    assert watchdog.faults() == ()


def test_a_low_rate_extends_the_timeout() -> None:
    fixture = WatchdogFixture(Watch(source="air", silent_s=5.0), rate_hz=0.1)
    assert fixture.faults_after(30) == []
    assert fixture.faults_after(1) == ["silent.air"]


def test_enough_equal_readings_are_a_stuck_fault_until_one_differs() -> None:
    fixture = WatchdogFixture(Watch(source="air", stuck_s=20.0))
    assert fixture.faults_after(21, {"x": 1.0}) == []
    assert fixture.faults_after(1, {"x": 1.0}) == ["stuck.air"]
    assert fixture.faults_after(1, {"x": 1.01}) == []
    quick = WatchdogFixture(Watch(source="air", stuck_s=2.0))
    assert quick.faults_after(9, b"picture") == []
    assert quick.faults_after(1, b"picture") == ["stuck.air"]


def test_a_continuing_fault_keeps_its_time_and_gives_advice() -> None:
    fixture = WatchdogFixture(Watch(source="air", silent_s=5.0, stuck_s=20.0))
    fixture.faults_after(10)
    (first,) = fixture.watchdog.faults()
    fixture.faults_after(100)
    assert fixture.watchdog.faults() == (first,)
    assert "'air' has sent nothing for 5 s. Check that the device has power" in first.message
