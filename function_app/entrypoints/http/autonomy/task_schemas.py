"""Requests and responses about tasks and their trials."""

from typing import Annotated, Any, Literal

import msgspec
from msgspec import Meta

from device_agent.protocol import MAX_SEED, Id, Label
from function_app.entrypoints.http.framework.schemas import Moment, Request, Response

MAX_BATCH = 100_000
"""Maximum number of trials in one batch."""
Number = Annotated[int, Meta(ge=0, le=MAX_BATCH)]
Sha256 = Annotated[str, Meta(pattern="^[0-9a-f]{64}$")]


class RateOut(Response, frozen=True, kw_only=True):
    """Success rate of trials with its 95 % Wilson score interval, 0 to 1.

    ``trials``: counted trials. ``unknown``: trials whose end was not observed; they do not count. ``rate`` is null
    without counted trials.
    """

    trials: int
    successes: int
    unknown: int
    rate: float | None
    lower: float
    upper: float


class TaskOut(Response, frozen=True, kw_only=True):
    """A task of a robot type.

    ``observed``: ``simulation``: by the state of a simulated scene; ``measurement``: by a room device. ``success``: the
    condition as the manifest declares it. ``resets``: whether a trial resets objects to a seed. ``rate``: of all trials
    on visible devices.
    """

    name: str
    label: str
    description: str
    movement: str
    parameters: dict[str, Any]
    time_limit_s: float
    observed: Literal["simulation", "measurement"]
    success: dict[str, Any]
    resets: bool
    rate: RateOut


class TaskList(Response, frozen=True, kw_only=True):
    """The tasks of a robot type, in the order of its manifest."""

    items: tuple[TaskOut, ...]


class DeviceRateOut(Response, frozen=True, kw_only=True):
    """The success rate on one device."""

    device: str
    rate: RateOut


class VersionRateOut(Response, frozen=True, kw_only=True):
    """The success rate with one version of the robot type; null: the device has not reported it."""

    type_version: int | None
    rate: RateOut


class DayRateOut(Response, frozen=True, kw_only=True):
    """The success rate of one day in UTC."""

    at: Moment
    rate: RateOut


class BatchOut(Response, frozen=True, kw_only=True):
    """Simulated trials that an account ran with the command line and published. They do not count in other rates.

    ``causes``: cause → number of failed trials. ``published_by``: name of the account or API key.
    """

    first_seed: int
    causes: dict[str, int]
    tasks_sha256: str
    movement_sha256: str
    software: str
    type_version: int
    published_at: Moment
    published_by: str
    rate: RateOut


class TaskReportOut(TaskOut, frozen=True, kw_only=True):
    """A task with its success rates. ``complete``: all trials were evaluated; else the oldest are missing."""

    devices: tuple[DeviceRateOut, ...]
    versions: tuple[VersionRateOut, ...]
    days: tuple[DayRateOut, ...]
    batches: tuple[BatchOut, ...]
    complete: bool


class TrialOut(Response, frozen=True, kw_only=True):
    """A trial with the verdict of the monitor that observed the task.

    ``state``: ``running``, ``success``, ``failed``, or ``unknown``: its end was not observed. ``duration_s``: on the
    clock of the monitor, simulated time in a simulation. ``seed``: null if nothing was reset. ``simulated``,
    ``software`` and ``type_version``: null until the device has reported.
    """

    action: str
    device: str
    state: Literal["running", "success", "failed", "unknown"]
    cause: str
    detail: str
    seed: int | None
    epoch: int
    caller: str
    started_at: Moment
    ended_at: Moment | None
    duration_s: float | None
    movement: str
    movement_version: int
    tasks_sha256: str
    simulated: bool | None
    software: str | None
    type_version: int | None


class TrialList(Response, frozen=True, kw_only=True):
    """Trials, newest first."""

    items: tuple[TrialOut, ...]
    cursor: str | None


class BatchRequest(Request, frozen=True, kw_only=True):
    """Results of simulated trials with consecutive seeds. ``successes`` and ``causes`` add up to ``trials``.

    Attributes:
        causes: Cause → number of failed trials.
        tasks_sha256: Hash of the manifest that defines the task.
        movement_sha256: Hash of the movement's script.
        software: Release of the program that ran them.
    """

    first_seed: Annotated[int, Meta(ge=0, le=MAX_SEED)]
    trials: Annotated[int, Meta(ge=1, le=MAX_BATCH)]
    successes: Number
    causes: Annotated[dict[Id, Number], Meta(max_length=16)] = msgspec.field(default_factory=dict)
    tasks_sha256: Sha256
    movement_sha256: Sha256
    software: Label
    type_version: Annotated[int, Meta(ge=0, le=1_000_000)]
