"""The lease of one device as a sequential object, and the order of the states of an action."""

import math
from collections.abc import Callable, Sequence
from itertools import pairwise
from typing import NamedTuple

from tests.simulation.checks.history import Operation

LEASE_CALLS = frozenset(
    {"acquire", "take_over", "renew", "release", "accept", "reset", "probe-reset", "share", "unpair"}
)
_CLOCK_S = 0.002
"""Resolution of the times in rows [s]."""


class LeaseState(NamedTuple):
    """The lease in the cloud. ``holder`` is empty if it is free.

    Attributes:
        expires_s: When it expires [s].
        ends_s: From when another session may get it: it has expired, or the device has ended it [s].
    """

    epoch: int
    holder: str
    expires_s: float
    ends_s: float


FREE = LeaseState(0, "", -math.inf, -math.inf)


class LeaseObject:
    """Steps of the lease of one device.

    Args:
        device_ended_s: When the device ended an epoch; infinite if it did not [s].
        expires_s: Virtual time of the expiry in a response; infinite if clocks have jumped [s].
        clocks_jumped: Whether a lease may have expired at any time.
    """

    def __init__(
        self, *, device_ended_s: Callable[[int], float], expires_s: Callable[[int], float], clocks_jumped: bool
    ) -> None:
        self._device_ended_s = device_ended_s
        self._expires_s = expires_s
        self._clocks_jumped = clocks_jumped

    def step(self, state: LeaseState, call: Operation) -> list[LeaseState]:  # noqa: PLR0911 (one per kind)
        """All states after a call; none if its response is impossible."""
        if call.outcome == "lost":
            return self._lost(state, call)
        if call.outcome != "ok":
            return [state]  # a rejection does not change the lease
        holder, epoch = call.actor, call.result.get("granted", 0)
        match call.kind:
            case "acquire":
                free = state.holder in {"", holder} or state.ends_s <= call.returned_s
                return [self._held(epoch, holder, call)] if epoch > state.epoch and free else []
            case "take_over":
                return [self._held(epoch, holder, call)] if epoch > state.epoch else []
            case "accept":
                if (state.epoch, state.holder) == (epoch, call.arguments["to"]):
                    return [state]  # the requester asked twice and got one request, which was accepted before
                # An action may have a lease of its own, which no response names.
                of_action = call.arguments["epoch"] > state.epoch
                live = of_action or self._is_held(state, holder, call.arguments["epoch"], call)
                return [self._held(epoch, call.arguments["to"], call)] if live and epoch > state.epoch else []
            case "renew":
                live = self._is_held(state, holder, call.arguments["epoch"], call)
                return [self._held(epoch, holder, call)] if live and epoch == state.epoch else []
            case "release":
                live = self._is_held(state, holder, call.arguments["epoch"], call)
                return [LeaseState(state.epoch, "", -math.inf, -math.inf)] if live else []
            case "reset" | "probe-reset":
                return [LeaseState(state.epoch + 1, "", -math.inf, -math.inf)]
            case _:  # share, unpair: they may revoke the lease
                return [state, LeaseState(state.epoch + 1, "", -math.inf, -math.inf)]

    def _lost(self, state: LeaseState, call: Operation) -> list[LeaseState]:
        """States after a call whose response is not known."""
        free = LeaseState(state.epoch + 1, "", -math.inf, -math.inf)
        match call.kind:
            case "renew":
                return [state, state._replace(expires_s=math.inf)]
            case "release":
                return [state, LeaseState(state.epoch, "", -math.inf, -math.inf)]
            case "acquire" | "take_over" | "accept":
                # The epoch is not known, also not to its holder, who cannot use it.
                return [state, LeaseState(state.epoch, "", -math.inf, -math.inf)]
            case _:
                return [state, free]

    def _held(self, epoch: int, holder: str, call: Operation) -> LeaseState:
        expires_s = self._expires_s(call.result["expires_ms"])
        ends_s = -math.inf if self._clocks_jumped else min(expires_s, self._device_ended_s(epoch))
        return LeaseState(epoch, holder, expires_s, ends_s)

    def _is_held(self, state: LeaseState, holder: str, epoch: int, call: Operation) -> bool:
        """Whether a call that requires the lease may succeed."""
        live = self._clocks_jumped or call.invoked_s <= state.expires_s + _CLOCK_S
        return (state.epoch, state.holder) == (epoch, holder) and live


def reverted_reads(operations: Sequence[Operation]) -> list[str]:
    """Responses about one action that are older than an earlier response."""
    found = []
    reads: dict[str, list[Operation]] = {}
    for operation in operations:
        action = operation.result.get("action") or operation.arguments.get("action")
        if operation.outcome == "ok" and action and "rank" in operation.result:
            reads.setdefault(action, []).append(operation)
    for action, each in reads.items():
        each.sort(key=lambda operation: operation.returned_s)
        newest = each[0]
        for earlier, operation in pairwise(each):
            newest = max(newest, earlier, key=lambda one: one.result["rank"])
            late = operation.invoked_s > newest.returned_s
            if late and operation.result["rank"] < newest.result["rank"]:
                found.append(f"action {action[-6:]}: {newest.result['status']}, later {operation.result['status']}")
    return found
