"""Tasks of robot types, their trials and success rates."""

from typing import Annotated, Any, Literal

import msgspec
from fastapi import Query, Request, Response

from device_agent.protocol.manifests.measured_tasks import MeasuredTask
from device_agent.protocol.manifests.tasks import Task, Tasks
from function_app.bootstrap import Functions
from function_app.domain.actions.trials import SuccessRate, Trial, TrialBatch
from function_app.domain.common.problems import forbidden
from function_app.domain.common.timestamps import rfc3339
from function_app.entrypoints.http.autonomy import task_schemas as schemas
from function_app.entrypoints.http.framework.authentication import RequestAuthenticator
from function_app.entrypoints.http.framework.responses import json_response, read
from function_app.entrypoints.http.framework.routing import Cursor, Limit, Routes
from function_app.entrypoints.http.framework.schemas import response_from
from function_app.services.autonomy.task_reports import TaskReport

OneDevice = Annotated[str | None, Query(max_length=200, description="Only trials on this device.")]
OneState = Annotated[
    Literal["running", "success", "failed", "unknown"] | None, Query(description="Only trials in this state.")
]


def router(functions: Functions, auth: RequestAuthenticator) -> Routes:
    """The routes."""
    routes = Routes("autonomy")

    @routes.add("GET /robot-types/{robot_type}/tasks", "List tasks of a robot type", schemas.TaskList, (404, 409))
    async def list_tasks(request: Request, robot_type: str) -> Response:
        """Returns what robots of this type shall achieve, with the success rates on visible devices."""
        caller = await auth.account(request)
        manifest = await functions.tasks.of_type(caller, robot_type)
        rates = await functions.task_reports.rates(caller, robot_type)
        items = tuple(_task(manifest, task, rates.get(task.name, SuccessRate())) for task in manifest.all_tasks)
        return json_response(schemas.TaskList(items=items))

    @routes.add("GET /robot-types/{robot_type}/tasks/{task}", "Get a task", schemas.TaskReportOut, (404, 409))
    async def get_task(request: Request, robot_type: str, task: str) -> Response:
        """Returns the task and its success rates: in all, by device, by version of the type and by day in UTC."""
        caller = await auth.account(request)
        manifest, found = await functions.tasks.get(caller, robot_type, task)
        return json_response(_report(manifest, found, await functions.task_reports.report(caller, robot_type, task)))

    @routes.add(
        "GET /robot-types/{robot_type}/tasks/{task}/trials", "List trials of a task", schemas.TrialList, (404, 409, 422)
    )
    async def list_trials(  # noqa: PLR0917 (query parameters)
        request: Request,
        robot_type: str,
        task: str,
        device: OneDevice = None,
        state: OneState = None,
        cursor: Cursor = None,
        limit: Limit = 100,
    ) -> Response:
        """Returns trials on the devices visible to the caller, newest first.

        A trial is started as an action of the kind ``run_trial``. A page may be empty although another one follows.
        """
        caller = await auth.account(request)
        trials, next_cursor = await functions.task_reports.trials(
            caller, robot_type, task, device=device, state=state, cursor=cursor, limit=limit
        )
        return json_response(schemas.TrialList(items=tuple(map(_trial, trials)), cursor=next_cursor))

    @routes.add(
        "POST /robot-types/{robot_type}/tasks/{task}/batches",
        "Publish a batch of simulated trials",
        {201: schemas.BatchOut},
        (404, 409),
        body=schemas.BatchRequest,
    )
    async def publish_trials(request: Request, robot_type: str, task: str) -> Response:
        """Stores results of the command ``trials``. The account that publishes them vouches for them.

        They are visible to this account only, and do not count in the rates of devices. Keys of viewers are rejected.
        """
        caller = await auth.account(request)
        if not caller.most.may_operate:
            raise forbidden("This API key may only read. Use a key with the role operator.")
        payload: schemas.BatchRequest = await read(request, schemas.BatchRequest)
        batch = TrialBatch(key="", task=task, published_ms=0, caller=caller.name, **msgspec.structs.asdict(payload))
        return json_response(_batch(await functions.task_reports.publish(caller, robot_type, batch)), 201)

    return routes


def _task_fields(manifest: Tasks, task: Task | MeasuredTask, rate: SuccessRate) -> dict[str, Any]:
    measured = isinstance(task, MeasuredTask)
    success = {name: value for name, value in msgspec.to_builtins(task.success).items() if value is not None}
    return {
        "observed": "measurement" if measured else "simulation",
        "success": success,
        "resets": not measured and bool(manifest.objects),
        "rate": _rate(rate),
    }


def _task(manifest: Tasks, task: Task | MeasuredTask, rate: SuccessRate) -> schemas.TaskOut:
    return response_from(task, schemas.TaskOut, **_task_fields(manifest, task, rate))


def _report(manifest: Tasks, task: Task | MeasuredTask, report: TaskReport) -> schemas.TaskReportOut:
    versions = report.versions.items()
    return response_from(
        task,
        schemas.TaskReportOut,
        **_task_fields(manifest, task, report.all),
        devices=tuple(schemas.DeviceRateOut(device=name, rate=_rate(rate)) for name, rate in report.devices.items()),
        versions=tuple(
            schemas.VersionRateOut(type_version=number or None, rate=_rate(rate)) for number, rate in versions
        ),
        days=tuple(schemas.DayRateOut(at=rfc3339(day), rate=_rate(rate)) for day, rate in report.days.items()),
        batches=tuple(map(_batch, report.batches)),
        complete=report.complete,
    )


def _batch(batch: TrialBatch) -> schemas.BatchOut:
    return response_from(
        batch,
        schemas.BatchOut,
        published_at=rfc3339(batch.published_ms),
        published_by=batch.caller,
        rate=_rate(SuccessRate(batch.trials, batch.successes)),
    )


def _rate(rate: SuccessRate) -> schemas.RateOut:
    lower, upper = rate.interval
    return response_from(rate, schemas.RateOut, lower=lower, upper=upper)


def _trial(trial: Trial) -> schemas.TrialOut:
    return response_from(
        trial,
        schemas.TrialOut,
        started_at=rfc3339(trial.started_ms),
        ended_at=rfc3339(trial.ended_ms) if trial.ended_ms else None,
        duration_s=None if trial.simulated is None else trial.duration_s,
        software=trial.software or None,
        type_version=trial.type_version or None,
    )
