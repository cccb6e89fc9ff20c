"""``devices/{id}/data``."""

from typing import Literal

from function_app.entrypoints.http.framework.schemas import Moment, Response

Resolution = Literal["raw", "10s", "1min", "10min", "1h", "6h", "1d"]


class StreamOut(Response, frozen=True, kw_only=True):
    """A stream of measurements: how many samples it has had since the device was paired, and when."""

    name: str
    samples: int
    first_at: Moment
    last_at: Moment
    fields: tuple[str, ...]


class StreamList(Response, frozen=True, kw_only=True):
    """The streams of a device, by name: all of them."""

    items: tuple[StreamOut, ...]
    cursor: str | None


class ColumnOut(Response, frozen=True, kw_only=True):
    """One field, a value for each of ``at_ms``; null where it was not measured.

    Of ``raw`` samples ``mean`` is the value itself, and the others are empty.
    """

    mean: tuple[float | None, ...]
    min: tuple[float | None, ...] = ()
    max: tuple[float | None, ...] = ()
    last: tuple[float | None, ...] = ()
    count: tuple[int, ...] = ()


class DataOut(Response, frozen=True, kw_only=True):
    """A page of a stream, in columns. ``at_ms``: times of samples, or the beginnings of stretches of ``span_ms``."""

    stream: str
    resolution: Resolution
    span_ms: int
    from_ms: int
    to_ms: int
    at_ms: tuple[int, ...]
    fields: dict[str, ColumnOut]
    cursor: str | None
