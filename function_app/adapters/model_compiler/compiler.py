"""Compiles models with MuJoCo in a sandboxed child process."""

import asyncio
import contextlib
import importlib.util
import json
import logging
import os
import shutil
import signal
import sys
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import msgspec

from device_agent.protocol.manifests.robot_type import RobotType
from function_app.ports.model_compiler import CompilerMissingError, ModelReport, UnconfinedError

CPU_S = 15
WALL_S = 30
MEMORY_MB = 1024
USER = 61_001
"""User and group of the child if the server runs as root: unused by accounts, and not that of scripts."""
_NO_MUJOCO, _UNCONFINED = 3, 4
"""Exit codes of the worker. Not imported from there, because the import would slow down a cold start."""
_CHILD = Path(__file__).with_name("worker.py")
_MISSING = "MuJoCo is not installed here; install the packages of requirements/local.txt, or run the checker elsewhere"
_REMEDY = (
    "Check models on Linux 5.13 or newer with Landlock and seccomp. If you trust every account, set "
    "TELESCOPE_ALLOW_UNCONFINED_MODELS=1."
)
_TOO_LONG = f"The model takes MuJoCo more than {CPU_S} s. Simplify it."
_CRASHED = f"MuJoCo ended while it read the model, or needed more than {MEMORY_MB} MB of memory. Simplify it."

_log = logging.getLogger(__name__)


class MujocoCompiler:
    """``ModelCompiler`` with one child process and one temporary folder per model.

    Args:
        allow_unconfined: Check models even if the machine cannot confine the child, with the layers that it has.
        cpu_s: Maximum processor time per model [s].
        wall_s: Maximum elapsed time per model [s].
    """

    def __init__(self, *, allow_unconfined: bool = False, cpu_s: int = CPU_S, wall_s: int = WALL_S) -> None:
        self._allow_unconfined = allow_unconfined
        self._cpu_s = cpu_s
        self._wall_s = wall_s

    async def require(self) -> None:
        _, output = await self._compile({}, {})
        if lacks := _lacks(output):
            _log.warning("uploaded models are checked with %s, as TELESCOPE_ALLOW_UNCONFINED_MODELS allows", lacks)

    async def check(
        self, robot_type: RobotType, files: Mapping[str, bytes], missing: Sequence[str] = ()
    ) -> ModelReport:
        code, output = await self._compile(_task(robot_type, missing), files)
        if code in {-signal.SIGKILL, -signal.SIGXCPU, -signal.SIGALRM}:
            return ModelReport((_TOO_LONG,))
        try:
            return msgspec.json.decode(output, type=ModelReport) if code == 0 else ModelReport((_CRASHED,))
        except msgspec.DecodeError:
            return ModelReport((_CRASHED,))

    async def _compile(self, task: Mapping[str, Any], files: Mapping[str, bytes]) -> tuple[int, bytes]:
        """Run a child process; returns its exit code and output.

        Raises:
            CompilerMissingError: There is no MuJoCo, or the child cannot be confined.
        """
        if importlib.util.find_spec("mujoco") is None:
            raise CompilerMissingError(_MISSING)
        limits = {"cpu_s": self._cpu_s, "wall_s": self._wall_s + 5, "memory_mb": MEMORY_MB}
        confinement = {"user": USER, "allow_unconfined": self._allow_unconfined}
        folder = await asyncio.to_thread(_write, files)
        try:
            code, output = await self._run(folder, json.dumps({**task, **limits, **confinement}).encode())
        finally:
            await asyncio.shield(asyncio.to_thread(shutil.rmtree, folder, ignore_errors=True))
        if code == _NO_MUJOCO:
            raise CompilerMissingError(_MISSING)
        if code == _UNCONFINED:
            raise UnconfinedError(
                f"this machine cannot confine the check of uploaded models: {_lacks(output)}. {_REMEDY}"
            )
        return code, output

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


def _task(robot_type: RobotType, missing: Sequence[str]) -> dict[str, Any]:
    manifest = msgspec.to_builtins(robot_type)
    names = ("type", "model", "scene", "joints", "frames", "home_rad")
    wheels = (manifest["simulation"] or {}).get("wheels") or {}
    sides = [wheels[side] for side in ("left", "right") if side in wheels]
    return {**{name: manifest[name] for name in names}, "wheels": sides, "missing": list(missing)}


def _lacks(output: bytes) -> str:
    """The layers that the child could not apply, with the reasons."""
    return ", ".join(f"no {layer} ({reason})" for layer, reason in json.loads(output)["missing"].items())


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
    if os.geteuid() == 0:
        for path in (folder, *folder.rglob("*")):
            os.chown(path, USER, USER)
    return folder
