"""Measurements of a device."""

from typing import Annotated, cast

from fastapi import Query, Request, Response

from function_app.bootstrap import Functions
from function_app.domain.common.timestamps import rfc3339
from function_app.entrypoints.http.framework.authentication import RequestAuthenticator
from function_app.entrypoints.http.framework.responses import json_response
from function_app.entrypoints.http.framework.routing import Routes, Since, Until
from function_app.entrypoints.http.telemetry import schemas
from function_app.services.telemetry.series_reader import MAX_POINTS, Part, Range

Points = Annotated[int, Query(ge=1, le=MAX_POINTS, description="Maximum number of points on a page.")]
Fields = Annotated[str | None, Query(max_length=4_000, description="Only these fields, separated by commas.")]
Cursor = Annotated[str | None, Query(max_length=40, description="Cursor of the previous page.")]
Resolution = Annotated[
    schemas.Resolution | None,
    Query(description="Time resolution. Default: the finest that fits on one page of `points`."),
]


def router(functions: Functions, auth: RequestAuthenticator) -> Routes:
    """The routes."""
    routes = Routes("data")

    @routes.add("GET /devices/{device}/data", "List measurement streams", schemas.StreamList, 404)
    async def list_streams(request: Request, device: str) -> Response:
        """Returns streams since the device was paired."""
        views = await functions.series.streams(await auth.account(request), device)
        items = tuple(
            schemas.StreamOut(
                name=view.name,
                samples=view.about.count,
                first_at=rfc3339(view.about.first_ms),
                last_at=rfc3339(view.about.last_ms),
                fields=view.about.fields,
            )
            for view in views
        )
        return json_response(schemas.StreamList(items=items, cursor=None))

    @routes.add("GET /devices/{device}/data/{stream}", "Read a measurement stream", schemas.DataOut, (404, 422))
    async def read_stream(  # noqa: PLR0917 (FastAPI names them)
        request: Request,
        device: str,
        stream: str,
        since: Since = None,
        until: Until = None,
        points: Points = 500,
        fields: Fields = None,
        resolution: Resolution = None,
        cursor: Cursor = None,
    ) -> Response:
        """Returns raw samples, or mean, minimum, maximum and last value of equal time spans."""
        time_range = Range(
            first_ms=since,
            last_ms=until,
            points=points,
            level=resolution,
            fields=None if fields is None else fields.split(","),
            cursor=cursor,
        )
        part = await functions.series.read(await auth.account(request), device, stream, time_range)
        return json_response(_data_out(stream, part))

    return routes


def _data_out(stream: str, part: Part) -> schemas.DataOut:
    columns = {name: schemas.ColumnOut(mean=tuple(values)) for name, values in part.values.items()}
    for name, summaries in part.summaries.items():
        columns[name] = schemas.ColumnOut(
            mean=tuple(each and each.mean for each in summaries),
            min=tuple(each and each.low for each in summaries),
            max=tuple(each and each.high for each in summaries),
            last=tuple(each and each.last for each in summaries),
            count=tuple(each.samples if each else 0 for each in summaries),
        )
    return schemas.DataOut(
        stream=stream,
        resolution=cast("schemas.Resolution", part.level.name),
        span_ms=part.level.span_ms,
        from_ms=part.first_ms,
        to_ms=part.last_ms,
        at_ms=tuple(part.at_ms),
        fields=columns,
        cursor=part.cursor,
    )
