"""``api-keys``."""

from typing import Annotated, Literal

from msgspec import Meta

from function_app.domain.identity.api_keys import MOST_DAYS, MOST_ONLY
from function_app.entrypoints.http.framework.schemas import Moment, Request, Response

Target = Annotated[str, Meta(pattern="^(space:)?[A-Za-z0-9_-]{1,64}$")]


class ApiKeyRequest(Request, frozen=True, kw_only=True):
    """A key to be made. ``only``: devices by id, spaces as ``space:<id>``; empty: all that the account may see."""

    name: Annotated[str, Meta(min_length=1, max_length=60)]
    role: Literal["operator", "viewer"]
    only: Annotated[tuple[Target, ...], Meta(max_length=MOST_ONLY)] = ()
    days: Annotated[int, Meta(ge=1, le=MOST_DAYS)] = 90


class ApiKeyOut(Response, frozen=True, kw_only=True):
    """A key without its secret. ``last_used_at`` is right to the hour."""

    id: str
    name: str
    role: str
    only: tuple[str, ...]
    created_at: Moment
    expires_at: Moment
    expired: bool
    last_used_at: Moment | None


class ApiKeyCreated(Response, frozen=True, kw_only=True):
    """A new key; nobody is told ``token`` again."""

    api_key: ApiKeyOut
    token: str


class ApiKeyList(Response, frozen=True, kw_only=True):
    """Keys."""

    items: tuple[ApiKeyOut, ...]
    cursor: str | None
