"""A robot as a node of ROS 1, under the Python that has ``rospy``: ``rospy_robot.py CONTROLLERS MESSAGES JOINT=RAD …``.

Its controllers are those of the emulated robot (the file ``CONTROLLERS``); ``MESSAGES`` is a folder with the package
``control_msgs``. Its action server is that of ``actionlib``. Each line of standard input is a JSON object with one of
the requests ``disturb``, ``restore``, ``reset``, ``abort``, ``silent`` and ``cut``, or none. ``cut`` closes the TCP
connections of the topics of joints and base. The answer is the robot's state: positions and velocities by joint, the
true speed of the base, counters, and times in seconds.
"""

import contextlib
import importlib.machinery
import json
import math
import os
import socket
import sys
import threading
import time

import actionlib
import rospy
from geometry_msgs.msg import Twist
from nav_msgs.msg import Odometry
from sensor_msgs.msg import JointState
from std_msgs.msg import Bool
from trajectory_msgs.msg import JointTrajectory


def main():
    controllers = importlib.machinery.SourceFileLoader("controllers", sys.argv[1]).load_module()
    sys.path.insert(0, sys.argv[2])
    home = {name: float(value) for name, _, value in (each.partition("=") for each in sys.argv[3:])}
    rospy.init_node("robot", disable_signals=True)
    robot = Robot(controllers, home)
    threading.Thread(target=robot.run, daemon=True).start()
    print("ready", flush=True)
    for line in sys.stdin:
        robot.execute(json.loads(line))
        print(json.dumps(robot.state()), flush=True)


class Corrupted(JointState):  # type: ignore[misc]
    """A message whose bytes are replaced."""

    def __init__(self, corrupt):
        super().__init__()
        self._corrupt = corrupt

    def serialize(self, buff):
        position = buff.tell()
        super().serialize(buff)
        data = buff.getvalue()[position:]
        buff.seek(position)
        buff.truncate()
        buff.write(self._corrupt(data))


