"""Offscreen rendering for all cameras of one simulated room: one thread, one frame buffer per image size.

Software renderers (OSMesa) are slow to create, use about 127 MB and belong to the thread that created them. Shadows,
reflections and multisampling are off: they reduce 211 frames/s to 25 at 320 x 240 (measured). Each geom costs about
20 µs, so geoms outside the view are hidden, and depth is rendered without lights and textures. In the laboratory this
saves 10 to 30 % of a colour frame and about half of a depth frame (measured).
"""

import contextlib
import copy
import math
import os
import queue
import sys
import threading
import time
import weakref
from concurrent.futures import Future
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np
import numpy.typing as npt

from device_agent.ports.sensor import Bytes, Depths, Floats, SensorError
from device_agent.ports.simulation import SimulatedWorld
from device_agent.ports.threads import Recovery, SupervisedThread
from device_agent.simulation import offscreen

TIMEOUT_S = 5.0
_RESPONSE_S = 15.0
"""A frame that is not rendered within this time is abandoned."""
_MAX_GEOMS = 5000
_CHANGING = ("light_diffuse", "light_ambient", "light_active", "geom_rgba", "geom_size", "geom_rbound", "mat_rgba")
"""Model fields that a process of the world may change at runtime."""
_NICE = 5
"""Rendering has a lower priority than stepping the world. Under heavy load the laboratory world lost 0.6 and 0.9 s of
60 s without this, and 0, 0 and 0.3 s with it."""
_HIDDEN = 5
"""A geom group that MuJoCo does not draw by default."""
_SMALLEST_PX = 1.0
"""Geoms smaller than a pixel would flicker."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RenderedImage:
    """One rendered image.

    Attributes:
        taken_s: ``time.monotonic()`` of the rendered state [s].
        pixels: Colours, shape (height, width, 3), or depth, shape (height, width) [m].
        position_m: Camera position, shape (3,) [m].
        rotation: Camera axes as columns, shape (3, 3).
    """

    taken_s: float
    pixels: Bytes | Depths
    position_m: Floats
    rotation: Floats


@dataclass(frozen=True, slots=True)
class _Job:
    camera: int
    size: tuple[int, int]
    depth: bool
    future: "Future[RenderedImage]"


class Renderer:
    """Renders images of one world. ``render`` is thread-safe.

    The thread starts with the first image and ends, with its frame buffers, when the last user closes.
    """

    def __init__(self, world: SimulatedWorld) -> None:
        self._world = world
        self._life = threading.Lock()
        self._users = 0
        self._jobs: queue.SimpleQueue[_Job | None] = queue.SimpleQueue()
        self._thread: SupervisedThread | None = None
        self._stopping = threading.Event()

    def open(self) -> None:
        """Register a user."""
        with self._life:
            self._users += 1

    def close(self) -> None:
        """Unregister a user; one call for each ``open``."""
        with self._life:
            self._users = max(0, self._users - 1)
            if self._users or self._thread is None:
                return
            thread, self._thread = self._thread, None
            self._stopping.set()
            self._jobs.put(None)
        thread.join(timeout=TIMEOUT_S)

    def render(self, camera: int, *, width: int, height: int, depth: bool = False) -> RenderedImage:
        """Render the current view of a camera.

        Args:
            camera: Index in the model.
            width: Image width [px].
            height: Image height [px].
            depth: Render distances instead of colours.

        Raises:
            SensorError: Rendering is not available or timed out.
        """
        future: Future[RenderedImage] = Future()
        with self._life:
            if not self._users:
                raise SensorError("the camera is not connected")
            if self._thread is None:
                self._jobs, self._stopping = queue.SimpleQueue(), threading.Event()
                self._thread = _start(self._world, self._jobs, self._stopping)
            self._jobs.put(_Job(camera, (width, height), depth, future))
        try:
            return future.result(timeout=TIMEOUT_S)
        except TimeoutError as error:
            future.cancel()
            raise SensorError(f"no image within {TIMEOUT_S:.0f} s; the machine is overloaded") from error


def _start(
    world: SimulatedWorld, jobs: "queue.SimpleQueue[_Job | None]", stopping: threading.Event
) -> SupervisedThread:
    thread = SupervisedThread(
        lambda: _draw(world, jobs, thread),
        name="renderer",
        part="renderer",
        stopping=stopping,
        recovery=Recovery.RESTART,
    )
    thread.start()
    return thread


def _draw(world: SimulatedWorld, jobs: "queue.SimpleQueue[_Job | None]", thread: SupervisedThread) -> None:
    """Process jobs one by one; runs in the renderer's thread."""
    if sys.platform == "linux":  # only Linux has thread priorities; the GL threads inherit this one
        os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), _NICE)
    view: _View | None = None
    while True:
        thread.beat(math.inf)
        if (job := jobs.get()) is None:
            break
        thread.beat(_RESPONSE_S)
        if not job.future.set_running_or_notify_cancel():
            continue
        try:
            view = view or _View(world)
            job.future.set_result(view.draw(job))
        except Exception as error:  # noqa: BLE001 (report every failure to the waiting caller)
            job.future.set_exception(
                error if isinstance(error, SensorError) else SensorError(f"rendering failed: {error}")
            )
    if view is not None:
        view.close()


