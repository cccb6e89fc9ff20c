"""The linter finds errors with their place without running the script."""

from pathlib import Path

import pytest

from device_agent.protocol.documents.script_api import script_api
from device_agent.protocol.manifests import robot_type
from device_agent.sandbox.api_document import document
from function_app.services.robot_types.script_linter import LintMessage, check_script
from tests.harness.paths import ROBOTS

UR5 = robot_type.load(ROBOTS / "ur5")
NAO = robot_type.load(ROBOTS / "nao")


def marks(source: str, kind: robot_type.RobotType = UR5) -> tuple[LintMessage, ...]:
    return check_script(source, kind).marks


@pytest.mark.parametrize(
    "path", sorted(ROBOTS.glob("*/movements/*.py")), ids=lambda path: f"{path.parts[-3]}/{path.stem}"
)
def test_shipped_movements_have_no_messages(path: Path) -> None:
    checked = check_script(path.read_text(), robot_type.load(path.parents[1]))
    assert checked.marks == ()
    assert checked.script is not None


@pytest.mark.parametrize(
    ("source", "severity", "where", "text"),
    [
        ("robot.home()\nwait(\n", "error", (2, 4), "never closed"),
        ("PARAMETERS = {'speed': 1 + len('x')}\n", "error", (1, 0), "literal dictionary"),
        ("PARAMETERS = {'speed': {'type': 'colour'}}\n", "error", (1, 0), "speed"),
        ("robot.hom()\n", "warning", (1, 0), "there are move_joints"),
        ("robot.move_joints({'elbow': 1, 'elbw': 1})\n", "warning", (1, 31), "no joint 'elbw'"),
        ("robot.move_to([0, 0, 1], frame='hand')\n", "warning", (1, 31), "no frame 'hand'"),
        ("robot.move_to([0, 0, 1], sped=1)\n", "warning", (1, 25), "no argument 'sped'"),
        ("robot.move_to()\n", "warning", (1, 0), "Without position_m"),
        ("robot.home(1, 2)\n", "warning", (1, 14), "Too many"),
        ("robot.home(1, speed=2)\n", "warning", (1, 14), "twice"),
        ("wiat(1)\n", "warning", (1, 0), "no 'wiat'"),
        ("import os.path, socket\n", "warning", (1, 0), "cannot import 'socket'"),
        ("from . import thing\n", "warning", (1, 0), "cannot import"),
        ("'ü'; wiat(1)\n", "warning", (1, 5), "no 'wiat'"),
    ],
)
def test_errors_are_reported_at_their_place(source: str, severity: str, where: tuple[int, int], text: str) -> None:
    (mark,) = marks(source)
    assert (mark.severity, (mark.line, mark.column)) == (severity, where), mark
    assert text in mark.message
    assert (mark.end_line, mark.end_column) > where


@pytest.mark.parametrize(
    "source",
    [
        "def robot_home(robot):\n    robot.anything()\n",
        "args = [1]\nrobot.home(*args)\n",
        "try:\n    robot.home()\nexcept RobotError as error:\n    print(error, sep='')\n",
        "match parameters:\n    case {'a': a, **rest}:\n        print(a, rest)\n",
        "match parameters:\n    case [b, *c] as d:\n        print(b, c, d)\n",
        "print([x for x in range(3)], (lambda y: y)(1), __name__, robot.__class__)\n",
        "name = 'elbow'\nrobot.move_joints({name: 1})\nrobot.posture('anything')\n",
        "def f():\n    global later\n    later = 1\nprint(later)\nimport numpy.linalg as la\nprint(la)\n",
    ],
)
def test_possibly_valid_code_has_no_message(source: str) -> None:
    assert marks(source) == ()


def test_names_are_those_of_the_robot_type() -> None:
    assert marks("robot.posture('Stand')\n", NAO) == ()
    (mark,) = marks("robot.posture('Fly')\n", NAO)
    assert "Stand" in mark.message


def test_a_wrong_indent_is_marked_in_its_line() -> None:
    (mark,) = marks("x = 1\n  y = 2\n")
    assert (mark.severity, mark.line, mark.message) == ("error", 2, "Unexpected indent.")


@pytest.mark.parametrize("source", ["", "(" * 30_000, "a." * 30_000 + "b", "x" * 100_000, "x\x00"])
def test_every_input_has_a_result(source: str) -> None:
    checked = check_script(source, UR5)
    assert checked.script is not None or checked.marks[0].severity == "error"


def test_the_document_equals_the_script_api() -> None:
    assert script_api() == document()
