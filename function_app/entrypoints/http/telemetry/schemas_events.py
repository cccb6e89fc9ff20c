"""``devices/{id}/events``."""

from typing import Any, Literal

from function_app.entrypoints.http.framework.schemas import Moment, Response


class EventOut(Response, frozen=True, kw_only=True):
    """A fact that happened. ``at`` is the clock of whoever tells it, ``received_at`` the cloud's."""

    id: str
    kind: str
    severity: Literal["info", "warning", "error"]
    message: str
    data: dict[str, Any]
    at: Moment
    received_at: Moment


class EventList(Response, frozen=True, kw_only=True):
    """Newest first."""

    items: tuple[EventOut, ...]
    cursor: str | None
