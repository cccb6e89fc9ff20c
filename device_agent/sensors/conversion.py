"""Converts raw values of devices to values of streams, and control values to raw values."""

import math

from msgspec import Struct

_MAX_TEXT = 40


class ConversionError(ValueError):
    """A raw value is not usable. The message completes "temperature_c is …"."""


class Conversion(Struct, frozen=True, kw_only=True):
    """Options of a quantity that convert its raw value: value = raw · ``scale`` + ``offset``.

    Attributes:
        scale: Factor.
        offset: Added after the factor.
        lower: Smallest plausible value; a smaller one is a fault. ``None``: no limit.
        upper: Largest plausible value; a larger one is a fault. ``None``: no limit.
        words: Raw text → value, for example ``{ ON = true, OFF = false }``.
    """

    scale: float = 1.0
    offset: float = 0.0
    lower: float | None = None
    upper: float | None = None
    words: dict[str, bool | float] = {}

    def __post_init__(self) -> None:
        numbers = [self.scale, self.offset, self.lower or 0.0, self.upper or 0.0, *self.words.values()]
        if not all(map(math.isfinite, numbers)) or self.scale == 0:
            raise ValueError("all numbers must be finite, and `scale` must not be 0")
        if self.lower is not None and self.upper is not None and self.lower >= self.upper:
            raise ValueError("`lower` must be below `upper`")

    def value(self, raw: object) -> float | bool:
        """The value of a stream.

        Raises:
            ConversionError: The raw value is not a finite number, or the result is outside the limits.
        """
        if isinstance(raw, str) and raw in self.words:
            return self.words[raw]
        if isinstance(raw, bool):
            return raw
        if not isinstance(raw, int | float):
            hint = "; map texts with `words`" if isinstance(raw, str) else ""
            raise ConversionError(f"{shown(raw)}, which is not a number{hint}")
        try:
            value = raw * self.scale + self.offset
        except OverflowError:
            value = math.inf
        if not math.isfinite(value):
            raise ConversionError(f"{shown(raw)}, which is not a finite number")
        if (self.lower is not None and value < self.lower) or (self.upper is not None and value > self.upper):
            raise ConversionError(f"{value:g}, outside of its limits {_limit(self.lower)} to {_limit(self.upper)}")
        return value

    def raw(self, value: float) -> float:
        """The raw value for a control's value."""
        return (value - self.offset) / self.scale


def shown(raw: object) -> str:
    """A raw value for operators: short, and without control characters."""
    text = raw if isinstance(raw, str) else str(raw)
    printable = "".join(letter if letter.isprintable() else "?" for letter in text[:_MAX_TEXT])
    return f"'{printable}{'…' if len(text) > _MAX_TEXT else ''}'"


def _limit(limit: float | None) -> str:
    return "…" if limit is None else f"{limit:g}"
