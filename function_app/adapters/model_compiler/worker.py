"""The other side of ``model_compiler``: compiles one robot type with MuJoCo in a process of its own.

Started as ``python -I -B model_compiler_child.py`` in a folder that holds the uploaded files alone. Reads the task from
standard input, limits itself before it looks at any file, and writes what it has found as JSON: ``Looked`` of
``model_compiler``.
"""

import ctypes
import json
import os
import resource
import signal
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

NO_MUJOCO = 3
_MEGABYTE = 2**20
_STEPS = 100
_TIMESTEP_S = 0.002
_SLACK_RAD = 1e-3
_LAST_VISIBLE_GROUP = 2
_OF_ATTACHING = "Attach conflict"
"""What a robot has in its options besides: the room has the say there."""
_MAX_BODIES = 500
_MAX_SHAPES = 2000
_MAX_NAMES = 200
_LEAST_MASS_KG, _LEAST_INERTIA_KG_M2 = 1e-3, 1e-6
_LANDLOCK_CREATE, _LANDLOCK_ADD, _LANDLOCK_RESTRICT = 444, 445, 446
_NO_NEW_PRIVILEGES = 38
_ALL_FILE_RIGHTS = 2**13 - 1
_READ_RIGHTS = 2**2 | 2**3


def limit(cpu_s: int, wall_s: int, memory_mb: int) -> None:
    """Take from this process what a hostile model could use."""
    for kind, most in (
        (resource.RLIMIT_CPU, cpu_s),
        (resource.RLIMIT_AS, memory_mb * _MEGABYTE),
        (resource.RLIMIT_CORE, 0),
        (resource.RLIMIT_FSIZE, _MEGABYTE),
        (resource.RLIMIT_NOFILE, 64),
    ):
        resource.setrlimit(kind, (most, most))
    signal.alarm(wall_s)  # also if the parent process has ended


def confine(folder: str) -> None:
    """From here on read this folder and nothing else, where the kernel has Landlock.

    Elsewhere the references in the XML have been looked at before, and that must do.
    """
    calls = ctypes.CDLL(None)
    rights = ctypes.c_uint64(_ALL_FILE_RIGHTS)
    rules = calls.syscall(_LANDLOCK_CREATE, ctypes.byref(rights), ctypes.sizeof(rights), 0)
    if rules < 0:
        return
    place = os.open(folder, os.O_PATH | os.O_DIRECTORY)
    rule = _READ_RIGHTS.to_bytes(8, sys.byteorder) + place.to_bytes(4, sys.byteorder, signed=True)
    calls.syscall(_LANDLOCK_ADD, rules, 1, rule, 0)
    calls.prctl(_NO_NEW_PRIVILEGES, 1, 0, 0, 0)
    calls.syscall(_LANDLOCK_RESTRICT, rules, 0)
    os.close(rules)


