"""What a manifest says beside limits: read as it stands, refused with what is wrong where it contradicts itself."""

import pytest

from device_agent.protocol.errors import ProtocolError
from device_agent.protocol.manifests.capabilities import PositionDependentLimit
from device_agent.protocol.manifests.robot_type import RobotType, parse
from tests.harness.paths import ROOT

JOINT = """
[[joints]]
name = "{name}"
label = "{name}"
lower_rad = {lower}
upper_rad = {upper}
max_velocity_rad_s = {velocity}
max_acceleration_rad_s2 = 8.0
max_jerk_rad_s3 = 80.0
max_effort_nm = 5.0
"""
HEAD = """
type = "nodder"
version = 1
label = "Nodder"
kind = "robot"
description = "A head on two legs."
model = "nodder.xml"
scene = "scene.xml"
driver = "mujoco"
period_ms = 20
braking_rad_s2 = 20.0
frames = []

[home_rad]
yaw = 0.0
pitch = 0.0
left = 0.0
right = 0.0
"""
JOINTS = "".join(
    JOINT.format(name=name, lower=lower, upper=upper, velocity=3.0)
    for name, lower, upper in (("yaw", -2.0, 2.0), ("pitch", -0.7, 0.5), ("left", -1.0, 0.5), ("right", -1.0, 0.5))
)
MIRRORS = """
[[mimic_joints]]
joint = "right"
mimics = "left"
multiplier = 1.0
"""
NARROWING = """
[[position_dependent_limits]]
joint = "pitch"
depends_on = "yaw"
table = [[-2.0, -0.4, 0.1], [0.0, -0.7, 0.5], [2.0, -0.4, 0.1]]
"""
SHOWN = """
[postures.Crouch]
left = -0.5

[expressions.doubtful]
yaw = 0.5
pitch = -0.3

[visemes.o]
pitch = 0.1

[[behaviours.bow]]
time_s = 0.5
position_rad = { pitch = 0.4 }
say = "Good day"

[[behaviours.bow]]
time_s = 1.5
position_rad = { pitch = 0.0 }

[simulation.wheels]
left = "left_wheel"
right = "right_wheel"
radius_m = 0.09
track_m = 0.2

[simulation.battery]
capacity_wh = 48.6
full_v = 24.9
empty_v = 18.6
idle_w = 27.0
"""
ALL = HEAD + JOINTS + MIRRORS + NARROWING + SHOWN


def read(text: str = ALL) -> RobotType:
    return parse(text)


def test_abilities_are_read() -> None:
    kind = read()
    assert kind.mimic_joints[0].mimics == "left"
    assert kind.postures == {"Crouch": {"left": -0.5}}
    assert kind.expressions["doubtful"]["pitch"] == -0.3
    assert [(frame.time_s, frame.say) for frame in kind.behaviours["bow"]] == [(0.5, "Good day"), (1.5, "")]
    assert kind.simulation is not None
    assert kind.simulation.wheels is not None
    assert kind.simulation.wheels.track_m == 0.2
    assert kind.simulation.battery is not None
    assert kind.simulation.battery.idle_w == 27.0


def test_a_manifest_without_them_has_none() -> None:
    kind = read(HEAD + JOINTS)
    assert (kind.mimic_joints, kind.position_dependent_limits, kind.postures, kind.simulation) == ((), (), {}, None)


@pytest.mark.parametrize(
    ("by_rad", "there"),
    [(-9.0, (-0.4, 0.1)), (-2.0, (-0.4, 0.1)), (-1.0, (-0.55, 0.3)), (0.0, (-0.7, 0.5)), (3.0, (-0.4, 0.1))],
)
def test_a_narrowed_range_is_linear_between_the_rows(by_rad: float, there: tuple[float, float]) -> None:
    narrowing = PositionDependentLimit(
        joint="pitch", depends_on="yaw", table=((-2.0, -0.4, 0.1), (0.0, -0.7, 0.5), (2.0, -0.4, 0.1))
    )
    assert narrowing.at(by_rad) == pytest.approx(there)


