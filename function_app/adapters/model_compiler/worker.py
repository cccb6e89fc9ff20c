"""The child process of ``compiler``: compiles one robot type with MuJoCo.

Runs as ``python -I -B worker.py`` in a folder that contains only the uploaded files. Reads the task from standard
input, sets its resource limits before it opens a file, and writes a ``ModelReport`` as JSON.
"""

import json
import os
import resource
import signal
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, TypeVar

T = TypeVar("T")
NO_MUJOCO, UNCONFINED = 3, 4
_MEGABYTE = 2**20
_STEPS = 100
_TIMESTEP_S = 0.002
_SLACK_RAD = 1e-3
_LAST_VISIBLE_GROUP = 2
_ATTACH_WARNING = "Attach conflict"
"""Warning about options of a robot that the room's options override."""
_MAX_BODIES = 500
_MAX_SHAPES = 2000
_MAX_NAMES = 200
_LEAST_MASS_KG, _LEAST_INERTIA_KG_M2 = 1e-3, 1e-6


def limit(cpu_s: int, wall_s: int, memory_mb: int) -> None:
    """Limit the resources of this process."""
    for kind, maximum in (
        (resource.RLIMIT_CPU, cpu_s),
        (resource.RLIMIT_AS, memory_mb * _MEGABYTE),
        (resource.RLIMIT_CORE, 0),
        (resource.RLIMIT_FSIZE, _MEGABYTE),
        (resource.RLIMIT_NOFILE, 64),
    ):
        resource.setrlimit(kind, (maximum, maximum))
    signal.alarm(wall_s)  # also if the parent process has ended


def confine(folder: str, user: int) -> dict[str, str]:
    """Confine this process to reading a folder: another user, Landlock, seccomp, in this order.

    Args:
        folder: The folder.
        user: User and group, if the server runs as root.

    Returns:
        Layer → why it could not be applied; empty if all layers are in force.
    """
    if sys.platform != "linux":
        return {"Linux": f"it runs {sys.platform}"}
    from device_agent.sandbox import landlock, privileges, seccomp  # noqa: PLC0415 (Linux only)

    missing: dict[str, str] = {}

    def attempt(layer: str, step: Callable[[], T]) -> T | None:
        try:
            return step()
        except (ImportError, OSError, RuntimeError, ValueError) as error:
            missing[layer] = str(error)
            return None

    filter_ = attempt("seccomp", lambda: seccomp.build(reading=True))  # loads files
    attempt("user", lambda: privileges.drop(user))
    attempt("landlock", lambda: landlock.restrict([folder]))
    if filter_ is not None:
        attempt("seccomp", lambda: seccomp.enforce(filter_))
    return missing


