"""``devices/{id}/uploads`` and ``agents/{id}/uploads``."""

from typing import Annotated

from msgspec import Meta

from device_agent.protocol import Id
from function_app.entrypoints.http.framework.schemas import DeviceName, Moment, Request, Response
from function_app.ports.blobs import MAX_UPLOAD_BYTES

_WORD = r"[A-Za-z0-9!#$&^_.+-]{1,60}"
ContentType = Annotated[str, Meta(pattern=f"^{_WORD}/{_WORD}$(?!\\n)", description="such as image/png")]
Length = Annotated[int, Meta(ge=0, le=MAX_UPLOAD_BYTES)]
Sha256 = Annotated[str, Meta(pattern="^[0-9a-f]{64}$")]
FileName = Annotated[str, Meta(max_length=200)]
AtMs = Annotated[int, Meta(ge=0, le=9_999_999_999_999)]


class UploadRequest(Request, frozen=True, kw_only=True):
    """What shall be uploaded. ``at_ms``: when it was taken [ms since 1970]; now."""

    stream: Id
    length: Length
    content_type: ContentType
    name: FileName = ""
    at_ms: AtMs | None = None
    sha256: Sha256 | None = None


class AgentUploadRequest(UploadRequest, frozen=True, kw_only=True):
    """The same by an agent, of one of its devices."""

    device: DeviceName


class AgentCompleteRequest(Request, frozen=True, kw_only=True):
    """Of which device it is."""

    device: DeviceName


class UploadStarted(Response, frozen=True, kw_only=True):
    """Send the content to ``url`` with ``method`` and exactly these headers, then complete the upload."""

    id: str
    method: str
    url: str
    headers: dict[str, str]
    expires_at: Moment


class UploadOut(Response, frozen=True, kw_only=True):
    """A registered capture. ``verified``: its content was seen to have the hash that was announced."""

    id: str
    stream: str
    name: str
    at: Moment
    content_type: str
    length: int
    sha256: str | None
    verified: bool
    created_by: str
    stored_at: Moment
    expires_at: Moment


class UploadWithUrl(UploadOut, frozen=True, kw_only=True):
    """A capture, and where it can be read for an hour."""

    url: str


class UploadList(Response, frozen=True, kw_only=True):
    """Captures, newest first."""

    items: tuple[UploadOut, ...]
    cursor: str | None
