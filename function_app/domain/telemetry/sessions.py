"""Sessions: the time in which one account or action holds the lease of a device, and who moved the device in it.

The papers define Global Task Intelligence as GTI = HTI + MTI = 1 and the autonomy as MTIA = MTI / HTI.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Any, Final

from function_app.domain.control.control_events import Fact

BEGINNINGS: Final = frozenset({Fact.TAKEN, Fact.TAKEN_OVER, Fact.HANDED_OVER})
"""Control events that start a session."""
ENDS: Final = frozenset({Fact.RELEASED, Fact.EXPIRED, Fact.ENDED, Fact.RESET_ORDERED})
"""Control events that end a session: that of ``ended_epoch`` in their data, or else of their epoch."""


@dataclass(frozen=True, slots=True)
class Session:
    """One session. Its fields arrive in any order, because agent and cloud report independently.

    Attributes:
        epoch: Epoch of the lease, unique for the device's pairing.
        holder: Name of the account; empty: not known yet.
        action: Id of the action if the lease belongs to an action.
        started_ms: When the lease was acquired [ms since 1970]; 0: not known yet.
        ended_ms: When it ended [ms since 1970]; 0: it lasts, or a newer session ended it.
        start: Kind of the event that started it.
        end: Kind of the event that ended it.
        task: Movement or kind of the action; empty: not known yet, or no action.
        outcome: Status of the action; empty: not recorded, or no action. Only the status of an ended action is stored.
        intervened: Whether a person ended the action before its end.
        operator_s: Moving time under setpoints of an operator [s].
        machine_s: All other moving time [s].
        first_input_s: Time from the grant to the first motion by an operator [s].
        seen_ms: When it changed last [ms since 1970].
        expires_ms: When it is deleted [ms since 1970].
    """

    epoch: int
    holder: str = ""
    action: str = ""
    started_ms: int = 0
    ended_ms: int = 0
    start: str = ""
    end: str = ""
    task: str = ""
    outcome: str = ""
    intervened: bool = False
    operator_s: float = 0.0
    machine_s: float = 0.0
    first_input_s: float | None = None
    seen_ms: int = 0
    expires_ms: int = 0

    def with_control(self, kind: str, at_ms: int, data: Mapping[str, Any]) -> "Session":
        """The session after a control event of its epoch."""
        if kind in BEGINNINGS:
            holder, action = str(data.get("holder", "")), str(data.get("action", ""))
            return replace(self, holder=holder, action=action, started_ms=at_ms, start=kind)
        if kind in ENDS and not self.ended_ms:
            return replace(self, ended_ms=at_ms, end=kind)
        return self

    def with_action(self, *, task: str, outcome: str, intervened: bool, ended_ms: int) -> "Session":
        """The session with its action, which ended at ``ended_ms`` [ms since 1970]; 0: it runs."""
        ended_ms = self.ended_ms or ended_ms
        return replace(self, task=task, outcome=outcome, intervened=intervened, ended_ms=ended_ms)

    def with_activity(self, operator_s: float, machine_s: float, first_input_s: float | None) -> "Session":
        """The session after a report of the agent. Reports are sums, so the largest ones count."""
        return replace(
            self,
            operator_s=max(self.operator_s, operator_s),
            machine_s=max(self.machine_s, machine_s),
            first_input_s=self.first_input_s if first_input_s is None else first_input_s,
        )


@dataclass(frozen=True, slots=True)
class Autonomy:
    """Moving time by source, and the papers' metrics of it.

    Attributes:
        operator_s: Moving time under setpoints of an operator [s].
        machine_s: All other moving time [s].
    """

    operator_s: float = 0.0
    machine_s: float = 0.0

    @property
    def moving_s(self) -> float:
        """Moving time [s]."""
        return self.operator_s + self.machine_s

    @property
    def hti(self) -> float | None:
        """Human Task Intelligence: the operator's share of the moving time; ``None`` without motion."""
        return self.operator_s / self.moving_s if self.moving_s else None

    @property
    def mti(self) -> float | None:
        """Machine Task Intelligence: the machine's share of the moving time; ``None`` without motion."""
        return self.machine_s / self.moving_s if self.moving_s else None

    @property
    def mtia(self) -> float | None:
        """Machine Task Intelligence Autonomy, MTI / HTI; ``None``: undefined, because no operator moved the device."""
        return self.machine_s / self.operator_s if self.operator_s else None


def total(sessions: Iterable[Session]) -> Autonomy:
    """The sums of sessions."""
    sessions = tuple(sessions)
    return Autonomy(sum(each.operator_s for each in sessions), sum(each.machine_s for each in sessions))
