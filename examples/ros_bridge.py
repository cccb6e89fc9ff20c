"""Show a device as ROS topics, and move it from ROS with a lease: ``python examples/ros_bridge.py DEVICE [options]``.

It signs in with the API key in ``TELESCOPE_TOKEN``. The topics are below ``/telescope/DEVICE``:

``joint_states`` (sensor_msgs/JointState), ``state`` (std_msgs/String): published.
``control`` (std_msgs/Bool): true takes control of the device, false releases it.
``joint_trajectory`` (trajectory_msgs/JointTrajectory), ``cmd_vel`` (geometry_msgs/Twist): executed while in control.

Rejected messages are reported on ``state``. The robot stops automatically 300 ms after the last setpoint. Limits, Stop
and the lease are enforced by the device's agent.
"""

import argparse
import json
import signal
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from typing import Any

import msgspec
import requests
from broker_link import BrokerLink
from telescope_client import call, find_device, topic

from device_agent.middleware.ros.connection import Connection, Publication, Subscription
from device_agent.middleware.ros.messages import NS, Dialect, Time, Twist
from device_agent.middleware.ros.rosbridge import RosbridgeChannel
from device_agent.middleware.ros.rospy_channel import RospyChannel
from device_agent.ports.driver import UnreachableError
from device_agent.protocol.security import setpoints

RENEW_S = 10.0
"""Time between two renewals of the lease [s]."""
REACHED_RAD = 0.02
SETTLE_S = 2.0
"""Time to reach the last point of a trajectory after its time [s]."""
DRIVE_S = 0.3
"""A velocity is valid for this time [s]."""


class Bool(msgspec.Struct):
    """``std_msgs/Bool``."""

    data: bool


class Point(msgspec.Struct):
    """``trajectory_msgs/JointTrajectoryPoint``."""

    positions: list[float]
    time_from_start: Time


class JointTrajectory(msgspec.Struct):
    """``trajectory_msgs/JointTrajectory``."""

    joint_names: list[str]
    points: list[Point]


@dataclass
class Trajectory:
    """Positions over time.

    Attributes:
        names: Joints.
        points: Time [s] and positions [rad], from the start.
        started_s: When it was started.
    """

    names: list[str]
    points: list[tuple[float, list[float]]]
    started_s: float

    def target(self, now_s: float) -> dict[str, float]:
        """Positions at this time [rad]."""
        elapsed_s = now_s - self.started_s
        before_s, before = self.points[0]
        for time_s, position in self.points[1:]:
            if elapsed_s < time_s:
                share = max(0.0, elapsed_s - before_s) / (time_s - before_s)
                values = [a + share * (b - a) for a, b in zip(before, position, strict=True)]
                return dict(zip(self.names, values, strict=True))
            before_s, before = time_s, position
        return dict(zip(self.names, before, strict=True))

    def ended(self, now_s: float, present: dict[str, float]) -> bool:
        """Whether the last point is reached, or was not reached in time."""
        last_s, last = self.points[-1]
        elapsed_s = now_s - self.started_s
        reached = all(abs(present[name] - value) < REACHED_RAD for name, value in zip(self.names, last, strict=True))
        return elapsed_s >= last_s and (reached or elapsed_s > last_s + SETTLE_S)


@dataclass
class Control:
    """A lease of the device."""

    epoch: int
    key: bytes
    link: BrokerLink
    topic: str
    sequence: int = 0
    input: int = 0
    confirmed: bool = False
    lost: threading.Event = field(default_factory=threading.Event)


