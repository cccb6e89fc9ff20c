"""The parts of a robot type's manifest that say how joints hang together and what the robot can show.

All of it is data, so that a real robot has it as well as a simulated one.
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
LONGEST_TEXT = 500
_LONGEST_BEHAVIOUR_S = 300.0
_SAME = 1e-9
_TIED_RAD = 1e-6


class MimicJoint(description.MimicJoint, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """As a manifest has it."""


class PositionDependentLimit(description.PositionDependentLimit, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """As a manifest has it."""


class Keyframe(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """One moment of a behaviour.

    Attributes:
        time_s: When the joints are to be there, counted from its beginning; as soon as they can be when that is later.
        position_rad: Joint name → position [rad]; joints not named keep their target. Empty: nothing moves.
        say: What the robot begins to say when it sets out for this keyframe.
    """

    time_s: float
    position_rad: Annotated[dict[str, float], Meta(max_length=128)] = {}
    say: Annotated[str, Meta(max_length=LONGEST_TEXT)] = ""


class Wheels(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Two driven wheels.

    Attributes:
        left: Actuator of the left wheel in the model, a velocity servo; ``right``: of the other.
        radius_m: Of each wheel; ``track_m``: from one to the other [m].
    """

    left: Label
    right: Label
    radius_m: float
    track_m: float


