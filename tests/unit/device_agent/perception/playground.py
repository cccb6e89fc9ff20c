"""A room of primitives with a person, two mobile robots and an arm, observed by a noisy lidar and depth camera."""

import math
import random
from dataclasses import dataclass, field

import mujoco
import numpy as np

from device_agent.perception.background_model import BackgroundModel
from device_agent.perception.object_classes import Mount, ObjectClass
from device_agent.perception.occupancy_grid import OccupancyGrid
from device_agent.perception.sensor_fusion import SensorFusion, Zone
from device_agent.ports.sensor import Image, Scan

LOWER_M, UPPER_M = (-3.0, -2.5), (3.0, 2.5)
KINDS = (
    ObjectClass(name="person", lowest_m=1.3, highest_m=2.1, radius_m=0.1, several=True),
    ObjectClass(name="nao", lowest_m=0.51, highest_m=0.64, radius_m=0.07, fastest_m_s=0.3),
    ObjectClass(name="qbo", lowest_m=0.38, highest_m=0.51, radius_m=0.13, fastest_m_s=0.6),
)
MOUNTS = (Mount(name="arm", lowest_m=0.78, highest_m=0.95, radius_m=0.05, near_m=(1.9, 1.6), reach_m=1.0),)
ARM_M = (1.95, 1.5)
WIDTH, HEIGHT, FOVY_RAD = 320, 240, math.radians(62)
FURNITURE = {  # name: middle and half size
    "shelf": ((-2.8, 0.8, 0.9), (0.18, 0.5, 0.9)),
    "desk": ((-1.4, 2.2, 0.72), (0.7, 0.3, 0.02)),
    "cupboard": ((0.9, -2.3, 0.5), (0.5, 0.2, 0.5)),
    "bin": ((-2.6, -2.2, 0.2), (0.15, 0.15, 0.2)),
    "table": ((1.95, 1.6, 0.73), (0.6, 0.5, 0.02)),
}
_PERSON = """<geom type="capsule" fromto="0 0 0.95 0 0 1.35" size="0.15" mass="1"/>
  <geom type="sphere" pos="0 0 1.62" size="0.11"/>
  <body pos="0 0.1 0.9"><joint name="left" axis="0 1 0"/>
    <geom type="capsule" fromto="0 0 0 0 0 -0.82" size="0.065"/></body>
  <body pos="0 -0.1 0.9"><joint name="right" axis="0 1 0"/>
    <geom type="capsule" fromto="0 0 0 0 0 -0.82" size="0.065"/></body>"""
_NAO = """<geom type="box" pos="0 0 0.38" size="0.05 0.07 0.09"/><geom type="sphere" pos="0 0 0.52" size="0.055"/>
  <geom type="box" pos="0 0.05 0.15" size="0.04 0.03 0.15"/>
  <geom type="box" pos="0 -0.05 0.15" size="0.04 0.03 0.15"/>"""
_QBO = """<geom type="cylinder" pos="0 0 0.14" size="0.15 0.13"/><geom type="sphere" pos="0 0 0.34" size="0.12"/>"""


def xml() -> str:
    boxes = [((side * 3.05, 0.0, 1.35), (0.05, 2.6, 1.35)) for side in (1, -1)]  # walls
    boxes += [((0.0, side * 2.55, 1.35), (3.1, 0.05, 1.35)) for side in (1, -1)]
    static = "".join(
        f'<geom type="box" pos="{" ".join(map(str, at))}" size="{" ".join(map(str, half))}"/>'
        for at, half in [*boxes, *FURNITURE.values()]
    )
    walkers = "".join(
        f'<body name="{name}"><freejoint name="{name}"/>{inside}</body>'
        for name, inside in (("person", _PERSON), ("nao", _NAO), ("qbo", _QBO))
    )
    arm = """<body name="arm" pos="1.95 1.5 0.75"><geom type="cylinder" pos="0 0 0.08" size="0.075 0.08"/>
      <body pos="0 0 0.16"><joint name="turn" axis="0 0 1"/>
      <geom type="capsule" fromto="0 0 0 -0.4 0 0.25" size="0.06"/>
      <geom type="capsule" fromto="-0.4 0 0.25 -0.75 0 0.1" size="0.05"/></body></body>"""
    return f"""<mujoco><compiler angle="radian"/><option gravity="0 0 0"/><worldbody>
      <geom type="plane" size="3.2 2.7 0.1"/>{static}
      <body name="lidar" pos="0 -2.4 0.3"><geom type="cylinder" size="0.04 0.03"/></body>{walkers}{arm}
    </worldbody></mujoco>"""


