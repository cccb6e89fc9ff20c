"""What happened in one simulation, in order. Equal seeds give equal histories, byte for byte."""

import hashlib
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any


@dataclass(slots=True)
class Operation:
    """One call of a person to the API.

    Attributes:
        outcome: ``ok``, the code of a problem, or ``lost``: no response arrived, so that the effect is unknown.
        result: What the response contained.
        returned_s: Virtual time of the response [s]; infinite while it is missing.
    """

    number: int
    actor: str
    kind: str
    device: str
    invoked_s: float
    arguments: dict[str, Any]
    returned_s: float = float("inf")
    outcome: str = "lost"
    result: dict[str, Any] = field(default_factory=dict)

    def __str__(self) -> str:
        values = " ".join(f"{key}={value}" for key, value in {**self.arguments, **self.result}.items())
        return f"{self.kind} {self.device} → {self.outcome} {values}".rstrip()


@dataclass(frozen=True, slots=True)
class Violation:
    """A broken promise: its kind, and what happened."""

    kind: str
    text: str

    def __str__(self) -> str:
        return f"{self.kind}: {self.text}"


class History:
    """The recorded facts.

    Attributes:
        lines: Time [s], machine or person, and text of each fact.
        operations: Calls to the API, in order of invocation.
        violations: Broken promises.
    """

    def __init__(self, now_s: Callable[[], float]) -> None:
        self._now_s = now_s
        self.lines: list[tuple[float, str, str]] = []
        self.operations: list[Operation] = []
        self.violations: list[Violation] = []

    def note(self, who: str, text: str) -> None:
        """Record a fact."""
        self.lines.append((self._now_s(), who, text))

    def invoke(self, actor: str, kind: str, device: str, **arguments: Any) -> Operation:
        """Record the invocation of an operation."""
        operation = Operation(len(self.operations), actor, kind, device, self._now_s(), arguments)
        self.operations.append(operation)
        return operation

    def complete(self, operation: Operation, outcome: str, **result: Any) -> None:
        """Record the outcome of an operation."""
        operation.outcome, operation.result = outcome, result
        if outcome != "lost":
            operation.returned_s = self._now_s()
        self.note(operation.actor, str(operation))

    def violate(self, kind: str, text: str) -> None:
        """Record a broken promise."""
        violation = Violation(kind, f"t={self._now_s():.3f} {text}")
        self.violations.append(violation)
        self.note("check", f"VIOLATION {violation}")

    @property
    def digest(self) -> str:
        """SHA-256 of all lines."""
        return hashlib.sha256("\n".join(self.text()).encode()).hexdigest()

    def text(self) -> list[str]:
        """The lines, readable."""
        return [f"{at_s:9.4f}  {who:8}  {text}" for at_s, who, text in self.lines]
