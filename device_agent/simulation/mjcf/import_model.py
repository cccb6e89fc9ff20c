"""Creates a robot type folder from a MuJoCo model, for example one of MuJoCo Menagerie.

Missing figures are replaced by conservative guesses, which the manifest marks.
"""

import math
import shutil
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from device_agent.protocol.topics import is_id
from device_agent.simulation.mjcf.equality_joints import SCALAR_JOINTS, EqualityJoints
from device_agent.simulation.scene_assembly import is_servo

GUESSED = "  # guessed"
_SPEED_RAD_S, _SPEED_M_S = 0.5, 0.05
"""Slow enough to be stopped by hand."""
_RANGE_RAD = math.pi
_ACCELERATION, _JERK, _BRAKING = 2.0, 20.0, 4.0
_LEAST_EFFORT = 1.0
_SAMPLES = 200
_ROOM_M = 0.05
_DIGITS = 1e4
_FRAMES = 8
_POSITION_KEY = "home"


class ImportModelError(Exception):
    """The model cannot become a robot type. The message states the cause and the remedy."""


@dataclass(frozen=True, slots=True)
class _Servo:
    """A joint and its motor. ``guessed`` names the fields that the model does not define."""

    name: str
    slides: bool
    lower: float
    upper: float
    effort: float
    guessed: frozenset[str]


def import_model(source: Path, name: str, into: Path, *, without: Sequence[str] = ()) -> Path:
    """Create ``into/name``: manifest, model, scene, a movement, README.

    Args:
        source: MJCF file of the robot, alone or in a scene; only the robot is imported.
        name: Id of the new type.
        into: Folder of robot types.
        without: Actuators to leave out.

    Returns:
        The new folder.

    Raises:
        ImportModelError: The folder exists, the model cannot be read, or an actuator is not a position servo.
    """
    if not is_id(name):
        raise ImportModelError(f"'{name}' is not a valid robot type: use 1 to 64 letters, digits, _ and -")
    folder = into / name
    if folder.exists():
        raise ImportModelError(f"{folder} exists already; choose another name, or delete it")
    spec = _read(source)
    home = _home(spec, _compile(spec, source))
    _leave_out(spec, without)
    model = _compile(spec, source)
    _check_servos(model)
    _keep_robot_only(spec, model.body(_root(model)).name)
    _name_actuators(spec, model)
    robot_model = _compile(spec, source)
    servos = [_servo(robot_model, actuator) for actuator in range(robot_model.nu)]
    for actuator, servo in zip(spec.actuators, servos, strict=True):
        actuator.forcelimited, actuator.forcerange = True, (-servo.effort, servo.effort)
        actuator.ctrllimited, actuator.ctrlrange = True, (servo.lower, servo.upper)
    for joint in spec.joints:
        match = next((servo for servo in servos if servo.name == joint.name), None)
        if match is not None and "range" in match.guessed:
            joint.limited, joint.range = True, (match.lower, match.upper)
    home = {servo.name: min(max(home.get(servo.name, 0.0), servo.lower), servo.upper) for servo in servos}
    folder.mkdir(parents=True)
    try:
        _write_model(spec, source, folder)
        _write_texts(folder, source, robot_model, servos, home)
    except (OSError, ValueError, ImportModelError) as error:
        shutil.rmtree(folder)
        raise ImportModelError(str(error)) from error
    return folder


# ------------------------------------------------------------ read the model


def _read(source: Path) -> Any:
    try:
        return mujoco.MjSpec.from_file(str(source))
    except (ValueError, OSError, mujoco.FatalError) as error:
        raise ImportModelError(f"{source}: MuJoCo cannot read this model: {error}") from error


def _compile(spec: Any, source: Path) -> Any:
    try:
        return spec.compile()
    except (ValueError, OSError, mujoco.FatalError) as error:
        raise ImportModelError(f"{source}: MuJoCo cannot build this model: {error}") from error


def _leave_out(spec: Any, without: Sequence[str]) -> None:
    known = {actuator.name: actuator for actuator in spec.actuators}
    for name in without:
        if name not in known:
            raise ImportModelError(f"no actuator '{name}' to leave out; available: {', '.join(known)}")
        spec.delete(known[name])


