"""Explores every state of one device's lease, with the real rules of the cloud and the real lease gate.

The transition system is the one of ``docs/models/LeaseEpoch.tla``, with the same names of actions. Messages are never
removed: they may arrive late, repeatedly, in any order, or never.
"""

import math
from collections import deque
from collections.abc import Iterator
from typing import Literal, NamedTuple

from device_agent.runtime.authority.lease_gate import Lease as GateLease
from device_agent.runtime.authority.lease_gate import LeaseGate
from device_agent.runtime.errors import Refused
from function_app.domain.common.problems import Problem
from function_app.domain.control import lease as rules
from function_app.domain.control.lease import Lease
from function_app.domain.identity.accounts import Identity

OPERATORS = ("a", "b")
NextEpoch = Literal["cloud", "device"]
Restore = Literal["never", "old", "fresh"]


class Message(NamedTuple):
    """A signed command to the device: ``grant``, or ``release`` (also of a reset)."""

    kind: str
    epoch: int
    holder: str = ""


class State(NamedTuple):
    """See the variables of the TLA+ module. An empty holder means that the lease is free."""

    cloud: tuple[int, str] = (0, "")
    backup: tuple[int, str] = (0, "")
    gate: tuple[int, int, str] = (0, 0, "")
    journal: int = 0
    messages: frozenset[Message] = frozenset()
    keys: frozenset[tuple[str, int]] = frozenset()


class Result(NamedTuple):
    """What was explored; ``trace``: the actions that lead to a broken promise, shortest first; empty: none."""

    states: int
    transitions: int
    trace: tuple[str, ...] = ()


class LeaseModel:
    """The transition system.

    Args:
        max_epoch: Bound of the epochs.
        next_epoch: ``cloud``: as the product does, the cloud's epoch + 1; ``device``: max(cloud, device) + 1.
        restore: ``never``; ``old``: a restore brings the epochs of the backup back; ``fresh``: it continues above every
            granted epoch.
    """

    def __init__(self, *, max_epoch: int, next_epoch: NextEpoch = "cloud", restore: Restore = "never") -> None:
        self._max_epoch = max_epoch
        self._next_epoch = next_epoch
        self._restore = restore

    def explore(self) -> Result:
        """Explore all states, breadth first, until a promise is broken."""
        first = State()
        came_from: dict[State, tuple[State, str] | None] = {first: None}
        pending, transitions = deque([first]), 0
        while pending:
            state = pending.popleft()
            for action, after in self._steps(state):
                transitions += 1
                broken = broken_promise(after) or _decreased(state, after)
                if after not in came_from:
                    came_from[after] = (state, action)
                    pending.append(after)
                if broken:
                    return Result(len(came_from), transitions, (*_trace(came_from, state), action, broken))
        return Result(len(came_from), transitions)

    def _steps(self, state: State) -> Iterator[tuple[str, State]]:
        for operator in OPERATORS:
            yield from self._acquire(state, operator)
            yield from _renew(state, operator)
            yield from _release(state, operator)
        yield from self._invalidate(state)
        epoch, holder = state.cloud
        if holder:
            yield "expire", state._replace(cloud=(epoch, ""))
        yield "back_up", state._replace(backup=state.cloud)
        if self._restore == "old":
            yield "restore", state._replace(cloud=state.backup)
        elif self._restore == "fresh":
            granted = {epoch, state.gate[0], *(m.epoch for m in state.messages), *(key[1] for key in state.keys)}
            yield "restore", state._replace(cloud=(max(granted), ""))
        for message in sorted(state.messages):
            yield from _deliver(state, message)
        gate = _gate(state)
        if gate.granted is not None:
            gate.burn()
            yield "burn", _with_gate(state, gate)
        yield "restart", _with_gate(state, LeaseGate(epoch=state.journal, burned=state.journal))

    def _base(self, state: State) -> Lease:
        """The lease from which the next epoch is counted."""
        epoch, holder = state.cloud
        if self._next_epoch == "device":
            epoch = max(epoch, state.gate[0])
        return _lease((epoch, holder))

    def _acquire(self, state: State, operator: str) -> Iterator[tuple[str, State]]:
        try:
            lease = rules.acquire(self._base(state), _identity(operator), lease_ms=1000, now_ms=0)
        except Problem:
            return
        if lease.epoch <= self._max_epoch:
            yield f"acquire({operator})", _granted(state, lease)

    def _invalidate(self, state: State) -> Iterator[tuple[str, State]]:
        lease = rules.invalidate(self._base(state), pairing="", now_ms=0)
        if lease.epoch <= self._max_epoch:
            messages = state.messages | {Message("release", lease.epoch)}
            yield "invalidate", state._replace(cloud=(lease.epoch, ""), messages=messages)


