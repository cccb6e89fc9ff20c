"""Errors of the API: each has a code, an HTTP status and a text that says what to do (RFC 9457)."""

from typing import Any


class Problem(Exception):  # noqa: N818 (named as in RFC 9457)
    """A rejected request.

    Attributes:
        code: Stable name for programs; the last part of the problem's ``type``.
        status: HTTP status.
        title: What is wrong; equal for all occurrences.
        detail: What is wrong in this case, and what to do.
        extras: Further members of the response.
        retry_after_s: When a retry may succeed [s].
    """

    def __init__(
        self,
        code: str,
        status: int,
        title: str,
        detail: str,
        *,
        retry_after_s: int | None = None,
        extras: dict[str, Any] | None = None,
    ) -> None:
        super().__init__(detail)
        self.code = code
        self.status = status
        self.title = title
        self.detail = detail
        self.extras = extras or {}
        self.retry_after_s = retry_after_s


def unauthorized(detail: str) -> Problem:
    """The caller is not authenticated."""
    return Problem("unauthorized", 401, "Sign in first", detail)


def forbidden(detail: str) -> Problem:
    """The caller is authenticated but lacks the permission."""
    return Problem("forbidden", 403, "Not allowed", detail)


def not_found(what: str, name: str) -> Problem:
    """The item does not exist, or is not visible to this account: the response is the same."""
    return Problem(f"{what}-unknown", 404, f"No such {what.replace('-', ' ')}", f"There is no {what} '{name[:80]}'.")


def invalid(detail: str, *, code: str = "invalid", **extras: Any) -> Problem:
    """The request is not valid."""
    return Problem(code, 422, "The request is not valid", detail, extras=extras)


def busy_store() -> Problem:
    """Too many concurrent requests changed the same row."""
    return Problem(
        "busy", 503, "Busy", "Too many concurrent requests changed this resource. Try again.", retry_after_s=1
    )


def broker_unavailable(detail: str) -> Problem:
    """The message broker is not reachable, so no message reaches the device."""
    return Problem("broker-unavailable", 503, "The broker cannot be reached", detail, retry_after_s=2)


def store_unavailable(detail: str) -> Problem:
    """The tables are not available."""
    return Problem("store-unavailable", 503, "The store cannot be used", detail, retry_after_s=5)


def invalid_cursor() -> Problem:
    """A cursor that does not belong to the list."""
    return invalid("The cursor is not valid for this list. Start without a cursor.", code="cursor-invalid")


def protocol_unsupported(detail: str) -> Problem:
    """``protocol-unsupported``: the agent and the server have no common version of the wire contract."""
    return Problem("protocol-unsupported", 409, "No common protocol version", detail)
