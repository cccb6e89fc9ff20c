"""Offscreen OpenGL contexts for MuJoCo, from the best library of this machine.

``MUJOCO_GL`` selects ``osmesa``, ``egl`` or another backend of MuJoCo. Without it, Linux uses the first that works:
OSMesa of the system, OSMesa in the Python package ``lavavu-osmesa``, EGL. The package makes cameras work on machines
without graphics packages. A library stays in the process that loaded it, and belongs to the first context's thread.
"""

import ctypes
import importlib.util
import os
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from device_agent.ports.sensor import SensorError

_SYSTEM = tuple(f"libOSMesa.so{version}" for version in (".8", ".6", ""))
_PACKAGE, _PACKAGE_LIBRARIES = "lavavu", "lavavu_osmesa.libs"
_RGBA, _UNSIGNED_BYTE = 0x1908, 0x1401
_DEPTH_BITS, _STENCIL_BITS, _ACCUMULATION_BITS = 24, 8, 0
_FAILURES = (ImportError, AttributeError, OSError, RuntimeError)


class OffscreenContext(Protocol):
    """One OpenGL context. All calls come from the thread that created it."""

    def make_current(self) -> None:
        """Direct the thread's OpenGL calls to this context."""

    def free(self) -> None:
        """Free the context."""


@dataclass(frozen=True, slots=True)
class OffscreenBackend:
    """A usable OpenGL library.

    Attributes:
        name: For people: kind and source.
        create: A context of this width and height [px].
    """

    name: str
    create: Callable[[int, int], OffscreenContext]


@cache
def select() -> OffscreenBackend:
    """The backend of this process.

    Raises:
        SensorError: No library can be loaded.
    """
    requested = os.environ.get("MUJOCO_GL", "").lower()
    if sys.platform != "linux" or requested not in {"", "osmesa", "egl"}:
        candidates = [_mujoco]
    else:
        candidates = [] if requested == "egl" else [_osmesa]
        candidates += [] if requested == "osmesa" else [_egl]
    for candidate in candidates:
        try:
            return candidate()
        except _FAILURES:
            continue
    raise SensorError(
        "this machine has no OpenGL library for offscreen rendering; install one (Debian: apt-get install libosmesa6)"
    )


def _osmesa() -> OffscreenBackend:
    name, library = next(_osmesa_libraries(), (None, None))
    if library is None:
        raise OSError("no OSMesa")
    _name_for_mujoco(b"osmesa")
    library.OSMesaCreateContextExt.argtypes = [ctypes.c_uint, *(ctypes.c_int,) * 3, ctypes.c_void_p]
    library.OSMesaCreateContextExt.restype = ctypes.c_void_p
    library.OSMesaMakeCurrent.argtypes = [ctypes.c_void_p, ctypes.c_void_p, ctypes.c_uint, *(ctypes.c_int,) * 2]
    library.OSMesaMakeCurrent.restype = ctypes.c_ubyte
    library.OSMesaDestroyContext.argtypes = [ctypes.c_void_p]
    library.OSMesaDestroyContext.restype = None
    return OffscreenBackend(f"OSMesa ({name})", lambda width, height: _OsmesaContext(library, width, height))


def _osmesa_libraries() -> Iterator[tuple[str, ctypes.CDLL]]:
    """The libraries that can be loaded, best first. Their names are visible to the OpenGL loader of MuJoCo."""
    for name in _SYSTEM:
        try:
            yield name, ctypes.CDLL(name, ctypes.RTLD_GLOBAL)
        except OSError:
            continue
    package = importlib.util.find_spec(_PACKAGE)
    if package is None or package.origin is None:
        return
    # The files have no search path for each other: load each after those that it needs.
    pending = sorted((Path(package.origin).parents[1] / _PACKAGE_LIBRARIES).glob("*.so*"))
    while pending:
        failed = []
        for path in pending:
            wanted = path.name.startswith("libOSMesa")
            try:
                library = ctypes.CDLL(str(path), ctypes.RTLD_GLOBAL if wanted else ctypes.DEFAULT_MODE)
            except OSError:
                failed.append(path)
                continue
            if wanted:
                yield "package lavavu-osmesa", library
        if len(failed) == len(pending):
            return
        pending = failed


class _OsmesaContext:
    """A context with OSMesa's own frame buffer, which MuJoCo does not read."""

    def __init__(self, library: ctypes.CDLL, width: int, height: int) -> None:
        self._library = library
        self._pixels = np.zeros((height, width, 4), dtype=np.uint8)
        self._handle = library.OSMesaCreateContextExt(_RGBA, _DEPTH_BITS, _STENCIL_BITS, _ACCUMULATION_BITS, None)
        if not self._handle:
            raise SensorError("OSMesa cannot create a context; the machine may be out of memory")

    def make_current(self) -> None:
        height, width, _ = self._pixels.shape
        if not self._library.OSMesaMakeCurrent(self._handle, self._pixels.ctypes.data, _UNSIGNED_BYTE, width, height):
            raise SensorError("OSMesa cannot use its context")

    def free(self) -> None:
        handle, self._handle = self._handle, None
        if handle:
            self._library.OSMesaMakeCurrent(None, None, _UNSIGNED_BYTE, 0, 0)
            self._library.OSMesaDestroyContext(handle)


def _egl() -> OffscreenBackend:
    from mujoco.egl import GLContext  # noqa: PLC0415 (opens a library)

    GLContext(1, 1).free()  # finds a device and its driver
    _name_for_mujoco(b"egl")
    return OffscreenBackend("EGL", GLContext)


def _name_for_mujoco(backend: bytes) -> None:
    """Name the library for MuJoCo's OpenGL loader, which reads the environment with the first context.

    Not through ``os.environ``: child processes would inherit it, and MuJoCo cannot be imported with ``osmesa`` unless
    the system has that library.
    """
    ctypes.CDLL(None).setenv(b"MUJOCO_GL", backend, 1)


def _mujoco() -> OffscreenBackend:
    from mujoco.rendering.classic.gl_context import GLContext  # noqa: PLC0415 (opens a library)

    backend: Any = GLContext
    return OffscreenBackend(f"MuJoCo's {os.environ.get('MUJOCO_GL') or 'default'} backend", backend)
