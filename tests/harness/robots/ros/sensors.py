"""Sensors with ROS: an emulated rosbridge server, or a node of ROS 1."""

import base64
import contextlib
import json
import math
import subprocess
import threading
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import simplejpeg

from device_agent.ports.threads import SupervisedThread
from tests.harness.robots.ros.ros_system import PYTHON, RosSystem, end
from tests.harness.robots.ros.rosbridge_server import RosbridgeServer

PERIOD_S = 0.02
COLOURS = np.random.default_rng(1).integers(0, 256, (48, 64, 3), np.uint8)
DEPTHS_MM = np.arange(48 * 64, dtype=np.uint16).reshape(48, 64)
POINTS = np.random.default_rng(2).uniform(-5, 5, (5000, 3)).astype(np.float32)
RANGES_M = [math.inf, math.nan, 0.01, 50.0, *(1.0 + 0.01 * index for index in range(356))]
_NODE = Path(__file__).with_name("rospy_sensors.py")


def image(pixels: Any, encoding: str, *, padding: int = 0) -> dict[str, Any]:
    """An Image; ``padding``: unused bytes at the end of each row."""
    height, width = pixels.shape[:2]
    rows = [row.tobytes() + bytes(padding) for row in pixels]
    return {
        "height": height, "width": width, "encoding": encoding, "is_bigendian": 0, "step": len(rows[0]),
        "data": b"".join(rows),
    }  # fmt: skip


def cloud(points: Any) -> dict[str, Any]:
    """A PointCloud2 with an intensity between the coordinates, and a point that is not finite."""
    rows = np.zeros((len(points) + 1, 6), np.float32)
    rows[:-1, [1, 3, 4]] = points
    rows[-1, 1] = math.nan
    names = {"x": 4, "intensity": 8, "y": 12, "z": 16}
    fields = [{"name": name, "offset": offset, "datatype": 7, "count": 1} for name, offset in names.items()]
    return {
        "height": 1, "width": len(rows), "fields": fields, "is_bigendian": False, "point_step": 24,
        "row_step": 24 * len(rows), "data": rows.tobytes(), "is_dense": False,
    }  # fmt: skip


MESSAGES: Mapping[str, tuple[str, dict[str, Any]]] = {
    "/scan": (
        "sensor_msgs/LaserScan",
        {
            "angle_min": -math.pi, "angle_increment": math.pi / 180, "range_min": 0.1, "range_max": 12.0,
            "ranges": RANGES_M,
        },
    ),
    "/camera": ("sensor_msgs/Image", image(COLOURS, "rgb8")),
    "/camera/compressed": (
        "sensor_msgs/CompressedImage", {"format": "jpeg", "data": simplejpeg.encode_jpeg(COLOURS)}
    ),
    "/depth": ("sensor_msgs/Image", image(DEPTHS_MM, "16UC1")),
    "/points": ("sensor_msgs/PointCloud2", cloud(POINTS)),
}  # fmt: skip
TOPICS = {
    "lidar": "/scan",
    "camera": "/camera",
    "compressed_camera": "/camera/compressed",
    "depth_camera": "/depth",
    "point_cloud": "/points",
}
"""Kind of the device → topic."""


def as_json(message: Mapping[str, Any]) -> dict[str, Any]:
    """Binary data as Base64."""
    return {
        name: base64.b64encode(value).decode() if isinstance(value, bytes) else value for name, value in message.items()
    }


class RosbridgeSensors:
    """A rosbridge server whose topics carry ``messages``, which tests may change."""

    def __init__(self, ros: int = 1) -> None:
        self.messages = {topic: as_json(message) for topic, (_, message) in MESSAGES.items()}
        types = {topic: kind if ros == 1 else kind.replace("/", "/msg/") for topic, (kind, _) in MESSAGES.items()}
        self.server = RosbridgeServer(types, lambda _topic, _message: None, ros, lambda _number, _goal: None)
        self._lock = threading.Lock()
        self._stopping = threading.Event()
        self._thread = SupervisedThread(self._run, name="sensors", part="sensors", stopping=self._stopping)
        self._thread.start()

    @property
    def options(self) -> dict[str, object]:
        """Options of a driver."""
        return {"address": f"127.0.0.1:{self.server.port}"}

    def change(self, topic: str, **fields: object) -> None:
        """Change fields of a message. A topic whose message is empty is silent."""
        with self._lock:
            self.messages[topic] = {**self.messages[topic], **fields} if fields else {}

    def stop(self) -> None:
        """Close all connections, and refuse new ones."""
        with self._lock:
            self.server.stop()

    def restart(self) -> None:
        """Accept connections again."""
        with self._lock:
            self.server.restart()

    def close(self) -> None:
        self._stopping.set()
        self._thread.join()
        self.server.stop()

    def _run(self) -> None:
        while not self._stopping.wait(PERIOD_S):
            with self._lock:
                self.server.step()
                for topic, message in self.messages.items():
                    if message and self.server.subscribers(topic):
                        self.server.publish(topic, message)


@contextlib.contextmanager
def rospy_sensors(system: RosSystem, folder: Path) -> Iterator[dict[str, object]]:
    """A node that publishes the messages; supplies the options of a driver."""
    file = folder / "messages.json"
    file.write_text(json.dumps({topic: (kind, as_json(message)) for topic, (kind, message) in MESSAGES.items()}))
    process = system.start(PYTHON, "-I", str(_NODE), str(file), stdin=subprocess.PIPE)
    assert process.stdout is not None
    assert process.stdout.readline() == "ready\n"
    yield {"connection": "rospy", "master": system.uri}
    end(process, 9)
