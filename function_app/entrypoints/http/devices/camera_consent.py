"""The owner's consent to record cameras."""

from fastapi import Request, Response

from function_app.bootstrap import Functions
from function_app.domain.common.timestamps import rfc3339
from function_app.entrypoints.http.actions.schemas import ReasonOut
from function_app.entrypoints.http.devices import schemas
from function_app.entrypoints.http.framework.authentication import RequestAuthenticator
from function_app.entrypoints.http.framework.responses import json_response, read
from function_app.entrypoints.http.framework.routing import Routes
from function_app.services.messaging.camera_consents import CameraConsentStatus

_OUT = schemas.CameraConsentOut


def router(functions: Functions, auth: RequestAuthenticator) -> Routes:
    """The routes."""
    routes = Routes("devices")

    @routes.add("GET /devices/{device}/camera-consent", "Get the consent to record cameras", _OUT, 404)
    async def get_camera_consent(request: Request, device: str) -> Response:
        """Returns which cameras of the device the owner allows to be recorded. Without a decision: none."""
        caller = await auth.account(request)
        return json_response(_out(await functions.camera_consents.get(caller, device)))

    @routes.add(
        "PUT /devices/{device}/camera-consent",
        "Decide which cameras may be recorded",
        _OUT,
        (403, 404),
        body=schemas.CameraConsentRequest,
    )
    async def set_camera_consent(request: Request, device: str) -> Response:
        """Owners only, and only by a person. API keys are rejected. Replaces the former decision.

        The agent records frames of these cameras with each session of its robots, and stores them in the cloud. The
        owner must have the consent of the people in the room. An empty list ends the recording of cameras at once.
        """
        caller = await auth.account(request)
        payload: schemas.CameraConsentRequest = await read(request, schemas.CameraConsentRequest)
        status = await functions.camera_consents.decide(caller, device, payload.cameras, wait_ms=payload.wait_ms)
        return json_response(_out(status))

    return routes


def _out(status: CameraConsentStatus) -> schemas.CameraConsentOut:
    decision, reason = status.decision, status.reason
    return schemas.CameraConsentOut(
        cameras=() if decision is None else decision.cameras,
        by=None if decision is None else decision.by,
        at=None if decision is None else rfc3339(decision.at_ms),
        confirmed=status.confirmed,
        reason=None if reason is None else ReasonOut(code=reason.code, message=reason.message),
    )
