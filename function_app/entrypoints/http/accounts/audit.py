"""The audit log of the signed-in account."""

from typing import Annotated

from fastapi import Query, Request, Response

from function_app.bootstrap import Functions
from function_app.domain.common.timestamps import rfc3339
from function_app.entrypoints.http.accounts import schemas
from function_app.entrypoints.http.framework.authentication import RequestAuthenticator
from function_app.entrypoints.http.framework.responses import json_response
from function_app.entrypoints.http.framework.routing import Cursor, Limit, Routes, Since, Until
from function_app.services.audit.audit_reader import AuditFilter

Target = Annotated[
    str | None, Query(max_length=200, description="Only records about the target with this id, such as a device.")
]
Event = Annotated[str | None, Query(max_length=60, description="Only records of this event, such as `control-taken`.")]


def router(functions: Functions, auth: RequestAuthenticator) -> Routes:
    """The routes."""
    routes = Routes("accounts")

    @routes.add("GET /accounts/me/audit", "Read the audit log", schemas.AuditList, (403, 422))
    async def read_audit(  # noqa: PLR0917 (FastAPI names them)
        request: Request,
        target: Target = None,
        event: Event = None,
        since: Since = None,
        until: Until = None,
        cursor: Cursor = None,
        limit: Limit = 100,
    ) -> Response:
        """Returns records of the account and its devices, of all actors, newest first.

        Records cover control changes, rejected requests, Stops, claims, shares, keys and sign-ins. Each hash also
        covers the previous record.
        """
        caller = await auth.account(request)
        audit_filter = AuditFilter(event=event, target=target, since_ms=since, until_ms=until)
        records, following = await functions.audit_reader.read(caller, audit_filter, cursor=cursor, limit=limit)
        items = tuple(
            schemas.AuditRecordOut(
                seq=record["seq"],
                at=rfc3339(record["at_ms"]),
                event=record["event"],
                target=record["target"],
                outcome=record["outcome"],
                actor=record["actor"],
                account=record["account"],
                session=record["session"],
                key=record["key"],
                data=record["data"],
                hash=record["hash"],
            )
            for record in records
        )
        return json_response(schemas.AuditList(items=items, cursor=following))

    return routes