def _check_servos(model: Any) -> None:
    """Check that every actuator is a position servo of one joint."""
    if not model.nu:
        raise ImportModelError("the model has no actuators")
    invalid = {
        model.actuator(index).name or f"actuator {index}": reason
        for index in range(model.nu)
        if (reason := _unsupported(model, index))
    }
    if invalid:
        details = "; ".join(f"{name} {reason}" for name, reason in invalid.items())
        options = " ".join(f"--without {name}" for name in invalid)
        raise ImportModelError(
            f"only position servos of joints are supported: {details}. Change the model, or use {options}"
        )
    joints = model.actuator_trnid[:, 0].tolist()
    if len(set(joints)) != len(joints):
        raise ImportModelError("two actuators move the same joint; leave one out with --without")
    if any(not model.joint(joint).name for joint in joints):
        raise ImportModelError("a joint with an actuator has no name; name it in the model")


def _unsupported(model: Any, index: int) -> str:
    if model.actuator_trntype[index] != int(mujoco.mjtTrn.mjTRN_JOINT):
        return "does not act on a joint"
    if model.jnt_type[model.actuator_trnid[index, 0]] not in SCALAR_JOINTS:
        return "acts on a joint that is neither a hinge nor a slide"
    if model.actuator_gear[index, 0] != 1:
        return f"has a gear of {model.actuator_gear[index, 0]:g}"
    servo = is_servo(model, index, order=0) and not model.actuator_dyntype[index]
    return "" if servo else "is not a position servo"


def _root(model: Any) -> int:
    """The top-level body of all driven joints."""
    roots = {int(model.body_rootid[model.jnt_bodyid[joint]]) for joint in model.actuator_trnid[:, 0]}
    if len(roots) != 1:
        names = ", ".join(sorted(model.body(root).name for root in roots))
        raise ImportModelError(f"the motors belong to several robots ({names}); use one file per robot")
    return roots.pop()


def _keep_robot_only(spec: Any, root: str) -> None:
    """Remove the scene around the robot."""
    world = spec.worldbody
    for element in [*world.geoms, *world.lights, *world.cameras, *world.sites]:
        spec.delete(element)
    for body in [body for body in world.bodies if body.name != root]:
        spec.delete(body)
    for body in world.bodies:
        for light in [light for each in (body, *_below(body)) for light in each.lights]:
            spec.delete(light)


def _below(body: Any) -> Iterator[Any]:
    for child in body.bodies:
        yield child
        yield from _below(child)


def _home(spec: Any, model: Any) -> dict[str, float]:
    """Joint positions of the keyframe ``home``, or the first one; else the model's reference."""
    match = model.qpos0
    if model.nkey:
        names = [model.key(index).name for index in range(model.nkey)]
        match = model.key_qpos[names.index(_POSITION_KEY) if _POSITION_KEY in names else 0]
    for key in list(spec.keys):  # they reference removed joints
        spec.delete(key)
    return {model.joint(joint).name: float(match[model.jnt_qposadr[joint]]) for joint in range(model.njnt)}


def _name_actuators(spec: Any, model: Any) -> None:
    """Name each actuator like its joint, as the driver expects."""
    names = [model.joint(joint).name for joint in model.actuator_trnid[:, 0]]
    for index, actuator in enumerate(spec.actuators):
        actuator.name = f"adopted {index}"
    for actuator, name in zip(spec.actuators, names, strict=True):
        actuator.name = name


