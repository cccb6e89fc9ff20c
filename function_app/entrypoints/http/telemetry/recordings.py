"""Uploads of recordings by agents."""

from fastapi import Request, Response

from function_app.bootstrap import Functions
from function_app.domain.telemetry.recordings import Segment
from function_app.entrypoints.http.framework.authentication import RequestAuthenticator
from function_app.entrypoints.http.framework.responses import empty, json_response, read
from function_app.entrypoints.http.framework.routing import Routes
from function_app.entrypoints.http.telemetry import schemas
from function_app.entrypoints.http.telemetry.uploads import own_device
from function_app.ports.blobs import Upload


def router(functions: Functions, auth: RequestAuthenticator) -> Routes:
    """The routes."""
    routes = Routes("recordings")

    @routes.add(
        "POST /agents/{agent}/recordings",
        "Start to upload a segment of a recording",
        schemas.RecordingUpload,
        (404, 409, 507),
        body=schemas.RecordingRequest,
        caller="agent",
    )
    async def begin_recording(request: Request, agent: str) -> Response:
        """Called by an agent for a session of one of its devices. Safe to repeat."""
        caller = await auth.agent(request)
        payload: schemas.RecordingRequest = await read(request, schemas.RecordingRequest)
        device = own_device(caller, agent, payload.device)
        announced = Segment(
            epoch=payload.epoch,
            segment=payload.segment,
            started_ms=payload.started_ms,
            ended_ms=payload.ended_ms,
            length=payload.length,
            sha256=payload.sha256,
            overview_length=payload.overview_length,
            overview_sha256=payload.overview_sha256,
            cameras=payload.cameras,
            rows=payload.rows,
        )
        uploads = await functions.recordings.begin(device, announced)
        body = schemas.RecordingUpload(stored=True)
        if uploads is not None:
            segment, overview = _file(uploads.segment), _file(uploads.overview)
            body = schemas.RecordingUpload(stored=False, segment=segment, overview=overview)
        return json_response(body, headers={"Cache-Control": "no-store"})

    @routes.add(
        "POST /agents/{agent}/recordings/complete",
        "Complete the upload of a segment",
        None,
        (404, 409),
        body=schemas.SegmentRequest,
        caller="agent",
    )
    async def complete_recording(request: Request, agent: str) -> Response:
        """Called by an agent. Verifies lengths and hashes. Safe to repeat."""
        caller = await auth.agent(request)
        payload: schemas.SegmentRequest = await read(request, schemas.SegmentRequest)
        device = own_device(caller, agent, payload.device)
        await functions.recordings.complete(device, payload.epoch, payload.segment, pending=payload.pending)
        return empty()

    return routes


def _file(upload: Upload | None) -> schemas.FileUpload | None:
    if upload is None:
        return None
    return schemas.FileUpload(method=upload.method, url=upload.url, headers=dict(upload.headers))
