"""A robot as a node of ROS 1, under the Python that has ``rospy``: ``rospy_robot.py CONTROLLERS JOINT=RAD …``.

Its controllers are those of the emulated robot (the file ``CONTROLLERS``). Standard input takes a line for each state
that it prints: positions and velocities by joint, the commanded and the true speed of the base, and times in seconds.
The line ``cut`` first closes the TCP connections of all topics.
"""

import contextlib
import importlib.machinery
import json
import socket
import sys
import threading
import time

import rospy
from geometry_msgs.msg import Twist
from nav_msgs.msg import Odometry
from sensor_msgs.msg import JointState
from std_msgs.msg import Bool
from trajectory_msgs.msg import JointTrajectory


def main():
    controllers = importlib.machinery.SourceFileLoader("controllers", sys.argv[1]).load_module()
    home = {name: float(value) for name, _, value in (each.partition("=") for each in sys.argv[2:])}
    robot = Robot(controllers, home)
    rospy.init_node("robot", disable_signals=True)
    command = rospy.Subscriber("/arm_controller/command", JointTrajectory, robot.follow, queue_size=1, tcp_nodelay=True)
    velocity = rospy.Subscriber("/cmd_vel", Twist, robot.drive, queue_size=1, tcp_nodelay=True)
    robot.topics += [command, velocity]
    stop = rospy.Publisher("/emergency_stop", Bool, queue_size=1, latch=True)
    stop.publish(Bool(False))
    threading.Thread(target=robot.run, daemon=True).start()
    print("ready", flush=True)
    for line in sys.stdin:
        if line == "cut\n":
            robot.cut()
        print(json.dumps(robot.state()), flush=True)


class Robot:
    def __init__(self, controllers, home):
        self.joints = controllers.JointController(home)
        self.base = controllers.BaseController()
        self._rejected = controllers.RejectedError
        self._cycle_s = controllers.CYCLE_S
        self._lock = threading.Lock()
        self._command_s = self._rest_s = self._cut_s = 0.0
        self._commands = 0
        self._states = rospy.Publisher("/joint_states", JointState, queue_size=1, tcp_nodelay=True)
        self._odometry = rospy.Publisher("/odom", Odometry, queue_size=1)
        self.topics = [self._states, self._odometry]

    def cut(self):
        with self._lock:
            for topic in self.topics:
                for connection in list(topic.impl.connections):
                    with contextlib.suppress(OSError, AttributeError):  # it has ended already
                        connection.socket.shutdown(socket.SHUT_RDWR)
            self._cut_s = self.joints.time_s

    def follow(self, message):
        points = [
            {
                "positions": point.positions,
                "velocities": point.velocities,
                "time_from_start": {"secs": point.time_from_start.secs, "nsecs": point.time_from_start.nsecs},
            }
            for point in message.points
        ]
        with self._lock:
            self._commands += 1
            self._command_s = self.joints.time_s
            try:
                self.joints.follow({"joint_names": message.joint_names, "points": points})
            except self._rejected as error:
                rospy.logwarn("%s", error)

    def drive(self, message):
        with self._lock:
            self.base.drive({"linear": {"x": message.linear.x}, "angular": {"z": message.angular.z}})

    def run(self):
        while True:
            time.sleep(self._cycle_s)
            with self._lock:
                self.joints.step()
                self.base.step()
                if not self.joints.at_rest:
                    self._rest_s = self.joints.time_s
                state = JointState()
                state.header.stamp = rospy.Time.now()
                state.name = list(self.joints.names)[::-1]
                state.position = [self.joints.position[name] for name in state.name]
                state.velocity = [self.joints.velocity[name] for name in state.name]
                odometry = Odometry()
                odometry.header.stamp = state.header.stamp
                odometry.pose.pose.position.x = self.base.x_m
                odometry.pose.pose.orientation.w = 1.0
                odometry.twist.twist.linear.x = self.base.forward_m_s
            self._states.publish(state)
            self._odometry.publish(odometry)

    def state(self):
        """Times are those of the robot: of the last command, and of the last cycle in which a joint moved."""
        with self._lock:
            return {
                "position": self.joints.position,
                "velocity": self.joints.velocity,
                "forward_m_s": self.base.forward_m_s,
                "commands": self._commands,
                "time_s": self.joints.time_s,
                "command_s": self._command_s,
                "moved_s": self._rest_s,
                "cut_s": self._cut_s,
            }


if __name__ == "__main__":
    main()
