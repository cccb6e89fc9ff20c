"""Fault reporter: one fault for each condition, with a count of its occurrences."""

from unittest import mock

from device_agent.protocol import Fault
from device_agent.runtime.authority import fault_reporter
from device_agent.runtime.authority.fault_reporter import FaultReporter

STABLE_S = 30.0


class ReporterFixture:
    """A fault reporter on a manual clock."""

    def __init__(self) -> None:
        self.now_s = 100.0
        self.reporter = FaultReporter(stable_s=STABLE_S, clock_s=lambda: self.now_s)
        self.raised = self.cleared = 0

    def see(self, *codes: str, message: str = "") -> None:
        self.now_s += 1.0
        changes = self.reporter.update([Fault(code=code, message=message, since_ms=1) for code in codes])
        self.raised += len(changes.raised)
        self.cleared += len(changes.cleared)


def test_a_condition_that_comes_and_goes_is_one_fault_with_a_count() -> None:
    fixture = ReporterFixture()
    for number in range(820):
        fixture.see("silent.camera", message=f"gap {number}")
        fixture.see()
    (fault,) = fixture.reporter.faults
    assert (fault.count, fault.message, fixture.raised, fixture.cleared) == (820, "gap 819", 1, 0)
    assert fault.last_ms > fault.since_ms


def test_each_occurrence_has_its_time() -> None:
    fixture = ReporterFixture()
    with mock.patch.object(fault_reporter, "wall_ms", side_effect=[1000, 2000]):
        fixture.see("driver")
        assert fixture.reporter.faults[0].last_ms == 1000
        fixture.see("driver")
        assert fixture.reporter.faults[0].last_ms == 2000


def test_a_fault_is_cleared_after_a_stable_time_and_its_recurrence_is_a_new_fault() -> None:
    fixture = ReporterFixture()
    fixture.see("driver", "silent.air")
    for _ in range(round(STABLE_S) - 1):
        fixture.see("driver")
    assert [fault.code for fault in fixture.reporter.faults] == ["driver", "silent.air"]
    fixture.see("driver")
    assert [fault.code for fault in fixture.reporter.faults] == ["driver"]
    fixture.see("driver", "silent.air")
    assert [(fault.code, fault.count) for fault in fixture.reporter.faults] == [("driver", 1), ("silent.air", 1)]
    assert (fixture.raised, fixture.cleared) == (3, 1)
