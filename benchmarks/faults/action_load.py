"""A client that requests one small move after another during faults and retries requests without a response."""

import threading
import time
from collections.abc import Mapping
from typing import Final, Self

import httpx
import msgspec

from benchmarks.faults.processes import ACTION_ARM, ProductProcesses

STEP_RAD: Final = 0.002
"""Action number n moves the wrist to n times this angle, so the simulation's trace identifies the action."""
_TERMINAL: Final = ("done", "failed", "expired", "cancelled")
_TTL_MS: Final = 4000
_TIMEOUT_S: Final = 20.0
_RETRY_S: Final = 0.2
_PAUSE_S: Final = 0.1


class RequestedAction(msgspec.Struct):
    """One requested action.

    Attributes:
        fault: Fault that was active at the time of the request.
        status: Last known status; empty if the API never accepted the request.
        done_ms: Time of the response with status ``done``.
    """

    number: int
    fault: str
    requested_ms: float
    id: str = ""
    status: str = ""
    done_ms: float = 0.0


class ActionLoad:
    """Requests actions until the context ends.

    Attributes:
        fault: Fault that is active now.
        actions: All requested actions.
    """

    def __init__(self, product: ProductProcesses) -> None:
        self._product = product
        self._http = httpx.Client(base_url=product.api, timeout=3, headers=dict(product.http.headers))
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._run)
        self.fault = "none"
        self.actions: list[RequestedAction] = []

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stopping.set()
        self._thread.join(_TIMEOUT_S)
        self._http.close()

    def done_since(self, at_ms: float) -> float | None:
        """Returns the completion time of the first action requested after a time, or None."""
        times_ms = [each.done_ms for each in list(self.actions) if each.requested_ms >= at_ms and each.status == "done"]
        return min(times_ms, default=None)

    def settle(self) -> None:
        """Waits until all accepted actions have a terminal status or the timeout expires."""
        for action in self.actions:
            deadline_s = time.monotonic() + _TIMEOUT_S
            while action.id and action.status not in _TERMINAL and time.monotonic() < deadline_s:
                self._poll(action)

    def _run(self) -> None:
        number = 0
        while not self._stopping.is_set():
            number += 1
            action = RequestedAction(number, self.fault, time.monotonic() * 1000)
            self.actions.append(action)
            self._request(action)
            self._stopping.wait(_PAUSE_S)

    def _request(self, action: RequestedAction) -> None:
        """Repeats the request with the same idempotency key until a response arrives."""
        body = {
            "request": {"kind": "move_joints", "position_rad": {"wrist_3": action.number * STEP_RAD}},
            "ttl_ms": _TTL_MS,
            "timeout_ms": 5000,
            "wait_for": "done",
            "wait_ms": 2000,
        }
        deadline_s = time.monotonic() + _TIMEOUT_S
        while not self._stopping.is_set() and time.monotonic() < deadline_s:
            try:
                path = f"{self._product.device(ACTION_ARM)}/actions"
                response = self._http.post(path, json=body, headers={"Idempotency-Key": f"action-{action.number}"})
            except httpx.HTTPError:
                self._stopping.wait(_RETRY_S)
                continue
            if response.is_success:
                self._update(action, response.json())
                while action.status not in _TERMINAL and not self._stopping.is_set() and time.monotonic() < deadline_s:
                    self._poll(action)
                return
            if response.is_client_error:  # rejected: the previous action has not ended, or the arm is offline
                return
            self._stopping.wait(_RETRY_S)

    def _poll(self, action: RequestedAction) -> None:
        try:
            response = self._http.get(f"/actions/{action.id}", params={"wait_ms": 1000})
        except httpx.HTTPError:
            time.sleep(_RETRY_S)
            return
        if response.is_success:
            self._update(action, response.json())

    @staticmethod
    def _update(action: RequestedAction, resource: Mapping[str, str]) -> None:
        action.id, action.status = resource["id"], resource["status"]
        if action.status == "done":
            action.done_ms = time.monotonic() * 1000


def lost(actions: list[RequestedAction]) -> list[RequestedAction]:
    """Returns the accepted actions without a terminal status."""
    return [each for each in actions if each.id and each.status not in _TERMINAL]


def duplicated(actions: list[RequestedAction], starts: Mapping[str, int]) -> list[RequestedAction]:
    """Returns the actions that started more than once. ``starts``: action → number of starts."""
    return [each for each in actions if starts.get(each.id, 0) > 1]


def count_returns(wrist_rad: list[float]) -> int:
    """Counts returns of the wrist to the target of an earlier action, from the simulation's trace.

    A target counts if the wrist rests there for three lines. A return to zero is a restart of the simulation.
    """
    newest = returns = 0
    for one, two, three in zip(wrist_rad, wrist_rad[1:], wrist_rad[2:], strict=False):
        number = round(one / STEP_RAD)
        if abs(one - two) > 1e-8 or abs(two - three) > 1e-8 or abs(one - number * STEP_RAD) > 1e-6:  # noqa: PLR2004
            continue
        returns += 0 < number < newest
        newest = number
    return returns
