"""Driver of a robot with ROS and a mobile base, which is commanded by velocities."""

import contextlib
from pathlib import Path

from device_agent.drivers.command_limits import limit_twist
from device_agent.drivers.ros.driver import RosDriver
from device_agent.drivers.ros.joint_states import Measurement
from device_agent.drivers.ros.options import Base, Options
from device_agent.drivers.watchdog import CommandWatchdog
from device_agent.middleware.ros import messages
from device_agent.middleware.ros.connection import Connection, Publication
from device_agent.ports.driver import REST, Twist, UnreachableError
from device_agent.protocol.manifests.robot_type import RobotType


class RosBaseDriver(RosDriver):
    """As ``RosDriver``, with a base. A watchdog brakes it; if the connection fails, only its own timeout does.

    Args:
        robot_type: Joints, limits, frames and base.
        folder: Folder of the robot type, for its model.
        options: Which topics carry what.
        base: Topics of the base.
        device: Id of the device at its agent.
    """

    def __init__(self, robot_type: RobotType, folder: Path, options: Options, base: Base, device: str) -> None:
        super().__init__(robot_type, folder, options, device)
        self._base = base
        self._watchdog = CommandWatchdog(self._brake, device=device)

    def connect(self) -> None:
        """Connect; the base is at rest."""
        super().connect()
        self._watchdog.start()

    def drive(self, twist: Twist) -> Twist:
        """Command a velocity within the limits of the base."""
        connection = self._free()
        self._measured(connection)
        applied = limit_twist(self._type, twist)
        self._watchdog.feed()
        self._command(connection, self._velocity(applied))
        return applied

    def close(self) -> None:
        """Brake the base, and end the connection."""
        self._watchdog.stop()
        with contextlib.suppress(UnreachableError):
            self._brake()
        super().close()

    def _advertised(self) -> dict[str, str]:
        kind = "geometry_msgs/TwistStamped" if self._base.stamped else "geometry_msgs/Twist"
        return {**super()._advertised(), self._base.cmd_vel: self._dialect.type(kind)}

    def _hold(self, connection: Connection, measured: Measurement | None) -> None:
        connection.publish(self._velocity(REST))
        super()._hold(connection, measured)

    def _brake(self) -> None:
        connection = self._connection
        if connection is not None:
            connection.publish(self._velocity(REST))

    def _velocity(self, twist: Twist) -> Publication:
        message = messages.twist((twist.forward_m_s, twist.left_m_s), twist.turn_rad_s)
        # Without a header, rosbridge inserts the time of its own clock.
        return Publication(self._base.cmd_vel, {"twist": message} if self._base.stamped else message)
