"""Moving time of each lease by its source, on constructed timelines."""

from typing import TYPE_CHECKING, Any

import pytest

from device_agent.protocol import Mode
from device_agent.protocol.events import EventKind
from device_agent.runtime.telemetry.activity_meter import MAX_ELAPSED_S, REPORT_S, REST_S, ActivityMeter

if TYPE_CHECKING:
    from device_agent.runtime.authority.event_recorder import EventRecord

PERIOD_S = 0.008


class Timeline:
    """A meter, and the time of its control loop."""

    def __init__(self) -> None:
        self.events: list[EventRecord] = []
        self.meter = ActivityMeter(self.events.append)
        self.now_s = 100.0

    def run(self, for_s: float, mode: Mode, *, moving: bool = True, epoch: int = 1) -> None:
        for _ in range(round(for_s / PERIOD_S)):
            self.now_s += PERIOD_S
            self.meter.record_period(self.now_s, epoch=epoch, mode=mode, moving=moving)

    def rest(self, for_s: float = REPORT_S + 0.1, *, epoch: int = 1) -> None:
        self.run(for_s, Mode.IDLE, moving=False, epoch=epoch)

    def sums(self) -> dict[int, Any]:
        """The newest sums of each lease: operator, machine [s]."""
        return {each.data["epoch"]: (each.data["operator_s"], each.data["machine_s"]) for each in self.events}


@pytest.fixture
def timeline() -> Timeline:
    timeline = Timeline()
    timeline.rest(PERIOD_S)
    return timeline


def test_motion_under_setpoints_is_the_operators_and_all_other_motion_the_machines(timeline: Timeline) -> None:
    timeline.run(4.0, Mode.STREAMING)
    timeline.run(0.16, Mode.HOLDING)
    timeline.rest()
    timeline.run(1.2, Mode.ACTION)
    timeline.rest()
    (first, second) = timeline.events
    assert timeline.sums() == {1: (pytest.approx(4.0, abs=1e-3), pytest.approx(1.36, abs=1e-3))}
    assert (first.kind, first.data["machine_s"]) == (EventKind.ACTIVITY, pytest.approx(0.16, abs=1e-3))
    assert second.message == "moved 4.0 s by an operator and 1.4 s by itself"


@pytest.mark.parametrize("mode", [Mode.STREAMING, Mode.ACTION, Mode.IDLE, Mode.HOLDING, Mode.STOPPED])
def test_a_robot_at_rest_adds_nothing(timeline: Timeline, mode: Mode) -> None:
    timeline.run(20.0, mode, moving=False)
    timeline.rest(epoch=2)
    assert timeline.events == []


def test_a_new_lease_ends_the_sums_of_the_former_one(timeline: Timeline) -> None:
    timeline.run(2.0, Mode.ACTION)
    timeline.run(3.0, Mode.STREAMING, epoch=2)
    timeline.rest(epoch=2)
    near = pytest.approx
    assert timeline.sums() == {1: (0.0, near(2.0, abs=1e-3)), 2: (near(3.0, abs=1e-3), 0.0)}


def test_the_time_to_the_first_input_counts_from_the_lease(timeline: Timeline) -> None:
    timeline.run(2.0, Mode.ACTION)
    timeline.rest(epoch=2)
    timeline.run(1.0, Mode.STREAMING, epoch=2)
    timeline.run(1.0, Mode.STREAMING, epoch=2)
    timeline.rest(epoch=2)
    first, second = timeline.events
    assert first.data["first_input_s"] is None
    assert second.data["first_input_s"] == pytest.approx(REPORT_S + 0.1, abs=2 * PERIOD_S)


def test_long_motion_is_reported_while_it_lasts(timeline: Timeline) -> None:
    timeline.run(2.5 * REPORT_S, Mode.ACTION)
    assert [round(each.data["machine_s"]) for each in timeline.events] == [REPORT_S, 2 * REPORT_S]
    timeline.rest()
    assert timeline.sums() == {1: (0.0, pytest.approx(2.5 * REPORT_S, abs=1e-3))}
    timeline.rest(5 * REPORT_S)
    assert len(timeline.events) == 3, "nothing changed"


def test_short_motions_in_a_row_are_one_report(timeline: Timeline) -> None:
    for _ in range(5):
        timeline.run(0.2, Mode.STREAMING)
        timeline.rest(0.2)
    assert timeline.events == []
    timeline.rest(REST_S)
    assert timeline.sums() == {1: (pytest.approx(1.0, abs=1e-3), 0.0)}


def test_motions_with_long_pauses_are_one_report_in_ten_seconds(timeline: Timeline) -> None:
    for _ in range(10):
        timeline.run(0.5, Mode.STREAMING)
        timeline.rest(1.5)
    assert len(timeline.events) == 2
    timeline.meter.report(timeline.now_s)
    timeline.meter.report(timeline.now_s)
    assert len(timeline.events) == 3, "the rest when the agent ends, once"
    assert timeline.sums() == {1: (pytest.approx(5.0, abs=0.05), 0.0)}


@pytest.mark.parametrize("jump_s", [2.0, 1e6])
def test_a_stalled_control_loop_counts_until_the_watchdogs_time(timeline: Timeline, jump_s: float) -> None:
    timeline.run(1.0, Mode.ACTION)
    timeline.now_s += jump_s
    timeline.run(1.0, Mode.ACTION)
    timeline.rest()
    assert timeline.sums()[1][1] == pytest.approx(2.0 + MAX_ELAPSED_S - PERIOD_S, abs=PERIOD_S + 1e-3)
