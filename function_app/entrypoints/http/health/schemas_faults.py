"""``devices/{id}/faults``."""

from typing import Literal

from function_app.entrypoints.http.framework.schemas import Moment, Response


class FaultOut(Response, frozen=True, kw_only=True):
    """Something that is or was wrong.

    ``kind``: ``reported`` by the device; ``silent``: nothing is heard of it; or what a detector found: ``level``, it is
    beyond a limit; ``trend``, on its way to one; ``change``, settled elsewhere; ``outlier``, far from its past.
    ``count``: first, second … of its code. ``worsened``: how often it got worse, each time to be acknowledged again.
    """

    id: str
    code: str
    state: Literal["raised", "acknowledged", "cleared"]
    source: Literal["device", "detector", "cloud"]
    kind: str
    severity: Literal["info", "warning", "error"]
    message: str
    stream: str
    field: str
    value: float | None
    baseline: float | None
    limit: float | None
    raised_at: Moment
    acknowledged_at: Moment | None
    acknowledged_by: str
    cleared_at: Moment | None
    count: int
    worsened: int


class FaultList(Response, frozen=True, kw_only=True):
    """Open ones worst first; then the history, newest first."""

    items: tuple[FaultOut, ...]
    cursor: str | None