@pytest.mark.parametrize(
    ("was", "now", "says"),
    [
        ('mimics = "left"', 'mimics = "leg"', "mimic_joints: no joint 'leg'; there are: yaw, pitch, left, right"),
        ('mimics = "left"', 'mimics = "right"', "which is a mimic joint itself"),
        (MIRRORS, MIRRORS + MIRRORS.replace('"left"', '"yaw"'), "'right' follows two joints"),
        ("multiplier = 1.0", "multiplier = 0.0", "multiplier is 0.0"),
        ("multiplier = 1.0", "multiplier = nan", "multiplier is nan"),
        ("multiplier = 1.0", "multiplier = -1.0", "cannot follow over the whole range of 'left'"),
        ("multiplier = 1.0", "multiplier = 2.0", "cannot follow over the whole range"),
        ('depends_on = "yaw"', 'depends_on = "head"', "position_dependent_limits: no joint 'head'"),
        ('depends_on = "yaw"', 'depends_on = "right"', "a mimic joint cannot have"),
        ('joint = "pitch"\ndepends_on', 'joint = "right"\ndepends_on', "a mimic joint cannot have"),
        (NARROWING, NARROWING + NARROWING, "is listed twice"),
        (NARROWING, NARROWING + NARROWING.replace('"yaw"', '"pitch"').replace('t = "pitch"', 't = "left"'), "itself"),
        ("[0.0, -0.7, 0.5]", "[-2.0, -0.7, 0.5]", "must rise from row to row"),
        ("[0.0, -0.7, 0.5]", "[0.0, -0.7, nan]", "must be finite"),
        ("[0.0, -0.7, 0.5]", "[0.0, -0.8, 0.5]", "at 0.0 the range must rise and lie in -0.7 to 0.5"),
        ("[0.0, -0.7, 0.5]", "[0.0, 0.5, 0.5]", "at 0.0 the range must rise"),
        ("[2.0, -0.4, 0.1]", "[1.0, -0.4, 0.1]", "must cover -2.0 to 2.0"),
        ("[0.0, -0.7, 0.5]", "[0.0, 0.1, 0.5]", "home_rad: 'pitch' is 0.0, outside of its range 0.1000 to 0.5000"),
        ("left = -0.5", "left = -1.5", "posture 'Crouch': 'left' is -1.5, outside of its range"),
        ("left = -0.5", "left = -0.5\nright = -0.4", "'right' must be 1.0 times 'left'"),
        ("left = -0.5", "leg = -0.5", "posture 'Crouch': no joint 'leg'"),
        ("yaw = 0.5", "yaw = 2.0\npitch = -0.5 #", "expression 'doubtful': 'pitch' is -0.5, outside of its range -0.4"),
        ("pitch = 0.1", "pitch = nan", "viseme 'o': 'pitch' is nan"),
        ("pitch = 0.4", "pitch = 0.6", "behaviour 'bow', keyframe 1: 'pitch' is 0.6"),
        ("time_s = 1.5", "time_s = 0.4", "time_s of keyframe 2 is 0.4; times must rise"),
        ("time_s = 1.5", "time_s = nan", "time_s of keyframe 2 is nan"),
        ("time_s = 1.5", "time_s = 301.0", "to 300 at most"),
        ("track_m = 0.2", "track_m = 0.0", "simulation.wheels: track_m is 0.0"),
        ("track_m = 0.2", "track_m = 0.2\nspeed = 1.0", "speed"),
        ("idle_w = 27.0", "idle_w = inf", "simulation.battery: idle_w is inf"),
        ("empty_v = 18.6", "empty_v = 28.6", "simulation.battery: empty_v must not be above full_v"),
    ],
)
def test_what_contradicts_itself_is_refused(was: str, now: str, says: str) -> None:
    text = ALL
    assert was in text
    text = text.replace(was, now, 1)
    if now.startswith("yaw = 2.0"):
        text = text.replace("pitch = -0.3", "", 1)
    with pytest.raises(ProtocolError, match=says):
        read(text)


def test_a_mirror_that_is_too_slow_is_refused() -> None:
    slow = JOINTS.rpartition("max_velocity_rad_s = 3.0")
    with pytest.raises(ProtocolError, match="max_velocity_rad_s is too low to follow 'left'"):
        read(HEAD + slow[0] + "max_velocity_rad_s = 2.0" + slow[2] + MIRRORS)


@pytest.mark.parametrize(
    ("was", "now", "says"),
    [
        ('left = ["LHip', 'left = ["Hip', "simulation.walk: no joint 'HipYawPitch'; there are: HeadYaw"),
        ('"LHipRoll", ', '"LHipPitch", ', "simulation.walk: a joint is named twice"),
        ("step_s = ", "step_s = 0 #", "simulation.walk: step_s is 0"),
        ("support_nm = ", "support_nm = nan #", "simulation.walk: support_nm is nan"),
    ],
)
def test_a_walk_on_legs_that_are_not_there_is_refused(was: str, now: str, says: str) -> None:
    text = (ROOT / "robots" / "nao" / "robot.toml").read_text(encoding="utf-8")
    assert was in text
    with pytest.raises(ProtocolError, match=says):
        read(text.replace(was, now, 1))
