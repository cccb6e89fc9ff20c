"""Trials of a task on all visible devices, their success rates, and published batches."""

from collections import defaultdict
from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import dataclass
from typing import Final, TypeVar

from function_app.domain.actions.trials import SuccessRate, Trial, TrialBatch, rate_of
from function_app.domain.common.problems import invalid
from function_app.domain.devices.devices import Device
from function_app.domain.identity.accounts import Identity
from function_app.services.actions.tasks import RobotTypeTasks
from function_app.services.actions.trial_log import TrialLog, key_of
from function_app.services.devices.device_access import DeviceAccess
from function_app.services.storage.retention import DAY_MS

MAX_TRIALS: Final = 5_000
"""Trials that one request evaluates, newest first."""
READ_SIZE: Final = 1_000
"""Trials of one read of a list. The limit of the caller would make a rare filter read very many pages."""
MAX_BATCHES: Final = 50
"""Batches in one report, newest first."""
_CURSOR_LENGTH: Final = 64

Key = TypeVar("Key", bound=Hashable)


@dataclass(frozen=True, slots=True)
class TaskReport:
    """Success rates of a task.

    Attributes:
        all: All trials on devices.
        devices: Device id → rate.
        versions: Version of the robot type → rate; 0: not reported.
        days: First moment of each day in UTC [ms since 1970] → rate.
        batches: Published batches.
        complete: Whether all trials were evaluated; else the oldest are missing.
    """

    all: SuccessRate
    devices: dict[str, SuccessRate]
    versions: dict[int, SuccessRate]
    days: dict[int, SuccessRate]
    batches: tuple[TrialBatch, ...]
    complete: bool


class TaskReports:
    """Reads trials and success rates, and stores published batches."""

    def __init__(self, *, trial_log: TrialLog, devices: DeviceAccess, tasks: RobotTypeTasks) -> None:
        self._trial_log = trial_log
        self._devices = devices
        self._tasks = tasks

    async def trials(
        self,
        caller: Identity,
        robot_type: str,
        task: str,
        *,
        device: str | None = None,
        state: str | None = None,
        cursor: str | None = None,
        limit: int,
    ) -> tuple[list[Trial], str | None]:
        """Trials of a task on visible devices, newest first, and the cursor of the next page.

        Args:
            caller: The account.
            robot_type: Robot type of the task.
            task: Name of the task.
            device: Only trials on this device.
            state: Only trials in this state.
            cursor: Cursor of the previous page.
            limit: Maximum number of trials.

        Raises:
            Problem: ``robot-type-unknown``, ``task-unknown``, ``device-unknown``, ``cursor-invalid``.
        """
        await self._tasks.get(caller, robot_type, task)
        if cursor is not None and not (cursor.isalnum() and len(cursor) <= _CURSOR_LENGTH):
            raise invalid("The cursor is not valid for this list. Start without a cursor.", code="cursor-invalid")
        devices = (
            await self._of_type(caller, robot_type) if device is None else [await self._devices.get(caller, device)]
        )
        found: list[Trial] = []
        after, seen = cursor or "", 0
        while seen < MAX_TRIALS:
            page = await self._trial_log.read(devices, after=after, limit=READ_SIZE)
            for trial in page:
                after = key_of(trial)
                seen += 1
                if _is_of(trial, robot_type, task) and state in {None, trial.state}:
                    found.append(trial)
                    if len(found) == limit:
                        return found, after
            if len(page) < READ_SIZE:
                return found, None
        return found, after

    async def report(self, caller: Identity, robot_type: str, task: str) -> TaskReport:
        """Success rates of a task on visible devices.

        Raises:
            Problem: ``robot-type-unknown``, ``task-unknown``.
        """
        await self._tasks.get(caller, robot_type, task)
        newest = await self._trial_log.read(await self._of_type(caller, robot_type), limit=MAX_TRIALS + 1)
        trials = [trial for trial in newest[:MAX_TRIALS] if _is_of(trial, robot_type, task)]
        batches = await self._trial_log.batches(caller.account, robot_type, task, limit=MAX_BATCHES)
        return TaskReport(
            all=rate_of(trials),
            devices=_by(trials, lambda trial: trial.device),
            versions=_by(trials, lambda trial: trial.type_version),
            days=_by(trials, lambda trial: trial.started_ms // DAY_MS * DAY_MS),
            batches=tuple(batches),
            complete=len(newest) <= MAX_TRIALS,
        )

    async def rates(self, caller: Identity, robot_type: str) -> Mapping[str, SuccessRate]:
        """The success rate of each task with trials on visible devices. Raises ``robot-type-unknown``."""
        newest = await self._trial_log.read(await self._of_type(caller, robot_type), limit=MAX_TRIALS)
        return _by([trial for trial in newest if trial.robot_type == robot_type], lambda trial: trial.task)

    async def publish(self, caller: Identity, robot_type: str, batch: TrialBatch) -> TrialBatch:
        """Store a batch of simulated trials of the caller's account.

        Raises:
            Problem: ``robot-type-unknown``, ``task-unknown``, ``invalid``: the numbers contradict each other.
        """
        await self._tasks.get(caller, robot_type, batch.task)
        if batch.successes + sum(batch.causes.values()) != batch.trials:
            raise invalid("successes and the numbers in causes must add up to trials.")
        return await self._trial_log.add_batch(caller.account, robot_type, batch)

    async def _of_type(self, caller: Identity, robot_type: str) -> list[Device]:
        return [device for device in await self._devices.all(caller) if device.robot_type == robot_type]


def _is_of(trial: Trial, robot_type: str, task: str) -> bool:
    return trial.robot_type == robot_type and trial.task == task


def _by(trials: Sequence[Trial], key: Callable[[Trial], Key]) -> dict[Key, SuccessRate]:
    groups: dict[Key, list[Trial]] = defaultdict(list)
    for trial in trials:
        groups[key(trial)].append(trial)
    return {group: rate_of(of_group) for group, of_group in sorted(groups.items(), key=lambda item: str(item[0]))}