class _View:
    """A copy of the model and state, and the frame buffers; used by the renderer's thread only."""

    def __init__(self, world: SimulatedWorld) -> None:
        self._world = world
        self._model = copy.copy(world.model)
        quality = self._model.vis.quality
        quality.offsamples, quality.shadowsize = 0, 0
        # Fewer faces for round geoms halve the time; the difference is not visible at these sizes.
        quality.numslices, quality.numstacks = 12, 7
        self._data = mujoco.MjData(self._model)
        self._groups = self._model.geom_group.copy()
        self._frame_buffers: dict[tuple[int, int], _FrameBuffer] = {}

    def draw(self, job: _Job) -> RenderedImage:
        """Render one image."""
        # Processes change lights and colours of the world's model.
        for changing in _CHANGING:
            getattr(self._model, changing)[:] = getattr(self._world.model, changing)
        self._world.copy(self._data)
        taken_s = time.monotonic()
        if job.size not in self._frame_buffers:
            self._frame_buffers[job.size] = _FrameBuffer(self._model, *job.size)
        seen = _in_view(self._model, self._data, job.camera, *job.size)
        self._model.geom_group[:] = np.where(seen, self._groups, _HIDDEN)
        return RenderedImage(
            taken_s=taken_s,
            pixels=self._frame_buffers[job.size].draw(self._data, job.camera, depth=job.depth),
            position_m=self._data.cam_xpos[job.camera].copy(),
            rotation=self._data.cam_xmat[job.camera].reshape(3, 3).copy(),
        )

    def close(self) -> None:
        """Free the frame buffers; call it in the thread that created them."""
        for frame_buffer in self._frame_buffers.values():
            frame_buffer.close()


def _in_view(model: Any, data: Any, camera: int, width: int, height: int) -> npt.NDArray[np.bool_]:
    """Geoms whose bounding sphere intersects the view, shape (geoms,)."""
    if model.cam_sensorsize[camera].any():  # sensor-based intrinsics may be off-axis: draw all geoms
        return np.ones(model.ngeom, dtype=np.bool_)
    up = float(np.tan(np.radians(model.cam_fovy[camera]) / 2))
    aside = up * width / height
    right_m, top_m, behind_m = ((data.geom_xpos - data.cam_xpos[camera]) @ data.cam_xmat[camera].reshape(3, 3)).T
    ahead_m, radius_m = -behind_m, model.geom_rbound
    inside = (
        (ahead_m > -radius_m)
        & (np.abs(right_m) - aside * ahead_m < radius_m * np.hypot(1, aside))
        & (np.abs(top_m) - up * ahead_m < radius_m * np.hypot(1, up))
        & (radius_m * height > _SMALLEST_PX * up * ahead_m)
    )
    seen: npt.NDArray[np.bool_] = inside | (radius_m == 0)  # a plane is infinite and has no bounding sphere
    return seen


class _FrameBuffer:
    """An offscreen context of one size."""

    def __init__(self, model: Any, width: int, height: int) -> None:
        whole = model.vis.global_
        whole.offwidth, whole.offheight = max(width, whole.offwidth), max(height, whole.offheight)
        self._model = model
        self._rect = mujoco.MjrRect(0, 0, width, height)
        self._scene = mujoco.MjvScene(model=model, maxgeom=_MAX_GEOMS)
        self._coloured, self._bare = mujoco.MjvOption(), mujoco.MjvOption()
        self._bare.flags[int(mujoco.mjtVisFlag.mjVIS_TEXTURE)] = 0
        self._camera = mujoco.MjvCamera()
        self._camera.type = mujoco.mjtCamera.mjCAMERA_FIXED
        self._screen = offscreen.select().create(width, height)
        self._screen.make_current()
        self._context = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100)
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN, self._context)
        self._context.readDepthMap = mujoco.mjtDepthMap.mjDEPTH_ZEROFAR  # more precise at large distances
        flags = mujoco.mjtRndFlag
        for flag in (flags.mjRND_SHADOW, flags.mjRND_REFLECTION, flags.mjRND_SKYBOX, flags.mjRND_FOG, flags.mjRND_HAZE):
            self._scene.flags[int(flag)] = 0
        extent = model.stat.extent
        self._near_m, self._far_m = model.vis.map.znear * extent, model.vis.map.zfar * extent

    def draw(self, data: Any, camera: int, *, depth: bool) -> Bytes | Depths:
        """The camera's view, first row at the top: colours, or distances [m]."""
        self._camera.fixedcamid = camera
        every = mujoco.mjtCatBit.mjCAT_ALL.value
        option = self._bare if depth else self._coloured
        mujoco.mjv_updateScene(self._model, data, option, None, self._camera, every, self._scene)
        if depth:
            self._scene.nlight = 0
        self._screen.make_current()
        mujoco.mjr_render(self._rect, self._scene, self._context)
        height, width = self._rect.height, self._rect.width
        if not depth:
            rgb = np.empty((height, width, 3), dtype=np.uint8)
            mujoco.mjr_readPixels(rgb, None, self._rect, self._context)
            return np.ascontiguousarray(rgb[::-1])
        buffer = np.empty((height, width), dtype=np.float32)
        mujoco.mjr_readPixels(None, buffer, self._rect, self._context)
        # From the depth buffer, 1 at the near plane and 0 at the far one: z = n f / (n + b (f - n)).
        buffer *= np.float32(self._far_m - self._near_m)
        buffer += np.float32(self._near_m)
        depth_m: Depths = np.divide(np.float32(self._near_m * self._far_m), buffer[::-1], dtype=np.float32)
        return np.ascontiguousarray(depth_m)

    def close(self) -> None:
        """Free the context."""
        with contextlib.suppress(Exception):  # the context may already be destroyed
            self._screen.make_current()
            self._context.free()
            self._screen.free()


_renderers: "weakref.WeakKeyDictionary[SimulatedWorld, Renderer]" = weakref.WeakKeyDictionary()
_renderers_lock = threading.Lock()


def renderer_of(world: SimulatedWorld) -> Renderer:
    """The renderer of this world."""
    with _renderers_lock:
        if world not in _renderers:
            _renderers[world] = Renderer(weakref.proxy(world))
        return _renderers[world]
