"""Draws what the cameras of one simulated room see: one thread, one renderer for each size, for all of them.

Software renderers (OSMesa) are slow to make and large (about 127 MB), and belong to the thread that made them. Shadows,
reflections and multisampling are off: with them a picture takes eight times as long (25 instead of 211 a second at
320 x 240, measured). What is left is a fixed price for each geom, some 20 microseconds: so what a camera cannot see is
left out before anything is drawn, and depth is drawn without lamps and textures. In the laboratory a picture in colour
takes 10 to 30 % less for it, one of depth about half (measured).
"""

import contextlib
import copy
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

WITHIN_S = 5.0
"""A picture that is not there after so long never comes."""
_MOST_GEOMS = 5000
_CHANGING = ("light_diffuse", "light_ambient", "light_active", "geom_rgba", "mat_rgba")
"""Of the model: what a process of the world may change while it goes on."""
_NICE = 5
"""Drawing gives way to what moves robots and steps the world. On a machine with much other work the laboratory lost
0.6 and 0.9 s of 60 without it; with it 0, 0 and 0.3 s."""
_HIDDEN = 5
"""A group of geoms that MuJoCo does not draw unless told to."""
_SMALLEST_PX = 1.0
"""What is less than a pixel across would be seen in some pictures and not in others."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RenderRequest:
    """One rendered picture.

    Attributes:
        taken_s: ``time.monotonic()`` of the state that it shows [s].
        pixels: Colours, shape (height, width, 3), or depth, shape (height, width) [m].
        position_m: Of the camera, shape (3,) [m].
        rotation: Its axes as columns, shape (3, 3).
    """

    taken_s: float
    pixels: Bytes | Depths
    position_m: Floats
    rotation: Floats


@dataclass(frozen=True, slots=True)
class _Wish:
    camera: int
    size: tuple[int, int]
    depth: bool
    future: "Future[RenderRequest]"


class Renderer:
    """The renderers of one world. ``shoot`` is thread-safe.

    The thread begins with the first user and ends, with its renderers, when the last has left.
    """

    def __init__(self, world: SimulatedWorld) -> None:
        self._world = world
        self._life = threading.Lock()
        self._users = 0
        self._wishes: queue.SimpleQueue[_Wish | None] = queue.SimpleQueue()
        self._thread: threading.Thread | None = None

    def open(self) -> None:
        """Take part."""
        with self._life:
            self._users += 1

    def close(self) -> None:
        """Leave; one call for each ``open``."""
        with self._life:
            self._users = max(0, self._users - 1)
            if self._users or self._thread is None:
                return
            thread, self._thread = self._thread, None
            self._wishes.put(None)
        thread.join(timeout=WITHIN_S)

    def shoot(self, camera: int, *, width: int, height: int, depth: bool = False) -> RenderRequest:
        """What a camera sees now.

        Args:
            camera: Its index in the model.
            width: Of the picture, in pixels.
            height: The same.
            depth: Distances instead of colours.

        Raises:
            SensorError: Nothing here can draw, or it took too long.
        """
        future: Future[RenderRequest] = Future()
        with self._life:
            if not self._users:
                raise SensorError("the camera is not connected")
            if self._thread is None:
                self._wishes = queue.SimpleQueue()
                self._thread = threading.Thread(
                    target=_draw, args=(self._world, self._wishes), name="studio", daemon=True
                )
                self._thread.start()
            self._wishes.put(_Wish(camera, (width, height), depth, future))
        try:
            return future.result(timeout=WITHIN_S)
        except TimeoutError as error:
            future.cancel()
            raise SensorError(f"no picture within {WITHIN_S:.0f} s; the machine is overloaded") from error


def _draw(world: SimulatedWorld, wishes: "queue.SimpleQueue[_Wish | None]") -> None:
    """The thread: one wish after another."""
    if (
        sys.platform == "linux"
    ):  # elsewhere a thread has no priority of its own; the renderer's threads inherit this one's
        os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), _NICE)
    booth: _View | None = None
    while (wish := wishes.get()) is not None:
        if not wish.future.set_running_or_notify_cancel():
            continue
        try:
            booth = booth or _View(world)
            wish.future.set_result(booth.draw(wish))
        except Exception as error:  # noqa: BLE001 (whatever it is, who waits must hear of it, and the next may go well)
            wish.future.set_exception(
                error if isinstance(error, SensorError) else SensorError(f"nothing can be drawn: {error}")
            )
    if booth is not None:
        booth.close()


class _View:
    """What belongs to the thread alone: a copy of model and state, and the canvases."""

    def __init__(self, world: SimulatedWorld) -> None:
        self._world = world
        self._model = copy.copy(world.model)
        quality = self._model.vis.quality
        quality.offsamples, quality.shadowsize = 0, 0
        # Round things from fewer faces: half the time, and no difference that these pictures could show.
        quality.numslices, quality.numstacks = 12, 7
        self._data = mujoco.MjData(self._model)
        self._groups = self._model.geom_group.copy()
        self._canvases: dict[tuple[int, int], _FrameBuffer] = {}

    def draw(self, wish: _Wish) -> RenderRequest:
        """One picture."""
        # Lamps and blinds change lights and colours of the world's model.
        for changing in _CHANGING:
            getattr(self._model, changing)[:] = getattr(self._world.model, changing)
        self._world.copy(self._data)
        taken_s = time.monotonic()
        if wish.size not in self._canvases:
            self._canvases[wish.size] = _FrameBuffer(self._model, *wish.size)
        seen = _in_view(self._model, self._data, wish.camera, *wish.size)
        self._model.geom_group[:] = np.where(seen, self._groups, _HIDDEN)
        return RenderRequest(
            taken_s=taken_s,
            pixels=self._canvases[wish.size].draw(self._data, wish.camera, depth=wish.depth),
            position_m=self._data.cam_xpos[wish.camera].copy(),
            rotation=self._data.cam_xmat[wish.camera].reshape(3, 3).copy(),
        )

    def close(self) -> None:
        """Let the canvases go, in the thread that made them."""
        for canvas in self._canvases.values():
            canvas.close()


def _in_view(model: Any, data: Any, camera: int, width: int, height: int) -> npt.NDArray[np.bool_]:
    """Which geoms may show in a picture, by the sphere around each: shape (geoms,)."""
    if model.cam_sensorsize[camera].any():  # a lens described by its sensor may look to a side: draw everything
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
    seen: npt.NDArray[np.bool_] = inside | (radius_m == 0)  # a plane has no end, and so no sphere
    return seen


class _FrameBuffer:
    """A renderer of one size. Leaner than MuJoCo's own, which has to be chosen before MuJoCo is first imported."""

    def __init__(self, model: Any, width: int, height: int) -> None:
        whole = model.vis.global_
        whole.offwidth, whole.offheight = max(width, whole.offwidth), max(height, whole.offheight)
        self._model = model
        self._rect = mujoco.MjrRect(0, 0, width, height)
        self._scene = mujoco.MjvScene(model=model, maxgeom=_MOST_GEOMS)
        self._coloured, self._bare = mujoco.MjvOption(), mujoco.MjvOption()
        self._bare.flags[int(mujoco.mjtVisFlag.mjVIS_TEXTURE)] = 0
        self._camera = mujoco.MjvCamera()
        self._camera.type = mujoco.mjtCamera.mjCAMERA_FIXED
        self._screen = _screen()(width, height)
        self._screen.make_current()
        self._context = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100)
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN, self._context)
        self._context.readDepthMap = mujoco.mjtDepthMap.mjDEPTH_ZEROFAR  # keeps its precision far away
        flags = mujoco.mjtRndFlag
        for flag in (flags.mjRND_SHADOW, flags.mjRND_REFLECTION, flags.mjRND_SKYBOX, flags.mjRND_FOG, flags.mjRND_HAZE):
            self._scene.flags[int(flag)] = 0
        extent = model.stat.extent
        self._near_m, self._far_m = model.vis.map.znear * extent, model.vis.map.zfar * extent

    def draw(self, data: Any, camera: int, *, depth: bool) -> Bytes | Depths:
        """What a camera sees, the first row at the top: colours, or distances [m]."""
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
        """Let it go."""
        with contextlib.suppress(Exception):  # a screen that is gone already takes nothing with it
            self._screen.make_current()
            self._context.free()
            self._screen.free()


def _screen() -> Any:
    """The class of what is drawn on without a display: software, or what ``MUJOCO_GL`` names."""
    try:
        if sys.platform != "linux" or os.environ.get("MUJOCO_GL", "osmesa").lower() not in {"osmesa", "egl"}:
            from mujoco.rendering.classic.gl_context import GLContext  # noqa: PLC0415 (opens a library)
        elif os.environ.get("MUJOCO_GL", "").lower() == "egl":
            from mujoco.egl import GLContext  # noqa: PLC0415
        else:
            os.environ["MUJOCO_GL"] = "osmesa"  # the library looks there too
            from mujoco.osmesa import GLContext  # noqa: PLC0415
    except (ImportError, AttributeError, OSError, RuntimeError) as error:
        raise SensorError(
            f"nothing here can draw without a display ({error}); install libosmesa6 and pyopengl"
        ) from error
    return GLContext


_studios: "weakref.WeakKeyDictionary[SimulatedWorld, Renderer]" = weakref.WeakKeyDictionary()
_making = threading.Lock()


def studio_of(world: SimulatedWorld) -> Renderer:
    """The one of this world."""
    with _making:
        if world not in _studios:
            _studios[world] = Renderer(weakref.proxy(world))
        return _studios[world]
