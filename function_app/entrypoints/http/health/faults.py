"""``devices/{id}/faults``."""

from typing import Annotated

from fastapi import Query, Request, Response

from function_app.bootstrap import Functions
from function_app.domain.common.timestamps import rfc3339
from function_app.domain.health.faults import Fault
from function_app.entrypoints.http.framework.authentication import Caller
from function_app.entrypoints.http.framework.responses import answer
from function_app.entrypoints.http.framework.routing import Cursor, Limit, Routes
from function_app.entrypoints.http.health import schemas_faults as contract
from function_app.services.devices.device_access import require_operator

Open = Annotated[bool | None, Query(alias="open", description="Only open ones, or only those that are over.")]


def router(functions: Functions, caller: Caller) -> Routes:
    """The routes."""
    routes = Routes("diagnostics")

    @routes.add(
        "GET",
        "/devices/{device}/faults",
        summary="What is and was wrong",
        answers={200: contract.FaultList},
        problems=(404, 422),
    )
    async def list_faults(
        request: Request, device: str, only: Open = None, cursor: Cursor = None, limit: Limit = 100
    ) -> Response:
        """Since the device was paired. All open faults stand on the first page, and do not count towards ``limit``."""
        who = await caller.account(request)
        found = await functions.devices.get(who, device)
        items: list[Fault] = []
        following = None
        if only is not True:
            items, following = await functions.faults.past(found, cursor=cursor, limit=limit)
        if only is not False and cursor is None:
            items = [*await functions.faults.open(found), *items]
        return answer(contract.FaultList(items=tuple(show(fault) for fault in items), cursor=following))

    @routes.add(
        "POST",
        "/devices/{device}/faults/{fault}/acknowledge",
        summary="Say that a fault was seen",
        answers={200: contract.FaultOut},
        problems=(404, 409),
    )
    async def acknowledge_fault(request: Request, device: str, fault: str) -> Response:
        """It stays open until it is cleared; who was first stays named."""
        who = await caller.account(request)
        found = require_operator(await functions.devices.get(who, device))
        return answer(show(await functions.faults.acknowledge(found, fault, by=who.name)))

    return routes


def show(fault: Fault) -> contract.FaultOut:
    """A fault as the API shows it."""
    return contract.FaultOut(
        id=fault.id,
        code=fault.code,
        state="cleared" if fault.cleared_ms else "acknowledged" if fault.acknowledged_ms else "raised",
        source=fault.source.value,
        kind=fault.kind,
        severity=fault.severity.value,
        message=fault.message,
        stream=fault.stream,
        field=fault.field,
        value=fault.value,
        baseline=fault.baseline,
        limit=fault.limit,
        raised_at=rfc3339(fault.raised_ms),
        acknowledged_at=None if fault.acknowledged_ms is None else rfc3339(fault.acknowledged_ms),
        acknowledged_by=fault.acknowledged_by,
        cleared_at=None if fault.cleared_ms is None else rfc3339(fault.cleared_ms),
        count=fault.count,
        worsened=fault.worse,
    )
