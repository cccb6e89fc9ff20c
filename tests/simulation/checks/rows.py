"""Observes the rows of the cloud, and checks each write of slot, lease and actions."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from function_app.domain.actions.action import LOST, Status
from function_app.ports.tables import Write
from function_app.services.devices.control_rows import LEASE, SLOT
from function_app.services.storage import records
from tests.simulation.checks.history import History

_ACTION = "action:"
_WITHOUT_SLOT = frozenset({Status.QUEUED, Status.UNKNOWN})


@dataclass
class ActionFact:
    """What the cloud has stored of an action.

    Attributes:
        issued_s: When it was created or left the queue, virtual time [s].
        exempt: Whether its terminal state is not compared with the robot's: it was open in a restored backup.
        epoch: Epoch of its command.
    """

    status: Status
    device: str
    pairing: str
    issued_s: float = 0.0
    code: str = ""
    exempt: bool = False
    epoch: int = 0


class RowChecks:
    """Checks of the control rows."""

    def __init__(self, history: History, *, now_s: Callable[[], float]) -> None:
        self._history = history
        self._now_s = now_s
        self.actions: dict[str, ActionFact] = {}
        self._dropped: dict[str, ActionFact] = {}
        self._slots: dict[str, tuple[str, str]] = {}
        self._leases: dict[str, tuple[int, str]] = {}

    def committed(self, table: str, writes: Sequence[Write]) -> None:
        """A batch was written."""
        if table != records.CONTROL:
            return
        devices = {}
        for write in writes:
            key, data = write.row.key, write.row.data
            if write.kind == "delete":
                continue
            if key.startswith(_ACTION):
                self._action(data)
                devices[write.row.partition] = data["pairing"]
            elif key == SLOT:
                self._slots[write.row.partition] = (data["action"], data["pairing"])
                devices[write.row.partition] = data["pairing"]
            elif key == LEASE:
                self._lease(write.row.partition, data)
        for device, pairing in devices.items():
            self._check_slot(device, pairing)

    def restored(self, tables: Any) -> None:
        """All rows were replaced by a backup: what was open in it, or is not in it, may end differently."""
        self._dropped |= self.actions
        self.actions = {}
        self._slots.clear()
        self._leases.clear()
        for table, row in tables.rows(records.CONTROL):
            assert table == records.CONTROL
            if row.key.startswith(_ACTION):
                self._action(row.data)
                fact = self.actions[row.data["id"]]
                before = self._dropped[row.data["id"]]
                fact.issued_s = before.issued_s
                fact.exempt = before.exempt or not fact.status.terminal
            elif row.key == SLOT:
                self._slots[row.partition] = (row.data["action"], row.data["pairing"])
            elif row.key == LEASE:
                self._lease(row.partition, row.data)

    def _action(self, data: Any) -> None:
        action, status = data["id"], Status(data["status"])
        fact = self.actions.get(action)
        if fact is None:
            fact = self.actions[action] = ActionFact(status, data["device"], data["pairing"], self._now_s())
        elif status is not fact.status:
            if fact.status.terminal and fact.code != LOST:  # a late report replaces a lost end
                self._history.violate("terminal-changed", f"action {action[-6:]}: {fact.status.value} → {status.value}")
            elif status.rank < fact.status.rank and data["epoch"] <= fact.epoch:  # else its command was issued again
                self._history.violate("step-back", f"action {action[-6:]}: {fact.status.value} → {status.value}")
            if fact.status is Status.QUEUED:
                fact.issued_s = self._now_s()
            fact.status = status
        fact.epoch = data["epoch"]
        fact.code = (data.get("reason") or {}).get("code", "")
        self._history.note("cloud", f"action {action[-6:]} {status.value} {fact.code}".rstrip())

    def _lease(self, device: str, data: Any) -> None:
        epoch, holder = data["epoch"], f"{data['account']}/{data['session']}" if data["account"] else ""
        before = self._leases.get(device)
        if before is not None:
            if epoch < before[0]:
                self._history.violate("epoch-decreased", f"{device}: {before[0]} → {epoch}")
            elif epoch == before[0] and holder and holder != before[1]:
                self._history.violate("shared-epoch", f"{device}: epoch {epoch} has a second holder")
        self._leases[device] = (epoch, holder)
        self._history.note("cloud", f"lease {device} epoch={epoch} {'held' if holder else 'free'}")

    def _check_slot(self, device: str, pairing: str) -> None:
        active = [
            action
            for action, fact in self.actions.items()
            if fact.device == device
            and fact.pairing == pairing
            and not fact.status.terminal
            and fact.status not in _WITHOUT_SLOT
        ]
        slot, slot_pairing = self._slots.get(device, ("", ""))
        if len(active) > 1:
            self._history.violate("two-slots", f"{device}: {len(active)} actions are active")
        elif slot_pairing == pairing and active != ([slot] if slot else []):
            self._history.violate("slot", f"{device}: the slot names {slot[-6:]}, active is {active}")
