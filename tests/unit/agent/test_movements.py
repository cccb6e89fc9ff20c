"""Movement scripts in real processes, with a robot that only takes notes."""

import hashlib
import threading
import time
from typing import Any

import pytest

from device_agent.protocol.messages import RunMovement
from device_agent.runtime.lease import Refused
from device_agent.runtime.movements import Script, ScriptFailed


class Notes:
    joints = ("shoulder", "elbow")

    def __init__(self) -> None:
        self.calls: list[Any] = []

    def move_joints(self, position_rad: dict[str, float], speed: float) -> None:
        if "knee" in position_rad:
            raise Refused("unknown_joint", "no joint 'knee'")
        self.calls.append((position_rad, speed))

    def home(self, speed: float) -> None:
        self.calls.append(("home", speed))

    def state(self) -> dict[str, Any]:
        return {"position_rad": {"shoulder": 0.1, "elbow": 0.2}, "mode": "action"}


def run(source: str, parameters: dict[str, Any] | None = None) -> tuple[Notes, str, list[float]]:
    notes, printed, progress = Notes(), [], []

    def told(text: str, share: float | None) -> None:
        printed.append(text)
        if share is not None:
            progress.append(share)

    Script(order(source, parameters), notes, told).run()
    return notes, "".join(printed), progress


def order(source: str, parameters: dict[str, Any] | None = None) -> RunMovement:
    digest = hashlib.sha256(source.encode()).hexdigest()
    return RunMovement(
        robot_type="toy", name="wave", version=1, sha256=digest, source=source, parameters=parameters or {}
    )


def test_a_script_moves_prints_and_reads_its_parameters() -> None:
    notes, printed, progress = run(
        "for angle in parameters['angles']:\n"
        "    robot.move_joints({'elbow': angle}, speed=0.3)\n"
        "robot.move_joints([1, 2])\n"
        "robot.home()\n"
        "wait(0.01)\n"
        "progress(0.5)\n"
        "print('elbow', robot.state()['position_rad']['elbow'])\n",
        {"angles": [0.5, 1]},
    )
    assert notes.calls == [
        ({"elbow": 0.5}, 0.3),
        ({"elbow": 1.0}, 0.3),
        ({"shoulder": 1.0, "elbow": 2.0}, 0.5),
        ("home", 0.5),
    ]
    assert printed == "elbow 0.2\n"
    assert progress == [0.5]


@pytest.mark.parametrize(
    ("source", "says"),
    [
        ("x = 1\ny = x / 0\n", "line 2: ZeroDivisionError"),
        ("def f():\n    raise ValueError('no')\n\n\nf()\n", "line 2: ValueError: no"),
        ("robot.move_joints({'elbow': float('nan')})", "line 1: ValueError"),
        ("robot.move_joints({'elbow': 10**400})", "line 1: OverflowError"),
        ("robot.move_joints([1])", "line 1: RobotError: 1 positions for 2 joints"),
        ("\nrobot.move_joints({'knee': 1})", "line 2: RobotError: no joint 'knee'"),
        ("robot.move_joints({'elbow': 1}, speed=0)", "line 1: RobotError: speed"),
        ("robot.fly()", "line 1: AttributeError"),
        ("if True print", "line 1: SyntaxError"),
        ("raise SystemExit(3)", "line 1: SystemExit: 3"),
        ("import os\nos._exit(1)", "ended before the script did"),
    ],
)
def test_a_script_that_fails_says_where(source: str, says: str) -> None:
    with pytest.raises(ScriptFailed) as failed:
        run(source)
    assert says in str(failed.value)


def test_a_script_may_catch_what_the_robot_refuses() -> None:
    _, printed, _ = run("try:\n    robot.move_joints({'knee': 1})\nexcept RobotError as e:\n    print(e)\n")
    assert printed == "no joint 'knee'\n"


def test_a_script_is_killed_at_once() -> None:
    script = Script(order("wait(600)"), Notes(), lambda _text, _share: None)
    failures: list[ScriptFailed] = []

    def body() -> None:
        try:
            script.run()
        except ScriptFailed as failed:
            failures.append(failed)

    thread = threading.Thread(target=body)
    thread.start()
    deadline_s = time.monotonic() + 10
    while script._process is None and time.monotonic() < deadline_s:
        time.sleep(0.01)
    script.kill()
    thread.join(10)
    assert not thread.is_alive()
    assert failures


def test_a_script_killed_before_it_began_does_not_run() -> None:
    notes = Notes()
    script = Script(order("robot.home()"), notes, lambda _text, _share: None)
    script.kill()
    with pytest.raises(ScriptFailed):
        script.run()
    assert notes.calls == []


def test_a_script_sees_no_environment_of_the_agent(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TELESCOPE_SECRET", "x")
    _, printed, _ = run("import os\nprint(sorted(k for k in os.environ if k.startswith('TELESCOPE')))")
    assert printed == "[]\n"
