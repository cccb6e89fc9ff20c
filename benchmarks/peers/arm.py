"""The common robot: the product's driver of its simulated UR5, used without any checks."""

from typing import Final

from device_agent.drivers import mujoco
from device_agent.ports.clock import tick_ms, wall_ms
from device_agent.protocol import JointTarget, JointTelemetry, Mode, Setpoint, codec
from device_agent.protocol.manifests import robot_type
from tests.harness.paths import ROOT

FOLDER: Final = ROOT / "robots" / "ur5"
KIND: Final = robot_type.load(FOLDER)
NAMES: Final = tuple(joint.name for joint in KIND.joints)
HOME_RAD: Final = tuple(KIND.home_rad[name] for name in NAMES)


class PeerArm:
    """Applies each setpoint and reports it immediately, without lease, limits, watchdog or Stop."""

    def __init__(self) -> None:
        self._driver = mujoco.create(KIND, FOLDER, {}, "ur5")
        self._driver.connect()

    def apply(self, setpoint: Setpoint) -> JointTelemetry:
        """Applies a setpoint.

        Raises:
            TypeError: The target is not a joint target.
        """
        if not isinstance(setpoint.target, JointTarget):
            raise TypeError("this arm takes joint targets")
        target_rad = setpoint.target.position_rad
        observation = self._driver.observe()
        applied = self._driver.send([target_rad[name] for name in NAMES])
        return JointTelemetry(
            tick_ms=tick_ms(),
            at_ms=wall_ms(),
            sequence=setpoint.sequence,
            mode=Mode.IDLE,
            position_rad=_rounded(observation.position_rad),
            velocity_rad_s=_rounded(observation.velocity_rad_s),
            effort_nm=_rounded(observation.effort_nm),
            commanded_rad=_rounded(applied),
            frames=observation.frames,
            epoch=setpoint.epoch,
            setpoint_sequence=setpoint.sequence,
            setpoint_sent_ms=setpoint.sent_ms,
        )

    def apply_encoded(self, payload: bytes) -> bytes:
        """Applies an encoded setpoint of the Telescope protocol and returns encoded telemetry."""
        return codec.encode(self.apply(codec.decode(payload, Setpoint)))


def _rounded(values: tuple[float, ...]) -> tuple[float, ...]:
    """Rounds to the digits that the agent publishes; longer text would cost more."""
    return tuple(round(value, 6) for value in values)


def setpoint(sequence: int, sent_ms: float) -> Setpoint:
    """Returns a setpoint that holds the home position."""
    return Setpoint(
        epoch=1,
        sequence=sequence,
        echo_tick_ms=tick_ms(),
        sent_ms=sent_ms,
        target=JointTarget(position_rad=dict(zip(NAMES, HOME_RAD, strict=True))),
    )
