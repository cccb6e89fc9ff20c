"""Compiles models with MuJoCo in a sandboxed child process."""

import asyncio
import contextlib
import importlib.util
import json
import os
import shutil
import signal
import sys
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path

import msgspec

from device_agent.protocol.manifests.robot_type import RobotType
from function_app.ports.model_compiler import CompilerMissingError, ModelReport

CPU_S = 15
WALL_S = 30
MEMORY_MB = 1024
_NO_MUJOCO = 3
"""Exit code of the worker. Not imported from there, because the import would slow down a cold start."""
_CHILD = Path(__file__).with_name("worker.py")
_MISSING = "MuJoCo is not installed here; install the packages of requirements/local.txt, or run the checker elsewhere"
_TOO_LONG = f"The model takes MuJoCo more than {CPU_S} s. Simplify it."
_CRASHED = f"MuJoCo ended while it read the model, or needed more than {MEMORY_MB} MB of memory. Simplify it."


class MujocoCompiler:
    """``ModelCompiler`` with one child process and one temporary folder per model.

    Args:
        cpu_s: Maximum processor time per model [s].
        wall_s: Maximum elapsed time per model [s].
    """

    def __init__(self, *, cpu_s: int = CPU_S, wall_s: int = WALL_S) -> None:
        self._cpu_s = cpu_s
        self._wall_s = wall_s

    def require(self) -> None:
        if importlib.util.find_spec("mujoco") is None:
            raise CompilerMissingError(_MISSING)

    async def check(
        self, robot_type: RobotType, files: Mapping[str, bytes], missing: Sequence[str] = ()
    ) -> ModelReport:
        self.require()
        folder = await asyncio.to_thread(_write, files)
        try:
            code, output = await self._run(folder, self._task(robot_type, missing))
        finally:
            await asyncio.shield(asyncio.to_thread(shutil.rmtree, folder, ignore_errors=True))
        if code == _NO_MUJOCO:
            raise CompilerMissingError(_MISSING)
        if code in {-signal.SIGKILL, -signal.SIGXCPU, -signal.SIGALRM}:
            return ModelReport((_TOO_LONG,))
        try:
            return msgspec.json.decode(output, type=ModelReport) if code == 0 else ModelReport((_CRASHED,))
        except msgspec.DecodeError:
            return ModelReport((_CRASHED,))

    def _task(self, robot_type: RobotType, missing: Sequence[str]) -> bytes:
        manifest = msgspec.to_builtins(robot_type)
        names = ("type", "model", "scene", "joints", "frames", "home_rad")
        wheels = (manifest["simulation"] or {}).get("wheels") or {}
        limits = {"cpu_s": self._cpu_s, "wall_s": self._wall_s + 5, "memory_mb": MEMORY_MB}
        sides = [wheels[side] for side in ("left", "right") if side in wheels]
        return json.dumps(
            {**{name: manifest[name] for name in names}, "wheels": sides, "missing": missing, **limits}
        ).encode()

    async def _run(self, folder: Path, task: bytes) -> tuple[int, bytes]:
        process = await asyncio.create_subprocess_exec(
            sys.executable,
            "-I",
            "-B",
            str(_CHILD),
            stdin=asyncio.subprocess.PIPE,
            stdout=asyncio.subprocess.PIPE,
            stderr=asyncio.subprocess.DEVNULL,
            cwd=folder,
            env={"OPENBLAS_NUM_THREADS": "1", "LANG": "C.UTF-8"},
            start_new_session=True,
        )
        try:
            async with asyncio.timeout(self._wall_s):
                output, _ = await process.communicate(task)
        except TimeoutError:
            return -signal.SIGKILL, b""
        finally:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)
            await process.wait()
        return process.returncode or 0, output


def _write(files: Mapping[str, bytes]) -> Path:
    """A temporary folder with these files. Checks the names again, although the caller has validated them."""
    folder = Path(tempfile.mkdtemp(prefix="telescope-model-")).resolve()
    for name, content in files.items():
        path = (folder / name).resolve()
        if not path.is_relative_to(folder):
            shutil.rmtree(folder)
            raise ValueError(f"'{name}' is outside the folder")
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(content)
    return folder
