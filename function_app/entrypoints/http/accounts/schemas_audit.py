"""``accounts/me/audit``."""

from typing import Any, Literal

from function_app.entrypoints.http.framework.schemas import Answer, Moment


class AuditRecordOut(Answer, frozen=True, kw_only=True):
    """What somebody did, as it is recorded. ``hash`` covers it and the hash of the record before it.

    ``by_account``, ``session`` and ``key`` (of an app) say who it was beside their name; all empty: the cloud itself,
    or nobody known.
    """

    seq: int
    at: Moment
    what: str
    on: str
    outcome: Literal["done", "refused", "failed", "unknown"]
    who: str
    by_account: str
    session: str
    key: str
    data: dict[str, Any]
    hash: str


class AuditList(Answer, frozen=True, kw_only=True):
    """Newest first. Where few of many records were asked for, a page may be short, or empty, and have a cursor."""

    items: tuple[AuditRecordOut, ...]
    cursor: str | None