class Bridge:
    """Connects one device to ROS.

    Args:
        device: The device, as the API describes it.
        ros: Version of ROS.
        renew_s: Longest time between two renewals of credentials [s].
    """

    def __init__(self, device: dict[str, Any], ros: int, renew_s: float) -> None:
        self.device = device
        self.stopping = threading.Event()
        self.watcher = BrokerLink(
            {"purpose": "view"},
            renew_s,
            subscriptions=[(topic(device, "desc"), 1), (topic(device, "tele/joints"), 0)],
            on_message=self.on_message,
            on_lost=self.stopping.set,
        )
        self._renew_s = renew_s
        self.dialect = Dialect(ros)
        self.connection: Connection | None = None
        self._root = f"/telescope/{device['name']}".replace("-", "_")
        self._joints: list[str] = []
        self._present: dict[str, float] = {}
        self._control: Control | None = None
        self._trajectory: Trajectory | None = None
        self._twist: tuple[dict[str, float], float] | None = None
        self._lock = threading.Lock()
        self._requests = ThreadPoolExecutor(max_workers=1)

    # ------------------------------------------------------------ ROS

    def subscriptions(self) -> list[Subscription]:
        """Topics that are executed."""
        rows = [
            ("control", "std_msgs/Bool", Bool, self._on_control),
            ("joint_trajectory", "trajectory_msgs/JointTrajectory", JointTrajectory, self._on_trajectory),
            ("cmd_vel", "geometry_msgs/Twist", Twist, self._on_twist),
        ]
        return [
            Subscription(f"{self._root}/{name}", self.dialect.type(kind), message, accept)
            for name, kind, message, accept in rows
        ]

    def advertised(self) -> dict[str, str]:
        """Topics that are published."""
        kinds = {"joint_states": "sensor_msgs/JointState", "state": "std_msgs/String"}
        return {f"{self._root}/{name}": self.dialect.type(kind) for name, kind in kinds.items()}

    def report(self, text: str) -> None:
        """Publish on ``state``, and print."""
        print(text, flush=True)
        self._publish("state", {"data": text})

    def _publish(self, name: str, message: dict[str, Any]) -> None:
        try:
            if self.connection is not None:
                self.connection.publish(Publication(f"{self._root}/{name}", message))
        except UnreachableError as error:
            print(error, flush=True)
            self.stopping.set()

    def _on_control(self, message: Bool, at_s: float) -> None:
        del at_s
        self._requests.submit(self._take if message.data else self._release, "")

    def _on_trajectory(self, message: JointTrajectory, at_s: float) -> None:
        names = message.joint_names
        unknown = sorted(set(names) - set(self._joints))
        points = [(point.time_from_start.ns / NS, point.positions) for point in message.points]
        times_s = [0.0, *(time_s for time_s, _ in points)]
        if unknown or not names or not points:
            self.report(f"rejected: joints {names} of a device with {self._joints}")
        elif any(len(position) != len(names) for _, position in points):
            self.report("rejected: a point needs one position for each joint")
        elif sorted(set(times_s)) != times_s:
            self.report("rejected: the times of the points must increase, from above 0")
        elif self._starts():
            start = (0.0, [self._present[name] for name in names])
            self._trajectory = Trajectory(names, [start, *points], at_s)

    def _on_twist(self, message: Twist, at_s: float) -> None:
        if self._twist is not None or self._starts():
            linear = message.linear
            twist = {"forward_m_s": linear.x, "left_m_s": linear.y, "turn_rad_s": message.angular.z}
            self._twist = (twist, at_s)

    def _starts(self) -> bool:
        """Start a new input, if this program is in control."""
        with self._lock:
            control = self._control
            if control is not None and control.confirmed:
                control.input += 1
                self._trajectory = self._twist = None
                return True
        self.report(f"rejected: not in control of {self.device['name']}; publish true on {self._root}/control")
        return False

    # ------------------------------------------------------------ device

    def on_message(self, name: str, payload: bytes) -> None:
        """Process a message of the device."""
        message = json.loads(payload)
        if name.endswith("/desc"):
            self._joints = [joint["name"] for joint in message["joints"]]
        elif self._joints:
            self._present = dict(zip(self._joints, message["position_rad"], strict=True))
            self._publish(
                "joint_states",
                {
                    "header": {"stamp": self.dialect.time(message["at_ms"] / 1000), "frame_id": ""},
                    "name": self._joints,
                    "position": message["position_rad"],
                    "velocity": message["velocity_rad_s"],
                    "effort": message["effort_nm"],
                },
            )
            self._continue(message)

    def _continue(self, telemetry: dict[str, Any]) -> None:
        """Send the setpoint that follows this telemetry."""
        control, now_s = self._control, time.monotonic()
        if control is None:
            return
        if telemetry.get("epoch", 0) == control.epoch:
            if not control.confirmed:
                control.confirmed = True
                self.report(f"in control of {self.device['name']}, epoch {control.epoch}")
        elif control.confirmed:
            self._control = None
            self._requests.submit(self._release, "control was lost", control)
            return
        if telemetry.get("ended_input", 0) >= control.input:
            if self._trajectory is not None or self._twist is not None:
                self.report("the robot holds; publish a new command to continue")
            self._trajectory = self._twist = None
        target = self._target(now_s)
        if target is not None:
            control.sequence += 1
            setpoint = {
                "epoch": control.epoch,
                "sequence": control.sequence,
                "echo_tick_ms": telemetry["tick_ms"],
                "sent_ms": time.time() * 1000,
                "input": control.input,
                "target": target,
            }
            sealed = setpoints.seal(json.dumps(setpoint).encode(), control.key, control.topic)
            control.link.publish(control.topic, sealed)

    def _target(self, now_s: float) -> dict[str, Any] | None:
        twist, trajectory = self._twist, self._trajectory
        if twist is not None:
            if now_s - twist[1] < DRIVE_S:
                return {"kind": "drive", **twist[0]}
            self._twist = None
        elif trajectory is not None:
            if not trajectory.ended(now_s, self._present):
                return {"kind": "joints", "position_rad": trajectory.target(now_s)}
            self._trajectory = None
            self.report("the trajectory has ended")
        return None

    # ------------------------------------------------------------ lease, in a thread that may wait

    def _take(self, _: str) -> None:
        if self._control is not None:
            return
        try:
            lease = call("POST", f"/devices/{self.device['id']}/lease", {})
            request = {"purpose": "control", "device": self.device["id"], "epoch": lease["epoch"]}
            link = BrokerLink(request, self._renew_s)
            link.renew()
        except SystemExit as error:
            self.report(f"rejected: {error}")
            return
        name = topic(self.device, f"ctl/{lease['epoch']}")
        control = Control(lease["epoch"], bytes.fromhex(lease["setpoint_key"]), link, name)
        threading.Thread(target=self._renew, args=(control,), daemon=True).start()
        self._control = control

    def _renew(self, control: Control) -> None:
        while not control.lost.wait(RENEW_S):
            try:
                call("POST", f"/devices/{self.device['id']}/lease", {"epoch": control.epoch})
            except SystemExit as error:
                self._requests.submit(self._release, f"control was lost: {error}", control)
                return

    def _release(self, reason: str, lost: Control | None = None) -> None:
        control = lost or self._control
        if control is None or control.lost.is_set():
            return
        control.lost.set()
        self._control = self._trajectory = self._twist = None
        if lost is None:
            try:
                call("DELETE", f"/devices/{self.device['id']}/lease?epoch={control.epoch}")
            except SystemExit as error:
                reason = str(error)
        control.link.close()
        self.report(reason or f"released {self.device['name']}")

    def renew_due(self) -> None:
        """Renew the credentials that are due. The previous ones stay valid if the server does not respond."""
        control = self._control
        for link in (self.watcher, control.link if control is not None else None):
            if link is not None and time.monotonic() > link.renew_s:
                link.renew_s = time.monotonic() + RENEW_S
                self._requests.submit(self._renew_link, link)

    def _renew_link(self, link: BrokerLink) -> None:
        control = self._control
        if link is not self.watcher and (control is None or control.link is not link):
            return  # released meanwhile
        try:
            link.renew()
            print("renewed credentials", flush=True)
        except (SystemExit, requests.RequestException) as error:
            print(f"credentials are not renewed: {error}", flush=True)

    def close(self) -> None:
        """Release control, and end."""
        self._requests.submit(self._release, "").result()
        self._requests.shutdown()