def _servo(model: Any, actuator: int) -> _Servo:
    joint = int(model.actuator_trnid[actuator, 0])
    guessed: set[str] = set()
    lower, upper = -_RANGE_RAD, _RANGE_RAD
    if model.jnt_limited[joint]:
        lower, upper = model.jnt_range[joint].tolist()
    else:
        guessed.add("range")
    if model.actuator_ctrllimited[actuator]:
        least, largest = model.actuator_ctrlrange[actuator].tolist()
        lower, upper = max(lower, least), min(upper, largest)
    # The written model has six digits; round inwards so that the manifest's range is within it.
    lower, upper = math.ceil(lower * _DIGITS) / _DIGITS, math.floor(upper * _DIGITS) / _DIGITS
    if lower >= upper:
        name = model.joint(joint).name
        raise ImportModelError(f"joint '{name}' and its actuator have disjoint ranges; correct them")
    efforts = [
        float(np.abs(ranges).min())
        for limited, ranges in (
            (model.actuator_forcelimited[actuator], model.actuator_forcerange[actuator]),
            (model.jnt_actfrclimited[joint], model.jnt_actfrcrange[joint]),
        )
        if limited and np.abs(ranges).min() > 0
    ]
    if not efforts:
        guessed.add("effort")
        efforts = [max(_LEAST_EFFORT, 2 * _gravity_load(model, joint))]
    slides = int(model.jnt_type[joint]) == int(mujoco.mjtJoint.mjJNT_SLIDE)
    return _Servo(
        model.joint(joint).name, slides, float(lower), float(upper), round(min(efforts), 3), frozenset(guessed)
    )


def _gravity_load(model: Any, joint: int) -> float:
    """Largest gravity load of a joint in random positions [N m or N]."""
    data, random = mujoco.MjData(model), np.random.default_rng(0)
    equality_joints, largest = EqualityJoints(model), 0.0
    dof = int(model.jnt_dofadr[joint])
    scalar = model.jnt_type >= int(mujoco.mjtJoint.mjJNT_SLIDE)
    addresses = model.jnt_qposadr[scalar]
    limited = model.jnt_limited[scalar].astype(bool)[:, np.newaxis]
    ranges = np.where(limited, model.jnt_range[scalar], (-_RANGE_RAD, _RANGE_RAD))
    for _ in range(_SAMPLES):
        data.qpos[addresses] = random.uniform(ranges[:, 0], ranges[:, 1])
        equality_joints.apply(data.qpos)
        mujoco.mj_forward(model, data)
        largest = max(largest, abs(float(data.qfrc_bias[dof] - data.qfrc_gravcomp[dof])))
    return largest


# ------------------------------------------------------------ write the folder


def _write_model(spec: Any, source: Path, folder: Path) -> None:
    """Write the model with the assets that it references."""
    spec.modelname = folder.name
    places = {"meshdir": spec.meshdir, "texturedir": spec.texturedir}
    needed = [(places["meshdir"], mesh) for mesh in spec.meshes] + [
        (places["texturedir"], each) for each in spec.textures
    ]
    for where, asset in needed:
        if asset.file:
            match = source.parent / where / asset.file
            if not match.is_file():
                raise ImportModelError(f"{match} is missing; the model references it")
            target = folder / "assets" / Path(asset.file).name
            target.parent.mkdir(exist_ok=True)
            shutil.copyfile(match, target)
            asset.file = target.name
    spec.meshdir = spec.texturedir = "assets"
    spec.modelfiledir = str(folder)
    (folder / f"{folder.name}.xml").write_text(spec.to_xml(), encoding="utf-8")


def _write_texts(folder: Path, source: Path, model: Any, servos: Sequence[_Servo], home: dict[str, float]) -> None:
    name = folder.name
    data = mujoco.MjData(model)
    for joint, position in home.items():
        data.joint(joint).qpos[0] = position
    EqualityJoints(model).apply(data.qpos)
    mujoco.mj_forward(model, data)
    (folder / "scene.xml").write_text(_scene(name, model, data), encoding="utf-8")
    (folder / "robot.toml").write_text(_manifest(name, model, servos, home), encoding="utf-8")
    (folder / "movements").mkdir()
    (folder / "movements" / "home.py").write_text(
        '"""Move slowly to the home position."""\n\nrobot.home(speed=0.3)\n', encoding="utf-8"
    )
    (folder / "README.md").write_text(_readme(name, source, servos), encoding="utf-8")