class Check:
    """One robot type against its manifest, as the agent's ``mujoco`` driver will use it."""

    def __init__(self, mujoco: Any, draw: Callable[..., Any], task: dict[str, Any]) -> None:
        self._mujoco = mujoco
        self._draw = draw
        self._task = task
        self.warnings: list[str] = []
        self.drawn: dict[str, Any] = {}
        """With what else a page may want to know of the model; empty where there are errors."""

    def errors(self) -> list[str]:
        """Everything that is wrong; what cannot be compiled is not looked at any further."""
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
        found = [f"{scene_file}: {error}" for error in self._play(model)]
        if not found:
            self._look(robot, model)
        return found

    def _compile(self, name: str, *, placed: bool) -> Any:
        """A file alone, or put into an empty world, as robots in one room are."""
        mujoco = self._mujoco
        spec = mujoco.MjSpec.from_file(name)
        self._do_without(spec)
        if placed:
            robot, spec = spec, mujoco.MjSpec()
            spec.attach(robot, prefix="robot/", frame=spec.worldbody.add_frame())
        spec.option.timestep = _TIMESTEP_S
        spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
        spec.option.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_AUTORESET)
        return spec.compile()

    def _do_without(self, spec: Any) -> None:
        """Remove elements whose files are missing. They are reported, and compilation finds further errors."""
        missing = set(self._task["missing"])
        if not missing:
            return
        gone = {mesh.name for mesh in spec.meshes if Path(mesh.file).name in missing}
        for geom in [geom for geom in spec.geoms if geom.meshname in gone]:
            spec.delete(geom)
        for mesh in [mesh for mesh in spec.meshes if mesh.name in gone]:
            spec.delete(mesh)
        spec.compiler.boundmass = max(spec.compiler.boundmass, _LEAST_MASS_KG)
        spec.compiler.boundinertia = max(spec.compiler.boundinertia, _LEAST_INERTIA_KG_M2)

    def _look(self, model: Any, scene: Any) -> None:
        """Draw the robot as a page will, and say what is well to know."""
        kinds, file = self._mujoco.mjtObj, self._task["model"]
        joints = [self._find(model, kinds.mjOBJ_JOINT, name) for name in self._known()]
        base = int(model.body_rootid[model.jnt_bodyid[joints[0]]]) if joints else 1
        shapes = [geom for geom in range(model.ngeom) if model.geom_group[geom] <= _LAST_VISIBLE_GROUP]
        self.drawn = {
            "actuators": self._named(model, kinds.mjOBJ_ACTUATOR, model.nu),
            "cameras": self._named(scene, kinds.mjOBJ_CAMERA, scene.ncam),
            "twin": None,
        }
        if model.nbody > _MAX_BODIES or len(shapes) > _MAX_SHAPES:
            self.warnings.append(
                f"{file}: it has too many parts to be drawn ({model.nbody} bodies, {len(shapes)} shapes)"
            )
        else:
            self.drawn["twin"] = self._draw(model, base=base, device=self._task["type"])
        if not shapes:
            self.warnings.append(f"{file}: nothing of it can be seen: all shapes are in groups 3 and up")
        if any(model.geom_dataid[geom] >= 0 for geom in shapes):
            self.warnings.append(f"{file}: meshes are shown as boxes")
        for name in self._named(model, kinds.mjOBJ_ACTUATOR, model.nu):
            if name not in {*self._known(), *self._task["wheels"]}:
                self.warnings.append(f"{file}: actuator '{name}' is not in robot.toml, so it cannot be moved")
        if not scene.ncam:
            self.warnings.append(f"{self._task['scene']}: there is no camera")

    def _known(self) -> list[str]:
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
                known = self._names(model, kinds.mjOBJ_SITE, model.nsite)
                bodies = self._names(model, kinds.mjOBJ_BODY, model.nbody)
                yield f"no site or body '{frame}'; the model has sites {known} and bodies {bodies}"
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
        """Below its base a robot turns and slides only: nothing else can be drawn."""
        for joint in range(model.njnt):
            body = int(model.jnt_bodyid[joint])
            if body != base and int(model.body_rootid[body]) == base and not self._scalar(model, joint):
                name = self._mujoco.mj_id2name(model, self._mujoco.mjtObj.mjOBJ_JOINT, joint) or f"number {joint}"
                yield f"joint '{name}' is neither a hinge nor a slide, below the robot's base"

    def _play(self, model: Any) -> Iterator[str]:
        """Hold home for a moment."""
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


def _inside(what: str, known: Any, joint: dict[str, Any]) -> Iterator[str]:
    lower, upper = float(known[0]), float(known[1])
    if joint["lower_rad"] < lower - _SLACK_RAD or joint["upper_rad"] > upper + _SLACK_RAD:
        hint = "joint ranges in MJCF are degrees unless it says <compiler angle='radian'/>"
        yield f"{what} is {lower:.4f} to {upper:.4f} rad; the manifest's must lie within ({hint})"


def main() -> int:
    """Check the task on standard input; the exit code says whether there is an answer."""
    task = json.load(sys.stdin)
    limit(task["cpu_s"], task["wall_s"], task["memory_mb"])
    answers = os.dup(1)
    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)  # nothing of MuJoCo's own may mix into the answer
    sys.path.append(str(Path(__file__).resolve().parents[3]))
    try:
        import msgspec  # noqa: PLC0415
        import mujoco  # noqa: PLC0415 (within the limits)

        from device_agent.simulation.mjcf.twin import build_twin  # noqa: PLC0415 (needs MuJoCo)
    except ImportError:
        return NO_MUJOCO
    warned: list[str] = []

    def warn(text: object) -> None:  # else it writes a file
        if _OF_ATTACHING not in str(text):
            warned.append(str(text))

    mujoco.set_mju_user_warning(warn)
    confine(".")
    check = Check(mujoco, build_twin, task)
    try:
        errors = check.errors()
    except MemoryError:
        errors = [f"The model needs more than {task['memory_mb']} MB of memory."]
    found = {
        "errors": [error[:2000] for error in errors[:50]],
        "warnings": [text[:2000] for text in (*check.warnings, *warned)[:50]],
        **check.drawn,
    }
    with os.fdopen(answers, "wb") as answer:
        answer.write(msgspec.json.encode(found))
    return 0


if __name__ == "__main__":
    sys.exit(main())
