"""Starting on many devices: concurrency, and the result of a device whose start fails."""

import asyncio
from typing import Any, cast

import msgspec
import pytest

from function_app.domain.common.problems import Problem
from function_app.domain.identity.accounts import Identity
from function_app.ports.tables import StoreError
from function_app.services.actions.requests import ActionRequest
from function_app.services.actions.start import StartAction, device_busy
from function_app.services.actions.start_many import CONCURRENT_STARTS, StartOnMany, StartResult
from tests.harness.cloud.cloud import MOVE

ANNA = Identity("a", "anna", "s")
REQUEST = msgspec.convert({"request": MOVE}, ActionRequest)


class FakeStart:
    """Counts concurrent starts while the gate is held; fails on the devices in ``errors``."""

    def __init__(self, **errors: Exception) -> None:
        self._errors = errors
        self._running = 0
        self.most = 0
        self.calls: list[tuple[Identity, str, ActionRequest, str]] = []

    async def start(
        self, caller: Identity, device: str, request: ActionRequest, *, idempotency_key: str, gate: Any
    ) -> tuple[str, bool]:
        self.calls.append((caller, device, request, idempotency_key))
        async with gate:
            self._running += 1
            self.most = max(self.most, self._running)
            await asyncio.sleep(0)
            self._running -= 1
        if device in self._errors:
            raise self._errors[device]
        return f"action of {device}", True


def start(fake: FakeStart, devices: list[str]) -> list[StartResult]:
    service = StartOnMany(start_action=cast("StartAction", fake))
    return asyncio.run(service.start(ANNA, dict.fromkeys(devices, REQUEST), idempotency_key="k"))


def test_a_bounded_number_of_starts_is_written_concurrently() -> None:
    fake = FakeStart()
    devices = [f"d{number}" for number in range(3 * CONCURRENT_STARTS)]
    results = start(fake, devices)
    assert fake.most == CONCURRENT_STARTS
    assert results == [StartResult(device, cast("Any", f"action of {device}"), reached=True) for device in devices]
    assert fake.calls == [(ANNA, device, REQUEST, "k") for device in devices]


@pytest.mark.parametrize(
    ("error", "code", "status"),
    [(device_busy("x"), "device-busy", 409), (StoreError("no connection"), "store-unavailable", 503)],
)
def test_a_failed_start_is_the_result_of_its_device_only(error: Exception, code: str, status: int) -> None:
    first, failed = start(FakeStart(bad=error), ["good", "bad"])
    assert (first.device, first.reached) == ("good", True)
    assert (failed.device, failed.reached) == ("bad", False)
    assert isinstance(failed.result, Problem)
    assert (failed.result.code, failed.result.status) == (code, status)
    assert failed.result.detail
