"""Decides, once per control period, what the motors of one device are told. When in doubt: hold.

Pure but for ``ruckig``: no thread, no clock, no I/O of its own, so that every path can be tested tick by tick. The
control loop calls ``step``; other threads offer setpoints, moves and stops through the methods, which lock.
"""

import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from enum import Enum

from device_agent.protocol.events import EventKind
from device_agent.protocol.messages import Mode, Setpoint, StopLatch
from device_agent.protocol.robot_type import RobotType
from device_agent.runtime.audit import Happened, Severity, Tell, to_nobody
from device_agent.runtime.lease import Lease, LeaseGate, Refused
from device_agent.runtime.motion import Motion, MotionError

WATCHDOG_S = 0.3
"""Commanded velocity is zero this long after the last fresh setpoint."""
MAX_LOOP_AGE_S = 0.2
"""A setpoint that answers telemetry older than this is not fresh."""
_SOONEST_BRAKING_S = 0.15
"""Braking never begins sooner than this after a setpoint, so that ordinary jitter does not stop the arm."""
_CREEP_RAD_S = 0.02
"""Slower than this, setpoints that end are a slider let go at its target, not an operator lost in mid-motion."""


class Outcome(Enum):
    """How a move ended."""

    REACHED = "reached"
    INTERRUPTED = "interrupted"


@dataclass(eq=False)
class Move:
    """One point-to-point move on its way. ``finished`` is set once, after ``outcome`` and ``why`` are."""

    target_rad: list[float]
    speed: float
    finished: threading.Event = field(default_factory=threading.Event)
    outcome: Outcome | None = None
    why: Refused | None = None

    def end(self, outcome: Outcome, why: Refused | None = None) -> None:
        """Wake whoever waits."""
        self.outcome, self.why = outcome, why
        self.finished.set()


@dataclass(eq=False)
class Tenure:
    """An action's hold on the device, from ``begin_action`` until the action ends or ``why`` says who took it away.

    ``on_lost`` is called once, with the controller locked: it must be quick and must not call back.
    """

    epoch: int
    on_lost: Callable[[Refused], None]
    why: Refused | None = None


@dataclass(frozen=True, slots=True)
class Tick:
    """What one ``step`` decided. ``position_rad`` is for the motors; the rest is for telemetry."""

    position_rad: list[float]
    mode: Mode
    epoch: int
    setpoint_sequence: int
    setpoint_sent_ms: float
    loop_age_ms: float
    limited: tuple[str, ...]


