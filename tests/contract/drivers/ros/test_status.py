"""Safety topics, streams, pictures and options of the driver for ROS, at an emulated rosbridge server."""

import math
import time
from typing import Any

import numpy as np
import pytest
import simplejpeg

from device_agent import drivers
from device_agent.drivers.ros import RosBaseDriver, RosDriver
from device_agent.drivers.testing.peer import Disturbance
from device_agent.ports.driver import DriverError, Twist, UnreachableError
from device_agent.protocol.camera_frames import jpeg_size
from tests.harness.paths import ROBOTS, UR5
from tests.harness.robots.ros import robot as topics
from tests.harness.robots.ros.peer import RosPeer
from tests.harness.robots.ros.sensors import COLOURS, DEPTHS_MM, MESSAGES, as_json, image
from tests.harness.robots.ros.steps import HOME, QBO, TYPE, until

NAMES = [joint.name for joint in TYPE.joints]

# ------------------------------------------------------------ safety and status


def test_a_safety_topic_without_messages_is_named(driver: RosDriver, peer: RosPeer) -> None:
    peer.change(lambda _, server: server.latched.clear())
    with pytest.raises(UnreachableError, match="no message of the safety topic /emergency_stop"):
        driver.connect()


@pytest.mark.parametrize(("value", "stops"), [(False, False), (True, True), (0, True), (None, True), ("unknown", True)])
def test_other_values_of_a_safety_topic_stop(driver: RosDriver, peer: RosPeer, value: object, stops: bool) -> None:
    peer.change(lambda _, server: server.latched.update({topics.SAFETY: {"data": value}}))
    driver.connect()
    assert [fault.code for fault in driver.faults()] == (["safety"] if stops else [])


def test_a_safety_message_without_its_field_is_reported(driver: RosDriver, peer: RosPeer) -> None:
    peer.change(lambda _, server: server.latched.update({topics.SAFETY: {"mode": 1}}))
    with pytest.raises(UnreachableError, match="the message has no field 'data'"):
        driver.connect()


def test_diagnostics_of_other_parts_are_shown_only(driver: RosDriver, peer: RosPeer) -> None:
    def diagnostics() -> dict[str, Any]:
        return {"status": [{"level": 2, "name": f"camera {number}", "message": "no picture"} for number in range(5)]}

    driver.connect()
    assert not driver.faults()
    peer.change(lambda robot, _: setattr(robot, "diagnostics", diagnostics))
    until(driver.faults)
    (fault,) = driver.faults()
    assert (fault.code, fault.stops) == ("diagnostics", False)
    assert fault.message == ("camera 0: no picture; camera 1: no picture; camera 2: no picture (and 2 more)")
    driver.send(HOME)


def test_battery_odometry_and_tf_are_streams(mobile: tuple[RosBaseDriver, RosPeer]) -> None:
    driver, peer = mobile
    until(lambda: driver.report("health") and driver.report("odometry"))
    assert driver.report("health") == {"battery_percent": 80.0, "battery_v": 12.5, "charging": False}
    assert driver.report("sonar") == {}
    home = driver.observe().position_rad

    def drives() -> bool:
        driver.send(home)
        driver.drive(Twist(0.3, 0.0, 0.5))
        return driver.report("odometry").get("forward_m_s", 0.0) > 0.25

    until(drives)
    driver.halt()
    peer.wait(lambda robot: robot.base.forward_m_s == 0.0 and robot.base.turn_rad_s == 0.0)
    base = peer.robot.base
    # The map's origin is turned by 90°.
    expected = {
        "x_m": pytest.approx(1.0 - base.y_m, abs=1e-6),
        "y_m": pytest.approx(2.0 + base.x_m, abs=1e-6),
        "yaw_rad": pytest.approx(math.pi / 2 + base.yaw_rad, abs=1e-6),
        "forward_m_s": 0.0,
        "left_m_s": 0.0,
        "turn_rad_s": 0.0,
    }
    assert base.x_m > 0.01
    until(lambda: driver.report("odometry") == expected)
    peer.disturb(Disturbance.SILENCE)
    until(lambda: driver.report("odometry") == {})


def test_pictures_are_camera_frames(mobile: tuple[RosBaseDriver, RosPeer]) -> None:
    driver, peer = mobile
    frames: list[Any] = []

    def arrives() -> bool:
        frame = driver.frame("eyes")
        if frame is not None:
            frames.append(frame)
        return bool(frames)

    until(arrives)
    assert (frames[0].width, frames[0].height) == (160, 120)
    assert simplejpeg.decode_jpeg(frames[0].content).shape == (120, 160, 3)
    assert frames[0].taken_s <= time.monotonic()
    peer.disturb(Disturbance.SILENCE)
    until(lambda: driver.frame("eyes") is None)
    with pytest.raises(DriverError, match="names no topic for 'chest'"):
        driver.frame("chest")


