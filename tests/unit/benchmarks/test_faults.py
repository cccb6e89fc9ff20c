"""What the fault bench makes of records: orders lost and doubled, the way from Stop to rest."""

import socket

from benchmarks.faults.action_load import STEP_RAD, RequestedAction, duplicated, lost, went_back
from benchmarks.faults.fault_runs import FaultResult
from benchmarks.faults.recorder import Period, Recorder
from benchmarks.faults.stops import CALL, MESSAGE, SPEEDS, StopResult, evaluate
from benchmarks.suites.faults import claims, faults_table, stops_table
from tests.harness.network.brokers import wait_until


def order(number: int, status: str, action: str = "a") -> RequestedAction:
    return RequestedAction(number, "none", 0.0, action and f"{action}{number}", status)


def rest(*numbers: float) -> list[float]:
    return [number * STEP_RAD for number in numbers for _ in range(5)]


def test_an_accepted_order_without_an_end_is_lost_and_a_refused_one_is_not() -> None:
    given = [order(1, "done"), order(2, "started"), order(3, "", action=""), order(4, "expired")]
    assert lost(given) == [given[1]]


def test_an_order_that_began_twice_is_doubled() -> None:
    given = [order(1, "done"), order(2, "done"), order(3, "", action="")]
    assert duplicated(given, {"a1": 1, "a2": 2}) == [given[1]]


def test_a_move_that_is_done_again_after_a_later_one_is_seen_in_the_record() -> None:
    assert went_back(rest(1, 1.4, 2, 3)) == 0
    assert went_back(rest(1, 2, 3, 2, 4)) == 1
    assert went_back(rest(5, 6, 0, 7)) == 0, "a simulation that was started anew begins at zero"
    assert went_back([each * 1e-4 for each in range(100)]) == 0, "on the way it is at no mark"


def periods(*moved: float, braking_from: int) -> list[Period]:
    return [
        Period(1008.0 + 8 * index, "stopped" if index >= braking_from else "streaming", each, 1, 1)
        for index, each in enumerate(moved)
    ]


def stopped(found: list[Period], **more: str) -> StopResult:
    before = [Period(992.0, "streaming", 0.008, 1, 1)]
    return evaluate(before, found, sent_ms=1000.0, **{"broker": "amqtt", "way": MESSAGE, "speed": "full speed", **more})


def test_braking_is_the_first_period_under_the_stop_and_zero_the_first_without_motion() -> None:
    found = stopped(periods(0.008, 0.006, 0.003, 0.0, 0.0, braking_from=1))
    assert (found.braking_ms, found.zero_ms, found.at_rad_s) == (16.0, 32.0, 1.0)


def test_turning_through_zero_is_no_rest() -> None:
    assert stopped(periods(0.008, 0.0, 0.002, 0.0, 0.0, braking_from=1)).zero_ms == 32.0


def test_an_arm_at_rest_has_zero_where_it_is_stopped() -> None:
    found = stopped(periods(0.0, 0.0, 0.0, braking_from=1))
    assert found.zero_ms == found.braking_ms == 16.0


def test_a_thing_that_moves_again_breaks_the_claim_of_rest() -> None:
    found = [
        FaultResult(fault="x", broker="amqtt", stop_ms=280.0, recovery_s=1.0, moved_again=again)
        for again in (False, True)
    ]
    stops = [
        stopped(periods(0.0, 0.0, braking_from=0), way=way, speed=speed) for way in (MESSAGE, CALL) for speed in SPEEDS
    ]
    orders = {("amqtt", "x"): (10, 0, 1)}
    made = {each.text.partition(",")[0]: each for each in claims(found, stops, orders)}
    assert not made["last fresh setpoint → zero commanded velocity"].holds
    assert made["lost"].holds
    assert not made["duplicated: actions executed twice"].holds
    assert [row[-1] for row in faults_table(found, orders).rows] == [1]
    assert len(stops_table(stops).rows) == len(stops)


def test_the_agent_is_heard(tmp_path) -> None:
    noted = Recorder(tmp_path / "s")
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as line:
        for text in ("begun arm1 x", "period arm0 10.5 streaming 0.001 3 7", "period arm0 18.5 stopped 0.002 3 7"):
            line.sendto(text.encode(), str(tmp_path / "s"))
    wait_until(lambda: len(noted.since("arm0", 0.0)) > 1, "two periods")
    assert noted.begun == {"x": 1}
    assert noted.since("arm0", 11.0) == [Period(18.5, "stopped", 0.002, 3, 7)]
    assert [row.target_rad for row in noted.rows("arm0", 0.0)] == [(0.001,), (0.003,)]
    noted.close()
