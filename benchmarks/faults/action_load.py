"""Somebody who orders one small move after the other, through whatever breaks, and asks again what was not answered."""

import threading
import time
from collections.abc import Mapping
from typing import Final, Self

import httpx
import msgspec

from benchmarks.faults.processes import ORDERED, ProductProcesses

STEP_RAD: Final = 0.002
"""Order number n brings the wrist to n times this: so the record says whose move it was."""
_ENDS: Final = ("done", "failed", "expired", "cancelled")
_TTL_MS: Final = 4000
_GIVE_UP_S: Final = 20.0
_AGAIN_S: Final = 0.2
_REST_S: Final = 0.1


class RequestedAction(msgspec.Struct):
    """One order.

    Attributes:
        fault: What was broken when it was given.
        status: The last that is known; empty where no function has ever accepted it.
        done_ms: When the answer came that it is done.
    """

    number: int
    fault: str
    given_ms: float
    action: str = ""
    status: str = ""
    done_ms: float = 0.0


class ActionLoad:
    """Gives them until the end of the ``with``.

    Attributes:
        fault: Now.
        given: All so far.
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
        """When the first order was done that was given after that moment."""
        found = [each.done_ms for each in list(self.given) if each.given_ms >= at_ms and each.status == "done"]
        return min(found, default=None)

    def settle(self) -> None:
        """Wait for the ends of those that were accepted, as long as one may be expected."""
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
        """With the same key until there is an answer: a client's retry must start nothing twice."""
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
            if answer.is_client_error:  # refused: the arm is busy with what has not ended yet, or off line
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
    """Those that were accepted and have no end."""
    return [each for each in orders if each.action and each.status not in _ENDS]


def duplicated(orders: list[RequestedAction], begun: Mapping[str, int]) -> list[RequestedAction]:
    """Those that have begun more than once. ``begun``: action → how often."""
    return [each for each in orders if begun.get(each.action, 0) > 1]


def went_back(wrist_rad: list[float]) -> int:
    """How often the record has the wrist at rest at the mark of an order that a later one had left behind.

    A mark counts where the wrist rests for three lines. Back at zero it has been started anew.
    """
    newest = found = 0
    for one, two, three in zip(wrist_rad, wrist_rad[1:], wrist_rad[2:], strict=False):
        number = round(one / STEP_RAD)
        if abs(one - two) > 1e-8 or abs(two - three) > 1e-8 or abs(one - number * STEP_RAD) > 1e-6:  # noqa: PLR2004
            continue
        found += 0 < number < newest
        newest = number
    return found