class Robot:
    def __init__(self, controllers, home):
        self._controllers, self._home = controllers, home
        self._lock = threading.RLock()
        self._command_s = self._rest_s = self._cut_s = 0.0
        self._commands = 0
        self._disturbance = ""
        self._stopped = False
        self._old = rospy.Time.now()
        self._handles = {}
        self._build()
        self._states = rospy.Publisher("/joint_states", JointState, queue_size=1, tcp_nodelay=True)
        self._odometry = rospy.Publisher("/odom", Odometry, queue_size=1)
        self._stop = rospy.Publisher("/emergency_stop", Bool, queue_size=1, latch=True)
        self._stop.publish(Bool(False))
        command, velocity = "/arm_controller/command", "/cmd_vel"
        self._topics = [
            self._states,
            self._odometry,
            rospy.Subscriber(command, JointTrajectory, self.follow, queue_size=1, tcp_nodelay=True),
            rospy.Subscriber(velocity, Twist, self.drive, queue_size=1, tcp_nodelay=True),
        ]
        messages = importlib.import_module("control_msgs.msg")
        self._result = messages.FollowJointTrajectoryResult
        self._server = actionlib.ActionServer(
            "/arm_controller/follow_joint_trajectory",
            messages.FollowJointTrajectoryAction,
            self.start_goal,
            self.cancel_goal,
            auto_start=False,
        )
        self._server.start()

    def _build(self):
        self.joints = self._controllers.JointController(self._home)
        self.action = self._controllers.TrajectoryAction(self.joints)
        self.base = self._controllers.BaseController()

    # commands

    def follow(self, message):
        with self._lock:
            self._count()
            if not self._stopped:
                try:
                    self.joints.follow(to_dict(message))
                except self._controllers.RejectedError as error:
                    rospy.logwarn("%s", error)

    def drive(self, message):
        with self._lock:
            if not self._stopped:
                self.base.drive({"linear": {"x": message.linear.x}, "angular": {"z": message.angular.z}})

    def start_goal(self, handle):
        number = handle.get_goal_id().id
        with self._lock:
            self._count()
            self._handles[number] = handle
            accepted = self.action.start(number, to_dict(handle.get_goal().trajectory))
        if accepted:
            handle.set_accepted()

    def cancel_goal(self, handle):
        with self._lock:
            self.action.cancel(handle.get_goal_id().id)

    def _count(self):
        self._commands += 1
        self._command_s = self.joints.time_s

    # requests of the test

    def execute(self, request):
        with self._lock:
            if "disturb" in request:
                self._disturbance, self._old = request["disturb"], rospy.Time.now()
                self._set_stop(self._disturbance == "safety")
            if "restore" in request:
                self._disturbance = ""
                self._set_stop(False)
            if "reset" in request:
                self._build()
            if "abort" in request:
                self.action.abort(-4, request["abort"])
            if "silent" in request:
                self.action.silent = request["silent"]
            if "cut" in request:
                self._cut()

    def _cut(self):
        for topic in self._topics:
            for connection in list(topic.impl.connections):
                with contextlib.suppress(OSError, AttributeError):  # it has ended already
                    connection.socket.shutdown(socket.SHUT_RDWR)
        self._cut_s = self.joints.time_s

    def _set_stop(self, stopped):
        if stopped != self._stopped:
            self._stopped, self.action.enabled = stopped, not stopped
            if stopped:
                self.action.abort(0, "emergency stop")
                self.joints.stop()
                self.base.stop()
            self._stop.publish(Bool(stopped))

    # messages

    def run(self):
        while True:
            time.sleep(self._controllers.CYCLE_S)
            with self._lock:
                self.joints.step()
                self.action.step()
                self.base.step()
                if not self.joints.at_rest:
                    self._rest_s = self.joints.time_s
                state, odometry = self._joint_state(), self._odom()
                ended, self.action.ended = self.action.ended, []
                silent = self._disturbance == "silence"
            if not silent:
                self._states.publish(state)
                self._odometry.publish(odometry)
            for number, outcome, code, text in ended:
                self._end(self._handles.pop(number), outcome, self._result(error_code=code, error_string=text), text)

    def _joint_state(self):
        kind = self._disturbance
        state = JointState()
        if kind == "garbage":
            state = Corrupted(lambda data: b"\xff" * 4 + os.urandom(len(data)))
        if kind == "truncated":
            state = Corrupted(lambda data: data[: len(data) // 2])
        state.header.stamp = self._old if kind == "clock" else rospy.Time.now()
        state.name = list(self.joints.names)[:: 1 if kind == "order" else -1]
        state.position = [math.nan if kind == "nan" else self.joints.position[name] for name in state.name]
        state.velocity = [self.joints.velocity[name] for name in state.name]
        return state

    def _odom(self):
        odometry = Odometry()
        odometry.header.stamp = rospy.Time.now()
        odometry.pose.pose.position.x = self.base.x_m
        odometry.pose.pose.orientation.w = 1.0
        odometry.twist.twist.linear.x = self.base.forward_m_s
        return odometry

    def _end(self, handle, outcome, result, text):
        if outcome == "rejected":
            handle.set_rejected(result, text)
        elif outcome == "preempted":
            handle.set_canceled(result, text)
        elif outcome == "aborted":
            handle.set_aborted(result, text)
        else:
            handle.set_succeeded(result, text)

    def state(self):
        """Times are those of the robot: of the last command, and of the last cycle in which a joint moved."""
        with self._lock:
            return {
                "position": self.joints.position,
                "velocity": self.joints.velocity,
                "forward_m_s": self.base.forward_m_s,
                "turn_rad_s": self.base.turn_rad_s,
                "commands": self._commands,
                "succeeded": self.action.succeeded,
                "cancelled": self.action.cancelled,
                "time_s": self.joints.time_s,
                "command_s": self._command_s,
                "moved_s": self._rest_s,
                "cut_s": self._cut_s,
            }


def to_dict(message):
    points = [
        {
            "positions": point.positions,
            "velocities": point.velocities,
            "time_from_start": {"secs": point.time_from_start.secs, "nsecs": point.time_from_start.nsecs},
        }
        for point in message.points
    ]
    return {"joint_names": message.joint_names, "points": points}


if __name__ == "__main__":
    main()
