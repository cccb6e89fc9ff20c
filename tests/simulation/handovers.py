"""Simulated handovers of control over an unreliable network, reproducible from one seed.

The robot is the real controller with the real lease gate. Cloud, operators and network are simulated: grants, renewals,
releases and setpoints are lost, duplicated, delayed and reordered. Operators continue after they have lost control, and
after gaps, with the same input or a new one. Old grants are replayed. The robot restarts with the content of its
journal. A model that receives every message, but is independent of the gate's rules, checks the result.
"""

import heapq
import random
from collections import Counter
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any

from device_agent.protocol import JointTarget, Mode, Setpoint, StopLatch
from device_agent.protocol.security.setpoints import SetpointKeys
from device_agent.runtime.authority.lease_gate import Lease, LeaseGate
from device_agent.runtime.control.controller import Controller
from device_agent.runtime.errors import Refused
from tests.fakes.drivers import PERIOD_S, joint, robot_type

HANDOVERS = 50
"""Handovers in one history of one robot."""
_TYPE = robot_type(joints=[joint("elbow")])
_WATCHDOG_S = 0.3
_RAMP_PERIODS = 6
"""Periods after an accepted setpoint, in which the joint becomes faster than ``_MOVING_RAD_S``."""
_MOVING_RAD_S = 0.03
"""Faster than this, the watchdog holds the joint when setpoints end."""


@dataclass(order=True, slots=True)
class Message:
    """A message in transit to the robot."""

    arrives_s: float
    number: int
    kind: str = field(compare=False)
    epoch: int = field(compare=False)
    lease_s: float = field(compare=False, default=0.0)
    sequence: int = field(compare=False, default=0)
    input: int = field(compare=False, default=0)


@dataclass(slots=True)
class EpochModel:
    """Decides from the received messages which epochs are valid."""

    newest: int = 0
    expires_s: dict[int, float] = field(default_factory=dict)
    ended: set[int] = field(default_factory=set)

    def granted(self, epoch: int, now_s: float, lease_s: float) -> None:
        """A signed grant or renewal arrived."""
        # A renewal is in time until the control loop's next period.
        if epoch in self.expires_s and now_s > self.expires_s[epoch] + PERIOD_S:
            self.ended.add(epoch)
        self.expires_s[epoch] = now_s + lease_s
        self.newest = max(self.newest, epoch)

    def commanded(self, epoch: int) -> None:
        """Another signed command arrived."""
        self.newest = max(self.newest, epoch)

    def all_ended(self) -> None:
        """A Stop or restart ends all previous leases."""
        self.ended.update(self.expires_s)
        self.ended.add(self.newest)

    def stale(self, epoch: int, now_s: float, *, needs_lease: bool) -> bool:
        """Whether a command of this epoch is from a caller without control."""
        if epoch < self.newest or epoch in self.ended:
            return True
        return needs_lease and self.expires_s.get(epoch, -1.0) < now_s


@dataclass(slots=True)
class InputModel:
    """Decides from the accepted setpoints and the motion which inputs have ended."""

    epoch: int = 0
    newest: int = 0
    accepted_s: float = 0.0
    moving: bool = False
    held: bool = False

    def accepted(self, message: Message, now_s: float, tally: "Tally") -> bool:
        """Record an accepted setpoint. Returns whether its input had ended."""
        if message.epoch != self.epoch:
            self.epoch, self.newest, self.held = message.epoch, 0, False
        elif self.moving and now_s > self.accepted_s + _WATCHDOG_S + PERIOD_S:
            self.held = True
        stale = message.input < self.newest or (self.held and message.input == self.newest)
        if message.input > self.newest:
            tally["resumed"] += self.held
            self.newest, self.held = message.input, False
        self.accepted_s = now_s
        return stale


Tally = Counter[str]
"""Counts of a run.

``handovers``, messages ``delivered``, commands ``applied``, and ``stale`` commands among them; setpoints that
``resumed`` motion by a new input after a hold, and rejected setpoints of an input that had ``ended``.
"""