class Check:
    """Checks a robot type against its manifest, with the settings of the agent's ``mujoco`` driver."""

    def __init__(self, mujoco: Any, draw: Callable[..., Any], task: dict[str, Any]) -> None:
        self._mujoco = mujoco
        self._draw = draw
        self._task = task
        self.warnings: list[str] = []
        self.description: dict[str, Any] = {}
        """Twin, actuators and cameras of the model; empty if there are errors."""

    def errors(self) -> list[str]:
        """All errors of the type, or the first compiler error."""
        model_file, scene_file = self._task["model"], self._task["scene"]
        robot = None
        for name, placed in ((model_file, False), (model_file, True), (scene_file, False)):
            try:
                model = self._compile(name, placed=placed)
            except (ValueError, OSError, self._mujoco.FatalError) as error:
                return [f"{name}: {' '.join(str(error).split())}"]
            if not placed:
                robot = model if robot is None else robot
                found = [f"{name}: {error}" for error in self._compare(model)]
                if found or self._task["missing"]:
                    return found
        found = [f"{scene_file}: {error}" for error in self._simulate(model)]
        if not found:
            self._describe(robot, model)
        return found

    def _compile(self, name: str, *, placed: bool) -> Any:
        """Compile a file, either alone or attached to an empty world like a robot in a room."""
        mujoco = self._mujoco
        spec = mujoco.MjSpec.from_file(name)
        self._remove_missing(spec)
        if placed:
            robot, spec = spec, mujoco.MjSpec()
            spec.attach(robot, prefix="robot/", frame=spec.worldbody.add_frame())
        spec.option.timestep = _TIMESTEP_S
        spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
        spec.option.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_AUTORESET)
        return spec.compile()

    def _remove_missing(self, spec: Any) -> None:
        """Remove elements whose files are missing, so that compilation finds further errors."""
        missing = set(self._task["missing"])
        if not missing:
            return
        names = {mesh.name for mesh in spec.meshes if Path(mesh.file).name in missing}
        for geom in [geom for geom in spec.geoms if geom.meshname in names]:
            spec.delete(geom)
        for mesh in [mesh for mesh in spec.meshes if mesh.name in names]:
            spec.delete(mesh)
        spec.compiler.boundmass = max(spec.compiler.boundmass, _LEAST_MASS_KG)
        spec.compiler.boundinertia = max(spec.compiler.boundinertia, _LEAST_INERTIA_KG_M2)

    def _describe(self, model: Any, scene: Any) -> None:
        """Create the description and the warnings."""
        kinds, file = self._mujoco.mjtObj, self._task["model"]
        joints = [self._find(model, kinds.mjOBJ_JOINT, name) for name in self._joint_names()]
        base = int(model.body_rootid[model.jnt_bodyid[joints[0]]]) if joints else 1
        shapes = [geom for geom in range(model.ngeom) if model.geom_group[geom] <= _LAST_VISIBLE_GROUP]
        self.description = {
            "actuators": self._named(model, kinds.mjOBJ_ACTUATOR, model.nu),
            "cameras": self._named(scene, kinds.mjOBJ_CAMERA, scene.ncam),
            "twin": None,
        }
        if model.nbody > _MAX_BODIES or len(shapes) > _MAX_SHAPES:
            self.warnings.append(
                f"{file}: it has too many parts to be drawn ({model.nbody} bodies, {len(shapes)} shapes)"
            )
        else:
            self.description["twin"] = self._draw(model, base=base, device=self._task["type"])
        if not shapes:
            self.warnings.append(f"{file}: nothing of it can be seen: all shapes are in groups 3 and up")
        if any(model.geom_dataid[geom] >= 0 for geom in shapes):
            self.warnings.append(f"{file}: meshes are shown as boxes")
        for name in self._named(model, kinds.mjOBJ_ACTUATOR, model.nu):
            if name not in {*self._joint_names(), *self._task["wheels"]}:
                self.warnings.append(f"{file}: actuator '{name}' is not in robot.toml, so it cannot be moved")
        if not scene.ncam:
            self.warnings.append(f"{self._task['scene']}: there is no camera")

    def _joint_names(self) -> list[str]:
        return [joint["name"] for joint in self._task["joints"]]

    def _compare(self, model: Any) -> Iterator[str]:
        kinds = self._mujoco.mjtObj
        joints: list[int] = []
        for joint in self._task["joints"]:
            name = joint["name"]
            index = self._find(model, kinds.mjOBJ_JOINT, name)
            actuator = self._find(model, kinds.mjOBJ_ACTUATOR, name)
            if index < 0:
                yield f"no joint '{name}'; the model has: {self._names(model, kinds.mjOBJ_JOINT, model.njnt)}"
                continue
            joints.append(index)
            yield from self._compare_joint(model, index, joint)
            if actuator < 0:
                yield f"no actuator '{name}'; the model has: {self._names(model, kinds.mjOBJ_ACTUATOR, model.nu)}"
            else:
                yield from self._compare_actuator(model, actuator, index, joint)
        for name in self._task["wheels"]:
            yield from self._compare_wheel(model, name)
        for frame in self._task["frames"]:
            if max(self._find(model, kind, frame) for kind in (kinds.mjOBJ_SITE, kinds.mjOBJ_BODY)) < 0:
                sites = self._names(model, kinds.mjOBJ_SITE, model.nsite)
                bodies = self._names(model, kinds.mjOBJ_BODY, model.nbody)
                yield f"no site or body '{frame}'; the model has sites {sites} and bodies {bodies}"
        if joints:
            yield from self._compare_tree(model, int(model.body_rootid[model.jnt_bodyid[joints[0]]]))

    def _compare_joint(self, model: Any, index: int, joint: dict[str, Any]) -> Iterator[str]:
        if not self._scalar(model, index):
            yield f"joint '{joint['name']}' is neither a hinge nor a slide"
        elif model.jnt_limited[index]:
            yield from _inside(f"the range of joint '{joint['name']}'", model.jnt_range[index], joint)

    def _compare_actuator(self, model: Any, actuator: int, index: int, joint: dict[str, Any]) -> Iterator[str]:
        mujoco, name = self._mujoco, joint["name"]
        gain = model.actuator_gainprm[actuator, 0]
        servo = (
            model.actuator_trntype[actuator] == int(mujoco.mjtTrn.mjTRN_JOINT)
            and model.actuator_trnid[actuator, 0] == index
            and model.actuator_gear[actuator, 0] == 1
            and model.actuator_biastype[actuator] == int(mujoco.mjtBias.mjBIAS_AFFINE)
            and gain > 0
            and model.actuator_biasprm[actuator, 1] == -gain
        )
        if not servo:
            yield f"actuator '{name}' is not a position servo on joint '{name}' with gear 1"
        elif model.actuator_ctrllimited[actuator]:
            yield from _inside(f"the control range of actuator '{name}'", model.actuator_ctrlrange[actuator], joint)

    def _compare_wheel(self, model: Any, name: str) -> Iterator[str]:
        mujoco = self._mujoco
        actuator = self._find(model, mujoco.mjtObj.mjOBJ_ACTUATOR, name)
        if actuator < 0:
            yield f"no actuator '{name}'; the model has: {self._names(model, mujoco.mjtObj.mjOBJ_ACTUATOR, model.nu)}"
            return
        gain = model.actuator_gainprm[actuator, 0]
        servo = (
            model.actuator_trntype[actuator] == int(mujoco.mjtTrn.mjTRN_JOINT)
            and model.jnt_type[model.actuator_trnid[actuator, 0]] == int(mujoco.mjtJoint.mjJNT_HINGE)
            and model.actuator_ctrllimited[actuator]
            and model.actuator_biastype[actuator] == int(mujoco.mjtBias.mjBIAS_AFFINE)
            and gain > 0
            and model.actuator_biasprm[actuator, 2] == -gain
        )
        if not servo:
            yield f"actuator '{name}' is not a velocity servo on a hinge, with a control range"

    def _compare_tree(self, model: Any, base: int) -> Iterator[str]:
        """All joints below the base must be hinges or slides, which the console can display."""
        for joint in range(model.njnt):
            body = int(model.jnt_bodyid[joint])
            if body != base and int(model.body_rootid[body]) == base and not self._scalar(model, joint):
                name = self._mujoco.mj_id2name(model, self._mujoco.mjtObj.mjOBJ_JOINT, joint) or f"number {joint}"
                yield f"joint '{name}' is neither a hinge nor a slide, below the robot's base"

    def _simulate(self, model: Any) -> Iterator[str]:
        """Check that the simulation is stable at the home position."""
        mujoco = self._mujoco
        data = mujoco.MjData(model)
        for name, position in self._task["home_rad"].items():
            joint = self._find(model, mujoco.mjtObj.mjOBJ_JOINT, name)
            data.qpos[model.jnt_qposadr[joint]] = position
            data.ctrl[self._find(model, mujoco.mjtObj.mjOBJ_ACTUATOR, name)] = position
        for _ in range(_STEPS):
            mujoco.mj_step(model, data)
            for warning in ("mjWARN_BADQPOS", "mjWARN_BADQVEL", "mjWARN_BADQACC"):
                if data.warning[int(getattr(mujoco.mjtWarning, warning))].number:
                    yield f"the simulation becomes unstable at home after {data.time:.3f} s ({warning})"
                    return

    def _scalar(self, model: Any, joint: int) -> bool:
        kinds = self._mujoco.mjtJoint
        return int(model.jnt_type[joint]) in {int(kinds.mjJNT_HINGE), int(kinds.mjJNT_SLIDE)}

    def _find(self, model: Any, kind: Any, name: str) -> int:
        return int(self._mujoco.mj_name2id(model, kind, name))

    def _names(self, model: Any, kind: Any, count: int) -> str:
        return ", ".join(self._named(model, kind, count)) or "none with a name"

    def _named(self, model: Any, kind: Any, count: int) -> list[str]:
        names = (self._mujoco.mj_id2name(model, kind, index) for index in range(count))
        return [name[:_MAX_NAMES] for name in names if name][:_MAX_NAMES]


