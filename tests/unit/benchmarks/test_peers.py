"""The compared systems do the same work, and each exchange ends with its own response."""

import threading

import pytest

from benchmarks.peers import operators
from benchmarks.peers.arm import HOME_RAD, NAMES, setpoint
from benchmarks.peers.robots import from_ros, to_ros
from benchmarks.peers.safety import COLUMNS, table
from device_agent.protocol import JointTarget, JointTelemetry, Mode, Setpoint, codec


def test_a_setpoint_asks_for_where_the_arm_is() -> None:
    asked = codec.decode(codec.encode(setpoint(3, 1.0)), Setpoint)
    assert asked.sequence == 3
    assert isinstance(asked.target, JointTarget)
    assert [asked.target.position_rad[name] for name in NAMES] == list(HOME_RAD)


def test_what_ros_asks_and_is_told_is_what_the_arm_does() -> None:
    asked = from_ros({"header": {"seq": 7}, "name": ["a", "b"], "position": [0.5, -1.0]})
    assert (asked.sequence, asked.target) == (7, JointTarget(position_rad={"a": 0.5, "b": -1.0}))
    told = JointTelemetry(
        tick_ms=1, at_ms=1500, sequence=1, mode=Mode.IDLE, position_rad=(0.5,), velocity_rad_s=(0.1,), effort_nm=(2.0,),
        commanded_rad=(0.6,), setpoint_sequence=7,
    )  # fmt: skip
    said = to_ros(told)
    assert said["header"] == {"seq": 7, "stamp": {"secs": 1, "nsecs": 500_000_000}}
    assert (said["position"], said["velocity"], said["effort"]) == ((0.5,), (0.1,), (2.0,))


def test_an_exchange_waits_for_its_own_answer() -> None:
    late: list[threading.Timer] = []

    def send(sequence: int) -> None:
        threading.Timer(0, operator.hear, [sequence - 1]).start()
        late.append(threading.Timer(0.1, operator.hear, [sequence]))
        late[-1].start()

    operator = operators.PeerOperator(send)
    assert operator.exchange() >= 95
    assert len(late) == 1


def test_an_exchange_without_an_answer_ends_the_run(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(operators, "TIMEOUT_S", 0.05)
    with pytest.raises(TimeoutError, match="setpoint 1"):
        operators.PeerOperator(lambda _: None).exchange()


def test_each_row_says_something_of_each_peer() -> None:
    assert {len(row) for row in table().rows} == {len(COLUMNS)}
