"""``devices/{id}/events``."""

from typing import Any, Literal

from function_app.entrypoints.http.framework.schemas import Answer, Moment


class EventOut(Answer, frozen=True, kw_only=True):
    """A fact that happened. ``at`` is the clock of whoever tells it, ``heard_at`` the cloud's."""

    id: str
    kind: str
    severity: Literal["info", "warning", "error"]
    message: str
    data: dict[str, Any]
    at: Moment
    heard_at: Moment


class EventList(Answer, frozen=True, kw_only=True):
    """Newest first."""

    items: tuple[EventOut, ...]
    cursor: str | None
