"""A client that requests one move after another during faults and retries requests without a response."""

import math
import ssl
import threading
import time
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from typing import Any, Final, Self

import httpx
import msgspec

from tests.faults.judge import Row

STEP_RAD: Final = 2e-4
"""Action number n moves the wrist to n times this angle, so the simulation's trace identifies the action.

Thirty thousand actions, a run of some hours, stay within the range of the wrist.
"""
_TERMINAL: Final = ("done", "failed", "expired", "cancelled")
_TTL_MS: Final = 4000
_TIMEOUT_S: Final = 20.0
_RETRY_S: Final = 0.2
_PAUSE_S: Final = 0.1
_STILL_RAD: Final = 1e-8
_TOLERANCE_RAD: Final = 1e-6
_SETTLING_MS, _UNRECORDED_MS = 200.0, 1_000.0
"""Time from the first line of rest until the arm has settled, and until the agent has recorded the result [ms]."""


class RequestedAction(msgspec.Struct):
    """One requested action.

    Attributes:
        fault: Fault that was active at the time of the request.
        status: Last known status; empty if the API never accepted the request.
        code: Code of the reason of the status.
        done_ms: Time of the response with status ``done``.
    """

    number: int
    fault: str
    requested_ms: float
    id: str = ""
    status: str = ""
    code: str = ""
    done_ms: float = 0.0

    @property
    def ended(self) -> bool:
        """True if the action has a terminal status."""
        return self.status in _TERMINAL


class ActionLoad:
    """Requests actions until the context ends.

    Args:
        api: Address of the API.
        token: Its API key.
        device: HTTP path of the device.
        verify: Trusted certificates; False for HTTP.

    Attributes:
        fault: Fault that is active now.
        actions: All requested actions.
    """

    def __init__(self, api: str, token: str, device: str, *, verify: ssl.SSLContext | bool = False) -> None:
        self._path = f"{device}/actions"
        headers = {"Authorization": f"Bearer {token}"}
        self._http = httpx.Client(base_url=api, timeout=3, headers=headers, verify=verify)
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._run)
        self.fault = "none"
        self.actions: list[RequestedAction] = []

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()
        self._http.close()

    def stop(self) -> None:
        """Requests no further actions. May be called twice."""
        self._stopping.set()
        self._thread.join(2 * _TIMEOUT_S)

    @staticmethod
    def target_rad(number: int) -> float:
        """Returns the target of an action, from which the trace identifies it."""
        return number * STEP_RAD

    @staticmethod
    def wait_ms(number: int) -> int:  # noqa: ARG004 (a subclass depends on it)
        """Returns the time for which a poll of an action waits; 0: the server does not wait for its acks."""
        return 1000

    def done_since(self, at_ms: float) -> float | None:
        """Returns the completion time of the first action requested after a time, or None."""
        times_ms = [each.done_ms for each in list(self.actions) if each.requested_ms >= at_ms and each.status == "done"]
        return min(times_ms, default=None)

    def settle(self) -> None:
        """Waits until all accepted actions have a terminal status or the timeout expires."""
        for action in self.actions:
            deadline_s = time.monotonic() + _TIMEOUT_S
            while action.id and not action.ended and time.monotonic() < deadline_s:
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
        wait_ms = self.wait_ms(action.number)
        body: dict[str, Any] = {
            "request": {"kind": "move_joints", "position_rad": {"wrist_3": self.target_rad(action.number)}},
            "ttl_ms": _TTL_MS,
            "timeout_ms": 5000,
            "wait_for": "done",
            "wait_ms": 2 * wait_ms,
        }
        deadline_s = time.monotonic() + _TIMEOUT_S
        while not self._stopping.is_set() and time.monotonic() < deadline_s:
            try:
                headers = {"Idempotency-Key": f"action-{action.number}"}
                response = self._http.post(self._path, json=body, headers=headers)
            except httpx.HTTPError:
                self._stopping.wait(_RETRY_S)
                continue
            if response.is_success:
                self._update(action, response.json())
                while not action.ended and not self._stopping.is_set() and time.monotonic() < deadline_s:
                    self._poll(action)
                return
            if response.is_client_error:  # rejected: the previous action has not ended, or the arm is offline
                return
            self._stopping.wait(_RETRY_S)

    def _poll(self, action: RequestedAction) -> None:
        wait_ms = self.wait_ms(action.number)
        try:
            response = self._http.get(f"/actions/{action.id}", params={"wait_ms": wait_ms})
        except httpx.HTTPError:
            time.sleep(_RETRY_S)
            return
        if response.is_success:
            self._update(action, response.json())
        if not (response.is_success and wait_ms):
            time.sleep(_PAUSE_S)

    @staticmethod
    def _update(action: RequestedAction, resource: Mapping[str, Any]) -> None:
        action.id, action.status = resource["id"], resource["status"]
        action.code = (resource["reason"] or {}).get("code", "")
        if action.status == "done":
            action.done_ms = time.monotonic() * 1000


def lost(actions: list[RequestedAction]) -> list[RequestedAction]:
    """Returns the accepted actions without a terminal status."""
    return [each for each in actions if each.id and not each.ended]


def duplicated(actions: list[RequestedAction], starts: Mapping[str, int]) -> list[RequestedAction]:
    """Returns the actions that started more than once. ``starts``: action → number of starts."""
    return [each for each in actions if starts.get(each.id, 0) > 1]


def rests(rows: Iterable[Row], targets_rad: Mapping[int, float]) -> Iterator[tuple[float, int]]:
    """Yields the time and the number of each action whose target the trace shows at rest, once per visit.

    A target counts if the wrist rests there for three lines. Number 0 is a restart of the simulation at zero.

    Args:
        rows: The trace; the wrist is the last joint.
        targets_rad: Number of an action → its target.
    """
    numbers = {round(target / _TOLERANCE_RAD): number for number, target in targets_rad.items()} | {0: 0}
    one = two = math.inf
    newest = -1
    for tick_ms, target_rad in rows:
        three = target_rad[-1]
        if abs(one - two) <= _STILL_RAD and abs(two - three) <= _STILL_RAD:
            key = round(three / _TOLERANCE_RAD)
            number = next((numbers[each] for each in (key, key - 1, key + 1) if each in numbers), newest)
            if number != newest:
                newest = number
                yield tick_ms, number
        one, two = two, three


def count_returns(numbers: Iterable[int]) -> int:
    """Counts repeated visits of the target of an action. Number 0 is a restart of the simulation."""
    visits = Counter(number for number in numbers if number)
    return visits.total() - len(visits)


def false_results(
    actions: list[RequestedAction], reached_ms: Mapping[int, float], ended_ms: list[float]
) -> Iterator[str]:
    """Yields the actions whose result differs from the trace.

    Args:
        actions: All actions.
        reached_ms: Number of an action → first time at which the arm rested at its target.
        ended_ms: Times of kills that end an action: of the agent, or of its link. An action whose target it reached at
            this time may have either result.
    """
    for action in actions:
        at_ms = reached_ms.get(action.number)
        if action.status == "done" and at_ms is None:
            yield f"action {action.number} is done, but the arm did not reach its target"
        elif action.ended and action.status != "done" and at_ms is not None:
            if any(-_SETTLING_MS <= each - at_ms <= _UNRECORDED_MS for each in ended_ms):
                continue
            yield f"action {action.number} is {action.status}, but the arm reached its target"
