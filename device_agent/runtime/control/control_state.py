"""State of one device's control: authority, goal, setpoints, stiffness and mode."""

from device_agent.ports.geometry import RobotGeometry
from device_agent.protocol import Mode, StopLatch
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
