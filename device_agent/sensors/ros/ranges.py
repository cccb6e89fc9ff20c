"""Lidars and point clouds over ROS."""

import json

import numpy as np

from device_agent.middleware.ros import scans
from device_agent.middleware.ros.scans import LaserScan, PointCloud2
from device_agent.ports.clock import wall_ms
from device_agent.ports.sensor import Capture, Frame, Scan, Values
from device_agent.protocol import camera_frames
from device_agent.sensors.frames import declared_camera
from device_agent.sensors.ros.base import RosSensor

_RANGE = "range"


class Lidar(RosSensor):
    """Stream ``range``: the smallest distance in each of eight sectors. Frames and capture ``scan``: all beams."""

    TYPE, MESSAGE = "sensor_msgs/LaserScan", LaserScan
    STREAMS, CAPTURES = (_RANGE,), ("scan",)
    FRAMES = (camera_frames.SCAN,)

    def check(self, message: LaserScan) -> None:
        """See ``RosSensor``."""
        scans.beams(message)

    def read(self, stream: str) -> Values:
        """See ``RoomDriver``."""
        return scans.sectors(self.newest()[0]) if stream == _RANGE else super().read(stream)

    def frame(self, camera: str) -> Frame:
        """See ``ports.sensor.Camera``."""
        declared_camera(self.device, camera)
        return self.raw().frame()

    def capture(self, name: str) -> Capture:
        """See ``RoomDriver``."""
        if name not in self.CAPTURES:
            return super().capture(name)
        return self.raw().capture()

    def raw(self) -> Scan:
        """See ``RoomDriver``."""
        message, at_s = self.newest()
        (angle_rad, range_m), (position_m, rotation) = scans.beams(message), self.pose()
        return Scan(
            taken_s=at_s,
            position_m=position_m,
            rotation=rotation,
            angle_rad=angle_rad,
            range_m=range_m,
            nearest_m=message.range_min,
            furthest_m=message.range_max,
        )


class PointCloud(RosSensor):
    """Stream ``range``: number of points, and distance of the nearest one. Capture ``cloud``: points as JSON."""

    TYPE, MESSAGE = "sensor_msgs/PointCloud2", PointCloud2
    STREAMS, CAPTURES = (_RANGE,), ("cloud",)

    def check(self, message: PointCloud2) -> None:
        """See ``RosSensor``."""
        scans.points(message)

    def read(self, stream: str) -> Values:
        """See ``RoomDriver``."""
        if stream != _RANGE:
            return super().read(stream)
        found = scans.points(self.newest()[0])
        nearest = {"nearest_m": round(float(np.linalg.norm(found, axis=1).min()), 4)} if len(found) else {}
        return {"points": float(len(found)), **nearest}

    def capture(self, name: str) -> Capture:
        """See ``RoomDriver``."""
        if name not in self.CAPTURES:
            return super().capture(name)
        found = scans.points(self.newest()[0]).astype(np.float64)
        position_m, rotation = self.pose()
        in_room = found @ rotation.T + position_m
        content = {"at_ms": wall_ms(), "points_m": np.round(in_room, 4).tolist()}
        return Capture("application/json", json.dumps(content).encode())
