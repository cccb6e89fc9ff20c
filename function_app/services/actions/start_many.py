"""One start on many devices: each has its own answer, and what happens to one does not touch the others."""

import asyncio
import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

from function_app.domain.actions.action import Action
from function_app.domain.common.problems import Problem, store_unavailable
from function_app.domain.identity.accounts import Identity
from function_app.ports.tables import StoreError
from function_app.services.actions.start import Start, StartAction

MOST = 100
"""Devices in one call."""
AT_ONCE = 16
"""Devices whose start is written and sent at the same moment. Any number is waited for."""

_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class StartResult:
    """What became of it on one device: an action, or why there is none. ``reached``: it is as far as was waited for."""

    device: str
    result: Action | Problem
    there: bool = False


class StartOnMany:
    """The fleet call."""

    def __init__(self, *, start_action: StartAction) -> None:
        self._start_action = start_action

    async def start(
        self, caller: Identity, devices: Sequence[str], start: Start, *, epochs: Mapping[str, int]
    ) -> list[StartResult]:
        """Start it on each device; the answers in the order of ``devices``.

        The idempotency key counts for each device by itself: asked again, those that have it are not started again, and
        those that were refused are tried again.
        """
        gate = asyncio.Semaphore(AT_ONCE)
        return await asyncio.gather(
            *(self._one(caller, device, replace(start, epoch=epochs.get(device)), gate) for device in devices)
        )

    async def _one(self, caller: Identity, device: str, start: Start, gate: asyncio.Semaphore) -> StartResult:
        try:
            action, reached = await self._start_action.start(caller, device, start, gate=gate)
        except Problem as problem:
            return StartResult(device, problem)
        except StoreError as error:
            _log.error("%s: %s", device, error)
            return StartResult(
                device, store_unavailable("The tables cannot be used now. Ask again, with the same key.")
            )
        return StartResult(device, action, reached)
