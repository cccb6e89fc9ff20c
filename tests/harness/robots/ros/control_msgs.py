"""Generates the Python package ``control_msgs``, which Debian lacks: ``control_msgs.py FOLDER``.

It uses ROS's own generator, under the Python that has ``genpy``. Only the messages of FollowJointTrajectory are
generated. Source of the fields: the published definitions of ``control_msgs`` 1.5.
"""

import importlib
import sys
from pathlib import Path

import genpy.generate_initpy
import genpy.generator

HEADER = "std_msgs/Header header\n"
GOAL_ID, STATUS = "actionlib_msgs/GoalID goal_id\n", "actionlib_msgs/GoalStatus status\n"
NAME = "FollowJointTrajectory"
POINTS = "".join(f"trajectory_msgs/JointTrajectoryPoint {name}\n" for name in ("desired", "actual", "error"))
CODES = {
    "SUCCESSFUL": 0,
    "INVALID_GOAL": -1,
    "INVALID_JOINTS": -2,
    "OLD_HEADER_TIMESTAMP": -3,
    "PATH_TOLERANCE_VIOLATED": -4,
    "GOAL_TOLERANCE_VIOLATED": -5,
}
DEFINITIONS = {
    "JointTolerance": "string name\nfloat64 position\nfloat64 velocity\nfloat64 acceleration\n",
    f"{NAME}Goal": "trajectory_msgs/JointTrajectory trajectory\nJointTolerance[] path_tolerance\n"
    "JointTolerance[] goal_tolerance\nduration goal_time_tolerance\n",
    f"{NAME}Result": "int32 error_code\n"
    + "".join(f"int32 {name} = {code}\n" for name, code in CODES.items())
    + "string error_string\n",
    f"{NAME}Feedback": f"{HEADER}string[] joint_names\n{POINTS}",
    f"{NAME}ActionGoal": f"{HEADER}{GOAL_ID}{NAME}Goal goal\n",
    f"{NAME}ActionResult": f"{HEADER}{STATUS}{NAME}Result result\n",
    f"{NAME}ActionFeedback": f"{HEADER}{STATUS}{NAME}Feedback feedback\n",
    f"{NAME}Action": f"{NAME}ActionGoal action_goal\n{NAME}ActionResult action_result\n"
    f"{NAME}ActionFeedback action_feedback\n",
}
USED = {
    "std_msgs": ("Header",),
    "actionlib_msgs": ("GoalID", "GoalStatus"),
    "trajectory_msgs": ("JointTrajectory", "JointTrajectoryPoint"),
}


def main():
    target = Path(sys.argv[1])
    source = target / "definitions"
    files = []
    for name, text in DEFINITIONS.items():
        files.append(write(source / "control_msgs" / f"{name}.msg", text))
    for package, names in USED.items():
        for name in names:
            whole = getattr(importlib.import_module(f"{package}.msg"), name)._full_text
            write(source / package / f"{name}.msg", whole.partition("\n=====")[0])
    folders = {package: [str(source / package)] for package in ("control_msgs", *USED)}
    messages = target / "control_msgs" / "msg"
    failed = genpy.generator.MsgGenerator().generate_messages("control_msgs", files, str(messages), folders)
    genpy.generate_initpy.write_modules(str(messages))
    (target / "control_msgs" / "__init__.py").touch()
    sys.exit(failed)


def write(path, text):
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)
    return str(path)


if __name__ == "__main__":
    main()
