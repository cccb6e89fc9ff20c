"""Joint couplings, postures, expressions, behaviours and simulation data of a robot type's manifest.

All of it is data, so that it applies to real and simulated robots.
"""

import math
from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import Annotated

from msgspec import Meta, Struct

from device_agent.protocol import description
from device_agent.protocol.description import Joint
from device_agent.protocol.errors import ProtocolError
from device_agent.protocol.fields import Id, Label
from device_agent.protocol.manifests.toml import check_known, check_positive

Positions = Annotated[dict[str, float], Meta(min_length=1, max_length=128)]
"""Joint name → position [rad]."""
Leg = tuple[Label, Label, Label, Label, Label, Label]
MAX_TEXT = 500
_MAX_BEHAVIOUR_S = 300.0
_EPSILON = 1e-9
_COUPLING_TOLERANCE_RAD = 1e-6


class MimicJoint(description.MimicJoint, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Mimic joint of a manifest."""


class PositionDependentLimit(description.PositionDependentLimit, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Position-dependent limit of a manifest."""


class Keyframe(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """One keyframe of a behaviour.

    Attributes:
        time_s: Time of arrival since the start [s]; later if the joints cannot be there in time.
        position_rad: Joint name → position [rad]; other joints keep their target. Empty: no motion.
        say: Text that the robot starts to speak when it departs for this keyframe.
    """

    time_s: float
    position_rad: Annotated[dict[str, float], Meta(max_length=128)] = {}
    say: Annotated[str, Meta(max_length=MAX_TEXT)] = ""


class Wheels(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Two driven wheels.

    Attributes:
        left: Velocity servo of the left wheel in the model.
        right: Velocity servo of the right wheel in the model.
        radius_m: Wheel radius [m].
        track_m: Distance between the wheels [m].
    """

    left: Label
    right: Label
    radius_m: float
    track_m: float


class Walk(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Assisted bipedal walk, from the home position.

    Attributes:
        left: Joints of the left leg: hip yaw, hip roll, hip pitch, knee, ankle pitch, ankle roll.
        right: The same of the right leg.
        soles: Sites on the left and the right sole, below the ankle.
        step_s: Duration of one step [s].
        lift_m: Height of the swing foot [m].
        support_n: Maximum assisting force along the path [N].
        support_nm: Maximum assisting torque that keeps the torso upright [N m].
    """

    left: Leg
    right: Leg
    soles: tuple[Label, Label]
    step_s: float
    lift_m: float
    support_n: float
    support_nm: float


class Battery(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Battery of a robot.

    Attributes:
        capacity_wh: Capacity when new [Wh].
        full_v: Voltage when full [V].
        empty_v: Voltage when empty [V].
        idle_w: Power without motion [W].
    """

    capacity_wh: float
    full_v: float
    empty_v: float
    idle_w: float


class Gripper(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A gripper that operators set from 0 (open) to 1 (closed), and that is not a joint.

    Attributes:
        actuator: Force-limited position servo of the model, on a joint or a fixed tendon; its range goes from open to
            closed.
        speed_m_s: Speed of the servo's target [m/s].
    """

    actuator: Label
    speed_m_s: float


class Simulation(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Data that only a simulation needs. Limits are not among them: they apply to real robots too.

    ``omni_wheels`` names the model's velocity servos of wheels that roll in one direction and slide in the other.
    ``grips`` names joints of fingers: an object may stop them at full effort, which is not a stall.
    """

    wheels: Wheels | None = None
    omni_wheels: Annotated[tuple[Label, ...], Meta(min_length=3)] | None = None
    walk: Walk | None = None
    battery: Battery | None = None
    gripper: Gripper | None = None
    grips: tuple[Label, ...] = ()


class Capabilities(Struct, frozen=True, kw_only=True):
    """Part of a manifest besides limits; ``robot_type.RobotType`` extends it.

    Attributes:
        mimic_joints: Joints that follow other joints.
        position_dependent_limits: Joints whose range depends on another joint.
        postures: Name → joint positions [rad]; other joints keep their position.
        expressions: Name → joint positions [rad] at strength 1; a lower strength interpolates from home.
        visemes: Viseme → joint positions [rad], for speech: ``sil``, ``PP``, ``FF``, ``TH``, ``DD``, ``kk``, ``CH``,
            ``SS``, ``nn``, ``RR``, ``aa``, ``E``, ``ih``, ``oh``, ``ou``. The nearest one replaces a missing viseme.
        behaviours: Name → keyframes in ascending time.
        simulation: Data for simulation.
    """

    mimic_joints: tuple[MimicJoint, ...] = ()
    position_dependent_limits: tuple[PositionDependentLimit, ...] = ()
    postures: dict[Id, Positions] = {}
    expressions: dict[Id, Positions] = {}
    visemes: dict[Id, Positions] = {}
    behaviours: dict[Id, Annotated[tuple[Keyframe, ...], Meta(min_length=1, max_length=200)]] = {}
    simulation: Simulation | None = None


def check(capabilities: Capabilities, joints: Sequence[Joint], home_rad: Mapping[str, float]) -> None:
    """Reject contradictions within the manifest and with the joints.

    Raises:
        ProtocolError: The message names the mistake and the known joints.
    """
    known = {joint.name: joint for joint in joints}
    _check_mimic_joints(capabilities.mimic_joints, known)
    _check_position_dependent_limits(capabilities, known)
    checker = _PositionChecker(capabilities, known, home_rad)
    checker.check("home_rad", home_rad)
    for word, group in (
        ("posture", capabilities.postures),
        ("expression", capabilities.expressions),
        ("viseme", capabilities.visemes),
    ):
        for name, position_rad in group.items():
            checker.check(f"{word} '{name}'", position_rad)
    for name, keyframes in capabilities.behaviours.items():
        _check_keyframes(f"behaviour '{name}'", keyframes, checker)
    if capabilities.simulation is not None:
        _check_simulation(capabilities.simulation, known)


def _check_simulation(simulation: Simulation, known: Mapping[str, Joint]) -> None:
    for part, holder, fields in (
        ("wheels", simulation.wheels, ("radius_m", "track_m")),
        ("walk", simulation.walk, ("step_s", "lift_m", "support_n", "support_nm")),
        ("battery", simulation.battery, Battery.__struct_fields__),
        ("gripper", simulation.gripper, ("speed_m_s",)),
    ):
        for field in () if holder is None else fields:
            check_positive(f"simulation.{part}: {field}", getattr(holder, field))
    if simulation.omni_wheels is not None:
        if simulation.wheels is not None:
            raise ProtocolError("simulation: a base has either wheels or omni_wheels")
        if len(set(simulation.omni_wheels)) < len(simulation.omni_wheels):
            raise ProtocolError("simulation.omni_wheels: a wheel is named twice")
    if simulation.walk is not None:
        legs = (*simulation.walk.left, *simulation.walk.right)
        check_known("simulation.walk", "joint", legs, known)
        if len(set(legs)) < len(legs):
            raise ProtocolError("simulation.walk: a joint is named twice")
    check_known("simulation.grips", "joint", simulation.grips, known)
    if simulation.battery is not None and simulation.battery.empty_v > simulation.battery.full_v:
        raise ProtocolError("simulation.battery: empty_v must not be above full_v")


def _check_mimic_joints(mimic_joints: Sequence[MimicJoint], known: Mapping[str, Joint]) -> None:
    followers = [mimic.joint for mimic in mimic_joints]
    for mimic in mimic_joints:
        where = f"mimic_joints: '{mimic.joint}'"
        check_known("mimic_joints", "joint", (mimic.joint, mimic.mimics), known)
        if followers.count(mimic.joint) > 1:
            raise ProtocolError(f"{where} follows two joints")
        if mimic.mimics in followers:
            raise ProtocolError(
                f"{where} follows '{mimic.mimics}', which is a mimic joint itself; name the driven joint"
            )
        if mimic.multiplier == 0 or not math.isfinite(mimic.multiplier):
            raise ProtocolError(f"{where}: multiplier is {mimic.multiplier}; it must be finite and not 0")
        follower, leader = known[mimic.joint], known[mimic.mimics]
        lower, upper = sorted((leader.lower_rad * mimic.multiplier, leader.upper_rad * mimic.multiplier))
        if lower < follower.lower_rad - _EPSILON or upper > follower.upper_rad + _EPSILON:
            raise ProtocolError(f"{where} cannot follow over the whole range of '{mimic.mimics}'")
        for field in ("max_velocity_rad_s", "max_acceleration_rad_s2", "max_jerk_rad_s3"):
            if getattr(leader, field) * abs(mimic.multiplier) > getattr(follower, field) * (1 + _EPSILON):
                raise ProtocolError(f"{where}: its {field} is too low to follow '{mimic.mimics}'")


def _check_position_dependent_limits(capabilities: Capabilities, known: Mapping[str, Joint]) -> None:
    followers = {mimic.joint for mimic in capabilities.mimic_joints}
    limited = [limit.joint for limit in capabilities.position_dependent_limits]
    for limit in capabilities.position_dependent_limits:
        where = f"position_dependent_limits of '{limit.joint}'"
        check_known("position_dependent_limits", "joint", (limit.joint, limit.depends_on), known)
        if limited.count(limit.joint) > 1:
            raise ProtocolError(f"{where} is listed twice")
        if limit.depends_on in limited:
            raise ProtocolError(f"{where}: '{limit.depends_on}' has a position-dependent limit itself")
        if followers & {limit.joint, limit.depends_on}:
            raise ProtocolError(f"{where}: a mimic joint cannot have or determine a limit; name the driven joint")
        if not all(math.isfinite(value) for row in limit.table for value in row):
            raise ProtocolError(f"{where}: all numbers of the table must be finite")
        positions = [row[0] for row in limit.table]
        if any(later <= earlier for earlier, later in pairwise(positions)):
            raise ProtocolError(f"{where}: positions of '{limit.depends_on}' must rise from row to row")
        leader, joint = known[limit.depends_on], known[limit.joint]
        if positions[0] > leader.lower_rad or positions[-1] < leader.upper_rad:
            raise ProtocolError(
                f"{where}: the table must cover {leader.lower_rad} to {leader.upper_rad}, "
                f"the range of '{limit.depends_on}'"
            )
        for position, lower, upper in limit.table:
            if not joint.lower_rad <= lower < upper <= joint.upper_rad:
                raise ProtocolError(
                    f"{where}: at {position} the range must rise and lie in {joint.lower_rad} to {joint.upper_rad}"
                )


def _check_keyframes(where: str, keyframes: Sequence[Keyframe], checker: "_PositionChecker") -> None:
    reached_s = 0.0
    for number, keyframe in enumerate(keyframes, 1):
        if not reached_s <= keyframe.time_s <= _MAX_BEHAVIOUR_S:  # false for NaN
            raise ProtocolError(
                f"{where}: time_s of keyframe {number} is {keyframe.time_s}; times must rise from 0, "
                f"to {_MAX_BEHAVIOUR_S:.0f} at most"
            )
        reached_s = keyframe.time_s
        checker.check(f"{where}, keyframe {number}", keyframe.position_rad)


class _PositionChecker:
    """Checks joint positions against ranges and couplings; unnamed joints count as at home."""

    def __init__(self, capabilities: Capabilities, known: Mapping[str, Joint], home_rad: Mapping[str, float]) -> None:
        self._mimic_joints = capabilities.mimic_joints
        self._limits = capabilities.position_dependent_limits
        self._known = known
        self._home_rad = home_rad

    def check(self, where: str, position_rad: Mapping[str, float]) -> None:
        check_known(where, "joint", tuple(position_rad), self._known)
        for name, value in position_rad.items():
            joint = self._known[name]
            if not joint.lower_rad <= value <= joint.upper_rad:  # false for NaN
                raise ProtocolError(
                    f"{where}: '{name}' is {value}, outside of its range {joint.lower_rad} to {joint.upper_rad}"
                )
        for mimic in self._mimic_joints:
            follower = position_rad.get(mimic.joint)
            leader = position_rad.get(mimic.mimics)
            if (
                follower is not None
                and leader is not None
                and abs(follower - leader * mimic.multiplier) > _COUPLING_TOLERANCE_RAD
            ):
                raise ProtocolError(f"{where}: '{mimic.joint}' must be {mimic.multiplier} times '{mimic.mimics}'")
        for limit in self._limits:
            if limit.joint in position_rad:
                lower, upper = limit.at(position_rad.get(limit.depends_on, self._home_rad[limit.depends_on]))
                value = position_rad[limit.joint]
                if not lower - _EPSILON <= value <= upper + _EPSILON:
                    raise ProtocolError(
                        f"{where}: '{limit.joint}' is {value}, outside of its range {lower:.4f} to {upper:.4f} "
                        f"at the position of '{limit.depends_on}'"
                    )
