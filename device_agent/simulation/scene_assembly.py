"""Builds a world from a scene and robots placed in it."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mujoco

from device_agent.ports.driver import DriverError
from device_agent.simulation.mjcf.equality_joints import SCALAR_JOINTS, EqualityJoints
from device_agent.simulation.mjcf.options import copy_options

TIMESTEP_S = 0.002


@dataclass(frozen=True, slots=True, kw_only=True)
class Placement:
    """One robot placed in a scene.

    Attributes:
        prefix: Prepended to every name of the robot's model, for example ``arm/``; unique in its world.
        model: MJCF file of the robot alone.
        position_m: Robot origin in the world [m]. A robot on a free joint starts there.
        quaternion: Robot orientation in the world (w, x, y, z).
    """

    prefix: str
    model: Path
    position_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    quaternion: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 0.0)


def assemble(scene: Path, robots: Sequence[Placement]) -> Any:
    """The compiled ``MjModel`` of a scene with robots in it.

    Raises:
        DriverError: A file is missing or MuJoCo rejects it.
    """
    try:
        spec = mujoco.MjSpec.from_file(str(scene))
        # One world has one time step and one integrator; the robots' servos are tuned for this pair.
        spec.option.timestep = TIMESTEP_S
        spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
        # A diverged world must stop with a fault. By default MuJoCo resets it to the start.
        spec.option.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_AUTORESET)
        for robot in robots:
            frame = spec.worldbody.add_frame(pos=robot.position_m, quat=robot.quaternion)
            model = mujoco.MjSpec.from_file(str(robot.model))
            copy_options(model.option, spec.option)
            copy_options(model.visual, spec.visual)
            spec.attach(model, prefix=robot.prefix, frame=frame)
        return spec.compile()
    except (ValueError, OSError, mujoco.FatalError) as error:
        raise DriverError(f"{scene}: MuJoCo cannot build this world: {error}") from error


def home_state(model: Any, home: Mapping[str, float], settings: Mapping[str, float], *, scene: Path) -> Any:
    """A new state: joints at home, every position servo holding its joint's start position.

    Args:
        model: ``MjModel``.
        home: Full joint name → position [rad or m]; other joints start at the model's reference.
        settings: Actuator name → start position of its joint [rad or m]; unknown names are ignored.
        scene: For error messages.

    Raises:
        DriverError: ``home`` names an unknown joint.
    """
    data = mujoco.MjData(model)
    for name, position in home.items():
        joint = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_JOINT, name)
        if joint < 0:
            known = ", ".join(model.joint(index).name for index in range(model.njnt))
            raise DriverError(f"{scene}: no joint '{name}'; the model has: {known}")
        data.qpos[model.jnt_qposadr[joint]] = position
    for name, position in settings.items():
        actuator = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_ACTUATOR, name)
        if actuator >= 0:
            data.qpos[model.jnt_qposadr[model.actuator_trnid[actuator, 0]]] = position
    EqualityJoints(model).apply(data.qpos)
    for actuator in range(model.nu):
        joint = model.actuator_trnid[actuator, 0]
        by_joint = model.actuator_trntype[actuator] == int(mujoco.mjtTrn.mjTRN_JOINT)
        if by_joint and model.actuator_biasprm[actuator, 1] < 0 and model.jnt_type[joint] in SCALAR_JOINTS:
            data.ctrl[actuator] = data.qpos[model.jnt_qposadr[joint]]
    mujoco.mj_forward(model, data)
    return data


def is_servo(model: Any, actuator: int, *, order: int) -> bool:
    """Whether an actuator is a servo on a joint: of position (``order`` 0) or velocity (1)."""
    gain = model.actuator_gainprm[actuator, 0]
    return bool(
        model.actuator_trntype[actuator] == int(mujoco.mjtTrn.mjTRN_JOINT)
        and model.actuator_biastype[actuator] == int(mujoco.mjtBias.mjBIAS_AFFINE)
        and gain > 0
        and model.actuator_biasprm[actuator, 1 + order] == -gain
    )