class Walk(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """An assisted walk on two legs, from home.

    Attributes:
        left: Joints of the left leg: hip yaw, hip roll, hip pitch, knee, ankle pitch, ankle roll; ``right``: the same.
        soles: Sites under the left and the right ankle, on the sole.
        step_s: Time of one step of one foot [s].
        lift_m: How high a foot goes [m].
        support_n: The most that draws the torso along its course [N].
        support_nm: The most that holds it upright [N m].
    """

    left: Leg
    right: Leg
    soles: tuple[Label, Label]
    step_s: float
    lift_m: float
    support_n: float
    support_nm: float


class Battery(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What a robot without a cable lives on.

    Attributes:
        capacity_wh: When it is new [Wh].
        full_v: Voltage when it is full; ``empty_v``: when it is empty [V].
        idle_w: What the robot takes while nothing moves [W].
    """

    capacity_wh: float
    full_v: float
    empty_v: float
    idle_w: float


class Simulation(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What only a simulation needs to know. No limit stands here: those hold for real metal too."""

    wheels: Wheels | None = None
    walk: Walk | None = None
    battery: Battery | None = None


class Abilities(Struct, frozen=True, kw_only=True):
    """What a manifest says besides limits: see ``robot_type.RobotType``, which is one.

    Attributes:
        mirrors: Joints that one motor moves together.
        narrowing: Joints whose range depends on another's position.
        postures: Name → joint positions [rad]; joints not named stay.
        expressions: Name → joint positions [rad] at strength 1; less is so much of the way from home.
        visemes: Name → joint positions of a mouth shape [rad], for speech, by the names of ``runtime/mouth.py``:
            ``sil``, ``PP``, ``FF``, ``TH``, ``DD``, ``kk``, ``CH``, ``SS``, ``nn``, ``RR``, ``aa``, ``E``, ``ih``,
            ``oh``, ``ou``. For one that is missing the nearest serves.
        behaviours: Name → keyframes, in the order of their times.
        simulation: What only a simulation needs to know.
    """

    mimic_joints: tuple[MimicJoint, ...] = ()
    position_dependent_limits: tuple[PositionDependentLimit, ...] = ()
    postures: dict[Id, Positions] = {}
    expressions: dict[Id, Positions] = {}
    visemes: dict[Id, Positions] = {}
    behaviours: dict[Id, Annotated[tuple[Keyframe, ...], Meta(min_length=1, max_length=200)]] = {}
    simulation: Simulation | None = None


def check(abilities: Abilities, joints: Sequence[Joint], home_rad: Mapping[str, float]) -> None:
    """Refuse what contradicts itself, or the joints.

    Raises:
        ProtocolError: The text names what is wrong, and the joints there are.
    """
    known = {joint.name: joint for joint in joints}
    _check_mirrors(abilities.mimic_joints, known)
    _check_narrowing(abilities, known)
    allowed = _Allowed(abilities, known, home_rad)
    allowed.check("home_rad", home_rad)
    for word, group in (
        ("posture", abilities.postures),
        ("expression", abilities.expressions),
        ("viseme", abilities.visemes),
    ):
        for name, position_rad in group.items():
            allowed.check(f"{word} '{name}'", position_rad)
    for name, keyframes in abilities.behaviours.items():
        _check_keyframes(f"behaviour '{name}'", keyframes, allowed)
    if abilities.simulation is not None:
        _check_simulation(abilities.simulation, known)


def _check_simulation(simulation: Simulation, known: Mapping[str, Joint]) -> None:
    for part, holder, fields in (
        ("wheels", simulation.wheels, ("radius_m", "track_m")),
        ("walk", simulation.walk, ("step_s", "lift_m", "support_n", "support_nm")),
        ("battery", simulation.battery, Battery.__struct_fields__),
    ):
        for field in () if holder is None else fields:
            check_positive(f"simulation.{part}: {field}", getattr(holder, field))
    if simulation.walk is not None:
        legs = (*simulation.walk.left, *simulation.walk.right)
        check_known("simulation.walk", "joint", legs, known)
        if len(set(legs)) < len(legs):
            raise ProtocolError("simulation.walk: no joint can be named twice")
    if simulation.battery is not None and simulation.battery.empty_v > simulation.battery.full_v:
        raise ProtocolError("simulation.battery: empty_v must not be above full_v")


def _check_mirrors(mirrors: Sequence[MimicJoint], known: Mapping[str, Joint]) -> None:
    followers = [mirror.joint for mirror in mirrors]
    for mirror in mirrors:
        where = f"mimic_joints: '{mirror.joint}'"
        check_known("mimic_joints", "joint", (mirror.joint, mirror.mimics), known)
        if followers.count(mirror.joint) > 1:
            raise ProtocolError(f"{where} mirrors two joints")
        if mirror.mimics in followers:
            raise ProtocolError(
                f"{where} mirrors '{mirror.mimics}', which is a mirror itself; name the joint that counts"
            )
        if mirror.multiplier == 0 or not math.isfinite(mirror.multiplier):
            raise ProtocolError(f"{where}: multiplier is {mirror.multiplier}; it must be finite and not 0")
        follower, leader = known[mirror.joint], known[mirror.mimics]
        lower, upper = sorted((leader.lower_rad * mirror.multiplier, leader.upper_rad * mirror.multiplier))
        if lower < follower.lower_rad - _SAME or upper > follower.upper_rad + _SAME:
            raise ProtocolError(f"{where} cannot follow over all of the range of '{mirror.mimics}'")
        for field in ("max_velocity_rad_s", "max_acceleration_rad_s2", "max_jerk_rad_s3"):
            if getattr(leader, field) * abs(mirror.multiplier) > getattr(follower, field) * (1 + _SAME):
                raise ProtocolError(f"{where}: its {field} is too low to follow '{mirror.mimics}'")


def _check_narrowing(abilities: Abilities, known: Mapping[str, Joint]) -> None:
    followers = {mirror.joint for mirror in abilities.mimic_joints}
    narrowed = [narrowing.joint for narrowing in abilities.position_dependent_limits]
    for narrowing in abilities.position_dependent_limits:
        where = f"position_dependent_limits of '{narrowing.joint}'"
        check_known("position_dependent_limits", "joint", (narrowing.joint, narrowing.depends_on), known)
        if narrowed.count(narrowing.joint) > 1:
            raise ProtocolError(f"{where} stands there twice")
        if narrowing.depends_on in narrowed:
            raise ProtocolError(f"{where}: '{narrowing.depends_on}' is narrowed itself")
        if followers & {narrowing.joint, narrowing.depends_on}:
            raise ProtocolError(f"{where}: a mirror cannot stand there; name the joint that counts")
        if not all(math.isfinite(value) for row in narrowing.table for value in row):
            raise ProtocolError(f"{where}: all numbers of its table must be finite")
        places = [row[0] for row in narrowing.table]
        if any(later <= earlier for earlier, later in pairwise(places)):
            raise ProtocolError(f"{where}: positions of '{narrowing.depends_on}' must rise from row to row")
        by, joint = known[narrowing.depends_on], known[narrowing.joint]
        if places[0] > by.lower_rad or places[-1] < by.upper_rad:
            raise ProtocolError(
                f"{where}: its table must reach from {by.lower_rad} to {by.upper_rad}, the range of '{narrowing.depends_on}'"
            )
        for place, lower, upper in narrowing.table:
            if not joint.lower_rad <= lower < upper <= joint.upper_rad:
                raise ProtocolError(
                    f"{where}: at {place} the range must rise and lie in {joint.lower_rad} to {joint.upper_rad}"
                )


def _check_keyframes(where: str, keyframes: Sequence[Keyframe], allowed: "_Allowed") -> None:
    reached_s = 0.0
    for number, keyframe in enumerate(keyframes, 1):
        if not reached_s <= keyframe.time_s <= _LONGEST_BEHAVIOUR_S:  # false for NaN
            raise ProtocolError(
                f"{where}: time_s of keyframe {number} is {keyframe.time_s}; times must rise from 0, "
                f"to {_LONGEST_BEHAVIOUR_S:.0f} at most"
            )
        reached_s = keyframe.time_s
        allowed.check(f"{where}, keyframe {number}", keyframe.position_rad)


class _Allowed:
    """Where joints may be, by name; where a place does not say, they are taken to be at home."""

    def __init__(self, abilities: Abilities, known: Mapping[str, Joint], home_rad: Mapping[str, float]) -> None:
        self._mirrors = abilities.mimic_joints
        self._narrowing = abilities.position_dependent_limits
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
        for mirror in self._mirrors:
            given = position_rad.get(mirror.joint)
            leads = position_rad.get(mirror.mimics)
            if given is not None and leads is not None and abs(given - leads * mirror.multiplier) > _TIED_RAD:
                raise ProtocolError(f"{where}: '{mirror.joint}' must be {mirror.multiplier} times '{mirror.mimics}'")
        for narrowing in self._narrowing:
            if narrowing.joint in position_rad:
                lower, upper = narrowing.at(
                    position_rad.get(narrowing.depends_on, self._home_rad[narrowing.depends_on])
                )
                value = position_rad[narrowing.joint]
                if not lower - _SAME <= value <= upper + _SAME:
                    raise ProtocolError(
                        f"{where}: '{narrowing.joint}' is {value}, but goes from {lower:.4f} to {upper:.4f} "
                        f"where '{narrowing.depends_on}' is"
                    )