def main() -> None:
    """Run until SIGTERM or SIGINT, or until a connection is lost."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("device")
    parser.add_argument("--ros", type=int, choices=(1, 2), default=1, help="version of ROS")
    parser.add_argument("--rosbridge", default="", metavar="[wss://]HOST:PORT", help="use rosbridge; otherwise rospy")
    parser.add_argument("--certificate-authority", default="", metavar="FILE", help="certificates for wss://")
    parser.add_argument(
        "--renew", type=float, default=300.0, metavar="SECONDS", help="longest time between renewals of credentials"
    )
    parser.add_argument("--master", default="http://127.0.0.1:11311", help="address of the ROS master, for rospy")
    parser.add_argument("--python", default="/usr/bin/python3", help="Python interpreter with rospy")
    options = parser.parse_args()
    bridge = Bridge(find_device(options.device), options.ros, options.renew)
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: bridge.stopping.set())
    channel = (
        RosbridgeChannel(options.rosbridge, certificate_authority=options.certificate_authority)
        if options.rosbridge
        else RospyChannel(
            python=options.python, folders=(), master=options.master, node="telescope_bridge", needs_subscribers=False
        )
    )
    bridge.connection = Connection(
        channel,
        subscriptions=bridge.subscriptions(),
        advertised=bridge.advertised(),
        device=options.device,
        clock=time.monotonic,
    )
    bridge.watcher.renew()
    print("ready", flush=True)
    problem = ""
    while not bridge.stopping.wait(0.2) and not bridge.connection.lost:
        bridge.renew_due()
        if bridge.connection.problem != problem:
            problem = bridge.connection.problem
            bridge.report(f"rejected: {problem}")
    bridge.close()
    bridge.watcher.close()
    bridge.connection.close()


if __name__ == "__main__":
    main()
