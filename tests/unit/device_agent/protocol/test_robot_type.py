"""A robot type's manifest is read, or rejected with the field that is wrong."""

import pytest

from device_agent.protocol.errors import ProtocolError
from device_agent.protocol.manifests.capabilities import PositionDependentLimit
from device_agent.protocol.manifests.robot_type import Base, Workspace, load, parse
from tests.harness.paths import ROBOTS

UR5 = (ROBOTS / "ur5" / "robot.toml").read_text(encoding="utf-8")
NAO = (ROBOTS / "nao" / "robot.toml").read_text(encoding="utf-8")
BASE = """
[base]
max_linear_m_s = 0.5
max_angular_rad_s = 1.0
max_linear_acceleration_m_s2 = 1.0
max_angular_acceleration_rad_s2 = 2.0
braking_linear_m_s2 = 2.0
braking_angular_rad_s2 = 4.0
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
home_rad = { yaw = 0.0, pitch = 0.0, left = 0.0, right = 0.0 }
"""
JOINTS = "".join(
    f"""
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
    for name, lower, upper, velocity in (
        ("yaw", -2.0, 2.0, 3.0),
        ("pitch", -0.7, 0.5, 3.0),
        ("left", -1.0, 0.5, 3.0),
        ("right", -1.0, 0.5, 3.5),
    )
)
MIMIC = """
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
CAPABILITIES = """
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
NODDER = HEAD + JOINTS + MIMIC + NARROWING + CAPABILITIES
DIAGNOSTIC = '\n[[diagnostics]]\nfields = "x"\nlabel = "X"\n'


def require_rejection(text: str, before: str, after: str, message: str = "") -> None:
    assert before in text
    with pytest.raises(ProtocolError, match=message):
        parse(text.replace(before, after, 1))


def test_limits_are_read() -> None:
    kind = parse(UR5 + BASE)
    assert kind.margin_m == 0.02
    assert isinstance(kind.workspace, Workspace)
    assert kind.workspace.lower_m == (-1.1, -1.1, 0.0)
    assert isinstance(kind.base, Base)
    assert not kind.base.sideways


def test_capabilities_are_read() -> None:
    kind = parse(NODDER)
    assert kind.mimic_joints[0].mimics == "left"
    assert kind.postures == {"Crouch": {"left": -0.5}}
    assert kind.expressions["doubtful"]["pitch"] == -0.3
    assert [(frame.time_s, frame.say) for frame in kind.behaviours["bow"]] == [(0.5, "Good day"), (1.5, "")]
    assert kind.simulation is not None
    assert kind.simulation.wheels is not None
    assert kind.simulation.wheels.track_m == 0.2
    assert kind.simulation.battery is not None
    assert kind.simulation.battery.idle_w == 27.0
    kind = parse(HEAD + JOINTS)
    assert (kind.mimic_joints, kind.position_dependent_limits, kind.postures, kind.simulation) == ((), (), {}, None)


def test_diagnostics_are_read() -> None:
    kind = parse(f"{UR5}{DIAGNOSTIC}low = -1\nwarning_high = 2\nhigh = 3\nchecks = ['level']\n")
    last = kind.diagnostics[-1]
    assert (last.low, last.warning_low, last.warning_high, last.high) == (-1.0, None, 2.0, 3.0)
    assert (last.stream, last.checks) == ("health", ("level",))


def test_diagnostics_of_the_ur5_have_advice() -> None:
    kind = load(ROBOTS / "ur5")
    assert {each.stream for each in kind.diagnostics} == {"health", "joints"}
    assert all(each.advice for each in kind.diagnostics)


@pytest.mark.parametrize(
    ("yaw_rad", "limits_rad"),
    [(-9.0, (-0.4, 0.1)), (-2.0, (-0.4, 0.1)), (-1.0, (-0.55, 0.3)), (0.0, (-0.7, 0.5)), (3.0, (-0.4, 0.1))],
)
def test_a_narrowed_range_is_linear_between_the_rows(yaw_rad: float, limits_rad: tuple[float, float]) -> None:
    narrowing = PositionDependentLimit(
        joint="pitch", depends_on="yaw", table=((-2.0, -0.4, 0.1), (0.0, -0.7, 0.5), (2.0, -0.4, 0.1))
    )
    assert narrowing.at(yaw_rad) == pytest.approx(limits_rad)


@pytest.mark.parametrize(
    ("before", "after", "message"),
    [
        ("period_ms = 8", "period_ms = 8\nmargin_m = -0.1", "margin_m is -0.1"),
        ("period_ms = 8", "period_ms = 8\nmargin_m = nan", "margin_m is nan"),
        ("lower_m = [-1.1, -1.1, 0.0]", "lower_m = [-1.1, -1.1, 2.0]", "lower_m must be below upper_m"),
        ("lower_m = [-1.1, -1.1, 0.0]", "lower_m = [-inf, -1.1, 0.0]", "finite"),
        ("lower_m = [-1.1, -1.1, 0.0]", "lower_m = [-1.1, nan, 0.0]", "lower_m must be below upper_m"),
        ('"wrist_3", "flange"]\n\n', '"wrist_3", "hand"]\n\n', "workspace: no frame 'hand'; there are: shoulder_pan"),
        ('model = "ur5.xml"', 'model = ""', "workspace needs a model"),
        ("max_linear_m_s = 0.5", "max_linear_m_s = 0", "max_linear_m_s of base is 0"),
        ("braking_linear_m_s2 = 2.0", "braking_linear_m_s2 = inf", "braking_linear_m_s2 of base is inf"),
        ("max_angular_rad_s = 1.0", "", "max_angular_rad_s"),
    ],
)
def test_invalid_limits_are_rejected(before: str, after: str, message: str) -> None:
    require_rejection(UR5 + BASE, before, after, message)


@pytest.mark.parametrize(
    ("cameras", "message"),
    [
        ('[{ name = "eyes", rate_hz = 30.0 }]', "camera 'eyes': rate_hz is 30; the limit is 10"),
        ('[{ name = "eyes", rate_hz = 0.0 }]', "rate_hz of camera 'eyes' is 0"),
        ('[{ name = "eyes", rate_hz = 1.0 }, { name = "eyes", rate_hz = 1.0 }]', "two cameras"),
        ('[{ name = "eyes", rate_hz = 1.0, kind = "depth" }]', "camera 'eyes': kind is 'depth'"),
    ],
)
def test_invalid_cameras_are_rejected(cameras: str, message: str) -> None:
    require_rejection(UR5, "period_ms = 8", f"period_ms = 8\ncameras = {cameras}", message)


@pytest.mark.parametrize(
    "lines",
    [
        *("low = 2\nhigh = 1", "warning_high = 5\nhigh = 4", "high = nan", "high = inf", "change = 0"),
        *("horizon_s = 1", "checks = ['why']", "limit = 3", "fields = ''"),
    ],
)
def test_invalid_diagnostics_are_rejected(lines: str) -> None:
    with pytest.raises(ProtocolError):
        parse(f"{UR5}{DIAGNOSTIC}{lines}\n")


@pytest.mark.parametrize(
    ("before", "after", "message"),
    [
        ('mimics = "left"', 'mimics = "leg"', "mimic_joints: no joint 'leg'; there are: yaw, pitch, left, right"),
        ('mimics = "left"', 'mimics = "right"', "which is a mimic joint itself"),
        (MIMIC, MIMIC + MIMIC.replace('"left"', '"yaw"'), "'right' follows two joints"),
        ("multiplier = 1.0", "multiplier = 0.0", "multiplier is 0.0"),
        ("multiplier = 1.0", "multiplier = nan", "multiplier is nan"),
        ("multiplier = 1.0", "multiplier = -1.0", "cannot follow over the whole range of 'left'"),
        ("multiplier = 1.0", "multiplier = 2.0", "cannot follow over the whole range"),
        ("rad_s = 3.5", "rad_s = 2.0", "max_velocity_rad_s is too low to follow 'left'"),
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
        ("yaw = 0.5\npitch = -0.3", "yaw = 2.0\npitch = -0.5", "expression 'doubtful': 'pitch' is -0.5, outside of"),
        ("pitch = 0.1", "pitch = nan", "viseme 'o': 'pitch' is nan"),
        ("pitch = 0.4", "pitch = 0.6", "behaviour 'bow', keyframe 1: 'pitch' is 0.6"),
        ("time_s = 1.5", "time_s = 0.4", "time_s of keyframe 2 is 0.4; times must rise"),
        ("time_s = 1.5", "time_s = nan", "time_s of keyframe 2 is nan"),
        ("time_s = 1.5", "time_s = 301.0", "to 300 at most"),
        ("track_m = 0.2", "track_m = 0.0", "simulation.wheels: track_m is 0.0"),
        ("track_m = 0.2", "track_m = 0.2\nspeed = 1.0", "speed"),
        ("[simulation.wheels]", '[simulation]\nomni_wheels = ["a", "b"]\n[simulation.wheels]', "omni_wheels"),
        ("[simulation.wheels]", '[simulation]\nomni_wheels = ["a", "b", "c"]\n[simulation.wheels]', "either wheels or"),
        ("idle_w = 27.0", "idle_w = inf", "simulation.battery: idle_w is inf"),
        ("empty_v = 18.6", "empty_v = 28.6", "simulation.battery: empty_v must not be above full_v"),
    ],
)
def test_inconsistent_capabilities_are_rejected(before: str, after: str, message: str) -> None:
    require_rejection(NODDER, before, after, message)


@pytest.mark.parametrize(
    ("before", "after", "message"),
    [
        ('left = ["LHip', 'left = ["Hip', "simulation.walk: no joint 'HipYawPitch'; there are: HeadYaw"),
        ('"LHipRoll", ', '"LHipPitch", ', "simulation.walk: a joint is named twice"),
        ("step_s = ", "step_s = 0 #", "simulation.walk: step_s is 0"),
        ("support_nm = ", "support_nm = nan #", "simulation.walk: support_nm is nan"),
    ],
)
def test_invalid_walks_are_rejected(before: str, after: str, message: str) -> None:
    require_rejection(NAO, before, after, message)


def test_a_gripper_has_a_positive_speed() -> None:
    text = (ROBOTS / "ur5_gripper" / "robot.toml").read_text(encoding="utf-8")
    simulation = parse(text).simulation
    assert simulation is not None
    assert simulation.gripper is not None
    assert simulation.gripper.actuator == "gripper"
    with pytest.raises(ProtocolError, match=r"simulation\.gripper: speed_m_s is 0"):
        parse(text.replace("speed_m_s = 0.1", "speed_m_s = 0.0"))