class Controller:
    """One device's authority and motion. Thread-safe.

    Args:
        robot_type: Joints and limits.
        gate: The lease gate, with the epochs remembered from before.
        latch: The Stop latch remembered from before.
        tell: Called with each change of authority, with the controller locked: it must be quick and not call back.

    Attributes:
        changed: Set whenever epochs or the latch have changed and must be written down; whoever does clears it.
    """

    def __init__(
        self,
        robot_type: RobotType,
        gate: LeaseGate,
        *,
        latch: StopLatch | None = None,
        tell: Tell = to_nobody,
    ) -> None:
        self._joints = robot_type.joints
        self._index = {joint.name: index for index, joint in enumerate(robot_type.joints)}
        self._motion = Motion(robot_type)
        self._gate = gate
        self._latch = latch
        self._tell = tell
        self._streaming_speed = robot_type.streaming_speed
        self._lock = threading.Lock()
        self.changed = threading.Event()
        self._fault: str | None = None
        self._mode = Mode.IDLE
        self._move: Move | None = None
        self._tenure: Tenure | None = None
        self._target: list[float] = [0.0] * len(self._joints)
        self._setpoint: Setpoint | None = None
        self._setpoint_at_s = float("-inf")
        self._taken = 0
        self._taken_sent_ms = 0.0
        self._loop_age_ms = 0.0
        self._limited: tuple[str, ...] = ()

    # ------------------------------------------------------------ what other threads ask

    def start_at(self, position_rad: Sequence[float]) -> None:
        """Begin at rest where the device is, shape (n,) [rad]."""
        with self._lock:
            self._motion.start_at(position_rad)
            self._target = list(position_rad)

    def grant(self, *, epoch: int, holder: str, lease_s: float, now_s: float, reason: str = "") -> None:
        """Take in a signed grant or renewal of the lease.

        Raises:
            Refused: Stale or ended.
        """
        with self._lock:
            before, had = self._gate.epoch, self._gate.granted
            self._gate.grant(epoch=epoch, holder=holder, lease_s=lease_s, now_s=now_s, reason=reason)
            if epoch != before:
                self._new_epoch(had)
            if had is None or had.epoch != epoch:
                self._note(EventKind.LEASE_GRANTED, f"{holder} took control", {"epoch": epoch, "holder": holder})

    def release(self, *, epoch: int) -> None:
        """The holder gave the lease up, or lost it.

        Raises:
            Refused: From an older lease.
        """
        with self._lock:
            self._gate.fence(epoch)
            self._end_lease(Refused("lease_lost", "control was released"))

    def fence(self, epoch: int) -> None:
        """Check the epoch of a signed command; a newer one takes the device from whoever had it.

        Raises:
            Refused: Stale, or of a lease that has ended here.
        """
        with self._lock:
            self._fence(epoch)

    def offer(self, setpoint: Setpoint, *, now_s: float, tick_ms: int) -> None:
        """Take in a streamed setpoint; the newest wins.

        Args:
            setpoint: As it arrived.
            now_s: Monotonic clock [s].
            tick_ms: The same clock as telemetry shows it [ms].

        Raises:
            Refused: No right, out of order, too old, or of unknown joints. Nothing changed.
        """
        with self._lock:
            lease = self._gate.current(now_s)
            if lease is None or setpoint.epoch != lease.epoch:
                raise Refused("no_lease", f"lease {setpoint.epoch} is not in force here")
            if self._setpoint is not None and setpoint.sequence <= self._setpoint.sequence:
                raise Refused("out_of_order", "a newer setpoint has arrived already")
            age_ms = tick_ms - setpoint.echo_tick_ms
            if not 0 <= age_ms <= MAX_LOOP_AGE_S * 1000:
                raise Refused(
                    "too_old", f"answers telemetry of {age_ms} ms ago; {MAX_LOOP_AGE_S * 1000:.0f} ms is the most"
                )
            self._check_free()
            if self._tenure is not None:
                raise Refused("busy", "an action runs; cancel it first")
            self._check_names(setpoint.target.position_rad)
            self._setpoint = setpoint
            self._setpoint_at_s = now_s
            self._loop_age_ms = float(age_ms)

    def begin_action(self, *, epoch: int, on_lost: Callable[[Refused], None]) -> Tenure:
        """An action now has the device, until ``end_action`` or until its lease ends.

        Raises:
            Refused: Stale or ended epoch, stopped, faulty, or another action runs.
        """
        with self._lock:
            self._fence(epoch)
            self._check_free()
            if self._tenure is not None:
                raise Refused("busy", "another action runs on this device")
            self._setpoint_at_s = float("-inf")
            self._tenure = Tenure(epoch, on_lost)
            return self._tenure

    def end_action(self, tenure: Tenure) -> None:
        """The action is over; what still moves is held."""
        with self._lock:
            if self._tenure is tenure:
                self._interrupt(Refused("ended", "the action ended"))
                self._tenure = None

    def move(self, tenure: Tenure, position_rad: dict[str, float], *, speed: float) -> Move:
        """Start a move to joint positions [rad] as part of an action; joints not named stay.

        Raises:
            Refused: The action no longer has the device, stopped, faulty, unknown joint, or outside a joint's range.
        """
        with self._lock:
            self._check_free()
            if self._tenure is not tenure:
                raise tenure.why or Refused("ended", "the action ended")
            self._check_names(position_rad)
            target = list(self._motion.position_rad)
            for name, value in position_rad.items():
                joint = self._joints[self._index[name]]
                if not joint.lower_rad <= value <= joint.upper_rad:
                    raise Refused(
                        "out_of_range",
                        f"{name} can go from {joint.lower_rad:.4f} to {joint.upper_rad:.4f} rad, not to {value:.4f}",
                    )
                target[self._index[name]] = value
            self._interrupt(Refused("replaced", "another move took its place"))
            self._move = Move(target, speed)
            self._motion.follow(target, speed=speed, together=True)
            return self._move

    def stop(self, latch: StopLatch) -> None:
        """Latch Stop. The first latch stays the one shown."""
        with self._lock:
            if self._latch is None:
                self._latch = latch
                self.changed.set()
                data = {"by": latch.by, "reason": latch.reason}
                self._note(EventKind.STOP_LATCHED, f"stopped by {latch.by}", data, "warning")
            self._end_lease(Refused("stopped", "the device was stopped"))

    def reset_stop(self, *, epoch: int) -> None:
        """Release the latch. Nothing resumes: every lease up to ``epoch``, the reset's own, has ended.

        Raises:
            Refused: Older than what the device has obeyed: a reset may come late, or again, and find a later latch.
        """
        with self._lock:
            self._fence(epoch)
            self._end_lease(Refused("lease_lost", "Stop was reset; take control again"))
            self._latch = None

    def lost(self, why: Refused) -> None:
        """The link is gone: hold what moves, and let it be taken again. What rests keeps its lease."""
        with self._lock:
            if self._motion.moving or self._tenure is not None:
                self._end_lease(why)

    def fail(self, message: str) -> None:
        """The driver no longer answers: hold until ``recover``."""
        with self._lock:
            if self._fault != message:
                self._note(EventKind.DRIVER_FAILED, message, {}, "error")
            self._fault = message
            self._end_lease(Refused("fault", message))

    def recover(self, position_rad: Sequence[float]) -> None:
        """The driver answers again, at rest at ``position_rad``, shape (n,) [rad]."""
        with self._lock:
            if self._fault is not None:
                self._fault = None
                self._note(EventKind.DRIVER_RECOVERED, "the device answers again", {})
                self._motion.start_at(position_rad)

    # ------------------------------------------------------------ what others may know

    @property
    def latch(self) -> StopLatch | None:
        """The Stop latch."""
        return self._latch

    @property
    def fault(self) -> str | None:
        """What is wrong with the driver."""
        return self._fault

    @property
    def mode(self) -> Mode:
        """What the last ``step`` did."""
        return self._mode

    @property
    def epochs(self) -> tuple[int, int]:
        """Highest epoch seen, highest epoch burned."""
        return self._gate.epoch, self._gate.burned

    def lease(self, now_s: float) -> Lease | None:
        """The lease in force."""
        with self._lock:
            return self._gate.current(now_s)

    @property
    def moving(self) -> bool:
        """Whether any commanded velocity is not zero."""
        return self._motion.moving

    # ------------------------------------------------------------ the control loop

    def step(self, now_s: float) -> Tick:
        """Decide this period's command.

        Args:
            now_s: Monotonic clock [s].
        """
        with self._lock:
            had = self._gate.granted
            if self._gate.expire(now_s):
                self._end_lease(Refused("lease_lost", "the lease ran out"), had)
            self._mode = self._decide(now_s)
            try:
                position = list(self._motion.update())
            except MotionError as error:
                self._end_lease(Refused("fault", str(error)))
                self._motion.start_at(self._motion.position_rad)
                self._mode, position = Mode.HOLDING, list(self._motion.position_rad)
            if self._move is not None and self._motion.reached:
                done, self._move = self._move, None
                done.end(Outcome.REACHED)
            lease = self._gate.current(now_s)
            return Tick(
                position,
                self._mode,
                lease.epoch if lease else 0,
                self._taken,
                self._taken_sent_ms,
                self._loop_age_ms,
                self._limited,
            )

    def _decide(self, now_s: float) -> Mode:
        if self._fault is not None:
            self._motion.brake()
            return Mode.FAULT
        if self._latch is not None:
            self._motion.brake()
            return Mode.STOPPED
        if self._tenure is not None:
            return Mode.ACTION
        age_s = now_s - self._setpoint_at_s
        if self._setpoint is not None and age_s < max(_SOONEST_BRAKING_S, WATCHDOG_S - self._motion.braking_time_s()):
            self._follow(self._setpoint)
            return Mode.STREAMING
        if self._mode is Mode.STREAMING and self._motion.fastest_rad_s > _CREEP_RAD_S:
            self._end_lease(Refused("watchdog", "setpoints stopped coming"))
        self._motion.brake()
        held = self._mode is Mode.HOLDING and (self._motion.moving or self._gate.burned >= self._gate.epoch)
        return Mode.HOLDING if held else Mode.IDLE

    def _follow(self, setpoint: Setpoint) -> None:
        if setpoint.sequence == self._taken:
            return
        limited = []
        for name, value in setpoint.target.position_rad.items():
            index = self._index[name]
            joint = self._joints[index]
            self._target[index] = min(max(value, joint.lower_rad), joint.upper_rad)
            if self._target[index] != value:
                limited.append(f"{name}: range")
        self._limited = tuple(limited)
        self._taken, self._taken_sent_ms = setpoint.sequence, setpoint.sent_ms
        self._motion.follow(self._target, speed=self._streaming_speed)

    def _fence(self, epoch: int) -> None:
        before, had = self._gate.epoch, self._gate.granted
        self._gate.fence(epoch)
        if epoch != before:
            self._new_epoch(had)
        elif epoch <= self._gate.burned:
            raise Refused("lease_ended", f"lease {epoch} has ended at the device; take control again")

    def _new_epoch(self, had: Lease | None) -> None:
        self.changed.set()
        why = Refused("lease_lost", "a newer lease took the device")
        self._note_end(had, why)
        self._hold(why)
        self._setpoint = None
        self._taken, self._taken_sent_ms, self._loop_age_ms, self._limited = 0, 0.0, 0.0, ()
        self._target = list(self._motion.position_rad)

    def _end_lease(self, why: Refused, had: Lease | None = None) -> None:
        self.changed.set()
        self._note_end(had or self._gate.granted, why)
        self._gate.burn()
        self._hold(why)

    def _hold(self, why: Refused) -> None:
        """Bring the device to rest; whoever moved it, by setpoints or as an action, no longer does."""
        self._setpoint_at_s = float("-inf")
        data = {"code": why.code, "epoch": self._gate.epoch}
        if self._motion.moving:
            if self._mode in {Mode.STREAMING, Mode.ACTION}:  # told once, not for each order to hold while it brakes
                self._note(EventKind.HELD, why.message, data, "warning")
            self._mode = Mode.HOLDING
        if self._tenure is not None:
            lost, self._tenure = self._tenure, None
            self._note(EventKind.ACTION_LOST, why.message, data, "warning")
            self._interrupt(why)
            lost.why = why
            lost.on_lost(why)
        self._motion.brake()

    def _interrupt(self, why: Refused) -> None:
        if self._move is not None:
            interrupted, self._move = self._move, None
            interrupted.end(Outcome.INTERRUPTED, why)
            self._motion.brake()

    def _note_end(self, had: Lease | None, why: Refused) -> None:
        if had is not None:
            data = {"epoch": had.epoch, "holder": had.holder, "code": why.code}
            self._note(EventKind.LEASE_ENDED, f"{had.holder}'s control ended: {why.message}", data)

    def _note(self, kind: EventKind, message: str, data: Mapping[str, object], severity: Severity = "info") -> None:
        self._tell(Happened(kind, message, severity, data))

    def _check_free(self) -> None:
        if self._latch is not None:
            raise Refused("stopped", f"stopped by {self._latch.by}; reset Stop first")
        if self._fault is not None:
            raise Refused("fault", self._fault)

    def _check_names(self, position_rad: dict[str, float]) -> None:
        unknown = sorted(set(position_rad) - set(self._index))
        if unknown:
            raise Refused("unknown_joint", f"no joint '{unknown[0][:80]}'; there are {', '.join(self._index)}")
