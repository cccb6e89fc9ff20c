"""One trial of a task: seeded reset, movement script, verdict by the state of the simulation."""

import hashlib
from dataclasses import dataclass
from pathlib import Path

from device_agent import geometry
from device_agent.cli.trials.publish import Version
from device_agent.cli.trials.stepped_robot import SteppedRobot
from device_agent.config.catalogue import TYPES
from device_agent.config.errors import ConfigError
from device_agent.ports.driver import DriverError
from device_agent.ports.sandbox import Sandbox
from device_agent.protocol import RunMovement, SetControl
from device_agent.protocol.errors import ProtocolError
from device_agent.protocol.manifests import robot_type, tasks
from device_agent.protocol.manifests.robot_type import RobotType
from device_agent.protocol.manifests.tasks import Task, Tasks
from device_agent.runtime.actions.script_action import ScriptAction, ScriptFailed, ScriptSandbox
from device_agent.runtime.errors import Refused
from device_agent.simulation.tasks.success_monitor import SuccessMonitor

_SETTLE_S = 0.5
"""Time after the reset, in which the objects come to rest [s]."""
_AFTER_S = 1.0
"""Time after the script, in addition to the rest that the task demands [s]."""
_RESET = "reset_objects"
_TIME_LIMIT = "the time limit has passed"


@dataclass(frozen=True, slots=True, kw_only=True)
class TrialResult:
    """Outcome of one trial.

    Attributes:
        seed: Seed of the reset.
        success: Whether the condition of the task was met at the end.
        lifted: Whether the robot has lifted the object, or moved the joint.
        shortfall: What the state of the simulation lacks; empty after a success.
        duration_s: Simulated time from the reset to the end [s].
        script_error: Error of the script; empty without one. It does not affect the verdict.
    """

    seed: int
    success: bool
    lifted: bool
    shortfall: str
    duration_s: float
    script_error: str

    @property
    def timed_out(self) -> bool:
        """Whether the time limit ended the script."""
        return self.script_error == _TIME_LIMIT

    @property
    def reason(self) -> str:
        """Why the trial failed, for operators; empty after a success."""
        if self.success:
            return ""
        return f"{self.shortfall}; {self.script_error}" if self.script_error else self.shortfall


class TaskTrials:
    """Trials of one task, each in a new world.

    Args:
        name: ``TYPE/TASK``, the robot type and the task of its scene.
        sandbox: Runs the movement script.

    Raises:
        ConfigError: The type, the task or its movement is unknown, a manifest is wrong, or scripts cannot run here.
        GeometryError: The model of the type cannot be used.
    """

    def __init__(self, name: str, sandbox: Sandbox) -> None:
        kind, _, task = name.partition("/")
        self._folder = TYPES.folder(kind)
        self._type = TYPES.load_from(self._folder)
        self._manifest, self._task = _load(self._folder, self._type, task)
        path = self._folder / robot_type.MOVEMENTS / f"{self._task.movement}.py"
        if not path.is_file():
            raise ConfigError(f"task '{task}' needs the movement '{self._task.movement}', but there is no {path}")
        self._source = path.read_text(encoding="utf-8")
        refusal = sandbox.refusal(untrusted=False)
        if refusal is not None:
            raise ConfigError(refusal)
        self._sandbox = ScriptSandbox(sandbox, untrusted=False)
        self._geometry = geometry.load(self._type, self._folder, scene=self._manifest.scene)

    @property
    def version(self) -> Version:
        """What the trials try."""
        movement = hashlib.sha256(self._source.encode()).hexdigest()
        return Version(tasks_sha256=self._manifest.sha256, movement_sha256=movement, type_version=self._type.version)

    def run(self, seed: int) -> TrialResult:
        """Run one trial.

        Raises:
            DriverError: The world cannot be built, or the reset is rejected.
        """
        robot = SteppedRobot(self._type, self._folder, self._geometry, self._manifest.scene)
        try:
            self._reset(robot, seed)
            monitor = SuccessMonitor(self._manifest, self._task.name)
            robot.world.add(monitor)
            start_s = robot.now_s
            robot.timeout_s = start_s + self._task.time_limit_s
            error = self._run_script(robot)
            robot.run(self._task.success.rest_s + _AFTER_S, lambda: monitor.met)
            return TrialResult(
                seed=seed,
                success=monitor.met,
                lifted=monitor.lifted,
                shortfall=monitor.shortfall,
                duration_s=round(robot.now_s - start_s, 3),
                script_error=error,
            )
        finally:
            robot.close()

    def _reset(self, robot: SteppedRobot, seed: int) -> None:
        try:
            robot.api.execute(SetControl(control=_RESET, value=float(seed)))
        except Refused as refused:
            raise DriverError(f"the objects cannot be reset: {refused.message}") from refused
        robot.run(_SETTLE_S, lambda: False)

    def _run_script(self, robot: SteppedRobot) -> str:
        """Run the movement; returns its error."""
        request = RunMovement(
            robot_type=self._type.type,
            name=self._task.movement,
            version=1,
            sha256=hashlib.sha256(self._source.encode()).hexdigest(),
            source=self._source,
            parameters=self._task.parameters,
        )
        script = ScriptAction(request, robot.api, _ignore, sandbox=self._sandbox, on_exit=robot.api.release)
        robot.api.on_timeout = script.kill
        try:
            script.run()
        except ScriptFailed as failed:
            return _TIME_LIMIT if robot.timed_out else str(failed)
        finally:
            robot.api.release()
        return ""


def _ignore(output: str, share: float | None) -> None:
    """Printed output and progress are not shown."""


def _load(folder: Path, kind: RobotType, task: str) -> tuple[Tasks, Task]:
    try:
        manifest = tasks.load(folder / kind.scene)
        if manifest is None:
            raise ConfigError(f"the scene of '{kind.type}' has no tasks: there is no {folder / tasks.MANIFEST}")
        return manifest, manifest.task(task)
    except ProtocolError as error:
        raise ConfigError(str(error)) from error
