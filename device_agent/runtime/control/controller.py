"""Controller: the thread-safe interface to one device's authority and motion.

It has no thread, clock or I/O. The control loop calls ``update``. Other threads submit setpoints, goals and
stops. One lock protects one ``ControlState``.
"""

import threading
from collections.abc import Callable, Mapping, Sequence

import numpy as np

from device_agent.ports.driver import Twist
from device_agent.ports.geometry import RobotGeometry
from device_agent.protocol import Mode, Setpoint, StopLatch
from device_agent.protocol.manifests.robot_type import RobotType
from device_agent.protocol.security.setpoints import SetpointKeys
from device_agent.runtime.authority.authority import Reservation
from device_agent.runtime.authority.event_recorder import RecordEvent, ignore_event
from device_agent.runtime.authority.lease_gate import Lease, LeaseGate
from device_agent.runtime.authority.speed_restrictions import Restriction
from device_agent.runtime.control.command_arbiter import CommandArbiter, ControlOutput
from device_agent.runtime.control.control_state import ControlState
from device_agent.runtime.control.goals import DriveGoal, JointGoal, TrajectoryGoal
from device_agent.runtime.errors import Refused
from device_agent.runtime.planning.trajectory import Trajectory


class Controller:
    """One device's authority and motion. Thread-safe.

    Args:
        robot_type: Joints and limits.
        gate: Lease gate with the epochs of the previous run.
        latch: Stop latch of the previous run.
        geometry: Shape of the robot; without it, clearance is not checked.
        record: Receives each change of authority with the controller locked; must not block or call the controller.

    Attributes:
        changed: Set when epochs or latch changed and must be journalled; the command processor clears it.
    """

    def __init__(
        self,
        robot_type: RobotType,
        gate: LeaseGate,
        *,
        latch: StopLatch | None = None,
        geometry: RobotGeometry | None = None,
        record: RecordEvent = ignore_event,
    ) -> None:
        self._joints = robot_type.joints
        self._state = ControlState(robot_type, gate, latch=latch, geometry=geometry, record=record)
        self._arbiter = CommandArbiter(robot_type, self._state)
        self.changed = self._state.authority.changed
        self._lock = threading.Lock()
        self._applied: ControlOutput | None = None

    # ------------------------------------------------------------ leases, Stop, faults

    def grant(
        self, *, epoch: int, holder: str, lease_s: float, now_s: float, reason: str = "", keys: SetpointKeys = ()
    ) -> None:
        """Accept a signed grant or renewal of the lease. ``keys`` authenticate its setpoints.

        Raises:
            Refused: The epoch is stale or burned.
        """
        with self._lock:
            authority = self._state.authority
            if authority.grant(epoch=epoch, holder=holder, lease_s=lease_s, now_s=now_s, reason=reason, keys=keys):
                self._state.stream.reset(self._state.motion.position_rad)

    def release(self, *, epoch: int) -> None:
        """End the lease that its holder released.

        Raises:
            Refused: The epoch is older than the lease in force.
        """
        with self._lock:
            self._state.authority.release(epoch)

    def restrict(self, source: str, speed: float, why: str) -> None:
        """Slow the device, or hold it with a speed of 0. The strictest of several sources applies.

        A hold ends the motion, and its source must take control again.

        Args:
            source: Name of the source; its restriction remains until it changes or is lifted.
            speed: Share of the speed, 0…1. Any other value counts as 0.
            why: Reason, for operators.
        """
        with self._lock:
            self._state.restrict(source, speed, why)

    def lift(self, source: str) -> None:
        """Remove a source's restriction. Slowed motion continues at full speed; held motion does not resume."""
        with self._lock:
            self._state.authority.restrictions.clear(source)

    def stop(self, latch: StopLatch, *, message: str = "") -> int:
        """Latch Stop; returns its number for ``stop_applied``. See ``Authority.stop``."""
        with self._lock:
            self._state.authority.stop(latch, message=message)
            self._state.stops += 1
            return self._state.stops

    def reset_stop(self, *, epoch: int) -> None:
        """Release the latch. Nothing resumes: every lease up to ``epoch``, that of the reset, has ended.

        Raises:
            Refused: The epoch is stale: a late or repeated reset must not release a later latch. Or the device has
                stopped itself.
        """
        with self._lock:
            self._fence(epoch)
            self._state.authority.reset_stop()

    def interrupt(self, why: Refused) -> None:
        """End the lease of a moving or reserved device. A device at rest keeps its lease."""
        with self._lock:
            if self._state.goals.moving or self._state.authority.reservation is not None:
                self._state.authority.end(why)

    def hold(self, why: Refused) -> None:
        """Brake, and end the lease and the running action."""
        with self._lock:
            self._state.authority.end(why)

    def set_fault(self, message: str) -> None:
        """Hold until ``clear_fault``: the driver failed."""
        with self._lock:
            self._state.authority.set_fault(message)

    def clear_fault(self, position_rad: Sequence[float]) -> None:
        """Start at rest at ``position_rad``, shape (n,) [rad], if there was a fault: the driver works again."""
        with self._lock:
            if self._state.authority.clear_fault():
                self._state.goals.start_at(position_rad)

    def follow_device_stop(self, latch: StopLatch, position_rad: Sequence[float]) -> None:
        """Latch Stop, and be at rest at ``position_rad``, shape (n,) [rad], until ``clear_fault``.

        The device has stopped itself for the reason of ``latch``. Until then Stop cannot be reset.
        """
        with self._lock:
            self._state.authority.follow_device_stop(latch)
            self._state.goals.start_at(position_rad)

    # ------------------------------------------------------------ setpoints

    def accept_setpoint(self, setpoint: Setpoint, *, now_s: float, tick_ms: int) -> None:
        """Accept a streamed setpoint; the newest replaces the previous one.

        Raises:
            Refused: No lease, out of order, too old, an ended input, or unknown joints; nothing moves. If the room
                holds the device, the lease also ends, so that the device does not start when a person leaves.
        """
        with self._lock:
            self._state.accept_setpoint(setpoint, now_s=now_s, tick_ms=tick_ms)

    # ------------------------------------------------------------ actions

    def reserve(self, *, epoch: int, on_revoked: Callable[[Refused], None], recovery: bool = False) -> Reservation:
        """Reserve the device for an action, until ``end_reservation`` or until its lease ends.

        Args:
            epoch: Epoch of the action's lease.
            on_revoked: Called with the controller locked when the reservation is revoked.
            recovery: Also while nothing may move: the action removes a fault, and its motion is still rejected.

        Raises:
            Refused: Stale or burned epoch, stopped, faulty, held by the room, or another action runs.
        """
        with self._lock:
            self._fence(epoch)
            if not recovery:
                self._state.authority.check_free()
            reservation = self._state.authority.reserve(epoch, on_revoked)
            self._state.stream.clear()
        return reservation

    def end_reservation(self, reservation: Reservation) -> None:
        """End the reservation of an action, and brake its motion."""
        with self._lock:
            if self._state.authority.reservation is reservation:
                self._state.goals.interrupt(Refused("ended", "the action ended"))
                self._state.authority.reservation = None
                self._state.stream.hold_here(self._state.motion.position_rad)

    def resolve_target(self, reservation: Reservation, position_rad: Mapping[str, float]) -> list[float]:
        """Final positions of a joint goal, shape (n,) [rad].

        Raises:
            Refused: As ``start_joint_goal``.
        """
        with self._lock:
            self._state.authority.check_goal(reservation)
            return self._state.limits.resolve_target(position_rad, self._state.motion.position_rad)

    def start_joint_goal(
        self, reservation: Reservation, position_rad: Mapping[str, float], *, speed: float
    ) -> JointGoal:
        """Start a motion to joint positions [rad]; joints without a position stay.

        Raises:
            Refused: The reservation has ended, stopped, faulty, held by the room, unknown joint, position not finite or
                out of range, or no clearance there.
        """
        with self._lock:
            self._state.authority.check_goal(reservation)
            self._state.stiffness.check_movable(position_rad)
            return self._state.goals.start_joint_goal(position_rad, speed)

    def start_trajectory(self, reservation: Reservation, trajectory: Trajectory) -> TrajectoryGoal:
        """Start to follow a trajectory that starts at the current position.

        Raises:
            Refused: The reservation has ended, stopped, faulty, held by the room, the trajectory starts elsewhere, or
                it leaves a joint's range.
        """
        with self._lock:
            self._state.authority.check_goal(reservation)
            moved = np.any(trajectory.position_rad != trajectory.position_rad[0], axis=0)
            self._state.stiffness.check_movable(
                joint.name for joint, moves in zip(self._joints, moved, strict=True) if moves
            )
            return self._state.goals.start_trajectory(trajectory)

    def hand_over(self, reservation: Reservation) -> None:
        """Let the robot move itself until ``take_over``. Setpoints are rejected until then.

        Raises:
            Refused: The reservation has ended, stopped, faulty, or held or slowed by the room.
        """
        with self._lock:
            self._state.authority.check_goal(reservation)
            self._state.hand_over()

    def take_over(self) -> None:
        """Hold at the positions that the driver applied last."""
        with self._lock:
            self._state.take_over()

    def start_drive(self, reservation: Reservation, twist: Twist, *, duration_s: float) -> DriveGoal:
        """Drive the base for ``duration_s`` [s]; then it brakes.

        Raises:
            Refused: The reservation has ended, stopped, faulty, held by the room, no base, not finite, or beyond the
                limits of the base.
        """
        with self._lock:
            self._state.authority.check_goal(reservation)
            return self._state.goals.start_drive(twist, duration_s)

    def stiffness_of(self, joints: Sequence[str]) -> dict[str, float]:
        """Stiffness of joints, 0…1; of all joints if none is named.

        Raises:
            Refused: A joint is unknown.
        """
        with self._lock:
            return self._state.stiffness.of(joints)

    def set_stiffness(self, values: Mapping[str, float], *, reservation: Reservation | None = None) -> None:
        """Record the stiffness of joints, 0…1. The caller sets it at the driver.

        Raises:
            Refused: A reservation is given, and it has ended or the device is stopped, faulty or held by the room.
        """
        with self._lock:
            if reservation is not None:
                self._state.authority.check_goal(reservation)
            self._state.stiffness.set(values)

    def suspend(self, why: str, now_s: float) -> str:
        """Reject grants and motion until ``resume``. Returns what prevents it, or an empty string."""
        with self._lock:
            return self._state.suspend(why, now_s)

    def resume(self) -> None:
        """Allow grants and motion again after ``suspend``."""
        with self._lock:
            self._state.authority.suspended = ""

    # ------------------------------------------------------------ state

    @property
    def latch(self) -> StopLatch | None:
        """The Stop latch."""
        return self._state.authority.latch

    @property
    def stop_pending(self) -> bool:
        """Whether Stop is latched but no period has applied it yet."""
        return self._state.authority.latch is not None and self._state.mode not in {Mode.STOPPED, Mode.FAULT}

    def stop_applied(self, number: int) -> bool:
        """Whether the device has accepted a period that began after this Stop was latched."""
        applied = self._applied
        return applied is not None and applied.mode is Mode.STOPPED and applied.stops >= number

    @property
    def applied_mode(self) -> Mode:
        """Mode of the last period that the device accepted: a period that hangs in the driver does not count."""
        if self._state.authority.fault is not None:
            return Mode.FAULT
        return Mode.IDLE if self._applied is None else self._applied.mode

    @property
    def fault(self) -> str | None:
        """Error message of the driver."""
        return self._state.authority.fault

    @property
    def limits(self) -> tuple[str, ...]:
        """Names of the limits that apply to every source of motion."""
        return self._state.limits.names

    @property
    def restrictions(self) -> tuple[Restriction, ...]:
        """Restrictions in force, the strictest first."""
        with self._lock:
            return self._state.authority.restrictions.all

    @property
    def reduced_stiffness(self) -> dict[str, float]:
        """Joint → stiffness, of the joints with reduced stiffness."""
        with self._lock:
            return dict(self._state.stiffness.values)

    @property
    def mode(self) -> Mode:
        """Mode of the last period."""
        return self._state.mode

    @property
    def epochs(self) -> tuple[int, int]:
        """Highest epoch seen, highest epoch burned."""
        return self._state.authority.epochs

    def lease(self, now_s: float) -> Lease | None:
        """The lease in force."""
        with self._lock:
            return self._state.authority.lease(now_s)

    @property
    def moving(self) -> bool:
        """Whether any commanded velocity is not zero."""
        return self._state.goals.moving

    @property
    def commanded_rad(self) -> list[float]:
        """Commanded positions of the last period, shape (n,)."""
        with self._lock:
            return list(self._state.motion.position_rad)

    # ------------------------------------------------------------ control loop

    def start_at(self, position_rad: Sequence[float]) -> None:
        """Start at rest at the measured position, shape (n,) [rad]."""
        with self._lock:
            self._state.motion.start_at(position_rad)
            self._state.stream.reset(position_rad)

    def update(
        self,
        now_s: float,
        measured_rad: Sequence[float] | None = None,
        *,
        elapsed_s: float | None = None,
        settled: bool = True,
    ) -> ControlOutput:
        """Compute the command of this period.

        Args:
            now_s: Monotonic clock [s].
            measured_rad: Measured positions, shape (n,). Compliant joints are commanded there; goals wait for them.
            elapsed_s: Time since the last period began if a Stop makes this one early [s].
            settled: Whether the device has reported the end of the previous command; goals wait for it.
        """
        with self._lock:
            return self._arbiter.update(now_s, measured_rad, elapsed_s, settled=settled)

    def record_period(self, output: ControlOutput) -> None:
        """Record that the device has accepted all commands of this period. Only the control loop calls this."""
        self._applied = output

    def record_applied(self, position_rad: Sequence[float]) -> None:
        """Record the positions that the driver applied, shape (n,) [rad]; ``limited`` shows differences."""
        with self._lock:
            self._arbiter.record_applied(position_rad)

    def record_driven(self, commanded: Twist, applied: Twist) -> None:
        """Record the twist that the driver applied; ``limited`` shows differences."""
        with self._lock:
            self._arbiter.record_driven(commanded, applied)

    def _fence(self, epoch: int) -> None:
        if self._state.authority.fence(epoch):
            self._state.stream.reset(self._state.motion.position_rad)
