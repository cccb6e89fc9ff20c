"""Fingerprints of requests: an idempotency key is valid for equal requests only."""

from typing import Any

import msgspec
import pytest

from function_app.services.actions.requests import ActionRequest

WAVE = {"kind": "run_movement", "name": "wave", "parameters": {"times": 2, "side": "left"}}
BASE: dict[str, Any] = {"request": WAVE, "policy": "queue"}


def fingerprint(**changes: Any) -> str:
    return msgspec.convert(BASE | changes, ActionRequest).fingerprint()


@pytest.mark.parametrize(
    "change",
    [
        {"request": WAVE | {"name": "nod"}},
        {"request": WAVE | {"parameters": {"times": 3, "side": "left"}}},
        {"epoch": 1},
        {"ttl_ms": 9_000},
        {"timeout_ms": 9_000},
        {"wait_ms": 9_000},
        {"wait_for": "done"},
        {"policy": "reject"},
        {"queue_ms": 9_000},
    ],
    ids=str,
)
def test_different_requests_have_different_fingerprints(change: dict[str, Any]) -> None:
    assert fingerprint(**change) != fingerprint()


def test_the_order_of_parameters_and_an_unused_queueing_time_do_not_matter() -> None:
    reordered = WAVE | {"parameters": {"side": "left", "times": 2}}
    assert fingerprint(request=reordered) == fingerprint()
    assert fingerprint(policy="reject", queue_ms=9_000) == fingerprint(policy="reject")