def _scene(name: str, model: Any, data: Any) -> str:
    """A floor, and a camera that shows the whole robot.

    The floor is under the robot's base at home; it is lower if it would be too close to moving parts.
    """
    reach = float(model.stat.extent)
    fixed = model.body_weldid[model.geom_bodyid] == 0
    stands = not fixed.any()  # mobile robot
    low = [_bottom(model, data, geom) - (0.0 if fixed[geom] or stands else _ROOM_M) for geom in range(model.ngeom)]
    lowest = min(low, default=0.0)
    x, y, z = (float(value) for value in model.stat.center)
    eye = f"{x + 1.6 * reach:.3f} {y - 1.6 * reach:.3f} {z + reach:.3f}"
    return f"""<mujoco model="{name}_scene">
  <include file="{name}.xml"/>
  <worldbody>
    <light pos="{x:.3f} {y - reach:.3f} {z + 2 * reach:.3f}" dir="0 0.4 -1" directional="true"/>
    <camera name="picture" fovy="40" pos="{eye}" xyaxes="1 1 0 -0.35 0.35 1.2"/>
    <geom name="floor" type="plane" size="5 5 0.1" pos="0 0 {lowest:.4f}" rgba="0.8 0.81 0.82 1"/>
  </worldbody>
</mujoco>
"""


def _bottom(model: Any, data: Any, geom: int) -> float:
    centre, half = model.geom_aabb[geom, :3], model.geom_aabb[geom, 3:]
    turn = data.geom_xmat[geom].reshape(3, 3)
    return float(data.geom_xpos[geom, 2] + (turn @ centre)[2] - np.abs(turn[2]) @ half)


def _manifest(name: str, model: Any, servos: Sequence[_Servo], home: dict[str, float]) -> str:
    frames = [model.site(index).name for index in range(model.nsite) if model.site(index).name][:_FRAMES]
    frames = frames or [model.body(model.jnt_bodyid[model.joint(servos[-1].name).id]).name]
    lines = [
        f'type = "{name}"',
        "version = 1",
        f'label = "{name}"',
        'kind = "robot"',
        'description = "Imported from a MuJoCo model. Check every guessed figure before use."',
        f'model = "{name}.xml"',
        'scene = "scene.xml"',
        'driver = "mujoco"',
        "period_ms = 20",
        f"braking_rad_s2 = {_BRAKING}{GUESSED}",
        "frames = [" + ", ".join(f'"{frame}"' for frame in frames if frame) + "]",
        'capabilities = ["joints", "movements"]',
        "",
        "[home_rad]",
        *(f'"{joint}" = {position!r}' for joint, position in home.items()),
        "",
        "[[streams]]",
        'name = "joints"',
        "rate_hz = 20.0",
    ]
    for servo in servos:
        guess = {field: GUESSED if field in servo.guessed else "" for field in ("range", "effort")}
        lines += [
            "",
            "[[joints]]",
            f'name = "{servo.name}"',
            f'label = "{servo.name}"',
            f"lower_rad = {servo.lower!r}{guess['range']}",
            f"upper_rad = {servo.upper!r}{guess['range']}",
            f"max_velocity_rad_s = {_SPEED_M_S if servo.slides else _SPEED_RAD_S}{GUESSED}",
            f"max_acceleration_rad_s2 = {_ACCELERATION}{GUESSED}",
            f"max_jerk_rad_s3 = {_JERK}{GUESSED}",
            f"max_effort_nm = {servo.effort!r}{guess['effort']}",
        ]
    return "\n".join(lines) + "\n"


def _readme(name: str, source: Path, servos: Sequence[_Servo]) -> str:
    efforts = ", ".join(servo.name for servo in servos if "effort" in servo.guessed) or "none"
    ranges = ", ".join(servo.name for servo in servos if "range" in servo.guessed) or "none"
    return f"""# {name}

Imported from `{source.name}` by `python -m device_agent import-model`. **Source** of shapes, masses, ranges and
servos: that model; its licence applies to this folder, too.

## What is approximate

- Speeds, accelerations, jerk and braking: guessed, conservative.
- Guessed ranges (±180°): {ranges}. Guessed efforts (twice the gravity load): {efforts}.
- The scene is a floor and a camera.
"""
