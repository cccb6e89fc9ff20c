"""A client that requests one small move after another during faults and retries requests without a response."""

import threading
import time
from collections.abc import Mapping
from typing import Final, Self

import httpx
import msgspec

from benchmarks.faults.processes import ORDERED, ProductProcesses

STEP_RAD: Final = 0.002
"""Action number n moves the wrist to n times this angle, so the simulation's trace identifies the action."""
_ENDS: Final = ("done", "failed", "expired", "cancelled")
_TTL_MS: Final = 4000
_GIVE_UP_S: Final = 20.0
_AGAIN_S: Final = 0.2
_REST_S: Final = 0.1


class RequestedAction(msgspec.Struct):
    """One requested action.

    Attributes:
        fault: Fault that was active at the time of the request.
        status: Last known status; empty if the API never accepted the request.
        done_ms: Time of the response with status ``done``.
    """

    number: int
    fault: str
    given_ms: float
    action: str = ""
    status: str = ""
    done_ms: float = 0.0


class ActionLoad:
    """Requests actions until the context ends.

    Attributes:
        fault: Fault that is active now.
        given: All requested actions.
    """

    def __init__(self, ground: ProductProcesses) -> None:
        self._ground = ground
        self._http = httpx.Client(base_url=ground.api, timeout=3, headers=dict(ground.http.headers))
        self._ending = threading.Event()
        self._thread = threading.Thread(target=self._run)
        self.fault = "none"
        self.given: list[RequestedAction] = []

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._ending.set()
        self._thread.join(_GIVE_UP_S)
        self._http.close()

    def done_since(self, at_ms: float) -> float | None:
        """Returns the completion time of the first action requested after a time, or None."""
        found = [each.done_ms for each in list(self.given) if each.given_ms >= at_ms and each.status == "done"]
        return min(found, default=None)

    def settle(self) -> None:
        """Waits until all accepted actions have a terminal status or the timeout expires."""
        for order in self.given:
            deadline_s = time.monotonic() + _GIVE_UP_S
            while order.action and order.status not in _ENDS and time.monotonic() < deadline_s:
                self._follow(order)

    def _run(self) -> None:
        number = 0
        while not self._ending.is_set():
            number += 1
            order = RequestedAction(number, self.fault, time.monotonic() * 1000)
            self.given.append(order)
            self._give(order)
            self._ending.wait(_REST_S)

    def _give(self, order: RequestedAction) -> None:
        """Repeats the request with the same idempotency key until a response arrives."""
        body = {
            "request": {"kind": "move_joints", "position_rad": {"wrist_3": order.number * STEP_RAD}},
            "ttl_ms": _TTL_MS,
            "timeout_ms": 5000,
            "wait_for": "done",
            "wait_ms": 2000,
        }
        deadline_s = time.monotonic() + _GIVE_UP_S
        while not self._ending.is_set() and time.monotonic() < deadline_s:
            try:
                path = f"{self._ground.device(ORDERED)}/actions"
                answer = self._http.post(path, json=body, headers={"Idempotency-Key": f"order-{order.number}"})
            except httpx.HTTPError:
                self._ending.wait(_AGAIN_S)
                continue
            if answer.is_success:
                self._note(order, answer.json())
                while order.status not in _ENDS and not self._ending.is_set() and time.monotonic() < deadline_s:
                    self._follow(order)
                return
            if answer.is_client_error:  # rejected: the previous action has not ended, or the arm is offline
                return
            self._ending.wait(_AGAIN_S)

    def _follow(self, order: RequestedAction) -> None:
        try:
            answer = self._http.get(f"/actions/{order.action}", params={"wait_ms": 1000})
        except httpx.HTTPError:
            time.sleep(_AGAIN_S)
            return
        if answer.is_success:
            self._note(order, answer.json())

    @staticmethod
    def _note(order: RequestedAction, action: Mapping[str, str]) -> None:
        order.action, order.status = action["id"], action["status"]
        if order.status == "done":
            order.done_ms = time.monotonic() * 1000


def lost(orders: list[RequestedAction]) -> list[RequestedAction]:
    """Returns the accepted actions without a terminal status."""
    return [each for each in orders if each.action and each.status not in _ENDS]


def duplicated(orders: list[RequestedAction], begun: Mapping[str, int]) -> list[RequestedAction]:
    """Returns the actions that started more than once. ``begun``: action → number of starts."""
    return [each for each in orders if begun.get(each.action, 0) > 1]


def went_back(wrist_rad: list[float]) -> int:
    """Counts returns of the wrist to the target of an earlier action, from the simulation's trace.

    A target counts if the wrist rests there for three lines. A return to zero is a restart of the simulation.
    """
    newest = found = 0
    for one, two, three in zip(wrist_rad, wrist_rad[1:], wrist_rad[2:], strict=False):
        number = round(one / STEP_RAD)
        if abs(one - two) > 1e-8 or abs(two - three) > 1e-8 or abs(one - number * STEP_RAD) > 1e-6:  # noqa: PLR2004
            continue
        found += 0 < number < newest
        newest = number
    return found
