"""Sessions with their recordings, and the episodes of these."""

from typing import Annotated

import msgspec
from fastapi import Path, Request, Response

from function_app.bootstrap import Functions
from function_app.domain.common.problems import Problem
from function_app.domain.common.timestamps import rfc3339
from function_app.domain.devices.devices import Device
from function_app.domain.telemetry import recordings as domain
from function_app.domain.telemetry.recordings import TOLERANCE_S, Segment
from function_app.domain.telemetry.sessions import Session
from function_app.entrypoints.http.autonomy import schemas
from function_app.entrypoints.http.autonomy.autonomy import session_out
from function_app.entrypoints.http.framework.authentication import RequestAuthenticator
from function_app.entrypoints.http.framework.responses import empty, json_response, read
from function_app.entrypoints.http.framework.routing import Routes
from function_app.services.devices.device_access import require_operator, require_owner
from function_app.services.telemetry.recordings import JSON, MCAP, Recording

EpochPath = Annotated[int, Path(ge=1, le=2**53)]


def router(functions: Functions, auth: RequestAuthenticator) -> Routes:
    """The routes."""
    routes = Routes("recordings")

    @routes.add("GET /devices/{device}/sessions/{epoch}", "Get a session", schemas.SessionWithRecording, (404, 422))
    async def device_session(request: Request, device: str, epoch: EpochPath) -> Response:
        """Returns a session and its recording. The ETag is the version of the episodes."""
        target = await functions.devices.get(await auth.account(request), device)
        session = await functions.autonomy.session(target, epoch)
        recording = await functions.recordings.read(target, epoch)
        body = await _session(functions, session, recording)
        return json_response(body, headers={"Cache-Control": "no-store", "ETag": _etag(recording.version)})

    @routes.add(
        "PUT /devices/{device}/sessions/{epoch}/episodes",
        "Set the episodes of a recording",
        schemas.EpisodeList,
        (404, 412, 428),
        body=schemas.EpisodesRequest,
    )
    async def set_episodes(request: Request, device: str, epoch: EpochPath) -> Response:
        """Replaces all episodes. The header If-Match contains the ETag with which they were read. Operators only."""
        target = require_operator(await functions.devices.get(await auth.account(request), device))
        payload: schemas.EpisodesRequest = await read(request, schemas.EpisodesRequest)
        version = _version(request.headers.get("if-match", ""))
        limit_s = await _duration_s(functions, target, epoch)
        episodes = domain.check_episodes(
            [domain.Episode(**msgspec.structs.asdict(each)) for each in payload.episodes], duration_s=limit_s
        )
        changed = await functions.recordings.set_episodes(target, epoch, episodes, version=version)
        body = schemas.EpisodeList(episodes=tuple(map(_episode, changed.episodes)))
        return json_response(body, headers={"ETag": _etag(changed.version)})

    @routes.add("DELETE /devices/{device}/sessions/{epoch}/recording", "Delete a recording", None, (404, 422))
    async def delete_recording(request: Request, device: str, epoch: EpochPath) -> Response:
        """Deletes the recording of a session with its episodes. Owners only."""
        target = require_owner(await functions.devices.get(await auth.account(request), device))
        await functions.recordings.delete(target, epoch)
        return empty()

    return routes


async def _duration_s(functions: Functions, device: Device, epoch: int) -> float:
    """Latest end of an episode, relative to the start of the session [s]."""
    session = await functions.autonomy.session(device, epoch)
    recording = await functions.recordings.read(device, epoch)
    return domain.duration_s(session, recording.segments, now_ms=functions.clock.now_ms()) + TOLERANCE_S


async def _session(functions: Functions, session: Session, recording: Recording) -> schemas.SessionWithRecording:
    stored = bool(recording.segments)
    shown = None
    if stored:
        shown = schemas.RecordingOut(
            segments=tuple([await _segment(functions, each) for each in recording.segments]),
            cameras=tuple(sorted({camera for each in recording.segments for camera in each.cameras})),
            episodes=tuple(map(_episode, recording.episodes)),
            complete=domain.is_complete(session, recording.segments),
            missing=tuple(
                schemas.MissingSegment(segment=each.segment, cause=each.cause)
                for each in domain.missing_segments(recording.segments)
            ),
            final=domain.is_final(session, recording.segments),
        )
    fields = msgspec.structs.asdict(session_out(session, recorded=stored))
    return schemas.SessionWithRecording(**fields, recording=shown)


async def _segment(functions: Functions, segment: Segment) -> schemas.SegmentOut:
    return schemas.SegmentOut(
        segment=segment.segment,
        started_at=rfc3339(segment.started_ms),
        ended_at=rfc3339(segment.ended_ms),
        length=segment.length,
        sha256=segment.sha256,
        url=await functions.recordings.url(segment.blob, MCAP),
        overview_url=await functions.recordings.url(segment.overview_blob, JSON),
    )


def _episode(episode: domain.Episode) -> schemas.Episode:
    return schemas.Episode(
        start_s=episode.start_s, end_s=episode.end_s, outcome=episode.outcome, label=episode.label, note=episode.note
    )


def _etag(version: int) -> str:
    return f'"{version}"'


def _version(if_match: str) -> int:
    text = if_match.strip().strip('"')
    if not text.isdecimal() or len(text) > 10:  # noqa: PLR2004 (more than any version)
        detail = "Send the ETag of the session in the header If-Match, so that no other change is lost."
        raise Problem("if-match-missing", 428, "The header If-Match is missing", detail)
    return int(text)
