"""``agents/{agent}/commands`` and ``agents/{agent}/messages``: the wire contract over HTTP."""

from typing import Annotated, Literal

from msgspec import Meta, Raw

from function_app.entrypoints.http.framework.schemas import Moment, Request, Response


class CommandOut(Response, frozen=True, kw_only=True):
    """One command. ``payload`` is the text of the MQTT message on ``topic``, byte for byte: its signature holds."""

    id: str
    topic: str
    payload: str
    expires_at: Moment


class CommandList(Response, frozen=True, kw_only=True):
    """Commands that wait for an answer: Stop first, then the oldest first."""

    items: tuple[CommandOut, ...]


class AgentMessage(Request, frozen=True, kw_only=True):
    """One message: topic and payload as on MQTT."""

    topic: Annotated[str, Meta(min_length=1, max_length=400)]
    payload: Raw


class MessagesRequest(Request, frozen=True, kw_only=True):
    """Messages in the order in which they were said."""

    messages: Annotated[tuple[AgentMessage, ...], Meta(min_length=1, max_length=500)]


class MessageResult(Response, frozen=True, kw_only=True):
    """``stored``, or why not: telling it again changes nothing."""

    status: Literal["stored", "rejected"]
    detail: str | None = None


class MessageResults(Response, frozen=True, kw_only=True):
    """One result for each message, in order."""

    results: tuple[MessageResult, ...]
