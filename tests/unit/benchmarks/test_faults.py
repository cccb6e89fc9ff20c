"""The fault benchmark finds lost and repeated actions, and measures from Stop to rest."""

import socket
from pathlib import Path

import pytest

from benchmarks.faults.action_load import STEP_RAD, RequestedAction, count_returns, duplicated, lost
from benchmarks.faults.fault_runs import FaultResult
from benchmarks.faults.recorder import Period, Recorder
from benchmarks.faults.stops import CALL, MESSAGE, SPEEDS, StopResult, evaluate
from benchmarks.suites.faults import claims, faults_table, stops_table
from tests.harness.network.brokers import wait_until


def requested(number: int, status: str) -> RequestedAction:
    return RequestedAction(number, "none", 0.0, f"a{number}" if status else "", status)


def test_unfinished_accepted_actions_are_lost_and_actions_with_two_starts_are_duplicated() -> None:
    actions = [requested(1, "done"), requested(2, "started"), requested(3, ""), requested(4, "expired")]
    assert lost(actions) == [actions[1]]
    assert duplicated(actions, {"a1": 1, "a4": 2}) == [actions[3]]


@pytest.mark.parametrize(
    ("steps", "count"),
    [
        ((1, 1.4, 2, 3), 0),
        ((1, 2, 3, 2, 4), 1),
        ((5, 6, 0, 7), 0),  # a restarted simulation begins at zero
    ],
)
def test_a_return_to_an_earlier_target_is_counted(steps: tuple[float, ...], count: int) -> None:
    assert count_returns([number * STEP_RAD for number in steps for _ in range(5)]) == count
    assert count_returns([each * 1e-4 for each in range(100)]) == 0, "positions on the method are not targets"


def stopped(*moved: float, braking_from: int, method: str = MESSAGE, speed: str = "full speed") -> StopResult:
    before = [Period(992.0, "streaming", 0.008, 1, 1)]
    after = [
        Period(1008.0 + 8 * index, "stopped" if index >= braking_from else "streaming", each, 1, 1)
        for index, each in enumerate(moved)
    ]
    return evaluate(before, after, sent_ms=1000.0, broker="amqtt", method=method, speed=speed)


@pytest.mark.parametrize(
    ("moved", "zero_ms"),
    [
        ((0.008, 0.006, 0.003, 0.0, 0.0), 32.0),
        ((0.008, 0.0, 0.002, 0.0, 0.0), 32.0),  # a reversal is not rest
        ((0.0, 0.0, 0.0), 16.0),
    ],
)
def test_stops_are_measured_to_braking_and_to_rest(moved: tuple[float, ...], zero_ms: float) -> None:
    result = stopped(*moved, braking_from=1)
    assert (result.braking_ms, result.zero_ms, result.at_rad_s) == (16.0, zero_ms, 1.0)


def test_motion_after_a_stop_fails_the_claim_of_rest() -> None:
    results = [
        FaultResult(fault="x", broker="amqtt", stop_ms=280.0, recovery_s=1.0, moved_again=again)
        for again in (False, True)
    ]
    stops = [
        stopped(0.0, 0.0, braking_from=0, method=method, speed=speed) for method in (MESSAGE, CALL) for speed in SPEEDS
    ]
    actions = {("amqtt", "x"): (10, 0, 1)}
    holds = {claim.text.partition(",")[0]: claim.holds for claim in claims(results, stops, actions)}
    assert not holds["last fresh setpoint → zero commanded velocity"]
    assert holds["lost"]
    assert not holds["duplicated: actions executed twice"]
    assert [row[-1] for row in faults_table(results, actions).rows] == [1]
    assert len(stops_table(stops).rows) == len(stops)


def test_the_recorder_receives_periods_of_the_agent(tmp_path: Path) -> None:
    recorder = Recorder(tmp_path / "s")
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as sender:
        for text in ("started arm1 x", "period arm0 10.5 streaming 0.001 3 7", "period arm0 18.5 stopped 0.002 3 7"):
            sender.sendto(text.encode(), str(tmp_path / "s"))
    wait_until(lambda: len(recorder.since("arm0", 0.0)) > 1, "two periods")
    assert recorder.starts == {"x": 1}
    assert recorder.since("arm0", 11.0) == [Period(18.5, "stopped", 0.002, 3, 7)]
    assert [row.target_rad for row in recorder.rows("arm0", 0.0)] == [(0.001,), (0.003,)]
    recorder.close()
