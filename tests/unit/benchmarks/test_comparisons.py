"""Comparisons with the papers and with other systems use the same work and the published figures."""

import statistics

import pytest

from benchmarks.papers import figure5, figure6, table2
from benchmarks.papers.table2 import EMBEDDED, MOSQUITTO, Condition
from benchmarks.peers import operators
from benchmarks.peers.arm import HOME_RAD, NAMES, setpoint
from benchmarks.peers.robots import from_ros, to_ros
from benchmarks.reporting.report import Report
from benchmarks.suites import operator
from device_agent.protocol import JointTarget, JointTelemetry, Mode, Setpoint, codec


@pytest.fixture
def report() -> Report:
    return Report(suite="papers", title="T", about=[], quick=True)


def test_table_2_has_the_published_means() -> None:
    assert (statistics.fmean(table2.HTTP), statistics.fmean(table2.XMPP)) == (2994.6, 824.25)


@pytest.mark.parametrize(("ours_ms", "holds"), [(2.0, True), (3.3, False)])
def test_table_2_compares_with_the_fastest_transport_other_than_mqtt(ours_ms: float, holds: bool) -> None:
    samples = {MOSQUITTO: [ours_ms], EMBEDDED: [1.0], "XMPP, Prosody": [4.0], "WebSocket, JSON relay": [3.0]}
    claim = table2.claim(Condition(15, 0.0, 1), samples)
    assert (claim.measured, claim.holds) == (ours_ms / 3.0, holds)
    assert "WebSocket" in claim.text


@pytest.mark.parametrize(("ours_ms", "holds"), [(824.0, True), (830.0, False)])
def test_table_2_from_operator_to_robot_compares_with_the_published_mean(
    report: Report, ours_ms: float, holds: bool
) -> None:
    operator.show(report, [1.0] * table2.SAMPLES, [ours_ms] * table2.SAMPLES)
    assert report.tables[0].rows[0] == [1, 800, 1.0, ours_ms]
    assert report.tables[0].rows[-1] == ["average", 824.25, 1.0, ours_ms]
    (claim,) = report.claims
    assert (claim.measured, claim.bound, claim.holds) == (ours_ms, 824.25, holds)


def test_paths_from_operator_to_robot_are_compared_with_mqtt_in_the_same_direction() -> None:
    found = {operator.BOTH_XMPP: ([4.0], [12.0]), operator.MQTT: ([2.0], [3.0])}
    table = operator.all_samples(0, found)
    assert [(row[0], row[-1]) for row in table.rows] == [
        (f"{operator.BOTH_XMPP}, to the robot", 2.0),
        (f"{operator.BOTH_XMPP}, and back", 4.0),
        (f"{operator.MQTT}, to the robot", 1.0),
        (f"{operator.MQTT}, and back", 1.0),
    ]


@pytest.mark.parametrize("quick", [True, False])
def test_all_runs_have_every_round_trip_time(quick: bool) -> None:
    conditions = table2.conditions(quick=quick)
    assert [each.rtt_ms for each in conditions if not each.loss] == [0, 15, 30, 100]
    assert 0 not in {each.rtt_ms for each in conditions if each.loss}


def test_figure_6_claims_mean_and_maximum_of_the_enrolment(report: Report) -> None:
    figure6.add_results(report, {figure6.ENROLLED: [16.0, 18.0, 41.0], "another": [99.0]})
    assert [(claim.measured, claim.holds) for claim in report.claims] == [(25.0, False), (41.0, False)]
    assert report.tables[0].rows[0][2:5] == [63.0, 36.0, 103.0]


def test_figure_5_claims_every_distant_robot_but_no_laboratory(report: Report) -> None:
    found: figure5.Samples = {}
    for robot in figure5.ROBOTS:
        for what in (figure5.SCRIPT, figure5.ACTION, figure5.SETPOINT):
            slow = 60.0 if what == figure5.SCRIPT and robot.name == "nao" else 24.0
            found[robot.label, what, figure5.RTT_MS] = [figure5.Sample(slow, slow + 10)] * 3
            found[robot.label, what, 0] = [figure5.Sample(1.0, 2.0)]
        found[f"{robot.label}, {figure5.LABORATORY}", figure5.ACTION, figure5.RTT_MS] = [figure5.Sample(500.0, 500.0)]
    figure5.show(report, found)
    assert [(claim.measured, claim.holds) for claim in report.claims] == [(24.0, True)] * 5 + [(60.0, False)]
    assert report.charts[0].series[figure5.SCRIPT] == [24.0, 60.0, 24.0, 24.0]


def test_peers_receive_the_same_setpoint() -> None:
    sent = codec.decode(codec.encode(setpoint(3, 1.0)), Setpoint)
    assert sent.sequence == 3
    assert sent.target == JointTarget(position_rad=dict(zip(NAMES, HOME_RAD, strict=True)))
    ros = from_ros({"header": {"seq": 7}, "name": ["a", "b"], "position": [0.5, -1.0]})
    assert (ros.sequence, ros.target) == (7, JointTarget(position_rad={"a": 0.5, "b": -1.0}))
    telemetry = JointTelemetry(
        tick_ms=1, at_ms=1500, sequence=1, mode=Mode.IDLE, position_rad=(0.5,), velocity_rad_s=(0.1,), effort_nm=(2.0,),
        commanded_rad=(0.6,), setpoint_sequence=7,
    )  # fmt: skip
    message = to_ros(telemetry)
    assert message["header"] == {"seq": 7, "stamp": {"secs": 1, "nsecs": 500_000_000}}
    assert (message["position"], message["velocity"], message["effort"]) == ((0.5,), (0.1,), (2.0,))


def operator_with_response(offset: int) -> operators.PeerOperator:
    peer = operators.PeerOperator(lambda sequence: peer.on_applied(sequence + offset))
    return peer


def test_an_exchange_ends_with_its_own_response_only(monkeypatch: pytest.MonkeyPatch) -> None:
    assert operator_with_response(0).exchange() >= 0
    monkeypatch.setattr(operators, "TIMEOUT_S", 0.05)
    with pytest.raises(TimeoutError, match="setpoint 1"):
        operator_with_response(-1).exchange()