def _inside(what: str, limits: Any, joint: dict[str, Any]) -> Iterator[str]:
    lower, upper = float(limits[0]), float(limits[1])
    if joint["lower_rad"] < lower - _SLACK_RAD or joint["upper_rad"] > upper + _SLACK_RAD:
        hint = "joint ranges in MJCF are degrees unless it says <compiler angle='radian'/>"
        yield f"{what} is {lower:.4f} to {upper:.4f} rad; the manifest's must lie within ({hint})"


def main() -> int:
    """Check the task on standard input; returns 0 if a report was written, which is empty for a task without a type."""
    task = json.load(sys.stdin)
    limit(task["cpu_s"], task["wall_s"], task["memory_mb"])
    output = os.dup(1)
    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)  # MuJoCo may print to standard output
    sys.path.append(str(Path(__file__).resolve().parents[3]))
    try:
        report, code = _check(task), 0
    except ImportError:
        return NO_MUJOCO
    except Unconfined as error:
        report, code = {"missing": error.missing}, UNCONFINED
    with os.fdopen(output, "wb") as file:
        file.write(json.dumps(report).encode())
    return code


class Unconfined(Exception):  # noqa: N818 (named after the state of the process)
    """Layers are missing, and the task does not accept this."""

    def __init__(self, missing: dict[str, str]) -> None:
        super().__init__()
        self.missing = missing


