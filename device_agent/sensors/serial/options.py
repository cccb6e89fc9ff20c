"""Options of the driver ``serial``."""

from typing import Annotated, Literal

from msgspec import Meta, Struct

from device_agent.protocol import Field, Id
from device_agent.sensors.conversion import Conversion
from device_agent.sensors.serial import line_pattern


class Source(Conversion, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A quantity in a line.

    Attributes:
        field: Named group of ``pattern``; path in a JSON line; number of a CSV column, counted from 0.
    """

    field: Annotated[str, Meta(min_length=1, max_length=200)] | Annotated[int, Meta(ge=0, le=1000)]


class Options(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Options of the driver.

    Attributes:
        path: Serial port: ``/dev/ttyUSB0``, or better its name in ``/dev/serial/by-id``.
        baud: Speed [bit/s].
        data_bits: Number of data bits.
        parity: ``none``, ``even`` or ``odd``.
        stop_bits: Number of stop bits.
        format: ``pattern``: a regular expression. ``json``: one JSON document in each line. ``csv``: columns.
        pattern: For ``pattern``: see ``line_pattern``.
        separator: For ``csv``: text between the columns.
        max_line: Longest accepted line [bytes].
        streams: Stream → quantity → source.
    """

    path: Annotated[str, Meta(min_length=1, max_length=255)]
    baud: Annotated[int, Meta(ge=50, le=4_000_000)] = 9600
    data_bits: Literal[7, 8] = 8
    parity: Literal["none", "even", "odd"] = "none"
    stop_bits: Literal[1, 2] = 1
    format: Literal["pattern", "json", "csv"] = "pattern"
    pattern: Annotated[str, Meta(max_length=500)] = ""
    separator: Annotated[str, Meta(min_length=1, max_length=10)] = ","
    max_line: Annotated[int, Meta(ge=8, le=4096)] = 512
    streams: dict[Id, dict[Field, Source]]

    def __post_init__(self) -> None:
        if bool(self.pattern) != (self.format == "pattern"):
            raise ValueError('`pattern` is needed for `format = "pattern"`, and only for it')
        groups = line_pattern.compiled(self.pattern).groupindex if self.pattern else {}
        for stream, sources in self.streams.items():
            for quantity, source in sources.items():
                if self.format == "csv" and not isinstance(source.field, int):
                    raise ValueError(f"`streams.{stream}.{quantity}.field` must be the number of a column")
                if self.format == "json" and not isinstance(source.field, str):
                    raise ValueError(f"`streams.{stream}.{quantity}.field` must be a path in the JSON document")
                if self.format == "pattern" and source.field not in groups:
                    known = ", ".join(groups) or "none"
                    raise ValueError(
                        f"`streams.{stream}.{quantity}.field`: `pattern` has no such group; it has: {known}"
                    )
