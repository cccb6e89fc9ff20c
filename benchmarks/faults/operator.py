"""An operator that streams to one arm at rest, slowly or at full speed, optionally duplicated and out of order."""

import contextlib
import threading
import time
from typing import Final, Self

from benchmarks.baseline.product import LEASE_MS, TIMEOUT_S
from benchmarks.faults.processes import STREAMING_ARM, ProductProcesses
from device_agent.protocol import JointTarget, JointTelemetry, Setpoint, codec
from device_agent.protocol.security import setpoints
from tests.harness.network.brokers import wait_until

JOINTS: Final = ("shoulder_pan", "shoulder_lift", "elbow", "wrist_1", "wrist_2", "wrist_3")
SLOW_RAD_S: Final = 0.1
FULL_SPEED: Final = float("inf")
_PERIOD_S: Final = 0.025
_FAR_RAD: Final = 1.4
_NEAR_RAD: Final = 0.5
_MOVING_RAD: Final = 5e-4
"""Motion per period of 8 ms that counts as moving; equals 0.06 rad/s."""


class FaultOperator:
    """Holds the lease and streams until the context ends.

    Args:
        product: The product.
        speed_rad_s: Speed of the first joint, alternating.
        shuffled: Send each setpoint twice and every second pair in reversed order.
    """

    def __init__(self, product: ProductProcesses, speed_rad_s: float, *, shuffled: bool = False) -> None:
        self._product = product
        self._speed_rad_s = speed_rad_s
        self._shuffled = shuffled
        self._stack = contextlib.ExitStack()
        self._newest: JointTelemetry | None = None
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._stream)

    def __enter__(self) -> Self:
        product = self._product
        lease = product.post(f"{product.device(STREAMING_ARM)}/lease", lease_ms=LEASE_MS, wait_ms=5000)
        self.epoch = lease["epoch"]
        self._key = bytes.fromhex(lease["setpoint_key"])
        self._topic = f"{product.topic(STREAMING_ARM)}/ctl/{self.epoch}"
        viewer = self._stack.enter_context(
            product.issued({"purpose": "view"}, f"{product.topic(STREAMING_ARM)}/tele/joints")
        )
        viewer.on_payload = self._on_telemetry
        control = {
            "purpose": "control",
            "device": product.device(STREAMING_ARM).rpartition("/")[2],
            "epoch": self.epoch,
        }
        self._control = self._stack.enter_context(product.issued(control))
        wait_until(lambda: self._newest is not None and self._newest.epoch == self.epoch, "the lease", TIMEOUT_S)
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.stop_streaming()
        self._stack.close()

    def stop_streaming(self) -> None:
        """Stops streaming. May be called twice."""
        self._stopping.set()
        self._thread.join()

    def _on_telemetry(self, payload: bytes) -> None:
        self._newest = codec.decode(payload, JointTelemetry)

    def _stream(self) -> None:
        """Streams at 40 Hz, the rate of the console."""
        assert self._newest is not None
        home = list(self._newest.commanded_rad)
        started_s, sequence, sign = time.monotonic(), 0, -1.0 if home[0] > 0 else 1.0
        pending: list[bytes] = []
        while not self._stopping.wait(_PERIOD_S):
            sequence += 1
            at_rad = self._newest.commanded_rad[0]
            if self._speed_rad_s == FULL_SPEED:
                sign = -sign if sign * at_rad > _FAR_RAD - _NEAR_RAD else sign
                first = sign * _FAR_RAD
            else:
                first = home[0] + sign * self._speed_rad_s * (time.monotonic() - started_s)
            target = dict(zip(JOINTS, [first, *home[1:]], strict=True))
            setpoint = Setpoint(
                epoch=self.epoch,
                sequence=sequence,
                echo_tick_ms=self._newest.tick_ms,
                sent_ms=time.monotonic() * 1000,
                target=JointTarget(position_rad=target),
            )
            pending = self._send([*pending, setpoints.seal(codec.encode(setpoint), self._key, self._topic)])

    def _send(self, pending: list[bytes]) -> list[bytes]:
        """Sends the payloads and returns those to send with the next setpoint."""
        if self._shuffled and len(pending) < 2:  # noqa: PLR2004 (a pair)
            return pending
        for payload in [*reversed(pending), *pending] if self._shuffled else pending:
            self._control.client.publish(self._topic, payload)
        return []

    def await_motion(self) -> None:
        """Waits until the arm is commanded to move at the requested speed."""
        if self._speed_rad_s:
            wait_until(self._is_moving, "motion", TIMEOUT_S)

    def _is_moving(self) -> bool:
        newest = self._product.recorder.since(STREAMING_ARM, time.monotonic() * 1000 - 50)
        return bool(newest) and newest[-1].epoch == self.epoch and newest[-1].moved_rad > _MOVING_RAD