@dataclass
class Walker:
    """Moves straight from one random place to the next and rests there."""

    rng: random.Random
    speed_m_s: float
    area_m: tuple[float, float, float, float]
    rest_s: float
    x_m: float = 0.0
    y_m: float = 0.0
    yaw_rad: float = 0.0
    walked_m: float = 0.0
    _goal: tuple[float, float] | None = None
    _rest_s: float = 0.0

    def step(self, elapsed_s: float) -> None:
        if self._rest_s > 0:
            self._rest_s -= elapsed_s
            return
        if self._goal is None:
            low_x, low_y, high_x, high_y = self.area_m
            self._goal = self.rng.uniform(low_x, high_x), self.rng.uniform(low_y, high_y)
        x, y = self._goal[0] - self.x_m, self._goal[1] - self.y_m
        left = math.hypot(x, y)
        step_m = min(left, self.speed_m_s * elapsed_s)
        self.yaw_rad = math.atan2(y, x)
        self.x_m += x / max(left, 1e-9) * step_m
        self.y_m += y / max(left, 1e-9) * step_m
        self.walked_m += step_m
        if left < 0.02:
            self._goal, self._rest_s = None, self.rng.uniform(0, self.rest_s)


@dataclass
class SyntheticRoom:
    """The room, its walkers and its sensors, in simulated time."""

    seed: int = 1
    time_s: float = 0.0
    walkers: dict[str, Walker] = field(default_factory=dict)

    def __post_init__(self) -> None:
        rng = random.Random(self.seed)
        self.noise = np.random.default_rng(self.seed)
        self.model = mujoco.MjModel.from_xml_string(xml())
        self.data = mujoco.MjData(self.model)
        self.walkers = {
            "person": Walker(rng, 0.9, (-2.2, -1.9, 2.4, 0.7), 3.0, x_m=-1.0),
            "nao": Walker(rng, 0.1, (-2.0, -0.2, -0.6, 1.4), 6.0, x_m=-1.5, y_m=0.6),
            "qbo": Walker(rng, 0.35, (0.3, -1.6, 2.2, 0.4), 4.0, x_m=1.4, y_m=-0.5),
        }
        across, up = np.meshgrid(
            (np.arange(0, WIDTH, 2) + 0.5 - WIDTH / 2), (HEIGHT / 2 - np.arange(0, HEIGHT, 2) - 0.5)
        )
        per_pixel = 2 * math.tan(FOVY_RAD / 2) / HEIGHT
        self.sight_lines = np.column_stack((across.ravel() * per_pixel, up.ravel() * per_pixel, -np.ones(across.size)))
        self.camera_m = np.array([-2.9, -2.3, 2.4])
        back = self.camera_m - (0.3, 0.2, 0.4)  # minus the point at which the camera points
        back /= np.linalg.norm(back)
        right = np.cross([0, 0, 1], back)
        right /= np.linalg.norm(right)
        self.camera = np.column_stack((right, np.cross(back, right), back))
        self.place()

    def place(self) -> None:
        for name, walker in self.walkers.items():
            at = self.model.joint(name).qposadr[0]
            half = walker.yaw_rad / 2
            self.data.qpos[at : at + 7] = [walker.x_m, walker.y_m, 0, math.cos(half), 0, 0, math.sin(half)]
        swing = 0.45 * math.sin(self.walkers["person"].walked_m / 0.65 * math.pi)
        self.data.joint("left").qpos[0] = swing
        self.data.joint("right").qpos[0] = -swing
        self.data.joint("turn").qpos[0] = 1.3 * math.sin(self.time_s * 0.4)
        mujoco.mj_kinematics(self.model, self.data)

    def step(self, elapsed_s: float) -> None:
        self.time_s += elapsed_s
        for walker in self.walkers.values():
            walker.step(elapsed_s)
        self.place()

    def clear(self) -> None:
        """Move all people and robots out of the room."""
        for name in self.walkers:
            self.data.joint(name).qpos[2] = 50.0
        self.model.body("arm").pos[2] = 50.0
        mujoco.mj_kinematics(self.model, self.data)

    def _cast(self, origin: np.ndarray, directions: np.ndarray, excluded_body: int) -> np.ndarray:
        distance, geoms = np.empty(len(directions)), np.empty(len(directions), dtype=np.int32)
        mujoco.mj_multiRay(
            self.model, self.data, origin, np.ascontiguousarray(directions).ravel(), None, True, excluded_body, geoms,
            distance, None, len(directions), 30.0,
        )  # fmt: skip
        return np.where(geoms >= 0, distance, np.inf)

    def scan(self) -> Scan:
        angle = np.linspace(0, 2 * math.pi, 360, endpoint=False)
        body = self.model.body("lidar").id
        origin = np.array([0.0, -2.4, 0.3])
        distance = self._cast(origin, np.column_stack((np.cos(angle), np.sin(angle), np.zeros(360))), body)
        distance += self.noise.normal(0, 1, 360) * np.maximum(
            0.005, 0.01 * np.where(np.isfinite(distance), distance, 0)
        )
        return Scan(taken_s=self.time_s, position_m=origin, rotation=np.eye(3), angle_rad=angle, range_m=distance,
                    nearest_m=0.15, furthest_m=12.0)  # fmt: skip

    def depth(self) -> Image:
        directions = self.sight_lines @ self.camera.T
        length = np.linalg.norm(directions, axis=1)
        z = self._cast(self.camera_m, directions / length[:, None], -1) / length
        z += self.noise.normal(0, 1, len(z)) * (0.0012 + 0.0019 * (np.where(np.isfinite(z), z, 0) - 0.4) ** 2)
        depth = np.full((HEIGHT, WIDTH), np.inf, dtype=np.float32)
        depth[::2, ::2] = np.where(z < 8.0, z, np.inf).reshape(HEIGHT // 2, WIDTH // 2)
        return Image(
            taken_s=self.time_s, position_m=self.camera_m, rotation=self.camera, fovy_rad=FOVY_RAD, depth_m=depth
        )

    def in_view(self, name: str) -> bool:
        """Whether an object's centre is visible to the depth camera."""
        walker = self.walkers[name]
        offset = (np.array([walker.x_m, walker.y_m, 0.3]) - self.camera_m) @ self.camera
        per_pixel = 2 * math.tan(FOVY_RAD / 2) / HEIGHT
        across, up = (abs(offset[:2]) / -offset[2] / per_pixel).tolist()
        return bool(across < WIDTH / 2 and up < HEIGHT / 2)


def survey(seed: int = 7) -> BackgroundModel:
    """The background model of the empty room."""
    scene, background = SyntheticRoom(seed), BackgroundModel()
    scene.clear()
    for _ in range(10):
        background.add("lidar", scene.scan())
        background.add("depth", scene.depth())
    background.fit()
    return background


def make_fusion(background: BackgroundModel) -> SensorFusion:
    return SensorFusion(
        grid=OccupancyGrid((-3.2, -2.7), (3.2, 2.7)),
        background=background,
        kinds=KINDS,
        mounts=MOUNTS,
        inside=(*LOWER_M, *UPPER_M),
        zones=(Zone("west", (-3.0, -2.5, 0.0, 2.5)), Zone("east", (0.0, -2.5, 3.0, 2.5))),
    )


def run(scene: SyntheticRoom, fusion: SensorFusion, seconds: float, *, period_s: float = 0.2, on_sample=None) -> None:
    """Sample every ``period_s``; ``on_sample(scene, fusion)`` is called half a period later."""
    for _ in range(round(seconds / period_s)):
        scene.step(period_s / 2)
        fusion.update("lidar", scene.scan())
        fusion.update("depth", scene.depth())
        fusion.advance(scene.time_s)
        scene.step(period_s / 2)
        if on_sample is not None:
            on_sample(scene, fusion)