class History:
    """One robot and its operators.

    Args:
        seed: Seed of the random numbers.
        gate: Class of the lease gate.
        journal_first: Whether an epoch is journalled before it is applied.
    """

    def __init__(self, seed: int, gate: type[LeaseGate] = LeaseGate, *, journal_first: bool = True) -> None:
        self._random = random.Random(seed)
        self._gate = gate
        self._journal_first = journal_first
        self._journalled_epoch = 0
        self._latch: StopLatch | None = None
        self._robot = self._create_controller()
        self._model = EpochModel()
        self._inputs = InputModel()
        self._now_s = 0.0
        self._queue: list[Message] = []
        self._number = 0
        self.tally: Tally = Counter()

    def run(self, handovers: int = HANDOVERS) -> Tally:
        """Run the history to its end."""
        self._plan(handovers)
        while self._queue:
            message = heapq.heappop(self._queue)
            message.arrives_s = self._now_s = max(message.arrives_s, self._now_s)
            self._robot.update(self._now_s)
            self.tally["delivered"] += 1
            getattr(self, f"_{message.kind}")(message)
        return self.tally

    # ------------------------------------------------------------ cloud, operators, network

    def _plan(self, handovers: int) -> None:
        rng = self._random
        now_s = 1.0
        for number in range(1, handovers + 1):
            self.tally["handovers"] += 1
            epoch = 2 * number  # odd epochs belong to resets of Stop
            if rng.random() < 0.2:
                self._send("reset", now_s - 0.05, epoch - 1)
            lease_s = rng.uniform(0.3, 2.0)
            self._send("grant", now_s, epoch, lease_s=lease_s)
            if rng.random() < 0.5:
                self._send("grant", now_s + lease_s * 0.6, epoch, lease_s=lease_s)
            self._plan_setpoints(now_s, epoch)
            event = rng.random()
            if event < 0.3:
                self._send("release", now_s + rng.uniform(0.1, 1.5), epoch)
            elif event < 0.6:
                self._send("act", now_s + rng.uniform(0.0, 1.5), epoch)
            if event > 0.9:
                self._put("restart", now_s + rng.uniform(0.0, 2.0), epoch)
            elif event > 0.85:
                self._send("stop", now_s + rng.uniform(0.0, 2.0), epoch)
            now_s += rng.uniform(0.05, 1.5)

    def _plan_setpoints(self, now_s: float, epoch: int) -> None:
        """Setpoints with gaps; a former holder may continue for a while. Some operators number no inputs."""
        rng = self._random
        numbered, number = rng.random() < 0.8, 1
        for sequence, sent_s in enumerate(sorted(now_s + rng.uniform(0.0, 2.5) for _ in range(4)), 1):
            number += rng.random() < 0.4
            self._send("setpoint", sent_s, epoch, sequence=sequence, input=number * numbered)

    def _send(self, kind: str, now_s: float, epoch: int, **fields: Any) -> None:
        rng = self._random
        if rng.random() < 0.1:
            return  # lost
        for _ in range(2 if rng.random() < 0.1 else 1):
            delay = rng.random()
            max_delay_s = 0.05 if delay < 0.8 else 1.0 if delay < 0.97 else 20.0
            self._put(kind, now_s + rng.random() * max_delay_s, epoch, **fields)

    def _put(self, kind: str, arrives_s: float, epoch: int, **fields: Any) -> None:
        self._number += 1
        heapq.heappush(self._queue, Message(arrives_s, self._number, kind, epoch, **fields))

    # ------------------------------------------------------------ the robot

    def _create_controller(self) -> Controller:
        controller = Controller(
            _TYPE, self._gate(epoch=self._journalled_epoch, burned=self._journalled_epoch), latch=self._latch
        )
        controller.start_at([0.0])
        return controller

    def _apply_signed(self, epoch: int, apply: Callable[[], None]) -> None:
        """Journal the epoch before applying it, as the command processor does; a crash may happen at any moment."""
        if self._journal_first:
            self._journalled_epoch = max(self._journalled_epoch, epoch)
        crash = self._random.random()
        if crash > 0.01:
            with suppress(Refused):
                apply()
        if crash < 0.02:
            self._restart_now()
        self._journalled_epoch = max(self._journalled_epoch, self._robot.epochs[0])

    def _grant(self, message: Message) -> None:
        now_s, epoch, lease_s = message.arrives_s, message.epoch, message.lease_s
        self._model.granted(epoch, now_s, lease_s)
        self._apply_signed(epoch, lambda: self._robot.grant(epoch=epoch, holder="h", lease_s=lease_s, now_s=now_s))

    def _release(self, message: Message) -> None:
        self._model.commanded(message.epoch)
        self._apply_signed(message.epoch, lambda: self._robot.release(epoch=message.epoch))
        self._model.ended.add(message.epoch)

    def _act(self, message: Message) -> None:
        stale = self._model.stale(message.epoch, message.arrives_s, needs_lease=False)
        self._model.commanded(message.epoch)

        def act() -> None:
            reservation = self._robot.reserve(epoch=message.epoch, on_revoked=lambda _: None)
            self._robot.end_reservation(reservation)
            self._count(stale=stale)

        self._apply_signed(message.epoch, act)

    def _setpoint(self, message: Message) -> None:
        now_s = message.arrives_s
        tick_ms = round(now_s * 1000)
        setpoint = Setpoint(
            epoch=message.epoch,
            sequence=message.sequence,
            echo_tick_ms=tick_ms,
            sent_ms=0.0,
            input=message.input,
            target=JointTarget(position_rad={"elbow": 1.0 if message.epoch % 2 else -1.0}),
        )
        try:
            self._robot.accept_setpoint(setpoint, now_s=now_s, tick_ms=tick_ms)
        except Refused as refused:
            self.tally["ended"] += refused.code == "input_ended"
            return
        if self._robot.update(now_s).mode is not Mode.STREAMING:
            return
        ended = self._inputs.accepted(message, now_s, self.tally)
        self._count(stale=ended or self._model.stale(message.epoch, now_s, needs_lease=True))
        self._ramp()

    def _ramp(self) -> None:
        """Run some periods, and record whether the joint moves at the end."""
        before = self._robot.commanded_rad[0]
        for _ in range(_RAMP_PERIODS):
            self._now_s += PERIOD_S
            before, (position,) = self._robot.commanded_rad[0], self._robot.update(self._now_s).position_rad
        self._inputs.moving = abs(position - before) / PERIOD_S > _MOVING_RAD_S

    def _stop(self, _message: Message) -> None:
        self._model.all_ended()
        self._latch = StopLatch(caller="bob", reason="", at_ms=1)
        self._robot.stop(self._latch)

    def _reset(self, message: Message) -> None:
        self._model.commanded(message.epoch)
        self._apply_signed(message.epoch, lambda: self._robot.reset_stop(epoch=message.epoch))
        self._latch = self._robot.latch
        self._model.ended.add(message.epoch)

    def _restart(self, _message: Message) -> None:
        self._restart_now()

    def _restart_now(self) -> None:
        self._model.all_ended()
        self._robot = self._create_controller()

    def _count(self, *, stale: bool) -> None:
        self.tally["applied"] += 1
        self.tally["stale"] += stale


