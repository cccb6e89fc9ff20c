"""Tasks of robot types, from the manifest in the type's folder."""

from pathlib import PurePosixPath

from device_agent.protocol.errors import ProtocolError
from device_agent.protocol.manifests import tasks as manifests
from device_agent.protocol.manifests.measured_tasks import MeasuredTask
from device_agent.protocol.manifests.tasks import Task, Tasks
from function_app.domain.common.problems import Problem, not_found
from function_app.domain.identity.accounts import Identity
from function_app.services.robot_types.catalogue import RobotTypes


class RobotTypeTasks:
    """Reads tasks."""

    def __init__(self, *, robot_types: RobotTypes) -> None:
        self._robot_types = robot_types

    async def of_type(self, caller: Identity, robot_type: str) -> Tasks:
        """Objects and tasks of a robot type; without tasks if its folder has no manifest of them.

        Raises:
            Problem: ``robot-type-unknown``, ``robot-type-not-ready``, ``robot-type-damaged``, ``tasks-invalid``.
        """
        kind = await self._robot_types.get(caller, robot_type)
        name = str(PurePosixPath(kind.scene).parent / manifests.MANIFEST)
        try:
            content = await self._robot_types.file(caller, robot_type, name)
        except Problem as problem:
            if problem.code != "file-unknown":
                raise
            return Tasks()
        try:
            return manifests.parse(content.decode())
        except (ProtocolError, UnicodeDecodeError) as error:
            detail = f"The tasks of '{robot_type}' cannot be used: {manifests.MANIFEST}: {error}."
            raise Problem("tasks-invalid", 409, "The tasks cannot be used", detail) from error

    async def get(self, caller: Identity, robot_type: str, name: str) -> tuple[Tasks, Task | MeasuredTask]:
        """The manifest, and its task of this name.

        Raises:
            Problem: ``task-unknown``, and as ``of_type``.
        """
        manifest = await self.of_type(caller, robot_type)
        try:
            return manifest, manifest.find(name)
        except ProtocolError as error:
            raise not_found("task", name) from error
