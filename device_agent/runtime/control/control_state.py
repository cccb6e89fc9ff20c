"""State of one device's control: authority, goal, setpoints, stiffness and mode."""

from device_agent.ports.geometry import RobotGeometry
from device_agent.protocol import Mode, Setpoint, StopLatch
from device_agent.protocol.events import EventKind
from device_agent.protocol.manifests.robot_type import RobotType
from device_agent.runtime.authority.authority import Authority
from device_agent.runtime.authority.event_recorder import RecordEvent
from device_agent.runtime.authority.lease_gate import LeaseGate
from device_agent.runtime.control.goal_executor import GoalExecutor
from device_agent.runtime.control.joint_stiffness import JointStiffness
from device_agent.runtime.control.limits import MotionLimits
from device_agent.runtime.control.setpoint_stream import SetpointStream
from device_agent.runtime.errors import Refused


class ControlState:
    """Everything that the controller's lock protects; see ``Controller`` for the arguments.

    Attributes:
        mode: Mode of the last period.
        stops: Number of received Stops.
        handed_over: Whether the robot moves itself.
    """

    def __init__(
        self,
        robot_type: RobotType,
        gate: LeaseGate,
        *,
        latch: StopLatch | None,
        geometry: RobotGeometry | None,
        record: RecordEvent,
    ) -> None:
        self.limits = MotionLimits(robot_type, geometry)
        self.goals = GoalExecutor(robot_type, self.limits)
        self.motion = self.goals.motion
        self.stream = SetpointStream(robot_type, self.limits, geometry)
        self.stiffness = JointStiffness(robot_type)
        self.authority = Authority(gate, latch, hold=self._hold, record=record)
        self.mode = Mode.IDLE
        self.stops = 0
        self.handed_over = False

    def restrict(self, source: str, speed: float, why: str) -> None:
        """See ``Controller.restrict``. A robot that moves itself cannot be slowed, so it is held."""
        self.authority.restrictions.set(source, speed, why)
        allowed = self.authority.restrictions.speed
        busy = self.authority.reservation is not None or self.goals.moving or self.stream.active
        if busy and (allowed <= 0 or (self.handed_over and allowed < 1)):
            self.authority.end(Refused("interlock", f"the room holds the device: {why}"))

    def accept_setpoint(self, setpoint: Setpoint, *, now_s: float, tick_ms: int) -> None:
        """See ``Controller.accept_setpoint``."""
        lease = self.authority.lease(now_s)
        if lease is None or setpoint.epoch != lease.epoch:
            raise Refused("no_lease", f"lease {setpoint.epoch} is not in force")
        self.stream.check(setpoint, tick_ms=tick_ms)
        self.authority.check_input(setpoint.input)
        try:
            self.authority.check_free()
        except Refused as refused:
            if refused.code == "interlock":
                self.authority.end(refused)
            raise
        if self.authority.reservation is not None or self.handed_over:
            raise Refused("busy", "an action runs; cancel it first")
        self.stream.accept(setpoint, now_s=now_s, tick_ms=tick_ms)

    def hand_over(self) -> None:
        """See ``Controller.hand_over``."""
        strictest = self.authority.restrictions.strictest
        if strictest is not None and strictest.speed < 1:
            raise Refused(
                "interlock", f"the room slows the device, and the robot cannot do this slower: {strictest.why}"
            )
        self.handed_over = True

    def take_over(self) -> None:
        """See ``Controller.take_over``."""
        self.handed_over = False
        self.stream.hold_here(self.motion.position_rad)

    def suspend(self, why: str, now_s: float) -> str:
        """See ``Controller.suspend``."""
        lease = self.authority.lease(now_s)
        if lease is not None:
            return f"{lease.holder} has control"
        if self.authority.reservation is not None:
            return "an action runs"
        if self.goals.moving:
            return "it moves"
        self.authority.suspended = why
        return ""

    def _hold(self, why: Refused) -> None:
        """Bring the device to rest after the right to move has ended."""
        self.stream.clear()
        if self.goals.moving:
            if self.mode in {Mode.STREAMING, Mode.ACTION}:  # recorded once, not for each hold while it brakes
                self.authority.record(EventKind.MOTION_HELD, why.message, self.authority.event_data(why), "warning")
            self.mode = Mode.HOLDING
        self.goals.interrupt(why)
        self.goals.brake()