def broken_promise(state: State) -> str:
    """The promise that a state breaks, or nothing."""
    epoch, burned, holder = state.gate
    movers = [operator for operator in OPERATORS if holder and (operator, epoch) in state.keys]
    if len(movers) > 1:
        return "AtMostOneHolder"
    if holder and epoch <= burned:
        return "BurnedNeverMoves"
    return "" if state.journal >= epoch >= burned else "JournalCoversGate"


def _decreased(before: State, after: State) -> str:
    lower = after.gate[0] < before.gate[0] or after.gate[1] < before.gate[1]
    return "EpochsNeverDecrease" if lower else ""


def _renew(state: State, operator: str) -> Iterator[tuple[str, State]]:
    epoch, _ = state.cloud
    try:
        lease = rules.renew(_lease(state.cloud), _identity(operator), epoch=epoch, lease_ms=1000, now_ms=0)
    except Problem:
        return
    yield f"renew({operator})", _granted(state, lease)


def _release(state: State, operator: str) -> Iterator[tuple[str, State]]:
    epoch, _ = state.cloud
    try:
        held = rules.require_held(_lease(state.cloud), _identity(operator), epoch=epoch, now_ms=0)
    except Problem:
        return
    free = rules.release(held, now_ms=0)
    messages = state.messages | {Message("release", epoch)}
    yield f"release({operator})", state._replace(cloud=(free.epoch, free.account), messages=messages)


def _deliver(state: State, message: Message) -> Iterator[tuple[str, State]]:
    gate = _gate(state)
    try:
        if message.kind == "grant":
            gate.grant(epoch=message.epoch, holder=message.holder, lease_s=math.inf, now_s=0.0)
        else:
            gate.fence(message.epoch)
            gate.burn()
    except Refused:
        return
    action = "grant" if message.kind == "grant" else "fence"
    after = state._replace(journal=max(state.journal, message.epoch))
    yield f"{action}({message.epoch}, {message.holder or 'free'})", _with_gate(after, gate)


def _granted(state: State, lease: Lease) -> State:
    messages = state.messages | {Message("grant", lease.epoch, lease.account)}
    keys = state.keys | {(lease.account, lease.epoch)}
    return state._replace(cloud=(lease.epoch, lease.account), messages=messages, keys=keys)


def _identity(operator: str) -> Identity:
    return Identity(operator, operator, operator)


def _lease(cloud: tuple[int, str]) -> Lease:
    epoch, holder = cloud
    return Lease(epoch, holder, holder, holder, expires_ms=1000) if holder else Lease(epoch)


def _gate(state: State) -> LeaseGate:
    epoch, burned, holder = state.gate
    gate = LeaseGate(epoch=epoch, burned=burned)
    if holder:
        gate._lease = GateLease(holder, epoch, math.inf)
    return gate


def _with_gate(state: State, gate: LeaseGate) -> State:
    return state._replace(gate=(gate.epoch, gate.burned, gate.granted.holder if gate.granted else ""))


def _trace(came_from: dict[State, tuple[State, str] | None], state: State) -> tuple[str, ...]:
    actions = []
    while (step := came_from[state]) is not None:
        state, action = step
        actions.append(action)
    return tuple(reversed(actions))
