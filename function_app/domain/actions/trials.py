"""Trials of tasks and their success rate.

A trial counts with the verdict of the monitor that observed the task. Trials with an unknown outcome do not count.
"""

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Final, Literal

_Z_95: Final = 1.959963984540054
"""Quantile of the normal distribution for 95 % on both sides."""

TrialState = Literal["running", "success", "failed", "unknown"]


@dataclass(frozen=True, slots=True)
class Trial:
    """One trial of a task on one device.

    Attributes:
        action: Id of the action that ran it; its last part counts down with time.
        device: Device id.
        robot_type: Robot type of the device.
        task: Name of the task.
        movement: Name of the movement.
        movement_version: Version of the movement.
        tasks_sha256: Hash of the manifest that defines the task.
        seed: Seed of the reset of the objects; ``None``: nothing was reset.
        epoch: Epoch of the session in which it ran.
        caller: Name of the account that started it.
        started_ms: Start of the action [ms since 1970].
        ended_ms: End of the action [ms since 1970]; 0: it runs.
        state: Verdict of the monitor; ``running`` until the action has ended.
        cause: Why it has no success; a ``TrialCause``.
        detail: The cause in words.
        duration_s: From the reset to the verdict, on the clock of the monitor [s].
        simulated: Whether the device is simulated; ``None``: not reported.
        software: Release of the agent.
        type_version: Version of the robot type at the agent; 0: not reported.
        expires_ms: When it is deleted [ms since 1970].
    """

    action: str
    device: str
    robot_type: str
    task: str
    movement: str
    movement_version: int
    tasks_sha256: str
    seed: int | None
    epoch: int
    caller: str
    started_ms: int
    ended_ms: int = 0
    state: TrialState = "running"
    cause: str = ""
    detail: str = ""
    duration_s: float = 0.0
    simulated: bool | None = None
    software: str = ""
    type_version: int = 0
    expires_ms: int = 0


@dataclass(frozen=True, slots=True)
class TrialBatch:
    """Trials of a task that an account has run in simulation with the command line, and has published.

    Attributes:
        key: Key of the row; counts down with time.
        task: Name of the task.
        tasks_sha256: Hash of the manifest that defines the task.
        movement_sha256: Hash of the movement's script.
        first_seed: Seed of the first trial; the others follow.
        trials: Number of trials.
        successes: Number of trials with success.
        causes: Cause → number of failed trials.
        software: Release of the program that ran them.
        type_version: Version of the robot type.
        published_ms: When they were published [ms since 1970].
        caller: Name of the account or API key that published them.
        expires_ms: When the batch is deleted [ms since 1970].
    """

    key: str
    task: str
    tasks_sha256: str
    movement_sha256: str
    first_seed: int
    trials: int
    successes: int
    causes: dict[str, int]
    software: str
    type_version: int
    published_ms: int
    caller: str
    expires_ms: int = 0


@dataclass(frozen=True, slots=True)
class SuccessRate:
    """Number of counted trials, of those with success, and of trials with an unknown outcome."""

    trials: int = 0
    successes: int = 0
    unknown: int = 0

    @property
    def rate(self) -> float | None:
        """Share of successful trials, 0 to 1; ``None`` without counted trials."""
        return self.successes / self.trials if self.trials else None

    @property
    def interval(self) -> tuple[float, float]:
        """Bounds of the 95 % Wilson score interval of the rate, 0 to 1; 0 and 1 without counted trials.

        Source: Wilson, "Probable inference, the law of succession, and statistical inference", 1927.
        """
        if not self.trials:
            return 0.0, 1.0
        share, square = self.successes / self.trials, _Z_95**2
        center = (share + square / (2 * self.trials)) / (1 + square / self.trials)
        spread = share * (1 - share) / self.trials + square / (4 * self.trials**2)
        half = _Z_95 / (1 + square / self.trials) * math.sqrt(spread)
        # Rounding errors must not exclude the rates 0 and 1.
        lower = 0.0 if self.successes == 0 else center - half
        return lower, (1.0 if self.successes == self.trials else center + half)


def rate_of(trials: Iterable[Trial]) -> SuccessRate:
    """The success rate of trials. Running trials and those with an unknown outcome do not count."""
    states = [trial.state for trial in trials]
    successes = states.count("success")
    return SuccessRate(successes + states.count("failed"), successes, states.count("unknown"))
