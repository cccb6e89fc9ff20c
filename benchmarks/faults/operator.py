"""An operator that streams to one arm at rest, slowly or at full speed, optionally duplicated and out of order."""

import contextlib
import threading
import time
from typing import Final, Self

from benchmarks.baseline.product import LEASE_MS, TIMEOUT_S
from benchmarks.faults.processes import STREAMED, ProductProcesses
from device_agent.protocol import JointTarget, JointTelemetry, Setpoint, codec
from tests.harness.network.brokers import wait_until

JOINTS: Final = ("shoulder_pan", "shoulder_lift", "elbow", "wrist_1", "wrist_2", "wrist_3")
SLOW_RAD_S: Final = 0.1
FULL: Final = float("inf")
_PERIOD_S: Final = 0.025
_FAR_RAD: Final = 1.4
_NEAR_RAD: Final = 0.5
_MOVES_RAD: Final = 5e-4
"""Motion per period of 8 ms that counts as moving; equals 0.06 rad/s."""


class FaultOperator:
    """Holds the lease and streams until the context ends.

    Args:
        ground: The product.
        speed_rad_s: Speed of the first joint, alternating.
        shuffled: Send each setpoint twice and every second pair in reversed order.
    """

    def __init__(self, ground: ProductProcesses, speed_rad_s: float, *, shuffled: bool = False) -> None:
        self._ground = ground
        self._speed_rad_s = speed_rad_s
        self._shuffled = shuffled
        self._stack = contextlib.ExitStack()
        self._newest: JointTelemetry | None = None
        self._ending = threading.Event()
        self._thread = threading.Thread(target=self._stream)

    def __enter__(self) -> Self:
        ground = self._ground
        granted = ground.post(f"{ground.device(STREAMED)}/lease", lease_ms=LEASE_MS, wait_ms=5000)
        self.epoch = granted["epoch"]
        ear = self._stack.enter_context(ground.issued({"purpose": "view"}, f"{ground.topic(STREAMED)}/tele/joints"))
        ear.on_payload = self._hear
        control = {"purpose": "control", "device": ground.device(STREAMED).rpartition("/")[2], "epoch": self.epoch}
        self._line = self._stack.enter_context(ground.issued(control))
        wait_until(lambda: self._newest is not None and self._newest.epoch == self.epoch, "the lease", TIMEOUT_S)
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.let_go()
        self._stack.close()

    def let_go(self) -> None:
        """Stops streaming. May be called twice."""
        self._ending.set()
        self._thread.join()

    def _hear(self, payload: bytes) -> None:
        self._newest = codec.decode(payload, JointTelemetry)

    def _stream(self) -> None:
        """Streams at 40 Hz, the rate of the console."""
        assert self._newest is not None
        home = list(self._newest.commanded_rad)
        began_s, sequence, sign = time.monotonic(), 0, -1.0 if home[0] > 0 else 1.0
        held: list[bytes] = []
        while not self._ending.wait(_PERIOD_S):
            sequence += 1
            at_rad = self._newest.commanded_rad[0]
            if self._speed_rad_s == FULL:
                sign = -sign if sign * at_rad > _FAR_RAD - _NEAR_RAD else sign
                first = sign * _FAR_RAD
            else:
                first = home[0] + sign * self._speed_rad_s * (time.monotonic() - began_s)
            target = dict(zip(JOINTS, [first, *home[1:]], strict=True))
            setpoint = Setpoint(
                epoch=self.epoch,
                sequence=sequence,
                echo_tick_ms=self._newest.tick_ms,
                sent_ms=time.monotonic() * 1000,
                target=JointTarget(position_rad=target),
            )
            held = self._send([*held, codec.encode(setpoint)])

    def _send(self, held: list[bytes]) -> list[bytes]:
        """Payloads that are sent with the next setpoint."""
        if self._shuffled and len(held) < 2:  # noqa: PLR2004 (a pair)
            return held
        for payload in [*reversed(held), *held] if self._shuffled else held:
            self._line.client.publish(f"{self._ground.topic(STREAMED)}/ctl/{self.epoch}", payload)
        return []

    def await_motion(self) -> None:
        """Waits until the arm is commanded to move at the requested speed."""
        if self._speed_rad_s:
            wait_until(self._moves, "motion", TIMEOUT_S)

    def _moves(self) -> bool:
        newest = self._ground.noted.since(STREAMED, time.monotonic() * 1000 - 50)
        return bool(newest) and newest[-1].epoch == self.epoch and newest[-1].moved_rad > _MOVES_RAD
