"""Linearizability of one object (Wing and Gong, 1993): some order of the calls explains all responses.

Each call takes effect at one moment between its invocation and its response. A call without a response takes effect at
any later moment, or never.
"""

import math
from collections.abc import Callable, Hashable, Iterable, Sequence
from typing import Protocol, TypeVar

S = TypeVar("S", bound=Hashable)
MAX_STATES = 200_000


class Call(Protocol):
    """A call and its response."""

    @property
    def invoked_s(self) -> float: ...

    @property
    def returned_s(self) -> float: ...


C = TypeVar("C", bound=Call)


def is_linearizable(calls: Sequence[C], initial: S, step: Callable[[S, C], Iterable[S]]) -> bool:
    """Whether an order of the calls explains their responses.

    Args:
        calls: Calls to one object, with responses.
        initial: State of the object before them.
        step: All states after a call in a state; none if its response is impossible there.

    Returns:
        False if no order exists. True also if the search was given up after ``MAX_STATES`` states.
    """
    calls = sorted(calls, key=lambda call: call.invoked_s)
    required = sum(1 << number for number, call in enumerate(calls) if call.returned_s < math.inf)
    seen: set[tuple[int, S]] = set()
    pending = [(0, initial)]
    while pending and len(seen) < MAX_STATES:
        done, state = pending.pop()
        if done & required == required:
            return True
        if (done, state) in seen:
            continue
        seen.add((done, state))
        left = [number for number in range(len(calls)) if not done >> number & 1]
        first_return_s = min(calls[number].returned_s for number in left)
        for number in left:
            if calls[number].invoked_s <= first_return_s:
                pending += [(done | 1 << number, after) for after in step(state, calls[number])]
    return bool(pending)