def _check(task: dict[str, Any]) -> dict[str, Any]:
    """The report about the task's model.

    Raises:
        ImportError: MuJoCo is not installed.
        Unconfined: This process cannot be confined.
    """
    import msgspec  # noqa: PLC0415
    import mujoco  # noqa: PLC0415 (within the limits)

    from device_agent.simulation.mjcf.twin import build_twin  # noqa: PLC0415 (needs MuJoCo)

    mujoco_warnings: list[str] = []

    def warn(text: object) -> None:  # without a handler, MuJoCo writes a log file
        if _ATTACH_WARNING not in str(text):
            mujoco_warnings.append(str(text))

    mujoco.set_mju_user_warning(warn)
    # All modules are loaded. From here on, the process reads only the model.
    missing = confine(".", task["user"])
    if missing and not task["allow_unconfined"]:
        raise Unconfined(missing)
    if "type" not in task:
        return {"missing": missing}
    check = Check(mujoco, build_twin, task)
    try:
        errors = check.errors()
    except MemoryError:
        errors = [f"The model needs more than {task['memory_mb']} MB of memory."]
    return {
        "errors": [error[:2000] for error in errors[:50]],
        "warnings": [text[:2000] for text in (*check.warnings, *mujoco_warnings)[:50]],
        **msgspec.to_builtins(check.description),
    }


if __name__ == "__main__":
    sys.exit(main())
