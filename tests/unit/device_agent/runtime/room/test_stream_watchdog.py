"""Streams and cameras of a room device that give nothing, or the same for ever, though no error is raised."""

from device_agent.protocol.manifests.room import Watch
from device_agent.runtime.room.stream_watchdog import StreamWatchdog


class Bedside:
    """A vigil over one stream, read once a second of a clock that is set by hand."""

    def __init__(self, *watches: Watch, rate_hz: float = 1.0) -> None:
        self.now_s, self.rate_hz = 100.0, rate_hz
        self.vigil = StreamWatchdog(watches, lambda _: self.rate_hz, lambda: self.now_s)
        self.vigil.reset()

    def pass_s(self, seconds: int, *contents: object) -> list[str]:
        """Seconds go by, in which it gives these in turn, or nothing; the codes of what is wrong then."""
        for second in range(seconds):
            self.now_s += 1.0
            if contents:
                self.vigil.record("air", contents[second % len(contents)])
        return [fault.code for fault in self.vigil.faults()]


def test_what_gives_something_is_well() -> None:
    assert Bedside(Watch(source="air", silent_s=5.0, stuck_s=20.0)).pass_s(100, {"x": 1.0}, {"x": 1.1}) == []


def test_what_gives_nothing_is_silent_until_it_is_heard() -> None:
    bed = Bedside(Watch(source="air", silent_s=5.0))
    assert bed.pass_s(5) == []
    assert bed.pass_s(1) == ["silent.air"]
    assert bed.pass_s(1, {"x": 1.0}) == []


def test_nothing_is_wrong_before_anything_is_expected() -> None:
    vigil = StreamWatchdog((Watch(source="air", silent_s=5.0),), lambda _: 1.0, lambda: 100.0)
    vigil.record("air", {"x": 1.0})
    assert vigil.faults() == ()


def test_what_is_there_again_has_its_time_anew() -> None:
    bed = Bedside(Watch(source="air", silent_s=5.0))
    assert bed.pass_s(60) == ["silent.air"]
    bed.vigil.reset()
    assert bed.pass_s(5) == []


def test_what_is_read_seldom_may_be_silent_longer() -> None:
    bed = Bedside(Watch(source="air", silent_s=5.0), rate_hz=0.1)
    assert bed.pass_s(30) == []
    assert bed.pass_s(1) == ["silent.air"]


def test_what_is_always_the_same_is_stuck_and_one_difference_clears_it() -> None:
    bed = Bedside(Watch(source="air", stuck_s=20.0))
    assert bed.pass_s(21, {"x": 1.0}) == []
    assert bed.pass_s(1, {"x": 1.0}) == ["stuck.air"]
    assert bed.pass_s(1, {"x": 1.01}) == []


def test_a_few_readings_that_are_alike_are_chance() -> None:
    bed = Bedside(Watch(source="air", stuck_s=2.0))
    assert bed.pass_s(9, b"picture") == []
    assert bed.pass_s(1, b"picture") == ["stuck.air"]


def test_what_may_be_silent_and_the_same_is_never_wrong() -> None:
    bed = Bedside(Watch(source="air"))
    assert bed.pass_s(1000) == []
    assert bed.pass_s(1000, {"open": False}) == []
    assert Bedside().pass_s(1000) == []


def test_a_fault_that_goes_on_keeps_its_time_and_says_what_to_do() -> None:
    bed = Bedside(Watch(source="air", silent_s=5.0, stuck_s=20.0))
    bed.pass_s(10)
    (first,) = bed.vigil.faults()
    bed.pass_s(100)
    assert bed.vigil.faults() == (first,)
    assert "'air' has sent nothing for 5 s. Check that the device has power" in first.message