# ------------------------------------------------------------ mutants


class _Epoch(int):
    """An epoch that equals every accepted one."""

    accepted: Callable[[object], bool]

    def __eq__(self, other: object) -> bool:
        return self.accepted(other)

    def __ne__(self, other: object) -> bool:
        return not self.accepted(other)

    __hash__ = int.__hash__


class NoCheck(LeaseGate):
    """A gate that accepts every holder, past or present."""

    def grant(
        self, *, epoch: int, holder: str, lease_s: float, now_s: float, reason: str = "", keys: SetpointKeys = ()
    ) -> None:
        """Accept every grant."""
        self.epoch, self.burned = epoch, 0
        self._lease = Lease(holder, _Epoch(epoch), now_s + lease_s, reason, keys)
        self._lease.epoch.accepted = lambda _: True  # type: ignore[attr-defined]

    def fence(self, epoch: int) -> None:
        """Reject nothing."""
        self.burned = min(self.burned, epoch - 1)

    def current(self, now_s: float) -> Lease | None:  # noqa: ARG002
        """Never expire."""
        return self._lease

    def expire(self, now_s: float) -> bool:  # noqa: ARG002
        """Never expire."""
        return False


class NoInputs(LeaseGate):
    """A gate that keeps the lease after a hold and accepts every input."""

    def check_input(self, number: int) -> None:
        """Accept every input."""

    def end_input(self) -> bool:
        """End no input."""
        return True


class ExpiryOnly(LeaseGate):
    """A gate that only checks the expiry of leases."""

    def __init__(self, *, epoch: int = 0, burned: int = 0) -> None:
        super().__init__(epoch=epoch, burned=burned)
        self._until_s: dict[object, float] = {}

    def grant(
        self, *, epoch: int, holder: str, lease_s: float, now_s: float, reason: str = "", keys: SetpointKeys = ()
    ) -> None:
        """Accept every grant."""
        self._until_s[epoch] = now_s + lease_s
        self.epoch, self.burned = max(self.epoch, epoch), 0
        self._lease = Lease(holder, epoch, max(self._until_s.values()), reason, keys)

    def fence(self, epoch: int) -> None:
        """Reject nothing."""
        self.burned = min(self.burned, epoch - 1)

    def current(self, now_s: float) -> Lease | None:
        """A lease that equals all unexpired ones."""
        if self._lease is None:
            return None
        epoch = _Epoch(self._lease.epoch)
        epoch.accepted = lambda other: now_s < self._until_s.get(other, -1.0)
        return Lease(self._lease.holder, epoch, self._lease.expires_s)


def simulate(handovers: int, *, seed: int = 0, gate: type[LeaseGate] = LeaseGate, journal_first: bool = True) -> Tally:
    """Run this many handovers, in histories of fifty; history ``n`` has the seed ``seed + n``."""
    total: Tally = Counter()
    for history in range(max(1, handovers // HANDOVERS)):
        total += History(seed + history, gate, journal_first=journal_first).run()
    return total
