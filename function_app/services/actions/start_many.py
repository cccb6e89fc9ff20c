"""Starts the same action on many devices; each device has its own result."""

import asyncio
import logging
from collections.abc import Mapping
from dataclasses import dataclass

from function_app.domain.actions.action import Action
from function_app.domain.common.problems import Problem, store_unavailable
from function_app.domain.identity.accounts import Identity
from function_app.ports.tables import StoreError
from function_app.services.actions.requests import ActionRequest
from function_app.services.actions.start import StartAction

CONCURRENT_STARTS = 16
"""Devices whose start is written and published at the same time. The wait for acks is not limited."""

_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class StartResult:
    """The action on one device, or the rejection; ``reached``: it reached the status that the request waits for."""

    device: str
    result: Action | Problem
    reached: bool = False


class StartOnMany:
    """Starts an action on many devices."""

    def __init__(self, *, start_action: StartAction) -> None:
        self._start_action = start_action

    async def start(
        self, caller: Identity, requests: Mapping[str, ActionRequest], *, idempotency_key: str = ""
    ) -> list[StartResult]:
        """Start ``requests[device]`` on each device; results are in the order of ``requests``.

        The idempotency key applies to each device separately. A repeated call starts only what was rejected before.
        """
        gate = asyncio.Semaphore(CONCURRENT_STARTS)

        async def start(device: str, request: ActionRequest) -> StartResult:
            try:
                action, reached = await self._start_action.start(
                    caller, device, request, idempotency_key=idempotency_key, gate=gate
                )
            except Problem as problem:
                return StartResult(device, problem)
            except StoreError as error:
                _log.error("%s: %s", device, error)
                detail = "The tables are not available. Send the request again with the same key."
                return StartResult(device, store_unavailable(detail))
            return StartResult(device, action, reached)

        return await asyncio.gather(*(start(device, request) for device, request in requests.items()))