@pytest.mark.parametrize("picture", [image(COLOURS, "bgr8"), image(DEPTHS_MM, "16UC1")], ids=["bgr8", "16UC1"])
def test_raw_pictures_are_frames_and_scans_are_streams(picture: dict[str, Any]) -> None:
    peer = RosPeer(QBO)
    raw, scan = as_json(picture), as_json(MESSAGES["/scan"][1])

    def offer(robot: Any, server: Any) -> None:
        server.types = {**server.types, "/image": "sensor_msgs/Image", "/scan": "sensor_msgs/LaserScan"}
        step = robot.step

        def publish() -> None:
            step()
            server.publish("/image", raw)
            server.publish("/scan", scan)

        robot.step = publish

    peer.change(offer)
    sonar = "sonar"
    options = {**peer.options(), "cameras": {"eyes": {"raw": "/image"}}, "scans": {sonar: "/scan"}}
    driver = drivers.load("ros")(QBO, ROBOTS / "qbo", options, "qbo")
    assert isinstance(driver, RosBaseDriver)
    driver.connect()
    frames: list[Any] = []
    until(lambda: frames.append(driver.frame("eyes")) or frames[-1] is not None)  # type: ignore[func-returns-value]
    assert (frames[-1].width, frames[-1].height) == (64, 48)
    assert simplejpeg.decode_jpeg(frames[-1].content).shape == (48, 64, 3)
    until(lambda: driver.report(sonar).get("range_m.1") == pytest.approx(1.41))
    peer.disturb(Disturbance.CONNECTION)
    until(lambda: driver.report(sonar) == {})
    driver.close()
    peer.close()


@pytest.mark.parametrize("cut", [0, 1, 2, 10, 150])
def test_other_data_are_no_picture(cut: int) -> None:
    picture = simplejpeg.encode_jpeg(np.zeros((120, 160, 3), np.uint8))
    assert jpeg_size(picture) == (160, 120)
    with pytest.raises(ValueError, match="no JPEG"):
        jpeg_size(picture[:cut])
    with pytest.raises(ValueError, match="no JPEG"):
        jpeg_size(b"\x89PNG" + picture)


# ------------------------------------------------------------ options


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"speed": 1}, "driver 'ros' has no option 'speed'; it has: connection, address, certificate_authority"),
        ({"command": {}}, r"missing required field `topic` - at `\$.command`"),
        ({"command": {"topic": "/c", "speed": 1}}, r"unknown field `speed` - at `\$.command`"),
        ({"connection": "rospy", "ros": 2}, 'use "rosbridge" with ROS 2'),
        ({"master": "robot"}, "master"),
        ({"ros": 3}, "Invalid enum value 3"),
        ({"address": "robot:port"}, "address"),
        ({"names": {"thumb": "thumb_joint"}}, "robot type 'ur5' has no 'thumb'; it has: shoulder_pan"),
        ({"cameras": {"eye": "/camera"}}, "option 'cameras': robot type 'ur5' has no 'eye'; it has: none"),
        ({"names": {"elbow": "wrist_1"}}, "two joints have the same name"),
        ({"command": {"topic": "/c", "kind": "positions"}}, "must list the joints of /c in the controller's order"),
        ({"command": {"topic": "/c", "joints": ["elbow"]}}, "each joint must be listed once, .* check shoulder_lift"),
        ({"command": [{"topic": "/c"}, {"topic": "/d"}]}, "must list the joints of /c"),
        ({"command": [{"topic": "/c", "joints": ["elbow"]}, {"topic": "/d", "joints": ["elbow"]}]}, "check elbow"),
        ({"command": [{"topic": "/c", "joints": ["thumb"]}]}, "check .*thumb"),
        ({"command": [{"topic": "/c", "joints": NAMES[:3]}, {"topic": "/c/", "joints": NAMES[3:]}]}, "the same topic"),
        ({"certificate_authority": "ca.pem"}, "needs an address with wss://"),
        ({"scans": {"lidar": "/scan"}}, "option 'scans': robot type 'ur5' has no 'lidar'"),
        ({"command": {"topic": "/c", "rate_hz": 10}}, "at least two command intervals"),
        ({"base": {"cmd_vel": "/cmd_vel"}}, "option 'base'"),
    ],
)
def test_wrong_options_are_rejected(changes: dict[str, object], message: str) -> None:
    options: dict[str, object] = {"command": {"topic": "/arm/command"}, **changes}
    with pytest.raises(DriverError, match=message):
        drivers.load("ros")(TYPE, UR5, options, "arm")
