"""The device at the other end of a driver, as the contract suite sees and disturbs it."""

from enum import Enum
from typing import Protocol

from device_agent.ports.driver import Twist


class Disturbance(Enum):
    """What can happen to a device and its connection."""

    CONNECTION = "connection"
    """The connection ends, and new ones are refused."""
    SILENCE = "silence"
    """The connection stays open without any message."""
    GARBAGE = "garbage"
    """All messages are random bytes."""
    TRUNCATED = "truncated"
    """All messages end in the middle."""
    NAN = "nan"
    """All messages contain values that are not finite."""
    CLOCK = "clock"
    """All messages repeat an old timestamp, as those of a controller that hangs."""
    ORDER = "order"
    """Messages list the joints in another order."""
    SAFETY = "safety"
    """The device stops itself, for example in a protective stop."""


class Peer(Protocol):
    """The device, on the side of the hardware: an emulator of the protocol, or the simulation itself.

    Values are the true ones in SI units, in the order of the robot type's ``joints``.
    """

    def joint_positions(self) -> tuple[float, ...]:
        """True positions, shape (n,) [rad]."""

    def joint_velocities(self) -> tuple[float, ...]:
        """True velocities, shape (n,) [rad/s]."""

    def base_twist(self) -> Twist:
        """True velocity of the base; ``REST`` for a device without one."""

    def disturb(self, disturbance: Disturbance) -> None:
        """Start a disturbance. It lasts until ``restore``. Those that a test class lists as ``absent`` never occur."""

    def restore(self) -> None:
        """End every disturbance. The device accepts connections again, and stays where it is."""
