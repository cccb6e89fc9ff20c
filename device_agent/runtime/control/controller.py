"""What may be asked of one device, by whom and from which thread; what the motors are told of it ``pilot`` decides.

No thread, no clock, no I/O of its own. The control loop calls ``step``; other threads offer setpoints, moves and stops
through the methods, which lock.
"""

import threading
from collections.abc import Callable, Mapping, Sequence

import numpy as np

from device_agent.ports.driver import Twist
from device_agent.ports.geometry import RobotGeometry
from device_agent.protocol import Mode, Setpoint, StopLatch
from device_agent.protocol.manifests.robot_type import RobotType
from device_agent.runtime.authority.authority import Reservation
from device_agent.runtime.authority.event_recorder import Tell, ignore_event
from device_agent.runtime.authority.lease_gate import Lease, LeaseGate
from device_agent.runtime.authority.speed_restrictions import Restriction
from device_agent.runtime.control.command_arbiter import CommandArbiter, ControlOutput
from device_agent.runtime.control.goals import DriveGoal, JointGoal, TrajectoryGoal
from device_agent.runtime.errors import Refused
from device_agent.runtime.planning.trajectory import Trajectory


class Controller:
    """One device's authority and motion. Thread-safe.

    Args:
        robot_type: Joints and limits.
        gate: The lease gate, with the epochs remembered from before.
        latch: The Stop latch remembered from before.
        geometry: The robot's shape; without it nobody knows what it could touch.
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
        geometry: RobotGeometry | None = None,
        tell: Tell = ignore_event,
    ) -> None:
        self._joints = robot_type.joints
        self._pilot = CommandArbiter(robot_type, gate, latch=latch, geometry=geometry, tell=tell)
        self._envelope, self._helm, self._stream = self._pilot.envelope, self._pilot.helm, self._pilot.stream
        self._motion, self._slack, self._authority = self._helm.motion, self._pilot.slack, self._pilot.authority
        self.changed = self._authority.changed
        self._lock = threading.Lock()

    # ------------------------------------------------------------ what other threads ask

    def start_at(self, position_rad: Sequence[float]) -> None:
        """Begin at rest where the device is, shape (n,) [rad]."""
        with self._lock:
            self._motion.start_at(position_rad)
            self._stream.begin(position_rad)

    def grant(self, *, epoch: int, holder: str, lease_s: float, now_s: float, reason: str = "") -> None:
        """Take in a signed grant or renewal of the lease.

        Raises:
            Refused: Stale or ended.
        """
        with self._lock:
            if self._authority.grant(epoch=epoch, holder=holder, lease_s=lease_s, now_s=now_s, reason=reason):
                self._stream.begin(self._motion.position_rad)

    def release(self, *, epoch: int) -> None:
        """The holder gave the lease up, or lost it.

        Raises:
            Refused: From an older lease.
        """
        with self._lock:
            self._authority.release(epoch)

    def offer(self, setpoint: Setpoint, *, now_s: float, tick_ms: int) -> None:
        """Take in a streamed setpoint; the newest wins.

        Args:
            setpoint: As it arrived.
            now_s: Monotonic clock [s].
            tick_ms: The same clock as telemetry shows it [ms].

        Raises:
            Refused: No right, out of order, too old, or of unknown joints. Nothing changed. Or the room holds the
                device; control then has to be taken again, so that the arm does not start when a person leaves.
        """
        with self._lock:
            lease = self._authority.lease(now_s)
            if lease is None or setpoint.epoch != lease.epoch:
                raise Refused("no_lease", f"lease {setpoint.epoch} is not in force here")
            self._stream.check(setpoint, tick_ms=tick_ms)
            try:
                self._authority.check_free()
            except Refused as refused:
                if refused.code == "interlock":
                    self._authority.end(refused)
                raise
            if self._authority.tenure is not None:
                raise Refused("busy", "an action runs; cancel it first")
            self._stream.take(setpoint, now_s=now_s, tick_ms=tick_ms)

    def begin_action(self, *, epoch: int, on_lost: Callable[[Refused], None]) -> Reservation:
        """An action now has the device, until ``end_action`` or until its lease ends.

        Raises:
            Refused: Stale or ended epoch, stopped, faulty, held by the room, or another action runs.
        """
        with self._lock:
            self._fence(epoch)
            self._authority.check_free()
            tenure = self._authority.begin(epoch, on_lost)
            self._stream.drop()
            return tenure

    def end_action(self, tenure: Reservation) -> None:
        """The action is over; what still moves is held."""
        with self._lock:
            if self._authority.tenure is tenure:
                self._helm.interrupt(Refused("ended", "the action ended"))
                self._authority.tenure = None
                self._stream.stand(self._motion.position_rad)

    def move(self, tenure: Reservation, position_rad: Mapping[str, float], *, speed: float) -> JointGoal:
        """Start a move to joint positions [rad] as part of an action; joints not named stay.

        Raises:
            Refused: The action no longer has the device, stopped, faulty, held by the room, unknown joint, a number
                that is none, outside a joint's range, or no room there.
        """
        with self._lock:
            self._check_course(tenure)
            self._slack.check(position_rad)
            return self._helm.move(position_rad, speed)

    def stiffness(self, joints: Sequence[str]) -> dict[str, float]:
        """How firmly joints hold, 0…1; all of them where none is named.

        Raises:
            Refused: There is no such joint.
        """
        with self._lock:
            return {name: self._slack.values.get(name, 1.0) for name in self._slack.named(joints)}

    def stiffened(self, values: Mapping[str, float]) -> None:
        """How firmly joints really hold from now on, 0…1; whoever has the device."""
        with self._lock:
            self._slack.set(values)

    def stiffen(self, tenure: Reservation, values: Mapping[str, float]) -> None:
        """As part of an action, take in how firmly joints are to hold, 0…1; who calls tells the driver.

        Raises:
            Refused: The action no longer has the device, stopped, faulty, or held by the room.
        """
        with self._lock:
            self._check_course(tenure)
            self._slack.set(values)

    def target(self, tenure: Reservation, position_rad: Mapping[str, float]) -> list[float]:
        """Where a move to these positions would end, shape (n,) [rad].

        Raises:
            Refused: As ``move`` does.
        """
        with self._lock:
            self._check_course(tenure)
            return self._envelope.target(position_rad, self._motion.position_rad)

    def go_along(self, tenure: Reservation, way: Trajectory) -> TrajectoryGoal:
        """Start along a way that was planned, as part of an action. It begins where the device rests.

        Raises:
            Refused: The action no longer has the device, stopped, faulty, held by the room, it begins elsewhere, or it
                leads a joint out of its range.
        """
        with self._lock:
            self._check_course(tenure)
            moved = np.any(way.position_rad != way.position_rad[0], axis=0)
            self._slack.check(joint.name for joint, moves in zip(self._joints, moved, strict=True) if moves)
            return self._helm.go_along(way)

    def drive(self, tenure: Reservation, twist: Twist, *, duration_s: float) -> DriveGoal:
        """Move the base as part of an action, for ``duration_s`` [s]; then it brakes by itself.

        Raises:
            Refused: The action no longer has the device, stopped, faulty, held by the room, no base, a number that is
                none, or beyond the base's limits.
        """
        with self._lock:
            self._check_course(tenure)
            return self._helm.drive(twist, duration_s)

    def restrict(self, source: str, speed: float, why: str) -> None:
        """The room slows the device, or holds it with a speed of 0; of several sources the strictest counts.

        A hold ends what moves, and whoever moved it has to take control again.

        Args:
            source: Who says so; its word stays until its next one, or ``lift``.
            speed: Share of the speed that it would have, 0…1. What is no such number is 0.
            why: For people.
        """
        with self._lock:
            self._authority.restrictions.set(source, speed, why)
            busy = self._authority.tenure is not None or self.moving or self._stream.heard
            if self._authority.restrictions.speed <= 0 and busy:
                self._authority.end(Refused("interlock", f"the room holds the device: {why}"))

    def lift(self, source: str) -> None:
        """A source restricts no more. What was slowed goes on at full speed; what was held stays."""
        with self._lock:
            self._authority.restrictions.lift(source)

    def stop(self, latch: StopLatch) -> None:
        """Latch Stop. The first latch stays the one shown."""
        with self._lock:
            self._authority.stop(latch)

    def reset_stop(self, *, epoch: int) -> None:
        """Release the latch. Nothing resumes: every lease up to ``epoch``, the reset's own, has ended.

        Raises:
            Refused: Older than what the device has obeyed: a reset may come late, or again, and find a later latch.
        """
        with self._lock:
            self._fence(epoch)
            self._authority.reset_stop()

    def lost(self, why: Refused) -> None:
        """The link is gone: hold what moves, and let it be taken again. What rests keeps its lease."""
        with self._lock:
            if self.moving or self._authority.tenure is not None:
                self._authority.end(why)

    def fail(self, message: str) -> None:
        """The driver no longer answers: hold until ``recover``."""
        with self._lock:
            self._authority.fail(message)

    def recover(self, position_rad: Sequence[float]) -> None:
        """The driver answers again, at rest at ``position_rad``, shape (n,) [rad]."""
        with self._lock:
            if self._authority.recover():
                self._helm.start_at(position_rad)

    def applied(self, position_rad: Sequence[float]) -> None:
        """What the driver made of the last command, shape (n,) [rad]; where it differs, ``limited`` says so."""
        with self._lock:
            self._pilot.applied(position_rad)

    def driven(self, asked: Twist, done: Twist) -> None:
        """What the driver made of the last twist; where it differs, ``limited`` says so: who sits does not walk."""
        with self._lock:
            self._pilot.driven(asked, done)

    # ------------------------------------------------------------ what others may know

    @property
    def latch(self) -> StopLatch | None:
        """The Stop latch."""
        return self._authority.latch

    @property
    def stops(self) -> bool:
        """Whether a Stop is latched that no period has obeyed yet."""
        return self._authority.latch is not None and self._pilot.mode not in {Mode.STOPPED, Mode.FAULT}

    @property
    def fault(self) -> str | None:
        """What is wrong with the driver."""
        return self._authority.fault

    @property
    def limits(self) -> tuple[str, ...]:
        """What it holds whoever moves the device, by name."""
        return self._envelope.limits

    @property
    def restrictions(self) -> tuple[Restriction, ...]:
        """What the room allows, the strictest first."""
        with self._lock:
            return self._authority.restrictions.all

    @property
    def slack(self) -> dict[str, float]:
        """Joint → share of its strength, of those that do not hold with all of it."""
        with self._lock:
            return dict(self._slack.values)

    @property
    def mode(self) -> Mode:
        """What the last ``step`` did."""
        return self._pilot.mode

    @property
    def epochs(self) -> tuple[int, int]:
        """Highest epoch seen, highest epoch burned."""
        return self._authority.epochs

    def lease(self, now_s: float) -> Lease | None:
        """The lease in force."""
        with self._lock:
            return self._authority.lease(now_s)

    @property
    def moving(self) -> bool:
        """Whether any commanded velocity is not zero."""
        return self._helm.moving

    @property
    def commanded_rad(self) -> list[float]:
        """Where the joints were told to be in the last period, shape (n,)."""
        with self._lock:
            return list(self._motion.position_rad)

    # ------------------------------------------------------------ the control loop

    def step(
        self, now_s: float, measured_rad: Sequence[float] | None = None, *, passed_s: float | None = None
    ) -> ControlOutput:
        """Decide this period's command.

        Args:
            now_s: Monotonic clock [s].
            measured_rad: Where the joints are, shape (n,); limp ones are commanded there, others are to arrive there.
            passed_s: Since the last period began, where a Stop makes this one come early [s].
        """
        with self._lock:
            return self._pilot.step(now_s, measured_rad, passed_s=passed_s)

    def _fence(self, epoch: int) -> None:
        if self._authority.fence(epoch):
            self._stream.begin(self._motion.position_rad)

    def _check_course(self, tenure: Reservation) -> None:
        self._authority.check_free()
        self._authority.check_tenure(tenure)
