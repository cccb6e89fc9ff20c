"""Tasks of a robot type that belongs to an account."""

import asyncio

import pytest

from device_agent.protocol.manifests import robot_type
from device_agent.protocol.manifests.robot_type import RobotType
from device_agent.protocol.manifests.tasks import MANIFEST
from function_app.domain.common.problems import Problem, not_found
from function_app.domain.identity.accounts import Identity
from function_app.services.actions.tasks import RobotTypeTasks
from tests.harness.paths import ROBOTS

FOLDER = ROBOTS / "ur5_gripper"
OWNER = Identity("owner", "", "")


class OwnTypes:
    """The robot types of the owner: one type, with this answer for the manifest of its tasks."""

    def __init__(self, answer: bytes | Problem) -> None:
        self.answer = answer

    async def get(self, caller: Identity, name: str) -> RobotType:
        assert (caller, name) == (OWNER, "own")
        return robot_type.parse((FOLDER / "robot.toml").read_text())

    async def file(self, caller: Identity, name: str, file: str) -> bytes:
        assert (caller, name, file) == (OWNER, "own", MANIFEST)
        if isinstance(self.answer, Problem):
            raise self.answer
        return self.answer


def tasks(answer: bytes | Problem) -> RobotTypeTasks:
    return RobotTypeTasks(robot_types=OwnTypes(answer))  # type: ignore[arg-type]


def rejected(answer: bytes | Problem) -> Problem:
    with pytest.raises(Problem) as error:
        asyncio.run(tasks(answer).of_type(OWNER, "own"))
    return error.value


def test_the_tasks_of_an_accounts_own_type_are_read_for_this_account() -> None:
    manifest, task = asyncio.run(tasks((FOLDER / MANIFEST).read_bytes()).get(OWNER, "own", "red_cube_in_green_tray"))
    assert task in manifest.tasks


def test_a_type_without_a_manifest_of_tasks_has_none() -> None:
    assert not asyncio.run(tasks(not_found("file", MANIFEST)).of_type(OWNER, "own")).tasks


def test_another_problem_of_the_file_is_reported() -> None:
    damaged = Problem("robot-type-damaged", 409, "The robot type is damaged", "")
    assert rejected(damaged) is damaged


@pytest.mark.parametrize("content", [b"[[tasks]]\nname = 1", b"\xff"])
def test_an_invalid_manifest_of_tasks_is_named(content: bytes) -> None:
    problem = rejected(content)
    assert (problem.code, problem.status, problem.title) == ("tasks-invalid", 409, "The tasks cannot be used")
    assert problem.detail.startswith(f"The tasks of 'own' cannot be used: {MANIFEST}: ")
