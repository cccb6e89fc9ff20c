"""Stop latency: from the operator's message to the first braking period, and to the first period without motion."""

import contextlib
import random
import time
from collections.abc import Callable
from typing import Final, Self

import msgspec

from benchmarks.faults.operator import FULL_SPEED, SLOW_RAD_S, FaultOperator
from benchmarks.faults.processes import STREAMING_ARM, ProductProcesses
from benchmarks.faults.recorder import Period
from device_agent.protocol import Stop, codec
from tests.faults.stack import now_ms

SPEEDS: Final = {"at rest": 0.0, f"{SLOW_RAD_S} rad/s": SLOW_RAD_S, "full speed": FULL_SPEED}
MESSAGE: Final = "MQTT message"
CALL: Final = "POST stop"
_STILL_RAD: Final = 1e-9
_REST_TIMEOUT_S: Final = 2.0
_ACCELERATION_S: Final = 0.35
"""Time to full speed, well before the arm reverses [s]."""
_PERIOD_S: Final = 0.008


class StopResult(msgspec.Struct, frozen=True, kw_only=True):
    """Result of one Stop. Times count from just before it was sent [ms]."""

    broker: str
    method: str
    speed: str
    at_rad_s: float
    braking_ms: float
    zero_ms: float


class StopRuns:
    """Sends Stops over a connection without proxies. Leaving the context closes it."""

    def __init__(self, product: ProductProcesses, *, seed: int) -> None:
        self._product = product
        self._chance = random.Random(seed)
        self._stack = contextlib.ExitStack()
        self._client = self._stack.enter_context(product.issued({"purpose": "view"}))
        self._number = 0

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    def run(self, method: str, speed: str) -> StopResult:
        """Sends one Stop at the requested speed and resets it."""
        send = self._send if method == MESSAGE else self._call
        with FaultOperator(self._product, SPEEDS[speed]) as operator:
            operator.await_motion()
            time.sleep((_ACCELERATION_S if speed == "full speed" else 0.1) + self._chance.uniform(0, 3 * _PERIOD_S))
            sent_ms = now_ms()
            send()
            periods = self._until_rest(sent_ms)
        before = [each for each in self._product.recorder.since(STREAMING_ARM, sent_ms - 30) if each.at_ms <= sent_ms]
        response = self._product.owner.post(f"{self._product.device(STREAMING_ARM)}/stop/reset")
        response.raise_for_status()
        return evaluate(before, periods, sent_ms=sent_ms, broker=self._product.kind, method=method, speed=speed)

    def _until_rest(self, sent_ms: float) -> list[Period]:
        deadline_s = time.monotonic() + _REST_TIMEOUT_S
        while time.monotonic() < deadline_s:
            periods = self._product.recorder.since(STREAMING_ARM, sent_ms)
            last = periods[-2:]
            if len(last) > 1 and all(each.mode == "stopped" and each.moved_rad <= _STILL_RAD for each in last):
                return periods
            time.sleep(0.02)
        raise TimeoutError("the arm did not stop after a Stop")

    def _send(self) -> None:
        self._number += 1
        stop = Stop(id=f"bench{self._number}")
        self._client.client.publish(f"{self._product.topic(STREAMING_ARM)}/stop/bench", codec.encode(stop), 1)

    def _call(self) -> None:
        self._product.post(f"{self._product.device(STREAMING_ARM)}/stop", reason="bench")


def evaluate(
    before: list[Period], periods: list[Period], *, sent_ms: float, broker: str, method: str, speed: str
) -> StopResult:
    """Evaluates the last periods before the Stop and those after it until rest."""
    braking = next(each for each in periods if each.mode == "stopped")
    moving = [each for each in periods if each.at_ms >= braking.at_ms and each.moved_rad > _STILL_RAD]
    after_ms = moving[-1].at_ms if moving else 0.0
    zero = next(each for each in periods if each.at_ms >= max(after_ms + 1e-6, braking.at_ms))
    return StopResult(
        broker=broker,
        method=method,
        speed=speed,
        at_rad_s=round(max((each.moved_rad for each in before), default=0.0) / _PERIOD_S, 3),
        braking_ms=round(braking.at_ms - sent_ms, 3),
        zero_ms=round(zero.at_ms - sent_ms, 3),
    )


def series(stops: StopRuns, each: int, log: Callable[[str], None]) -> list[StopResult]:
    """Runs a number of Stops for each speed and method, interleaved."""
    results: list[StopResult] = []
    for number in range(each):
        for speed in SPEEDS:
            results += [stops.run(method, speed) for method in (MESSAGE, CALL)]
        if number % 10 == 9:  # noqa: PLR2004 (a line every ten rounds)
            log(f"{len(results)} Stops")
    return results
