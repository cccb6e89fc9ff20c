"""``accounts/me/audit``."""

from typing import Any, Literal

from function_app.entrypoints.http.framework.schemas import Moment, Response


class AuditRecordOut(Response, frozen=True, kw_only=True):
    """What somebody did, as it is recorded. ``hash`` covers it and the hash of the record before it.

    ``account``, ``session`` and ``key`` (an API key) identify the actor. All are empty if the cloud itself or an unknown
    caller acted.
    """

    seq: int
    at: Moment
    event: str
    target: str
    outcome: Literal["done", "rejected", "failed", "unknown"]
    actor: str
    account: str
    session: str
    key: str
    data: dict[str, Any]
    hash: str


class AuditList(Response, frozen=True, kw_only=True):
    """Newest first. Where few of many records were asked for, a page may be short, or empty, and have a cursor."""

    items: tuple[AuditRecordOut, ...]
    cursor: str | None
